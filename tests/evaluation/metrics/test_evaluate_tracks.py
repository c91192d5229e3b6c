import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.evaluate import evaluate

TRUTH = "1,1,0,0,10,20,1,-1,-1\n1,2,100,0,10,20,1,-1,-1\n2,1,0,0,10,20,1,-1,-1\n2,2,100,0,10,20,0,-1,-1\n"
FOUND = "1,7,0,0,10,20,1,-1,-1,-1\n1,8,100,0,10,20,1,-1,-1,-1\n2,8,0,0,10,20,1,-1,-1,-1\n2,7,100,0,10,20,1,-1,-1,-1\n"
DETECTED = "1,-1,0,0,10,20,0.9,-1,-1,-1\n"


def clip(tmp_path, truth=TRUTH, **files) -> tuple[Path, Path]:
    """The places of a truth file and of a result folder with these files, a __ for each dot."""
    (tmp_path / "gt.txt").write_text(truth)
    (tmp_path / "out").mkdir(exist_ok=True)
    for name, text in files.items():
        (tmp_path / "out" / name.replace("__", ".")).write_text(text)
    return tmp_path / "gt.txt", tmp_path / "out"


def test_tracks_of_a_folder_and_of_a_file_score_the_same(tmp_path):
    truth, out = clip(tmp_path, tracks__txt=FOUND)
    by_folder = evaluate(truth, out)["clips"]["out"]
    assert by_folder == evaluate(truth, out / "tracks.txt")["clips"]["tracks"]
    assert set(by_folder) == {"frames", "tracks"}
    assert by_folder["frames"] == 2
    assert by_folder["tracks"]["n_switches"] == 1
    assert (by_folder["tracks"]["n_fp"], by_folder["tracks"]["n_true"], by_folder["tracks"]["n_found"]) == (1, 2, 2)
    assert by_folder["tracks"]["mota"] == pytest.approx(1 - 2 / 3)


def test_rows_marked_zero_may_take_the_boxes_on_them_along(tmp_path):
    found = evaluate(*clip(tmp_path, tracks__txt=FOUND), ignoring="removed")["clips"]["out"]["tracks"]
    assert (found["n_fp"], found["precision"]) == (0, 1)


def test_detections_and_tracks_are_both_scored(tmp_path):
    report = evaluate(*clip(tmp_path, tracks__txt=FOUND, detections__txt=DETECTED))["clips"]["out"]
    assert (report["boxes"]["n_hit"], report["tracks"]["n_tp"]) == (1, 3)


@pytest.mark.parametrize("place", [".", "detections.txt"])
def test_a_result_without_identities_is_scored_by_its_boxes(tmp_path, place):
    truth, out = clip(tmp_path, detections__txt=DETECTED)
    (scored,) = evaluate(truth, out / place)["clips"].values()
    assert set(scored) == {"frames", "boxes"}
    assert (scored["boxes"]["n_hit"], scored["boxes"]["n_missed"]) == (1, 2)


def test_tracks_against_a_truth_without_identities_are_scored_by_their_boxes(tmp_path):
    boxes = evaluate(*clip(tmp_path, DETECTED, tracks__txt=FOUND))["clips"]["out"]["boxes"]
    assert (boxes["n_hit"], boxes["n_false"]) == (1, 1)


def test_an_interval_scores_frames_that_far_apart(tmp_path):
    truth, out = clip(tmp_path, tracks__txt=FOUND, detections__txt=DETECTED)
    scored = evaluate(truth, out, interval=2)["clips"]["out"]
    assert (scored["frames"], scored["tracks"]["n_tp"], scored["boxes"]["n_missed"]) == (1, 2, 1)
    assert scored["tracks"]["hota"] == pytest.approx(1)
    with pytest.raises(InputError, match="interval must be at least 1 frame, got 0"):
        evaluate(truth, out, interval=0)


def test_tracks_of_every_fifth_frame_alone_are_remarked(tmp_path):
    truth = "".join(f"{f},1,0,0,10,20,1,-1,-1\n" for f in range(1, 12))
    found = "".join(f"{f},1,0,0,10,20,1,-1,-1,-1\n" for f in (1, 6, 11))
    places = clip(tmp_path, truth, tracks__txt=found)
    report = evaluate(*places)
    assert report["clips"]["out"]["tracks"]["recall"] == pytest.approx(3 / 11)
    assert "every 5th frame alone" in report["notes"][0]
    report = evaluate(*places, interval=5)
    assert (report["clips"]["out"]["tracks"]["recall"], report["notes"]) == (1, [])


