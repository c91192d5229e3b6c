import json
import math

import cv2
import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.evaluate import evaluate

SQUARE = np.zeros((30, 40), np.uint8)
SQUARE[5:15, 10:20] = 1
HALF = np.zeros((30, 40), np.uint8)
HALF[5:10, 10:20] = 1
NOTHING = np.zeros((30, 40), np.uint8)


def write_masks(folder, masks):
    folder.mkdir(parents=True, exist_ok=True)
    for name, mask in masks.items():
        cv2.imwrite(str(folder / f"{name}.png"), mask)


def write_result(folder, masks, state="complete"):
    write_masks(folder / "masks", {f"{i + 1:06d}": m for i, m in enumerate(masks)})
    lines = []
    for i, mask in enumerate(masks):
        if mask.any():
            lines.append(f"{i + 1},-1,{','.join(map(str, cv2.boundingRect(mask)))},0.9,-1,-1,-1")
    (folder / "detections.txt").write_text("\n".join(lines))
    record = {"state": state, "frames": {"written": len(masks)}, "outputs": ["tables", "masks"]}
    (folder / "run.json").write_text(json.dumps(record))
    return folder


@pytest.mark.parametrize("names", [("00000", "00002"), ("000001", "000003")])
def test_masks_of_some_frames_are_scored_whether_numbered_from_0_or_1(tmp_path, names):
    write_masks(tmp_path / "truth", {names[0]: SQUARE, names[1]: SQUARE})
    clip = evaluate(tmp_path / "truth", write_result(tmp_path / "out", [SQUARE, NOTHING, HALF]))["clips"]["out"]
    assert clip["frames"] == 2
    assert clip["pixels"]["recall"] == pytest.approx(0.75)
    assert clip["pixels"]["precision"] == 1
    assert clip["boxes"]["f1"] == 1
    assert clip["pixels"]["n_tp"] == 150


def test_first_frame_shifts_the_truth(tmp_path):
    write_masks(tmp_path / "truth", {"0101": SQUARE})
    result = write_result(tmp_path / "out", [NOTHING, SQUARE])
    assert evaluate(tmp_path / "truth", result, first_frame=100)["clips"]["out"]["pixels"]["f"] == 1
    with pytest.raises(InputError, match="share no frame: truth 101 to 101, result 1 to 2"):
        evaluate(tmp_path / "truth", result)
    with pytest.raises(InputError, match="below the first frame, 102"):
        evaluate(tmp_path / "truth", result, first_frame=102)


def test_colours_of_a_palette_are_labels(tmp_path):
    coloured = np.zeros((30, 40, 3), np.uint8)
    coloured[5:15, 0:10] = (0, 0, 128)
    coloured[5:15, 10:20] = (0, 128, 0)
    write_masks(tmp_path / "truth", {"00000": coloured})
    assert (
        evaluate(tmp_path / "truth", write_result(tmp_path / "out", [SQUARE]))["clips"]["out"]["boxes"]["n_missed"] == 1
    )


def test_one_labelled_target(tmp_path):
    (tmp_path / "boxes.txt").write_text("10,5,10,10\n10,5,10,10\nnan,nan,nan,nan\n10,5,10,10\n")
    report = evaluate(tmp_path / "boxes.txt", write_result(tmp_path / "out", [SQUARE, NOTHING, SQUARE]))
    assert report["clips"]["out"]["target"]["hit"] == 0.5
    assert report["clips"]["out"]["target"]["other_blobs_per_frame"] == 0
    assert report["notes"] == ["out: truth goes to frame 4, the result to 3; the rest is not scored"]


def test_motchallenge_truth_and_its_boxes_that_do_not_count(tmp_path):
    (tmp_path / "gt.txt").write_text("1,1,10,5,10,10,1,-1,-1\n1,2,0,0,5,5,0,-1,-1\n2,1,30,5,5,5,1,-1,-1\n")
    clip = evaluate(tmp_path / "gt.txt", write_result(tmp_path / "out", [SQUARE, NOTHING]))["clips"]["out"]
    assert (clip["boxes"]["n_hit"], clip["boxes"]["n_false"], clip["boxes"]["n_missed"]) == (1, 0, 1)


