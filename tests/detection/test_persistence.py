"""Targets are blobs that persist under registration, and small ones that have travelled."""

from dataclasses import replace

import numpy as np
import pytest

from torchvision_dddas.config import PersistenceParameters, SmallParameters
from torchvision_dddas.detection.blob_motion import Motion
from torchvision_dddas.detection.blobs import Blob
from torchvision_dddas.detection.persistence import Sighting, SmallTracks, find_persistent, find_small_boxes

SIZE = (640, 480)
# The flow test for every blob, however few there are.
STRICT = PersistenceParameters(flow_share=0.4, sure_share=0.7, links=3, passes=2, large_share=0.02, trusted_blobs=0)
FEW = STRICT.model_copy(update={"trusted_blobs": 4, "weak_links": 4, "weak_passes": 3})


def motion(velocity=(4.0, 0.0), steady=0.5) -> Motion:
    return Motion(np.array(velocity), steady, (np.zeros((3, 2)), np.zeros((3, 2))), (0.0, 0.0, 1.0))


def shift(u=0.0, v=0.0) -> np.ndarray:
    return np.array([[1, 0, u], [0, 1, v], [0, 0, 1.0]])


@pytest.fixture
def sightings(box_blob):
    """Five frames of one blob; `there` gives those in which it is visible, camera the motion and cut its loss."""

    def make(there=(1, 1, 1, 1, 1), steady=0.5, size=(20, 20), cut=False, camera=(0, 0), weak=False):
        frames = []
        for k, visible in enumerate(there):
            x, y = 100 + (4 + camera[0]) * k, 100 + camera[1] * k
            blobs = [replace(box_blob((x, y, *size)), weak=weak)] if visible else []
            step = None if cut and k in (1, 2) else shift(*camera)
            frames.append(Sighting(blobs, [motion(steady=steady)] * len(blobs), step))
        return frames

    return make


def verdict(frames, index=2, parameters=STRICT) -> bool:
    """Of the first blob of a frame, where every frame has another one far off."""
    off = Blob((500, 400, 9, 9), np.ones((9, 9), bool), np.ones((9, 9), bool), 1.0)
    crowds = [Sighting([*f.blobs, off], [*f.motions, motion()], f.next_from_this) for f in frames]
    return find_persistent(crowds, index, SIZE, parameters)[0]


@pytest.mark.parametrize(
    ("how", "parameters", "is_target"),
    [
        ({}, STRICT, True),
        ({"there": (0, 1, 1, 1, 0)}, STRICT, True),
        ({"there": (0, 1, 1, 0, 0)}, STRICT, False),
        ({"steady": 0.1}, STRICT, False),  # stays, but does not move steadily
        ({"camera": (60, -30)}, STRICT, True),  # a camera that moves breaks no chain
        ({"cut": True}, STRICT, False),
        ({"there": (0, 0, 1, 1, 0), "size": (100, 100), "steady": 0.0}, STRICT, True),  # a large one needs less
        ({"there": (0, 0, 1, 1, 0), "steady": 0.0}, STRICT, False),
        ({"there": (0, 0, 1, 1, 0), "steady": 0.0}, FEW, True),  # where few blobs are seen one link is enough
        ({"there": (0, 0, 1, 0, 0), "steady": 0.0}, FEW, False),
    ],
)
def test_a_linked_and_steady_blob_is_a_target(sightings, how, parameters, is_target):
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
def test_a_blob_that_jumps_in_place_or_size_is_not_linked(box_blob, boxes):
    assert not verdict([Sighting([box_blob(box)], [motion((0, 0))], np.eye(3)) for box in boxes])


@pytest.mark.parametrize(
    ("how", "is_target"), [({}, True), ({"steady": 0.0}, False), ({"there": (0, 0, 1, 1, 1)}, False)]
)
def test_a_weak_blob_must_be_linked_and_steady_even_among_few(sightings, how, is_target):
    assert find_persistent(sightings(weak=True, **how), 2, SIZE, FEW) == [is_target]


SMALL = SmallParameters()


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