def test_a_box_in_a_frame_without_truth_is_false_up_to_the_end_of_the_clip(tmp_path):
    truth, out = clip(tmp_path, tracks__txt=FOUND + "4,7,0,0,10,20,1,-1,-1,-1\n9,7,0,0,10,20,1,-1,-1,-1\n")
    report = evaluate(truth, out)
    assert report["clips"]["out"]["tracks"]["n_fp"] == 1
    assert report["notes"] == ["out: tracks go to frame 9, the truth to 2; no more counts"]
    (tmp_path / "seqinfo.ini").write_text("[Sequence]\nseqLength=5\n")
    scored = evaluate(truth, out)["clips"]["out"]
    assert (scored["frames"], scored["tracks"]["n_fp"]) == (5, 2)


def test_an_interrupted_run_is_scored_as_far_as_it_looked(tmp_path):
    record = {"state": "interrupted", "frames": {"written": 2}, "outputs": ["tables"], "interval_frames": 2}
    truth = "".join(f"{f},1,0,0,10,20,1,-1,-1\n" for f in range(1, 9))
    found = "".join(f"{f},1,0,0,10,20,1,-1,-1,-1\n" for f in (1, 3))
    report = evaluate(*clip(tmp_path, truth, tracks__txt=found, run__json=json.dumps(record)), interval=2)
    assert report["clips"]["out"]["frames"] == 2
    assert report["clips"]["out"]["tracks"]["recall"] == 1
    assert "interrupted after frame 3" in report["notes"][0]


def test_a_run_that_begins_late_is_scored_up_to_the_last_frame_that_it_names(tmp_path):
    record = {"state": "complete", "frames": {"written": 60}, "outputs": ["tables"], "interval_frames": 1}
    rows = "".join(f"{f},-1,0,0,10,20,1,-1,-1\n" for f in range(500, 560))
    places = clip(tmp_path, rows, tracks__txt=rows.replace(",-1,0", ",1,0"), run__json=json.dumps(record))
    with pytest.raises(InputError, match="share no frame"):
        evaluate(*places)
    clip(tmp_path, rows, run__json=json.dumps(record | {"first_frame": 500, "last_frame": 559}))
    scored = evaluate(*places)["clips"]["out"]
    assert (scored["frames"], scored["boxes"]["n_hit"]) == (60, 60)


def test_no_tracks_at_all_are_zero_and_not_an_error(tmp_path):
    scored = evaluate(*clip(tmp_path, tracks__txt=""))["clips"]["out"]["tracks"]
    assert (scored["hota"], scored["idf1"], scored["n_fn"]) == (0, 0, 3)
    assert math.isnan(scored["ar_2"])


def test_the_one_labelled_target_is_followed_without_masks(tmp_path):
    truth = "0,0,10,20\nnan,nan,nan,nan\n0,0,10,20\n"
    found = "1,3,0,0,10,20,1\n1,4,50,50,5,5,1\n3,5,0,0,10,20,1\n"
    scored = evaluate(*clip(tmp_path, truth, tracks__txt=found))["clips"]["out"]
    assert set(scored) == {"frames", "target_track"}
    assert scored["target_track"] == pytest.approx(
        {"found": 1, "same_identity": 0.5, "n_frames": 2, "n_found": 2, "n_switches": 1}
        | {"n_fragmentations": scored["target_track"]["n_fragmentations"], "n_same": 1}
    )


def test_masks_score_what_they_can_and_say_what_not(tmp_path):
    mask = np.zeros((30, 40), np.uint8)
    mask[5:15, 10:20] = 1
    _, out = clip(tmp_path, tracks__txt="1,3,10,5,10,10,1\n")
    for folder in (tmp_path / "truth", out / "masks"):
        folder.mkdir()
        cv2.imwrite(str(folder / "000001.png"), mask)
    report = evaluate(tmp_path / "truth", out)
    assert (report["clips"]["out"]["pixels"]["f"], report["clips"]["out"]["boxes"]["f1"]) == (1, 1)
    assert report["notes"] == ["out: tracks are not scored, for masks do not tell identities"]


