"""VisDrone-MOT, UAVDT and Stanford Drone become clips; what is wrong with one is told in a line, and others go on."""

from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.datasets.layouts import complaint, read, text, video
from tests.evaluation.datasets.numbered import line_of, numbered
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.matching import counted

# -- VisDrone ----------------------------------------------------------------------------------------------------------

PEDESTRIAN, CAR, SKY, OTHERS = (
    "1,1,2,3,4,5,1,1,0,0",
    "2,2,12,3,4,5,1,4,0,1",
    "1,0,20,0,10,10,0,0,0,0",
    "2,9,0,0,8,8,1,11,0,0",
)


def visdrone(split: Path, rows: str, name: str = "uav1") -> Path:
    numbered(split / "sequences" / name, 2, "{:07d}.png")
    return text(split / "annotations" / f"{name}.txt", rows)


def test_a_clip_of_visdrone_has_pictures_boxes_and_regions(tmp_path: Path) -> None:
    visdrone(tmp_path / "val", "\n".join([PEDESTRIAN, CAR, SKY, OTHERS]))
    found = read("visdrone", tmp_path / "val")
    (clip,) = found.clips
    assert (clip.name, clip.frames, len(clip.pictures), found.missing) == ("uav1", 2, 2, ())
    truth = clip.truth
    assert truth and truth.tracks and truth.regions and truth.length == 2
    assert truth.tracks.box_px.tolist() == [[2, 3, 4, 5], [12, 3, 4, 5]]
    assert truth.regions.frame.tolist() == [1, 2]
    boxes = np.array([[21, 1, 4, 4], [21, 1, 4, 4], [1, 1, 3, 3]], float)
    assert counted(truth, np.array([1, 2, 2]), boxes).tolist() == [False, True, False]


def test_true_boxes_in_a_region_or_of_other_categories_neither_count_nor_harm(tmp_path: Path) -> None:
    inside = "1,5,22,2,4,5,1,1,0,0"
    marked = "2,7,12,23,4,5,0,1,0,0"
    visdrone(tmp_path / "sets/VisDrone2019-MOT-val", "\n".join([PEDESTRIAN, CAR, SKY, inside, marked]))
    (clip,) = read("visdrone", tmp_path / "sets", classes=["pedestrian"]).clips
    assert clip.truth and clip.truth.tracks and clip.truth.ignored
    assert clip.truth.tracks.identity.tolist() == [1]
    assert clip.truth.ignored.identity.tolist() == [2, 5, 7]
    frames, boxes = np.array([1, 2]), np.array([[2, 3, 4, 5], [12, 3, 4, 5]], float)
    assert counted(clip.truth, frames, boxes).tolist() == [True, False]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("1,1,2,3,4,5,1\n", "line 1: 7 columns; wanted frame,identity,left"),
        ("1,1,2,3,4,5,1,12,0,0\n", "line 1: the category is '12'; wanted 0 to 11"),
        ("3,1,2,3,4,5,1,1,0,0\n", "labels frame 3, but the clip has 2"),
        (SKY, "holds no box that counts"),
        ("", "holds no box that counts"),
    ],
)
def test_a_spoiled_clip_of_visdrone_is_one_line(tmp_path: Path, rows: str, said: str) -> None:
    visdrone(tmp_path / "val", PEDESTRIAN, "good")
    visdrone(tmp_path / "val", rows, "bad")
    found = read("visdrone", tmp_path / "val")
    assert [clip.name for clip in found.clips] == ["good"]
    assert line_of(found).startswith("bad: ") and said in line_of(found)


def test_clips_of_visdrone_without_truth_or_pictures_are_told(tmp_path: Path) -> None:
    visdrone(tmp_path / "val", PEDESTRIAN, "a")
    numbered(tmp_path / "val/sequences/b", 1)
    text(tmp_path / "val/annotations/c.txt", PEDESTRIAN)
    found = read("visdrone", tmp_path / "val")
    assert [(clip.name, len(clip.pictures)) for clip in found.clips] == [("a", 2), ("c", 0)]
    assert [line.split(",")[0] for line in found.missing] == ["b: no truth"]
    assert [line.split(",")[0] for line in found.notes] == ["c: no pictures"]
    with pytest.raises(InputError, match="'dog' is no class of VisDrone; wanted some of pedestrian, people"):
        read("visdrone", tmp_path / "val", classes=["dog"])


# -- UAVDT -------------------------------------------------------------------------------------------------------------

VEHICLES = "1,1,2,3,4,5,1,1,1\n2,1,3,3,4,5,1,1,1\n2,2,12,13,4,5,1,2,3\n"


def uavdt(home: Path, name: str = "M0101", rows: str = VEHICLES) -> None:
    numbered(home / "UAV-benchmark-M" / name, 2, "img{:06d}.png")
    text(home / "UAV-benchmark-MOTD_v1.0/GT" / f"{name}_gt_whole.txt", rows)


def test_a_clip_of_uavdt_has_vehicles_and_ignored_regions(tmp_path: Path) -> None:
    uavdt(tmp_path / "uavdt")
    text(tmp_path / "uavdt/UAV-benchmark-MOTD_v1.0/GT/M0101_gt_ignore.txt", "1,1,20,0,10,10,1,-1,-1\n")
    found = read("uavdt", tmp_path / "uavdt")
    (clip,) = found.clips
    assert (clip.name, clip.rate_hz, clip.frames, found.missing) == ("M0101", 30.0, 2, ())
    assert clip.truth and clip.truth.tracks and clip.truth.tracks.identity.tolist() == [1, 1, 2]
    found_boxes = np.array([[21, 1, 4, 4], [2, 3, 4, 5]], float)
    assert counted(clip.truth, np.array([1, 1]), found_boxes).tolist() == [False, True]


