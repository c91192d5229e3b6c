"""Blobs parted by their dense flow."""

import numpy as np
import pytest

from torchvision_dddas.detection.blob_motion import find_second_motion, split_by_flow
from torchvision_dddas.detection.blobs import Blob

CORE = np.ones((30, 40), bool)


def flow(left: tuple[float, float], right: tuple[float, float], at: int = 20, noise: float = 0.1) -> np.ndarray:
    """A (30, 40, 2) field with one motion left of a column and another right of it."""
    field = np.random.default_rng(0).normal(0, noise, (30, 40, 2))
    field[:, :at] += left
    field[:, at:] += right
    return field.astype(np.float32)


@pytest.mark.parametrize("at", [10, 20, 28])
@pytest.mark.parametrize(("left", "right"), [((3, 0), (-3, 0)), ((0, 3), (3, 0)), ((6, 1), (3, 6))])
def test_two_motions_are_found_where_they_meet(left, right, at):
    second = find_second_motion(flow(left, right, at), CORE)
    assert second is not None
    assert second[0, 0] != second[0, -1]
    wanted = np.zeros(CORE.shape, bool)
    wanted[:, at:] = True
    if second[0, 0]:
        second = ~second
    assert (second != wanted).mean() < 0.05


@pytest.mark.parametrize(
    "field",
    [
        flow((3, 0), (3, 0)),
        flow((3, 0), (3.5, 0)),  # less than 1 px a frame
        flow((9, 0), (7, 0)),  # less than 30 %
        flow((8, 0), (4, 1)),  # slower the same way
        flow((3, 0), (0, 0)),  # ground between its wheels
        flow((3, 0), (-3, 0), at=4),  # a part of a tenth
        flow((3, 0), (3, 0), noise=2.0),
        np.zeros((30, 40, 2), np.float32),
    ],
)
def test_one_motion_stays_one(field):
    assert find_second_motion(field, CORE) is None


def test_a_body_that_turns_and_grows_moves_as_one():
    v, u = np.mgrid[:30, :40].astype(np.float32)
    turning = np.dstack([4 + 0.1 * (u - 20) - 0.15 * (v - 15), 0.15 * (u - 20) + 0.1 * (v - 15)])
    assert find_second_motion(turning, CORE) is None


def test_a_part_that_is_scattered_is_no_target():
    field = flow((3, 0), (3, 0))
    field[np.random.default_rng(1).random((30, 40)) < 0.4] = (-3, 0)
    assert find_second_motion(field, CORE) is None


def test_too_few_pixels_are_not_judged():
    assert find_second_motion(flow((3, 0), (-3, 0)), np.zeros((30, 40), bool)) is None


@pytest.mark.parametrize("corner", [(0, 0), (13, 7)])
@pytest.mark.parametrize("size", [(80, 60), (81, 59)])
def test_a_blob_is_cut_along_the_seam_and_loses_no_pixel(corner, size):
    picture = np.zeros((70, 110, 2), np.float32)
    seam = corner[0] // 2 + 20
    picture[:, :seam] = (3, 0)
    picture[:, seam:] = (-3, 0)
    full = np.ones((size[1], size[0]), bool)
    blob = Blob((*corner, *size), full, full, 100.0)
    left, right = sorted(split_by_flow(blob, [2 * picture, -2 * picture], (2, -2)), key=lambda part: part.box[0])
    assert left.box[:2] == corner
    assert left.box[0] + left.box[2] == pytest.approx(corner[0] + 40, abs=3)
    assert left.area_px + right.area_px == blob.area_px
    assert right.box[0] + right.box[2] == corner[0] + size[0]


def test_flow_that_differs_between_the_neighbours_only_by_their_distance_parts_nothing():
    field = np.full((70, 110, 2), 3.0, np.float32)
    full = np.ones((60, 80), bool)
    blob = Blob((0, 0, 80, 60), full, full, 100.0)
    assert split_by_flow(blob, [field, 2 * field], (1, 2)) == [blob]


def test_a_blob_too_small_for_the_flow_stays_whole():
    full = np.ones((5, 5), bool)
    blob = Blob((0, 0, 5, 5), full, full, 100.0)
    assert split_by_flow(blob, [np.zeros((50, 50, 2), np.float32)] * 2, (1, -1)) == [blob]
