"""Blobs parted by their trails, and the heading and speed that a trail tells."""

import numpy as np
import pytest

from torchvision_dddas.config import HistoryParameters
from torchvision_dddas.detection.blobs import find_blobs
from torchvision_dddas.detection.motion_history import MotionHistory, flood_regions, split_by_trail

SIZE = (161, 121)
KNOBS = HistoryParameters()


def film(painted, *movers, frames=6, step=None):
    """The history of boxes (x, y, width, height, vx, vy), placed as in the last frame, and that frame's blobs."""
    history = MotionHistory(KNOBS.duration_frames)
    silhouette = painted(SIZE)
    for number in range(1, frames + 1):
        ago = frames - number
        boxes = [(round(x - vx * ago), round(y - vy * ago), w, h) for x, y, w, h, vx, vy in movers]
        silhouette = painted(SIZE, *boxes)
        history.move(number, np.eye(3) if step is None else step)
        history.add(silhouette)
    return history, find_blobs(silhouette, silhouette, 20, 20, 0, hull=False)


def test_flood_regions_join_stamps_within_the_threshold_and_part_those_beyond():
    stamps = np.array([[250, 251, 252, 0, 254, 250, 249]], np.uint8)
    everywhere = stamps > 0
    assert [r[0].nonzero()[0].tolist() for r in flood_regions(stamps, everywhere, 1)] == [[0, 1, 2], [4], [5, 6]]
    assert [r[0].nonzero()[0].tolist() for r in flood_regions(stamps, everywhere, 4)] == [[0, 1, 2], [4, 5, 6]]
    assert len(flood_regions(stamps, everywhere, 0)) == 6


def test_only_regions_that_hold_a_seed_are_found():
    stamps = np.array([[250, 251, 0, 254]], np.uint8)
    found = flood_regions(stamps, np.array([[False, True, True, False]]), 1)
    assert [r[0].tolist() for r in found] == [[True, True, False, False]]
    assert flood_regions(np.zeros((3, 3), np.uint8), np.ones((3, 3), bool), 1) == []


@pytest.mark.parametrize("velocity", [(4, 0), (-2, 0), (0, 3), (0, -1)])
def test_a_box_that_moves_has_its_heading_and_speed_and_stays_whole(velocity, painted):
    history, (blob,) = film(painted, (70, 50, 24, 16, *velocity))
    (part,) = split_by_trail(blob, history, SIZE, KNOBS)
    assert part[0] is blob
    np.testing.assert_allclose(part[1], velocity, atol=0.15)


def test_a_box_that_moves_aslant_is_within_20_degrees_and_a_fifth_of_its_speed(painted):
    history, (blob,) = film(painted, (70, 50, 20, 20, 3, 2))
    (part,) = split_by_trail(blob, history, SIZE, KNOBS)
    heading = np.degrees(np.arctan2(*part[1][::-1]))
    assert heading == pytest.approx(np.degrees(np.arctan2(2, 3)), abs=20)
    assert np.hypot(*part[1]) == pytest.approx(np.hypot(3, 2), rel=0.2)


def test_the_velocity_is_the_movers_own_and_not_the_cameras(painted):
    """The camera pans by 5 px a frame after a box that goes 3 px a frame over the ground."""
    history, (blob,) = film(painted, (70, 50, 24, 16, -2, 0), step=np.array([[1, 0, -5], [0, 1, 0], [0, 0, 1.0]]))
    (part,) = split_by_trail(blob, history, SIZE, KNOBS)
    np.testing.assert_allclose(part[1], (3, 0), atol=0.15)


def test_two_that_pass_each_other_and_touch_come_apart_along_their_seam(painted):
    history, (blob,) = film(painted, (60, 40, 30, 14, 3, 0), (64, 54, 30, 14, -3, 0))
    parts = sorted(split_by_trail(blob, history, SIZE, KNOBS), key=lambda part: part[0].box[1])
    assert len(parts) == 2
    np.testing.assert_allclose(parts[0][0].box, (60, 40, 30, 14), atol=2)
    np.testing.assert_allclose(parts[1][0].box, (64, 54, 30, 14), atol=2)
    assert parts[0][1][0] > 2 and parts[1][1][0] < -2
    assert sum(part[0].area_px for part in parts) == blob.area_px


def test_two_that_meet_head_on_come_apart(painted):
    history, (blob,) = film(painted, (50, 40, 20, 14, 3, 0), (70, 40, 20, 14, -3, 0))
    parts = sorted(split_by_trail(blob, history, SIZE, KNOBS), key=lambda part: part[0].box[0])
    assert [part[0].box for part in parts] == [(50, 40, 20, 14), (70, 40, 20, 14)]


def test_two_that_touch_and_go_the_same_way_stay_one(painted):
    history, (blob,) = film(painted, (50, 40, 20, 14, 3, 0), (70, 44, 20, 14, 3, 0))
    assert len(split_by_trail(blob, history, SIZE, KNOBS)) == 1


def test_flicker_at_the_edges_parts_nothing(painted):
    rng = np.random.default_rng(1)
    history = MotionHistory(KNOBS.duration_frames)
    silhouette = painted(SIZE)
    for number in range(1, 9):
        left, top, right, bottom = rng.integers(0, 4, 4)
        silhouette = painted(SIZE, (50 - left, 40 - top, 30 + left + right, 24 + top + bottom))
        history.move(number, np.eye(3))
        history.add(silhouette)
    (blob,) = find_blobs(silhouette, silhouette, 20, 20, 0, hull=False)
    assert len(split_by_trail(blob, history, SIZE, KNOBS)) == 1


@pytest.mark.parametrize("box", [(0, 0, 161, 121), (0, 0, 5, 5), (156, 116, 5, 5)])
def test_without_a_past_a_blob_is_whole_and_its_velocity_unknown(box, painted):
    history, (blob,) = film(painted, (*box, 0, 0), frames=1)
    (part,) = split_by_trail(blob, history, SIZE, KNOBS)
    assert part[0] is blob and np.isnan(part[1]).all()