def test_categories_and_attributes_of_uavdt_can_be_asked_for(tmp_path: Path) -> None:
    for name, night in (("M0101", 0), ("M0201", 1)):
        uavdt(tmp_path / "uavdt", name)
        text(tmp_path / f"uavdt/M_attr/train/{name}_attr.txt", f"{1 - night},{night},0,1,0,0,1,1,0,0\n")
    (clip,) = read("uavdt", tmp_path / "uavdt", classes=["bus"], attributes=["night", "low-alt"]).clips
    assert clip.name == "M0201" and clip.truth and clip.truth.tracks and clip.truth.ignored
    assert clip.truth.tracks.identity.tolist() == [2] and clip.truth.ignored.identity.tolist() == [1, 1]
    text(tmp_path / "uavdt/M_attr/train/M0101_attr.txt", "1,0\n")
    assert "does not hold 10 times 0 or 1" in line_of(read("uavdt", tmp_path / "uavdt", attributes=["night"]))


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("1,1,2,3,4,5,1,1\n", "8 columns"),
        ("1,1,2,3,4,5,1,1,4\n", "category is '4'"),
        ("7,1,2,3,4,5,1,1,1", "labels frame 7"),
    ],
)
def test_a_spoiled_clip_of_uavdt_is_one_line(tmp_path: Path, rows: str, said: str) -> None:
    uavdt(tmp_path / "uavdt", "M0101")
    uavdt(tmp_path / "uavdt", "M0203", rows)
    found = read("uavdt", tmp_path / "uavdt")
    assert [clip.name for clip in found.clips] == ["M0101"] and said in line_of(found)


def test_sequences_of_uavdt_without_truth_are_told_and_so_is_an_empty_folder(tmp_path: Path) -> None:
    uavdt(tmp_path / "uavdt")
    numbered(tmp_path / "uavdt/UAV-benchmark-M/M0205", 1)
    found = read("uavdt", tmp_path / "uavdt")
    assert line_of(found).startswith("M0205: no truth, which belongs in ") and line_of(found).endswith("_gt_whole.txt")
    (tmp_path / "empty").mkdir()
    assert "M0101_gt_whole.txt" in complaint("uavdt", tmp_path / "empty")


# -- Stanford Drone ----------------------------------------------------------------------------------------------------

WALKERS = (
    '0 10 20 18 30 0 0 0 0 "Pedestrian"\n0 11 20 19 30 1 0 1 1 "Pedestrian"\n0 0 20 8 30 2 1 0 0 "Pedestrian"\n'
    '3 1 2 5 6 0 0 0 0 "Biker"\n'
)


def test_a_clip_of_stanford_drone_counts_from_one_and_leaves_out_who_is_lost(tmp_path: Path) -> None:
    text(tmp_path / "sdd/annotations/quad/video0/annotations.txt", WALKERS)
    video(tmp_path / "sdd/videos/quad/video0/video.mov", 3)
    found = read("sdd", tmp_path / "sdd")
    (clip,) = found.clips
    assert (clip.name, clip.frames, len(clip.pictures), found.missing) == ("quad-video0", 3, 1, ())
    assert clip.truth and clip.truth.tracks
    assert clip.truth.tracks.frame.tolist() == [1, 2, 1] and clip.truth.tracks.identity.tolist() == [0, 0, 3]
    assert clip.truth.tracks.box_px[0].tolist() == [10, 20, 8, 10]
    assert clip.truth.boxes[3].shape == (0, 4)  # nobody is there, and that is known


def test_labels_can_be_asked_for_and_folders_may_be_flat(tmp_path: Path) -> None:
    text(tmp_path / "sdd/SDD-quad-video0/annotations.txt", WALKERS)
    found = read("sdd", tmp_path / "sdd", classes=["Biker"])
    (clip,) = found.clips
    assert clip.name == "SDD-quad-video0" and found.missing == ()
    assert "no pictures, which belong in" in line_of(found)
    assert clip.truth and clip.truth.tracks and clip.truth.tracks.identity.tolist() == [3]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ('0 10 20 18 30 0 0 0 "Pedestrian"\n', "9 columns"),
        ('0 10 20 18 30 0 0 0 0 "Dog"\n', "the label is 'Dog'; wanted Pedestrian"),
        ('0 10 20 10 30 0 0 0 0 "Biker"\n', "0×10 pixels"),
        ('0 10 20 18 30 -1 0 0 0 "Biker"\n', "frame is '-1'"),
        ('0 10 20 18 30 0 1 0 0 "Biker"\n', "holds no box that counts"),
        ('0 10 20 18 30 9 0 0 0 "Biker"\n', "labels frame 10, but the clip has 2"),
    ],
)
def test_a_spoiled_clip_of_stanford_drone_is_one_line(tmp_path: Path, rows: str, said: str) -> None:
    for name, content in (("good", WALKERS.splitlines()[0]), ("bad", rows)):
        text(tmp_path / "sdd" / name / "annotations.txt", content)
        video(tmp_path / "sdd" / name / "video.mp4", 2)
    found = read("sdd", tmp_path / "sdd")
    assert [clip.name for clip in found.clips] == ["good"]
    assert line_of(found).startswith("bad: ") and said in line_of(found)
