"""Small slow targets: candidates, and tracks that are believed once they have travelled."""

import numpy as np
import pytest

from torchvision_dddas.config import SmallParameters
from torchvision_dddas.detection.persistence import SmallTracks, find_candidates

KNOBS = SmallParameters()


def confirmed(tracks):
    return [track for track in tracks.tracks if track.confirmed]


def follow(place, frames=30, camera=(0.0, 0.0), size=(10, 6), seen=lambda k: True):
    """Tracks of one candidate whose ground position is place(k), under a camera that shifts the picture."""
    tracks = SmallTracks(KNOBS)
    shift = np.array([[1, 0, camera[0]], [0, 1, camera[1]], [0, 0, 1.0]])
    for k in range(frames):
        u, v = np.array(place(k)) + np.array(camera) * k
        tracks.step(k, shift if k else None, [(round(u), round(v), *size)] if seen(k) else [])
    return tracks


@pytest.mark.parametrize("camera", [(0.0, 0.0), (7.0, -3.0)])
def test_a_slow_straight_traveller_is_confirmed_however_the_camera_moves(camera):
    (track,) = confirmed(follow(lambda k: (50 + 0.8 * k, 60), camera=camera))
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
def test_what_does_not_travel_is_never_confirmed(place, more):
    assert confirmed(follow(place, **more)) == []


def test_a_few_misses_are_bridged_and_more_end_the_track():
    assert len(follow(lambda k: (50 + 0.8 * k, 60), seen=lambda k: k % 3 != 1).tracks) == 1
    assert follow(lambda k: (50 + 0.8 * k, 60), frames=25, seen=lambda k: k < 20).tracks == []


def test_two_that_pass_near_each_other_keep_their_tracks():
    tracks = SmallTracks(KNOBS)
    for k in range(30):
        tracks.step(k, np.eye(3), [(30 + k, 60, 8, 6), (60 - k, 67, 8, 6)])
    assert sorted(round(float(t.velocity_px[0])) for t in confirmed(tracks)) == [-1, 1]


def test_candidates_are_gated_by_area_and_box_and_too_many_are_none(painted):
    assert find_candidates(painted((101, 67), (5, 5, 3, 3), (20, 5, 4, 3), (40, 5, 60, 60)), KNOBS) == [(20, 5, 4, 3)]
    assert find_candidates(painted((101, 67)), KNOBS) == []
    mask = painted((200, 40), *((16 * k + 2, 10, 5, 5) for k in range(12)))
    found = [len(find_candidates(mask, SmallParameters(max_candidates=most))) for most in (12, 11)]
    assert found == [12, 0]
