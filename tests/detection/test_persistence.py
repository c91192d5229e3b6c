"""Which blobs are targets: those seen again where registration puts them; small ones, once they have travelled."""

from dataclasses import replace

import numpy as np
import pytest

from torchvision_dddas.config import PersistenceParameters, SmallParameters
from torchvision_dddas.detection.blob_motion import Motion
from torchvision_dddas.detection.blobs import Blob
from torchvision_dddas.detection.persistence import Sighting, SmallTracks, find_candidates, find_persistent

SIZE = (640, 480)
# The flow test for every blob, however few there are.
STRICT = PersistenceParameters(flow_share=0.4, sure_share=0.7, links=3, passes=2, large_share=0.02, trusted_blobs=0)
FEW = STRICT.model_copy(update={"trusted_blobs": 4, "weak_links": 4, "weak_passes": 3})
CUT = (np.eye(3), None, None, np.eye(3), np.eye(3))


def motion(velocity=(4.0, 0.0), steady=0.5) -> Motion:
    return Motion(np.array(velocity), steady, (np.zeros((3, 2)), np.zeros((3, 2))), (0.0, 0.0, 1.0))


@pytest.fixture
def sightings(box_blob):
    """Five frames of one blob that moves by `velocity`; `there` says in which it is seen, step how the camera moves."""

    def make(there=(1, 1, 1, 1, 1), steady=0.5, size=(20, 20), step=None, camera=(0, 0), weak=False):
        frames = []
        for k, seen in enumerate(there):
            x, y = 100 + (4.0 + camera[0]) * k, 100 + camera[1] * k
            blobs = [replace(box_blob((int(x), int(y), *size)), weak=weak)] if seen else []
            shift = np.array([[1, 0, camera[0]], [0, 1, camera[1]], [0, 0, 1.0]])
            frames.append(Sighting(blobs, [motion(steady=steady)] * len(blobs), shift if step is None else step[k]))
        return frames

    return make


def verdict(frames, index=2, parameters=STRICT) -> bool:
    """Of the first blob of a frame; a second one far off in every frame is there so that blobs come in crowds."""
    off = Blob((500, 400, 9, 9), np.ones((9, 9), bool), np.ones((9, 9), bool), 1.0)
    crowds = [Sighting([*f.blobs, off], [*f.motions, motion()], f.next_from_this) for f in frames]
    return find_persistent(crowds, index, SIZE, parameters)[0]


@pytest.mark.parametrize(
    ("how", "parameters", "is_target"),
    [
        ({}, STRICT, True),
        ({"there": (1, 1, 1, 0, 0)}, STRICT, True),
        ({"there": (0, 1, 1, 1, 0)}, STRICT, True),
        ({"there": (0, 1, 1, 0, 0)}, STRICT, False),
        ({"steady": 0.1}, STRICT, False),  # stays, but does not move steadily
        ({"camera": (60, -30)}, STRICT, True),  # a camera that moves breaks no chain
        ({"step": CUT}, STRICT, False),
        ({"there": (0, 0, 1, 1, 0), "size": (100, 100), "steady": 0.0}, STRICT, True),  # a large one needs less
        ({"there": (0, 0, 1, 1, 0), "steady": 0.0}, STRICT, False),
        ({"there": (0, 0, 1, 1, 0), "steady": 0.0}, FEW, True),  # where few blobs are seen one link is enough
        ({"there": (0, 0, 1, 0, 0), "steady": 0.0}, FEW, False),
    ],
)
def test_a_blob_that_is_linked_and_steady_is_a_target(sightings, how, parameters, is_target):
    assert verdict(sightings(**how), parameters=parameters) is is_target


def test_at_the_ends_of_a_clip_fewer_frames_are_enough(sightings):
    frames = sightings()
    assert verdict(frames, 0) and verdict(frames, 4)
    assert find_persistent(frames[:1], 0, SIZE, STRICT) == [True]


@pytest.mark.parametrize(
    "boxes",
    [
        [(x, y, 20, 20) for x, y in ((0, 0), (300, 9), (100, 100), (9, 300), (500, 400))],
        [(100, 100, side, side) for side in (60, 60, 20, 60, 60)],
    ],
    ids=["place", "size"],
)
def test_a_blob_that_jumps_in_place_or_size_is_not_the_same(box_blob, boxes):
    assert not verdict([Sighting([box_blob(box)], [motion((0, 0))], np.eye(3)) for box in boxes])


@pytest.mark.parametrize(
    ("how", "is_target"),
    [
        ({"weak": True}, True),
        ({"weak": True, "steady": 0.0}, False),
        ({"weak": True, "there": (0, 0, 1, 1, 1)}, False),
        ({"there": (0, 0, 1, 1, 1)}, True),
    ],
)
def test_a_weak_blob_must_be_linked_and_steady_however_few_blobs_there_are(sightings, how, is_target):
    assert find_persistent(sightings(**how), 2, SIZE, FEW) == [is_target]


SMALL = SmallParameters()


def confirmed(tracks):
    return [track for track in tracks.tracks if track.confirmed]


def tracked(place, frames=30, camera=(0.0, 0.0), size=(10, 6), seen=lambda k: True):
    """Tracks of one candidate whose ground position is place(k), under a camera that shifts the picture."""
    tracks = SmallTracks(SMALL)
    shift = np.array([[1, 0, camera[0]], [0, 1, camera[1]], [0, 0, 1.0]])
    for k in range(frames):
        u, v = np.array(place(k)) + np.array(camera) * k
        tracks.step(k, shift if k else None, [(round(u), round(v), *size)] if seen(k) else [])
    return tracks


@pytest.mark.parametrize("camera", [(0.0, 0.0), (7.0, -3.0)])
def test_a_slow_straight_traveller_is_confirmed_however_the_camera_moves(camera):
    (track,) = confirmed(tracked(lambda k: (50 + 0.8 * k, 60), camera=camera))
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
    assert confirmed(tracked(place, **more)) == []


def test_a_few_misses_are_bridged_and_more_end_the_track():
    assert len(tracked(lambda k: (50 + 0.8 * k, 60), seen=lambda k: k % 3 != 1).tracks) == 1
    assert tracked(lambda k: (50 + 0.8 * k, 60), frames=25, seen=lambda k: k < 20).tracks == []


def test_two_that_pass_near_each_other_keep_their_tracks():
    tracks = SmallTracks(SMALL)
    for k in range(30):
        tracks.step(k, np.eye(3), [(30 + k, 60, 8, 6), (60 - k, 67, 8, 6)])
    assert sorted(round(float(t.velocity_px[0])) for t in confirmed(tracks)) == [-1, 1]


def test_candidates_are_gated_by_area_and_box_and_too_many_are_none(painted):
    assert find_candidates(painted((101, 67), (5, 5, 3, 3), (20, 5, 4, 3), (40, 5, 60, 60)), SMALL) == [(20, 5, 4, 3)]
    assert find_candidates(painted((101, 67)), SMALL) == []
    mask = painted((200, 40), *((16 * k + 2, 10, 5, 5) for k in range(12)))
    found = [len(find_candidates(mask, SmallParameters(max_candidates=most))) for most in (12, 11)]
    assert found == [12, 0]
