"""The motion history of a clip, and the velocities of blobs from their trails."""

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


def shift(u: float) -> np.ndarray:
    return np.array([[1, 0, u], [0, 1, 0], [0, 0, 1]], float)


def test_stamps_count_the_frames_since_a_place_moved_until_the_duration(painted):
    history = MotionHistory(2.0)
    for number in range(1, 6):
        history.move(number, np.eye(3))
        history.add(painted(HISTORY_SIZE, (10 * number, 5, 4, 4)))
    stamps = history.stamps((0, 0, *HISTORY_SIZE))
    assert [int(stamps[6, 10 * number + 1]) for number in range(1, 6)] == [0, 0, NEWEST - 2, NEWEST - 1, NEWEST]
    history.move(6, None)  # a cut
    assert not history.stamps((0, 0, *HISTORY_SIZE)).any()


def test_stamps_stay_on_the_ground_while_the_camera_moves_by_fractions_of_a_pixel(painted):
    """Warping the stamps at every step would leave them where they were: 0.4 px rounds to 0."""
    history = MotionHistory(20.0)
    history.move(1, None)
    history.add(painted(HISTORY_SIZE, (10, 5, 6, 6)))
    for number in range(2, 12):
        history.move(number, shift(0.4))
    assert np.flatnonzero(history.stamps((0, 0, *HISTORY_SIZE))[7]).tolist() == list(range(14, 20))


SIZE = (161, 121)
PARAMETERS = HistoryParameters()


def filmed(painted, *movers, frames=6, camera=0.0):
    """The history of boxes (x, y, width, height, vx, vy), placed as in the last frame, and that frame's blobs."""
    history = MotionHistory(PARAMETERS.duration_frames)
    for ago in reversed(range(frames)):
        boxes = [(round(x - vx * ago), round(y - vy * ago), w, h) for x, y, w, h, vx, vy in movers]
        silhouette = painted(SIZE, *boxes)
        history.move(frames - ago, shift(camera))
        history.add(silhouette)
    return history, find_blobs(silhouette, silhouette, 20, 20, 0, hull=False)


def test_flood_regions_join_stamps_within_the_threshold():
    stamps = np.array([[250, 251, 252, 0, 254, 250, 249]], np.uint8)
    everywhere = stamps > 0
    assert [r[0].nonzero()[0].tolist() for r in flood_regions(stamps, everywhere, 1)] == [[0, 1, 2], [4], [5, 6]]
    assert [r[0].nonzero()[0].tolist() for r in flood_regions(stamps, everywhere, 4)] == [[0, 1, 2], [4, 5, 6]]
    assert len(flood_regions(stamps, everywhere, 0)) == 6


@pytest.mark.parametrize(
    ("velocity", "camera", "on_ground"),
    [((4, 0), 0, (4, 0)), ((0, 3), 0, (0, 3)), ((0, -1), 0, (0, -1)), ((-2, 0), -5, (3, 0))],
)
def test_a_trail_gives_the_velocity_over_the_ground(velocity, camera, on_ground, painted):
    history, (blob,) = filmed(painted, (70, 50, 24, 16, *velocity), camera=camera)
    (part,) = split_by_trail(blob, history, SIZE, PARAMETERS)
    assert part[0] is blob
    np.testing.assert_allclose(part[1], on_ground, atol=0.15)


def test_two_passing_targets_that_touch_are_split_along_their_seam(painted):
    history, (blob,) = filmed(painted, (60, 40, 30, 14, 3, 0), (64, 54, 30, 14, -3, 0))
    parts = sorted(split_by_trail(blob, history, SIZE, PARAMETERS), key=lambda part: part[0].box[1])
    assert len(parts) == 2
    np.testing.assert_allclose(parts[0][0].box, (60, 40, 30, 14), atol=2)
    np.testing.assert_allclose(parts[1][0].box, (64, 54, 30, 14), atol=2)
    assert parts[0][1][0] > 2 and parts[1][1][0] < -2
    assert sum(part[0].area_px for part in parts) == blob.area_px


@pytest.mark.parametrize("box", [(0, 0, 161, 121), (0, 0, 5, 5), (156, 116, 5, 5)])
def test_without_a_past_a_blob_is_whole_and_has_no_velocity(box, painted):
    history, (blob,) = filmed(painted, (*box, 0, 0), frames=1)
    (part,) = split_by_trail(blob, history, SIZE, PARAMETERS)
    assert part[0] is blob and np.isnan(part[1]).all()
