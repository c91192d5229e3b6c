"""`evaluate` on files: masks, boxes and tracks of one clip or many; a mistake is one line with file and line."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.io.track_files import write_tracks
from torchvision_dddas.lab.evaluation.evaluate import evaluate

NOTHING = np.zeros((30, 40), np.uint8)
SQUARE, HALF = NOTHING.copy(), NOTHING.copy()
SQUARE[5:15, 10:20] = HALF[5:10, 10:20] = 1


def write_masks(folder, masks):
    folder.mkdir(parents=True, exist_ok=True)
    for name, mask in masks.items():
        cv2.imwrite(str(folder / f"{name}.png"), mask)


def write_result(folder, masks, state="complete"):
    write_masks(folder / "masks", {f"{n:06d}": mask for n, mask in enumerate(masks, 1)})
    boxes = [(n, *cv2.boundingRect(mask)) for n, mask in enumerate(masks, 1) if mask.any()]
    (folder / "detections.txt").write_text("".join(f"{n},-1,{x},{y},{w},{h},0.9,-1,-1,-1\n" for n, x, y, w, h in boxes))
    record = {"state": state, "frames": {"written": len(masks)}, "outputs": ["tables", "masks"]}
    (folder / "run.json").write_text(json.dumps(record))
    return folder


@pytest.mark.parametrize("names", [("00000", "00002"), ("000001", "000003")])
def test_masks_of_some_frames_are_scored_whether_numbered_from_0_or_1(tmp_path, names):
    write_masks(tmp_path / "truth", dict.fromkeys(names, SQUARE))
    clip = evaluate(tmp_path / "truth", write_result(tmp_path / "out", [SQUARE, NOTHING, HALF]))["clips"]["out"]
    assert clip["frames"] == 2
    assert (clip["pixels"]["recall"], clip["pixels"]["precision"], clip["pixels"]["n_tp"]) == (0.75, 1, 150)
    assert clip["boxes"]["f1"] == 1


def test_first_frame_shifts_the_truth(tmp_path):
    write_masks(tmp_path / "truth", {"0101": SQUARE})
    result = write_result(tmp_path / "out", [NOTHING, SQUARE])
    assert evaluate(tmp_path / "truth", result, first_frame=100)["clips"]["out"]["pixels"]["f"] == 1
    with pytest.raises(InputError, match="share no frame: truth 101 to 101, result 1 to 2"):
        evaluate(tmp_path / "truth", result)
    with pytest.raises(InputError, match="below the first frame, 102"):
        evaluate(tmp_path / "truth", result, first_frame=102)


def test_colours_of_a_palette_are_labels_and_f_is_undefined_where_nothing_moves(tmp_path):
    coloured = np.zeros((30, 40, 3), np.uint8)
    coloured[5:15, 0:10] = (0, 0, 128)
    coloured[5:15, 10:20] = (0, 128, 0)
    write_masks(tmp_path / "truth", {"00000": coloured})
    result = write_result(tmp_path / "out", [SQUARE])
    assert evaluate(tmp_path / "truth", result)["clips"]["out"]["boxes"]["n_missed"] == 1
    write_masks(tmp_path / "truth", {"00000": NOTHING})
    found = evaluate(tmp_path / "truth", write_result(tmp_path / "out", [NOTHING]))["clips"]["out"]["pixels"]
    assert math.isnan(found["f"]) and found["specificity"] == 1


def test_many_clips_are_pooled_and_averaged(tmp_path):
    write_masks(tmp_path / "truth/a/masks", {"00000": SQUARE})
    write_masks(tmp_path / "truth/b/masks", {"00000": SQUARE, "00001": SQUARE})
    write_masks(tmp_path / "truth/c", {"00000": SQUARE})
    (tmp_path / "truth/d").mkdir()
    for name, masks in (("a", [SQUARE]), ("b", [NOTHING, HALF]), ("d", [SQUARE])):
        write_result(tmp_path / "out" / name, masks)
    report = evaluate(tmp_path / "truth", tmp_path / "out")
    assert set(report["clips"]) == {"a", "b"}
    assert report["pooled"]["pixels"]["recall"] == pytest.approx(150 / 300)
    assert report["mean"]["pixels"]["recall"] == pytest.approx((1 + 0.25) / 2)
    assert report["mean"]["pixels"]["worst_f"] == pytest.approx(100 / 250)
    assert sorted(report["notes"]) == ["c: no result, not scored", "d: no truth, not scored"]


def test_masks_of_an_interrupted_run_are_scored_as_far_as_they_go(tmp_path):
    write_masks(tmp_path / "truth", {"00000": SQUARE, "00001": SQUARE})
    report = evaluate(tmp_path / "truth", write_result(tmp_path / "out", [SQUARE], state="interrupted"))
    assert report["clips"]["out"]["frames"] == 1
    assert "interrupted after frame 1" in report["notes"][0]


@pytest.mark.parametrize(
    ("labelled", "line"),
    [
        ({"00000": SQUARE[:20]}, r"frame 1: the truth is 40×20 .* the result 40×30"),
        ({"00000": SQUARE, "00009": SQUARE}, r"has 2 frames, but .* labels frame 10"),
        ({"00000": SQUARE, "00001": SQUARE}, r"000002\.png is missing"),
        ({}, r"00000\.png cannot be read as a picture"),
    ],
)
def test_masks_that_do_not_fit_are_named(tmp_path, labelled, line):
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth/00000.png").write_bytes(b"no picture")
    write_masks(tmp_path / "truth", labelled)
    result = write_result(tmp_path / "out", [SQUARE, SQUARE])
    (result / "masks/000002.png").unlink()
    with pytest.raises(InputError, match=line):
        evaluate(tmp_path / "truth", result)


@pytest.mark.parametrize(
    ("truth", "result", "line"),
    [
        ("empty", "out", "holds no truth"),
        ("nowhere", "out", "no truth at"),
        ("empty", "empty", "no clip to score"),
        ("truth", "empty", r"not a result of dddas detect or dddas track: it holds neither detections\.txt"),
    ],
)
def test_empty_and_missing_places_are_refused(tmp_path, truth, result, line):
    (tmp_path / "empty").mkdir()
    write_masks(tmp_path / "truth", {"00000": SQUARE})
    write_result(tmp_path / "out", [SQUARE])
    with pytest.raises(InputError, match=line):
        evaluate(tmp_path / truth, tmp_path / result)


# -- tracks ------------------------------------------------------------------------------------------------------------

BOX = "0,0,10,20,1,-1,-1"
TRUTH = "1,1,0,0,10,20,1,-1,-1\n1,2,100,0,10,20,1,-1,-1\n2,1,0,0,10,20,1,-1,-1\n2,2,100,0,10,20,0,-1,-1\n"
FOUND = "1,7,0,0,10,20,1,-1,-1,-1\n1,8,100,0,10,20,1,-1,-1,-1\n2,8,0,0,10,20,1,-1,-1,-1\n2,7,100,0,10,20,1,-1,-1,-1\n"
DETECTED = "1,-1,0,0,10,20,0.9,-1,-1,-1\n"


def clip(tmp_path, truth=TRUTH, **files) -> tuple[Path, Path]:
    """The places of a truth file and of a result folder with these files, a __ for each dot."""
    (tmp_path / "out").mkdir(parents=True, exist_ok=True)
    (tmp_path / "gt.txt").write_text(truth)
    for name, text in files.items():
        (tmp_path / "out" / name.replace("__", ".")).write_text(text)
    return tmp_path / "gt.txt", tmp_path / "out"


def rows(frames, identity=1):
    """One box in each frame."""
    return "".join(f"{frame},{identity},{BOX}\n" for frame in frames)


def test_tracks_of_a_folder_and_of_a_file_score_the_same(tmp_path):
    truth, out = clip(tmp_path, tracks__txt=FOUND)
    by_folder = evaluate(truth, out)["clips"]["out"]
    assert by_folder == evaluate(truth, out / "tracks.txt")["clips"]["tracks"]
    assert set(by_folder) == {"frames", "tracks"} and by_folder["frames"] == 2
    tracks = by_folder["tracks"]
    assert [tracks[name] for name in ("n_switches", "n_fp", "n_true", "n_found")] == [1, 1, 2, 2]
    assert tracks["mota"] == pytest.approx(1 - 2 / 3)
    found = evaluate(truth, out, ignoring="removed")["clips"]["out"]["tracks"]  # with the boxes on rows marked 0
    assert (found["n_fp"], found["precision"]) == (0, 1)
    report = evaluate(*clip(tmp_path, tracks__txt=FOUND, detections__txt=DETECTED))["clips"]["out"]
    assert (report["boxes"]["n_hit"], report["tracks"]["n_tp"]) == (1, 3)


@pytest.mark.parametrize("place", [".", "detections.txt"])
def test_a_result_without_identities_is_scored_by_its_boxes(tmp_path, place):
    truth, out = clip(tmp_path, detections__txt=DETECTED)
    (scored,) = evaluate(truth, out / place)["clips"].values()
    assert set(scored) == {"frames", "boxes"}
    assert (scored["boxes"]["n_hit"], scored["boxes"]["n_missed"]) == (1, 2)
    (out / "detections.txt").unlink()
    boxes = evaluate(*clip(tmp_path, DETECTED, tracks__txt=FOUND))["clips"]["out"]["boxes"]
    assert (boxes["n_hit"], boxes["n_false"]) == (1, 1)


def test_an_interval_scores_every_nth_frame_and_is_advised_where_tracks_have_no_others(tmp_path):
    truth, out = clip(tmp_path, tracks__txt=FOUND, detections__txt=DETECTED)
    scored = evaluate(truth, out, interval=2)["clips"]["out"]
    assert (scored["frames"], scored["tracks"]["n_tp"], scored["boxes"]["n_missed"]) == (1, 2, 1)
    assert scored["tracks"]["hota"] == pytest.approx(1)
    with pytest.raises(InputError, match="interval must be at least 1 frame, got 0"):
        evaluate(truth, out, interval=0)
    (out / "detections.txt").unlink()
    clip(tmp_path, rows(range(1, 12)), tracks__txt=rows((1, 6, 11)))
    report = evaluate(truth, out)
    assert report["clips"]["out"]["tracks"]["recall"] == pytest.approx(3 / 11)
    assert "only every 5th frame" in report["notes"][0]
    report = evaluate(truth, out, interval=5)
    assert (report["clips"]["out"]["tracks"]["recall"], report["notes"]) == (1, [])


def test_a_box_in_a_frame_without_truth_is_false_up_to_the_end_of_the_clip(tmp_path):
    truth, out = clip(tmp_path, tracks__txt=FOUND + rows((4, 9), 7))
    report = evaluate(truth, out)
    assert report["clips"]["out"]["tracks"]["n_fp"] == 1
    assert report["notes"] == ["out: tracks end at frame 9, the truth at 2; later frames are not scored"]
    (tmp_path / "seqinfo.ini").write_text("[Sequence]\nseqLength=5\n")
    scored = evaluate(truth, out)["clips"]["out"]
    assert (scored["frames"], scored["tracks"]["n_fp"]) == (5, 2)


def test_an_interrupted_or_late_run_is_scored_on_the_frames_of_its_record(tmp_path):
    record = {"state": "interrupted", "frames": {"written": 2}, "outputs": ["tables"], "interval_frames": 2}
    places = clip(tmp_path, rows(range(1, 9)), tracks__txt=rows((1, 3)), run__json=json.dumps(record))
    report = evaluate(*places, interval=2)
    assert (report["clips"]["out"]["frames"], report["clips"]["out"]["tracks"]["recall"]) == (2, 1)
    assert "interrupted after frame 3" in report["notes"][0]
    late, record = range(500, 560), {"state": "complete", "frames": {"written": 60}, "outputs": ["tables"]}
    clip(tmp_path, rows(late, -1), tracks__txt=rows(late), run__json=json.dumps(record))
    with pytest.raises(InputError, match="share no frame"):
        evaluate(*places)
    clip(tmp_path, rows(late, -1), run__json=json.dumps(record | {"first_frame": 500, "last_frame": 559}))
    scored = evaluate(*places)["clips"]["out"]
    assert (scored["frames"], scored["boxes"]["n_hit"]) == (60, 60)


def test_one_labelled_target_is_scored_by_masks_or_tracks(tmp_path):
    (tmp_path / "boxes.txt").write_text("10,5,10,10\n10,5,10,10\nnan,nan,nan,nan\n10,5,10,10\n")
    report = evaluate(tmp_path / "boxes.txt", write_result(tmp_path / "masks", [SQUARE, NOTHING, SQUARE]))
    target = report["clips"]["masks"]["target"]
    assert (target["hit"], target["other_blobs_per_frame"]) == (0.5, 0)
    assert report["notes"] == ["masks: truth ends at frame 4, the result at 3; the rest is not scored"]
    found = "1,3,0,0,10,20,1\n1,4,50,50,5,5,1\n3,5,0,0,10,20,1\n"
    scored = evaluate(*clip(tmp_path, "0,0,10,20\nnan,nan,nan,nan\n0,0,10,20\n", tracks__txt=found))["clips"]["out"]
    assert set(scored) == {"frames", "target_track"}
    assert (scored["target_track"]["found"], scored["target_track"]["same_identity"]) == (1, 0.5)


def test_masks_do_not_score_tracks_and_a_note_says_so(tmp_path):
    write_masks(tmp_path / "truth", {"000001": SQUARE})
    out = write_result(tmp_path / "out", [SQUARE])
    (out / "tracks.txt").write_text("1,3,10,5,10,10,1\n")
    for name in ("detections.txt", "run.json"):  # as another program leaves it
        (out / name).unlink()
    report = evaluate(tmp_path / "truth", out)
    assert (report["clips"]["out"]["pixels"]["f"], report["clips"]["out"]["boxes"]["f1"]) == (1, 1)
    assert report["notes"] == ["out: tracks are not scored, because masks hold no identities"]


def test_a_folder_with_the_csv_of_a_run_alone_is_a_result(tmp_path):
    header, found = "frame,identity,x_px,y_px,width_px,height_px\n", FOUND.replace(",1,-1,-1,-1\n", "\n")
    for name in "ab":
        clip(tmp_path / "gt" / name), (tmp_path / "ours" / name).mkdir(parents=True)
        (tmp_path / "ours" / name / "tracks.csv").write_text(header + found)
    (tmp_path / "ours" / "b" / "detections.csv").write_text(header + found)
    scored = evaluate(tmp_path / "gt", tmp_path / "ours")["clips"]
    assert [clip["tracks"]["n_tp"] for clip in scored.values()] == [3, 3]
    assert scored["b"]["boxes"]["n_hit"] == 3


@pytest.mark.parametrize("name", ["gt.json", "gt.xml", "gt.csv"])
def test_true_boxes_in_other_formats_score_as_text_does(tmp_path, name):
    text, out = clip(tmp_path, TRUTH[: TRUTH.rindex("2,2")], tracks__txt=FOUND, detections__txt=DETECTED)
    write_tracks(read_detections(text), tmp_path / name, size=(200, 40))
    wanted, found = (evaluate(truth, out)["clips"]["out"] for truth in (text, tmp_path / name))
    assert found == wanted and found["tracks"]["n_tp"] == 3


def test_true_boxes_of_results_name_their_assumptions_and_an_empty_file_is_refused(tmp_path):
    _, out = clip(tmp_path, detections__txt=DETECTED)
    for boxes in ([], [{"image_id": 1, "bbox": [0, 0, 10, 20]}]):
        (tmp_path / "gt.json").write_text(json.dumps(boxes))
        if not boxes:
            with pytest.raises(InputError, match=r"gt\.json holds no boxes; wanted the true boxes"):
                evaluate(tmp_path / "gt.json", out)
    report = evaluate(tmp_path / "gt.json", out)
    assert report["clips"]["out"]["boxes"]["n_hit"] == 1
    assert report["notes"][0].startswith("the truth of out: the file lists no images")


def test_tracks_of_clips_are_paired_by_name_with_folders_or_files_and_pooled_by_counts(tmp_path):
    for name in "ab":
        (tmp_path / "truth" / name / "gt").mkdir(parents=True)
        (tmp_path / "truth" / name / "gt/gt.txt").write_text(TRUTH)
    (tmp_path / "found/b").mkdir(parents=True)
    (tmp_path / "found/a.txt").write_text("")
    (tmp_path / "found/b/tracks.txt").write_text(FOUND)
    report = evaluate(tmp_path / "truth", tmp_path / "found")
    assert [report["clips"][name]["tracks"]["hota"] > 0 for name in "ab"] == [False, True]
    assert report["pooled"]["tracks"]["recall"] == report["mean"]["tracks"]["recall"] == pytest.approx(1 / 2)


@pytest.mark.parametrize(
    ("truth", "found", "line"),
    [
        (TRUTH, rows((1, 1), 7), r"tracks\.txt, lines 1 and 2: identity 7 twice in frame 1"),
        (TRUTH, rows([1], 7.5), r"tracks\.txt, line 1: identity is '7\.5'; wanted a whole number"),
        (
            TRUTH,
            rows([1], 7) + "\n2,nan,0,0,10,20,1\n",
            r"tracks\.txt, line 3: identity is 'nan'; wanted a whole number",
        ),
        (TRUTH, "1,7,0,inf,10,20,1\n", r"line 1: y is 'inf'; wanted a number"),
        (TRUTH, "1,7,0,1_0,10,20,1\n", r"line 1: y is '1_0'; wanted a number"),
        (TRUTH, rows([0], 7), r"line 1: frame is '0'; wanted a whole number, 1 to"),
        (TRUTH, rows([1.5], 7), r"line 1: frame is '1\.5'; wanted a whole number"),
        (TRUTH, "1,7,0,0,-10,20,1\n", r"line 1: the box is -10×20 pixels; wanted more than 0"),
        (TRUTH, "1,7,0,0\n", r"line 1: 4 columns; wanted frame,identity,x,y,width,height"),
        (TRUTH, "frame,id,x,y,w,h\n", r"line 1: frame is 'frame'"),
        (
            TRUTH,
            rows([1], -1) + rows([1], 3),
            r"line 1 has no identity \(-1 or nothing\), but other lines have an identity",
        ),
        (TRUTH, rows([101], 7), r"share no frame: truth 1 to 2, result 101 to 101"),
        (TRUTH + rows([2]), FOUND, r"gt\.txt, lines 3 and 5: identity 1 twice in frame 2"),
        (TRUTH + rows([2], "x"), FOUND, r"truth .*gt\.txt, line 5: identity is 'x'"),
        ("1,2,3,4\n1,2", FOUND, "not a table"),
    ],
)
def test_a_mistake_in_a_table_is_one_line_with_file_and_line(tmp_path, truth, found, line):
    with pytest.raises(InputError, match=line):
        evaluate(*clip(tmp_path, truth, tracks__txt=found))


def test_a_box_without_identity_among_others_is_named_in_each_format(tmp_path):
    truth, _ = clip(tmp_path)
    (tmp_path / "a.csv").write_text("frame,identity,x_px,y_px,width_px,height_px\n1,7,0,0,10,20\n1,,50,0,10,20\n")
    with pytest.raises(InputError, match=r"a\.csv, line 3 has no identity \(-1 or nothing\), but other lines have"):
        evaluate(truth, tmp_path / "a.csv")
    boxes = [{"image_id": 1, "bbox": [50 * k, 0, 9, 9], **({"track_id": 7} if k else {})} for k in range(3)]
    (tmp_path / "a.json").write_text(json.dumps(boxes))
    with pytest.raises(InputError, match=r"a\.json, box 1 has no identity \(-1 or nothing\), but other boxes have"):
        evaluate(truth, tmp_path / "a.json")
    (tmp_path / "a.json").write_text(json.dumps(boxes[1:]))
    with pytest.raises(InputError, match=r"a\.json, boxes 1 and 2: identity 7 twice in frame 1"):
        evaluate(truth, tmp_path / "a.json")


def test_truth_without_the_asked_frames_or_a_length_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"gt\.txt has no box of every 5th"):
        evaluate(*clip(tmp_path, rows((2, 4)), tracks__txt=FOUND), interval=5)
    (tmp_path / "seqinfo.ini").write_text("[Sequence]\nname=x\n")
    with pytest.raises(InputError, match=r"seqinfo\.ini does not hold seqLength"):
        evaluate(*clip(tmp_path, tracks__txt=FOUND))
