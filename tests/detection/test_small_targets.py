"""Small slow targets: candidates, and tracks that are believed once they have travelled."""

import numpy as np
import pytest

from torchvision_dddas.config import SmallParameters
from torchvision_dddas.detection.small_targets import SmallTracks, find_candidates

KNOBS = SmallParameters()


def confirmed(tracks):
    return [track for track in tracks.tracks if track.confirmed]


def follow(place, frames=30, camera=(0.0, 0.0), size=(10, 6), parameters=KNOBS, seen=lambda k: True):
    """Tracks of one candidate whose ground position is place(k), under a camera that shifts the picture."""
    tracks = SmallTracks(parameters)
    shift = np.array([[1, 0, camera[0]], [0, 1, camera[1]], [0, 0, 1.0]])
    for k in range(frames):
        u, v = np.array(place(k)) + np.array(camera) * k
        boxes = [(round(u), round(v), *size)] if seen(k) else []
        tracks.step(k, shift if k else None, boxes)
    return tracks


def test_a_slow_straight_traveller_is_confirmed():
    (track,) = confirmed(follow(lambda k: (50 + 0.8 * k, 60)))
    np.testing.assert_allclose(track.velocity_px, (0.8, 0), atol=0.1)


def test_a_camera_that_pans_and_shakes_does_not_matter():
    (track,) = confirmed(follow(lambda k: (50 + 0.8 * k, 60), camera=(7.0, -3.0)))
    np.testing.assert_allclose(track.velocity_px, (0.8, 0), atol=0.1)


def test_what_stands_is_never_confirmed_however_the_camera_moves():
    assert confirmed(follow(lambda k: (50, 60), camera=(7.0, -3.0))) == []


def test_what_sways_to_and_fro_is_never_confirmed():
    assert confirmed(follow(lambda k: (50 + 6 * np.sin(k), 60))) == []


def test_travel_of_less_than_a_quarter_of_its_own_length_is_not_enough():
    assert confirmed(follow(lambda k: (50 + 0.25 * k, 60), size=(40, 6))) == []


def test_a_few_misses_are_bridged_and_more_end_the_track():
    assert len(follow(lambda k: (50 + 0.8 * k, 60), seen=lambda k: k % 3 != 1).tracks) == 1
    gone = follow(lambda k: (50 + 0.8 * k, 60), frames=25, seen=lambda k: k < 20)
    assert gone.tracks == []


def test_two_that_pass_near_each_other_keep_their_tracks():
    tracks = SmallTracks(KNOBS)
    for k in range(30):
        tracks.step(k, np.eye(3), [(30 + k, 60, 8, 6), (60 - k, 67, 8, 6)])
    speeds = sorted(round(float(t.velocity_px[0])) for t in confirmed(tracks))
    assert speeds == [-1, 1]


def test_candidates_are_gated_by_area_and_box(painted):
    mask = painted((101, 67), (5, 5, 3, 3), (20, 5, 4, 3), (40, 5, 60, 60))
    assert find_candidates(mask, KNOBS) == [(20, 5, 4, 3)]
    assert find_candidates(painted((101, 67)), KNOBS) == []


@pytest.mark.parametrize(("most", "count"), [(12, 12), (11, 0)])
def test_too_many_candidates_are_none(most, count, painted):
    mask = painted((200, 40), *((16 * k + 2, 10, 5, 5) for k in range(12)))
    assert len(find_candidates(mask, SmallParameters(max_candidates=most))) == count