def test_many_clips_are_pooled_and_averaged(tmp_path):
    write_masks(tmp_path / "truth/a/masks", {"00000": SQUARE})
    write_masks(tmp_path / "truth/b/masks", {"00000": SQUARE, "00001": SQUARE})
    write_masks(tmp_path / "truth/c", {"00000": SQUARE})
    (tmp_path / "truth/d").mkdir()
    write_result(tmp_path / "out/a", [SQUARE])
    write_result(tmp_path / "out/b", [NOTHING, HALF])
    write_result(tmp_path / "out/d", [SQUARE])
    report = evaluate(tmp_path / "truth", tmp_path / "out")
    assert set(report["clips"]) == {"a", "b"}
    assert report["pooled"]["pixels"]["recall"] == pytest.approx(150 / 300)
    assert report["mean"]["pixels"]["recall"] == pytest.approx((1 + 0.25) / 2)
    assert report["mean"]["pixels"]["worst_f"] == pytest.approx(100 / 250)
    assert sorted(report["notes"]) == ["c: no result, not scored", "d: no truth, not scored"]


def test_a_truth_where_nothing_moves_leaves_f_undefined_and_counts_false_boxes(tmp_path):
    write_masks(tmp_path / "truth", {"00000": NOTHING})
    clip = evaluate(tmp_path / "truth", write_result(tmp_path / "out", [NOTHING]))["clips"]["out"]
    assert math.isnan(clip["pixels"]["f"])
    assert clip["pixels"]["specificity"] == 1


def test_an_interrupted_run_is_scored_as_far_as_it_goes_and_said_so(tmp_path):
    write_masks(tmp_path / "truth", {"00000": SQUARE, "00001": SQUARE})
    report = evaluate(tmp_path / "truth", write_result(tmp_path / "out", [SQUARE], state="interrupted"))
    assert report["clips"]["out"]["frames"] == 1
    assert "interrupted after frame 1" in report["notes"][0]


def test_masks_of_another_size_are_named_with_both_sizes(tmp_path):
    write_masks(tmp_path / "truth", {"00000": SQUARE[:20]})
    with pytest.raises(InputError, match=r"frame 1: the truth is 40×20 .* the result 40×30"):
        evaluate(tmp_path / "truth", write_result(tmp_path / "out", [SQUARE]))


def test_truth_of_a_longer_clip_is_refused(tmp_path):
    write_masks(tmp_path / "truth", {"00000": SQUARE, "00009": SQUARE})
    with pytest.raises(InputError, match=r"has 1 frames, but .* labels frame 10"):
        evaluate(tmp_path / "truth", write_result(tmp_path / "out", [SQUARE]))


def test_a_missing_mask_is_named(tmp_path):
    write_masks(tmp_path / "truth", {"00001": SQUARE, "00000": SQUARE})
    result = write_result(tmp_path / "out", [SQUARE, SQUARE])
    (result / "masks/000002.png").unlink()
    with pytest.raises(InputError, match=r"000002\.png is missing"):
        evaluate(tmp_path / "truth", result)


@pytest.mark.parametrize(
    ("text", "says"),
    [("", "is empty"), ("1,2,3\n", "has 3 columns"), ("a,b,c,d\n", "no table of boxes"), ("1,2,3,4\n1,2", "no table")],
)
def test_unusable_tables_of_truth_are_refused(tmp_path, text, says):
    (tmp_path / "gt.txt").write_text(text)
    with pytest.raises(InputError, match=says):
        evaluate(tmp_path / "gt.txt", write_result(tmp_path / "out", [SQUARE]))


def test_empty_and_missing_places_are_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    result = write_result(tmp_path / "out", [SQUARE])
    with pytest.raises(InputError, match="holds no truth"):
        evaluate(tmp_path / "empty", result)
    with pytest.raises(InputError, match="no truth at"):
        evaluate(tmp_path / "nowhere", result)
    with pytest.raises(InputError, match="no clip to score"):
        evaluate(tmp_path / "empty", tmp_path / "empty")
    write_masks(tmp_path / "truth", {"00000": SQUARE})
    with pytest.raises(InputError, match=r"no result of dddas detect: it holds no detections\.txt"):
        evaluate(tmp_path / "truth", tmp_path / "empty")


def test_a_truth_file_that_is_no_picture_is_named(tmp_path):
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth/00000.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"00000\.png is no picture"):
        evaluate(tmp_path / "truth", write_result(tmp_path / "out", [SQUARE]))
