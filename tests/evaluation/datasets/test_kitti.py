"""KITTI's tracks become clips, with places on the ground by the car's own motion."""

from math import cos, pi, radians
from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.datasets.layouts import complaint, read, text
from tests.evaluation.datasets.numbered import line_of, numbered
from torchvision_dddas.evaluation.datasets.kitti import EARTH_RADIUS_M
from torchvision_dddas.evaluation.metrics.matching import counted

# The camera looks ahead: its right is the unit's -y, its down -z, its ahead x; it sits 1 m ahead of the unit.
CALIBRATION = (
    "P2: " + " ".join(["0"] * 12) + "\nR_rect 1 0 0 0 1 0 0 0 1\n"
    "Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0\nTr_imu_velo 1 0 0 -1 0 1 0 0 0 0 1 0\n"
)


def label(frame: int, identity: int, kind: str = "Car", truncated: int = 0, occluded: int = 0, x: float = 10) -> str:
    return f"{frame} {identity} {kind} {truncated} {occluded} -1 {x} 5 {x + 4} 10 1.5 1.6 3.7 -2 1.6 20 0.1\n"


def drive(headings_rad: tuple[float, ...], north_m: float = 0.0) -> str:
    """Records of a car that turns, and goes north between them."""
    degree = 2 * pi * EARTH_RADIUS_M / 360
    lines = [f"{north_m * n / degree:.12f} 8.4 110 0 0 {yaw} 0 0" for n, yaw in enumerate(headings_rad)]
    return "\n".join(lines) + "\n"


def kitti(home: Path, labels: str, name: str = "0000", frames: int = 2, oxts: str = drive((0.0, 0.0))) -> None:
    numbered(home / "training/image_02" / name, frames, first=0)
    text(home / "training/label_02" / f"{name}.txt", labels)
    text(home / "training/calib" / f"{name}.txt", CALIBRATION)
    text(home / "training/oxts" / f"{name}.txt", oxts)


def test_a_clip_has_its_boxes_from_frame_one_and_dont_care_regions(tmp_path: Path) -> None:
    care = "0 -1 DontCare -1 -1 -10 20 0 30 20 -1 -1 -1 -1000 -1000 -1000 -10\n"
    kitti(tmp_path / "kitti", label(0, 0) + care + label(1, 0) + label(1, 3, "Pedestrian", x=20))
    found = read("kitti", tmp_path / "kitti")
    (clip,) = found.clips
    assert (clip.name, clip.rate_hz, clip.frames, found.missing) == ("0000", 10.0, 2, ())
    assert clip.truth and clip.truth.tracks and clip.truth.tracks.frame.tolist() == [1, 2, 2]
    assert clip.truth.tracks.box_px[0].tolist() == [10, 5, 4, 5]
    boxes = np.array([[21, 1, 4, 4], [10, 5, 4, 5], [21, 1, 4, 4]], float)
    assert counted(clip.truth, np.array([1, 1, 2]), boxes).tolist() == [False, True, True]


def test_other_classes_and_what_is_cut_off_or_unknown_neither_count_nor_harm(tmp_path: Path) -> None:
    rows = [label(0, 0), label(0, 1, "Van", x=16), label(0, 2, truncated=1, x=20), label(0, 3, occluded=3, x=24)]
    kitti(tmp_path / "kitti", "".join(rows) + label(0, 4, occluded=2, x=28))
    (clip,) = read("kitti", tmp_path / "kitti", classes=["Car"]).clips
    assert clip.truth and clip.truth.tracks and clip.truth.ignored
    assert clip.truth.tracks.identity.tolist() == [0, 4] and clip.truth.ignored.identity.tolist() == [1, 2, 3]


def test_places_turn_and_move_with_the_car(tmp_path: Path) -> None:
    """20 m ahead of the camera, 2 m to its left: first the car looks east, then north from 100 m farther north."""
    kitti(tmp_path / "kitti", label(0, 0) + label(1, 0), oxts=drive((0.0, pi / 2), 100.0))
    (clip,) = read("kitti", tmp_path / "kitti").clips
    assert clip.truth and clip.truth.positions
    assert clip.truth.positions.east_north_m == pytest.approx(np.array([[21.0, 2.0], [-2.0, 121.0]]), abs=1e-3)


def test_metres_are_metres_far_from_the_equator(tmp_path: Path) -> None:
    east = 10.0 / (EARTH_RADIUS_M * cos(radians(49)) * pi / 180)
    oxts = f"49 8 110 0 0 0\n49 {8 + east:.12f} 110 0 0 0\n"
    kitti(tmp_path / "kitti", label(0, 0) + label(1, 0), oxts=oxts)
    (clip,) = read("kitti", tmp_path / "kitti").clips
    assert clip.truth and clip.truth.positions
    assert np.diff(clip.truth.positions.east_north_m, axis=0) == pytest.approx(np.array([[10.0, 0.0]]), abs=1e-3)


def test_without_calibration_there_are_no_places_and_that_is_told(tmp_path: Path) -> None:
    kitti(tmp_path / "kitti", label(0, 0))
    (tmp_path / "kitti/training/calib/0000.txt").unlink()
    found = read("kitti", tmp_path / "kitti")
    assert found.clips[0].truth and found.clips[0].truth.positions is None
    assert line_of(found).startswith("0000: no places in metres, which need ")
    assert found.missing == ()  # it is read all the same


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("label_02", "0 0 Car 0 0\n", "5 columns"),
        ("label_02", label(0, 0, "Dog"), "the type is 'Dog'; wanted Car"),
        ("label_02", label(5, 0), "frame 6 is labelled"),
        ("label_02", label(0, 0) + label(0, 0), "identity 0 twice in frame 1"),
        ("calib", "R_rect 1 0 0\n", "does not hold R_rect with 9 numbers"),
        ("calib", CALIBRATION.replace("1 0 0 0 1 0 0 0 1", "1 0 0 1 0 0 0 0 1"), "R_rect is no rotation"),
        ("oxts", "", "is empty"),
        ("oxts", "95 8 0 0 0 0\n", "95, 8 is no place"),
    ],
)
def test_a_spoiled_clip_is_one_line_and_the_others_go_on(tmp_path: Path, file: str, content: str, said: str) -> None:
    kitti(tmp_path / "kitti", label(0, 0), "0000")
    kitti(tmp_path / "kitti", label(0, 0), "0001")
    text(tmp_path / "kitti/training" / file / "0001.txt", content)
    found = read("kitti", tmp_path / "kitti")
    assert [clip.name for clip in found.clips] == ["0000"]
    assert line_of(found).startswith("0001: ") and said in line_of(found)


def test_what_is_not_there_is_told(tmp_path: Path) -> None:
    (tmp_path / "kitti").mkdir()
    assert "training/label_02/0000.txt" in complaint("kitti", tmp_path / "kitti")
    kitti(tmp_path / "kitti", label(0, 0))
    numbered(tmp_path / "kitti/training/image_02/0009", 1, first=0)
    assert line_of(read("kitti", tmp_path / "kitti")).startswith("0009: no truth, which belongs in ")
