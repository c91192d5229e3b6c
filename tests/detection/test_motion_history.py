"""The motion history of a clip, and what the trails in it tell of blobs."""

import numpy as np
import pytest

from torchvision_dddas.config import HistoryParameters
from torchvision_dddas.detection.blobs import find_blobs
from torchvision_dddas.detection.motion_history import (
    NEWEST,
    MotionHistory,
    flood_regions,
    split_by_trail,
)

HISTORY_SIZE = (67, 43)
ALL = (0, 0, *HISTORY_SIZE)


def shift(u: float, v: float) -> np.ndarray:
    return np.array([[1, 0, u], [0, 1, v], [0, 0, 1]], float)


def test_stamps_tell_how_many_frames_ago_a_place_moved_and_forget_after_the_duration(painted):
    history = MotionHistory(2.0)
    for number in range(1, 6):
        history.move(number, np.eye(3))
        history.add(painted(HISTORY_SIZE, (10 * number, 5, 4, 4)))
    stamps = history.stamps(ALL)
    assert [int(stamps[6, 10 * number + 1]) for number in range(1, 6)] == [0, 0, NEWEST - 2, NEWEST - 1, NEWEST]
    history.move(6, None)  # a cut
    assert not history.stamps(ALL).any()


def test_what_stands_on_the_ground_stays_there_under_a_camera_that_moves_by_fractions_of_a_pixel(painted):
    """Warping the stamps on at every step would leave them where they were: 0.4 px rounds to 0."""
    history = MotionHistory(20.0)
    history.move(1, None)
    history.add(painted(HISTORY_SIZE, (10, 5, 6, 6)))
    for number in range(2, 12):
        history.move(number, shift(0.4, 0.0))
    assert np.flatnonzero(history.stamps(ALL)[7]).tolist() == list(range(14, 20))


SIZE = (161, 121)
PARAMETERS = HistoryParameters()


def film(painted, *movers, frames=6, step=None):
    """The history of boxes (x, y, width, height, vx, vy), placed as in the last frame, and that frame's blobs."""
    history = MotionHistory(PARAMETERS.duration_frames)
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


@pytest.mark.parametrize("velocity", [(4, 0), (-2, 0), (0, 3), (0, -1)])
def test_a_box_that_moves_has_its_heading_and_speed_and_stays_whole(velocity, painted):
    history, (blob,) = film(painted, (70, 50, 24, 16, *velocity))
    (part,) = split_by_trail(blob, history, SIZE, PARAMETERS)
    assert part[0] is blob
    np.testing.assert_allclose(part[1], velocity, atol=0.15)


def test_the_velocity_is_the_movers_own_and_not_the_cameras(painted):
    """The camera pans by 5 px a frame after a box that goes 3 px a frame over the ground."""
    history, (blob,) = film(painted, (70, 50, 24, 16, -2, 0), step=np.array([[1, 0, -5], [0, 1, 0], [0, 0, 1.0]]))
    (part,) = split_by_trail(blob, history, SIZE, PARAMETERS)
    np.testing.assert_allclose(part[1], (3, 0), atol=0.15)


def test_two_that_pass_each_other_and_touch_come_apart_along_their_seam(painted):
    history, (blob,) = film(painted, (60, 40, 30, 14, 3, 0), (64, 54, 30, 14, -3, 0))
    parts = sorted(split_by_trail(blob, history, SIZE, PARAMETERS), key=lambda part: part[0].box[1])
    assert len(parts) == 2
    np.testing.assert_allclose(parts[0][0].box, (60, 40, 30, 14), atol=2)
    np.testing.assert_allclose(parts[1][0].box, (64, 54, 30, 14), atol=2)
    assert parts[0][1][0] > 2 and parts[1][1][0] < -2
    assert sum(part[0].area_px for part in parts) == blob.area_px


@pytest.mark.parametrize("box", [(0, 0, 161, 121), (0, 0, 5, 5), (156, 116, 5, 5)])
def test_without_a_past_a_blob_is_whole_and_its_velocity_unknown(box, painted):
    history, (blob,) = film(painted, (*box, 0, 0), frames=1)
    (part,) = split_by_trail(blob, history, SIZE, PARAMETERS)
    assert part[0] is blob and np.isnan(part[1]).all()
