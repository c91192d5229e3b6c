"""VIVID in the layouts in which it is passed on: all vehicles, one target by boxes, one target by masks."""

from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.datasets.layouts import clip, complaint, mask, pictures, read, text

CSV = "name,frame,id,x,y,w,h\ncar,0,7,1,2,8,5\ntruck,0,9,15,2,8,5\ncar,10,7,3,2,8,5\n"


def frames(folder: Path, count: int = 21, name: str = "egtest01") -> Path:
    pictures(folder / name, [f"frame{n:05d}.jpg" for n in range(count)])
    return folder / name


@pytest.mark.parametrize("home", ["egtest01", ".", "Groundtruth"])
def test_all_vehicles_with_identities(tmp_path: Path, home: str) -> None:
    frames(tmp_path)
    text(tmp_path / home / "egtest01_truth.csv", CSV)
    found = clip("vivid", tmp_path)
    assert (found.name, found.frames, found.rate_hz) == ("egtest01", 21, 30.0)
    truth = found.truth
    assert truth is not None
    assert truth.kind == "boxes"
    assert truth.tracks is not None
    assert truth.tracks.frame.tolist() == [1, 1, 11]
    assert truth.tracks.identity.tolist() == [7, 9, 7]
    assert len(truth.boxes[1]) == 2
    assert truth.length == 21


def test_one_target_by_boxes_of_every_tenth_frame(tmp_path: Path) -> None:
    frames(tmp_path)
    text(tmp_path / "egtest01_gt.txt", "0 1 2 8 5\n10 3 2 8 5\n20 NaN NaN NaN NaN\n")
    truth = clip("vivid", tmp_path).truth
    assert truth is not None
    assert truth.kind == "one target"
    assert truth.frames == [1, 11, 21]
    assert truth.boxes[11].tolist() == [[3, 2, 8, 5]]
    assert truth.tracks is not None
    assert truth.tracks.frame.tolist() == [1, 11]


def test_one_target_by_a_box_a_frame(tmp_path: Path) -> None:
    frames(tmp_path, 2)
    text(tmp_path / "egtest01" / "egtest01.txt", "1,2,8,5\n2,2,8,5\n")
    truth = clip("vivid", tmp_path).truth
    assert truth is not None
    assert truth.frames == [1, 2]


@pytest.mark.parametrize("home", ["egtest01mask", "egtest01_masks", "egtest01/masks"])
def test_one_target_by_masks_is_the_box_about_it(tmp_path: Path, home: str) -> None:
    frames(tmp_path)
    mask(tmp_path / home / "frame00000.png", {(4, 3, 10, 6): 255})
    mask(tmp_path / home / "frame00010.png", {})
    found = clip("vivid", tmp_path)
    truth = found.truth
    assert truth is not None
    assert truth.kind == "one target"
    assert truth.boxes[1].tolist() == [[4, 3, 10, 6]]
    assert np.isnan(truth.boxes[11]).all()
    assert truth.tracks is not None
    assert truth.tracks.frame.tolist() == [1]


def test_pictures_may_lie_one_folder_deeper(tmp_path: Path) -> None:
    frames(tmp_path / "egtest01")
    text(tmp_path / "egtest01" / "egtest01_truth.csv", CSV)
    assert clip("vivid", tmp_path).frames == 21


def test_a_clip_without_truth_is_told_and_the_others_go_on(tmp_path: Path) -> None:
    frames(tmp_path)
    frames(tmp_path, name="egtest02")
    text(tmp_path / "egtest01_truth.csv", CSV)
    found = read("vivid", tmp_path)
    assert [c.name for c in found.clips] == ["egtest01"]
    assert "has no truth of it; wanted egtest02_truth.csv, egtest02*.txt or a folder" in found.missing[0]


def test_truth_without_pictures_is_told(tmp_path: Path) -> None:
    text(tmp_path / "egtest01" / "egtest01_truth.csv", CSV)
    assert "holds no pictures; wanted frame00000.jpg and so on" in complaint("vivid", tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("egtest01_truth.csv", CSV + "car,99,7,1,2,8,5\n", "line 5: there is no picture 99; the clip has 0 to 20"),
        ("egtest01_truth.csv", CSV + "car,1,7\n", "line 5: 3 columns; wanted name,frame,identity,x,y,width,height"),
        ("egtest01_truth.csv", CSV + "car,1,7,a,2,8,5\n", "line 5: wanted a number from -1e+09 to 1e+09, got 'a'"),
        ("egtest01_truth.csv", CSV + "car,1,7,1,2,-8,5\n", "the box is -8×5 pixels; wanted more than 0"),
        ("egtest01_truth.csv", CSV + "car,10,7,1,2,8,5\n", "lines 4 and 5: identity 7 twice in frame 11"),
        ("egtest01_truth.csv", CSV + "car,1,7.5,1,2,8,5\n", "7.5 is no identity; wanted whole numbers"),
        ("egtest01_truth.csv", "name,frame,id,x,y,w,h\n", "holds no boxes"),
        ("egtest01.txt", "", "is empty; wanted frame,x,y,width,height"),
        ("egtest01.txt", "1,2\n", "has 2 columns; wanted frame,x,y,width,height"),
        ("egtest01.txt", "0,1,2,8,5\n0,1,2,8,5\n", "line 2: frame 0 is there twice"),
        ("egtest01.txt", "1,2,8,5\n", "has 1 lines, but the clip 21 frames; wanted a line a frame"),
        ("egtest01.txt", "0,1,2,8,5\n1,2,8,5\n", "line 2: 4 columns; the first line has 5"),
        ("egtest01.txt", "NaN,1,2,8,5\n", "line 1: there is no picture nan"),
    ],
)
def test_damaged_truth_is_told(tmp_path: Path, name: str, content: str, line: str) -> None:
    frames(tmp_path)
    text(tmp_path / name, content)
    assert line in complaint("vivid", tmp_path)


def test_masks_of_no_picture_are_told(tmp_path: Path) -> None:
    frames(tmp_path)
    mask(tmp_path / "egtest01mask" / "frame00030.png", {(4, 3, 10, 6): 255})
    assert "frame00030.png labels no picture of" in complaint("vivid", tmp_path)


def test_masks_of_another_size_are_told(tmp_path: Path) -> None:
    frames(tmp_path)
    mask(tmp_path / "egtest01mask" / "frame00010.png", {(4, 3, 10, 6): 255}, size=(64, 48))
    assert "frame00010.png is 64×48 pixels, but frame00000.jpg 32×24" in complaint("vivid", tmp_path)