def test_clips_are_paired_by_name_with_folders_or_files_and_pooled_by_counts(tmp_path):
    for name in "ab":
        (tmp_path / "truth" / name / "gt").mkdir(parents=True)
        (tmp_path / "truth" / name / "gt/gt.txt").write_text(TRUTH)
    (tmp_path / "found/b").mkdir(parents=True)
    (tmp_path / "found/a.txt").write_text(FOUND)
    (tmp_path / "found/b/tracks.txt").write_text(FOUND + "2,9,300,0,10,20,1,-1,-1,-1\n")
    report = evaluate(tmp_path / "truth", tmp_path / "found")
    assert set(report["clips"]) == {"a", "b"}
    assert report["pooled"]["tracks"]["n_fp"] == 3
    assert report["pooled"]["tracks"]["precision"] == pytest.approx(6 / 9)
    assert report["mean"]["tracks"]["precision"] == pytest.approx((3 / 4 + 3 / 5) / 2)
    assert report["mean"]["tracks"]["worst_idf1"] == min(c["tracks"]["idf1"] for c in report["clips"].values())


@pytest.mark.parametrize(
    ("found", "says"),
    [
        ("1,7,0,0,10,20,1\n1,7,5,5,10,20,1\n", r"tracks\.txt, lines 1 and 2: identity 7 twice in frame 1"),
        ("1,7.5,0,0,10,20,1\n", r"tracks\.txt, line 1: id is '7\.5'; wanted a whole number"),
        ("1,7,0,0,10,20,1\n\n2,nan,0,0,10,20,1\n", r"tracks\.txt, line 3: id is 'nan'; wanted a finite number"),
        ("1,7,0,inf,10,20,1\n", r"line 1: y is 'inf'; wanted a finite number"),
        ("1,7,0,,10,20,1\n", r"line 1: y is ''; wanted a finite number"),
        ("1,7,0,1_0,10,20,1\n", r"line 1: y is '1_0'; wanted a finite number"),
        ("0,7,0,0,10,20,1\n", r"line 1: frame is '0'; frames count from 1"),
        ("1.5,7,0,0,10,20,1\n", r"line 1: frame is '1\.5'; wanted a whole number"),
        ("1,7,0,0,-10,20,1\n", r"line 1: the box is -10×20 pixels; wanted more than 0"),
        ("1,7,0,0\n", r"line 1: 4 columns; wanted frame,id,x,y,w,h"),
        ("frame,id,x,y,w,h\n", r"line 1: frame is 'frame'"),
        ("1,-1,0,0,10,20,1\n1,3,0,0,10,20,1\n", r"line 1: identity -1 means none, but other rows have one"),
        ("101,7,0,0,10,20,1\n", r"share no frame: truth 1 to 2, result 101 to 101"),
    ],
)
def test_a_mistake_in_tracks_is_told_with_file_and_line(tmp_path, found, says):
    with pytest.raises(InputError, match=says):
        evaluate(*clip(tmp_path, tracks__txt=found))


@pytest.mark.parametrize(
    ("truth", "says"),
    [
        (TRUTH + "2,1,9,9,10,20,1,-1,-1\n", r"gt\.txt, lines 3 and 5: identity 1 twice in frame 2"),
        (TRUTH + "2,x,9,9,10,20,1,-1,-1\n", r"truth .*gt\.txt, line 5: id is 'x'"),
        ("2,1,0,0,10,20,1,-1,-1\n4,1,0,0,10,20,1,-1,-1\n", r"gt\.txt has no box of every 5th"),
    ],
)
def test_a_mistake_in_the_truth_is_told_with_file_and_line(tmp_path, truth, says):
    with pytest.raises(InputError, match=says):
        evaluate(*clip(tmp_path, truth, tracks__txt=FOUND), interval=5)


def test_a_seqinfo_without_a_length_is_named(tmp_path):
    places = clip(tmp_path, tracks__txt=FOUND)
    (tmp_path / "seqinfo.ini").write_text("[Sequence]\nname=x\n")
    with pytest.raises(InputError, match=r"seqinfo\.ini does not hold seqLength"):
        evaluate(*places)
