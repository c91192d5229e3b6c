"""Small targets are candidates that have travelled."""

import numpy as np
import pytest

from torchvision_dddas.config import SmallParameters
from torchvision_dddas.detection.small_tracks import SmallTracks, find_small_boxes

SMALL = SmallParameters()


def shift(u=0.0, v=0.0) -> np.ndarray:
    return np.array([[1, 0, u], [0, 1, v], [0, 0, 1.0]])


def tracked(place, frames=30, camera=(0.0, 0.0), size=(10, 6), gaps=()):
    """Tracks of one candidate whose ground position is place(k), under a camera that shifts the picture."""
    tracks = SmallTracks(SMALL)
    for k in range(frames):
        u, v = np.array(place(k)) + np.array(camera) * k
        tracks.step(k, shift(*camera) if k else None, [] if k in gaps else [(round(u), round(v), *size)])
    return tracks.tracks


def straight(k):
    return 50 + 0.8 * k, 60


@pytest.mark.parametrize("camera", [(0.0, 0.0), (7.0, -3.0)])
def test_a_slow_straight_mover_is_confirmed(camera):
    (track,) = tracked(straight, camera=camera)
    assert track.confirmed
    np.testing.assert_allclose(track.velocity_px, (0.8, 0), atol=0.1)


@pytest.mark.parametrize(
    ("place", "more"),
    [
        (lambda k: (50, 60), {"camera": (7.0, -3.0)}),  # stands before a moving camera
        (lambda k: (50 + 6 * np.sin(k), 60), {}),  # sways to and fro
        (lambda k: (50 + 0.25 * k, 60), {"size": (40, 6)}),  # travels less than a quarter of its length
    ],
    ids=["stands", "sways", "long"],
)
def test_a_candidate_that_does_not_travel_is_not_confirmed(place, more):
    assert not any(track.confirmed for track in tracked(place, **more))


def test_a_few_misses_are_bridged_and_more_end_the_track():
    assert len(tracked(straight, gaps=range(1, 30, 3))) == 1
    assert tracked(straight, frames=25, gaps=range(20, 25)) == []


def test_candidates_are_gated_by_area_box_and_number(painted):
    assert find_small_boxes(painted((101, 67), (5, 5, 3, 3), (20, 5, 4, 3), (40, 5, 60, 60)), SMALL) == [(20, 5, 4, 3)]
    assert find_small_boxes(painted((101, 67)), SMALL) == []
    mask = painted((200, 40), *((16 * k + 2, 10, 5, 5) for k in range(12)))
    found = [len(find_small_boxes(mask, SmallParameters(max_candidates=most))) for most in (12, 11)]
    assert found == [12, 0]
