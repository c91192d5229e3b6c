"""Blobs that stay are targets, blobs that flicker are not. Parameters are given: a new default changes nothing here."""

from dataclasses import replace

import numpy as np
import pytest

from torchvision_dddas.config import PersistenceParameters
from torchvision_dddas.detection.blob_motion import Motion
from torchvision_dddas.detection.blobs import Blob
from torchvision_dddas.detection.persistence import Sighting, find_persistent

SIZE = (640, 480)
NOTHING = np.zeros((3, 2))
# The flow test for every blob, however few there are.
STRICT = PersistenceParameters(flow_share=0.4, sure_share=0.7, links=3, passes=2, large_share=0.02, trusted_blobs=0)


def motion(velocity=(4.0, 0.0), steady=0.5) -> Motion:
    return Motion(np.array(velocity), steady, (NOTHING, NOTHING), (0.0, 0.0, 1.0))


@pytest.fixture
def sightings(box_blob):
    """Five frames of one blob that moves by `velocity`; `there` says in which it is seen, step how the camera moves."""

    def make(there=(1, 1, 1, 1, 1), velocity=(4.0, 0.0), steady=0.5, size=(20, 20), step=None, camera=(0, 0)):
        frames = []
        for k, seen in enumerate(there):
            x, y = 100 + (velocity[0] + camera[0]) * k, 100 + (velocity[1] + camera[1]) * k
            blobs = [box_blob((int(x), int(y), *size))] if seen else []
            shift = np.array([[1, 0, camera[0]], [0, 1, camera[1]], [0, 0, 1.0]])
            frames.append(Sighting(blobs, [motion(velocity, steady)] * len(blobs), shift if step is None else step[k]))
        return frames

    return make


def verdict(frames, index=2, parameters=STRICT) -> bool:
    """Of the first blob of a frame; a second one far off in every frame is there so that blobs come in crowds."""
    off = Blob((500, 400, 9, 9), np.ones((9, 9), bool), np.ones((9, 9), bool), 1.0)
    crowds = [Sighting([*f.blobs, off], [*f.motions, motion()], f.next_from_this) for f in frames]
    return find_persistent(crowds, index, SIZE, parameters)[0]


def test_a_blob_seen_all_along_and_moving_steadily_is_a_target(sightings):
    assert verdict(sightings())


def test_a_blob_seen_in_three_of_five_frames_is_one_and_in_two_none(sightings):
    for there, wanted in (((1, 1, 1, 0, 0), True), ((0, 1, 1, 1, 0), True), ((0, 1, 1, 0, 0), False)):
        assert verdict(sightings(there=there)) is wanted


def test_a_blob_that_stays_but_does_not_move_steadily_is_none(sightings):
    assert not verdict(sightings(steady=0.1))


def test_a_camera_that_moves_breaks_no_chain(sightings):
    assert verdict(sightings(camera=(60, -30)))


def test_a_chain_ends_at_a_cut(sightings):
    whole = np.eye(3)
    assert not verdict(sightings(step=(whole, None, None, whole, whole)))


def test_at_the_ends_of_a_clip_fewer_frames_do(sightings):
    frames = sightings()
    assert verdict(frames, 0) and verdict(frames, 4)
    assert find_persistent(frames[:1], 0, SIZE, STRICT) == [True]


def test_a_large_blob_is_believed_without_steady_flow(sightings):
    assert verdict(sightings(there=(0, 0, 1, 1, 0), size=(100, 100), steady=0.0))
    assert not verdict(sightings(there=(0, 0, 1, 1, 0), size=(20, 20), steady=0.0))


def test_where_few_blobs_are_seen_one_link_does_for_a_small_one(sightings):
    few = STRICT.model_copy(update={"trusted_blobs": 4})
    assert verdict(sightings(there=(0, 0, 1, 1, 0), steady=0.0), parameters=few)
    assert not verdict(sightings(there=(0, 0, 1, 0, 0), steady=0.0), parameters=few)


def test_a_blob_that_jumps_elsewhere_is_not_the_same(box_blob):
    frames = [
        Sighting([box_blob((x, y, 20, 20))], [motion((0, 0))], np.eye(3))
        for x, y in ((0, 0), (300, 9), (100, 100), (9, 300), (500, 400))
    ]
    assert not verdict(frames)


def test_a_blob_that_changes_its_size_too_much_is_not_the_same(box_blob):
    frames = [Sighting([box_blob((100, 100, s, s))], [motion((0, 0))], np.eye(3)) for s in (60, 60, 20, 60, 60)]
    assert not verdict(frames)


def test_a_weak_blob_must_be_linked_and_steady_however_few_blobs_there_are(sightings):
    def weak(frames):
        return [Sighting([replace(b, weak=True) for b in f.blobs], f.motions, f.next_from_this) for f in frames]

    few = STRICT.model_copy(update={"trusted_blobs": 4, "weak_links": 4, "weak_passes": 3})
    assert find_persistent(weak(sightings()), 2, SIZE, few) == [True]
    assert find_persistent(weak(sightings(steady=0.0)), 2, SIZE, few) == [False]
    assert find_persistent(weak(sightings(there=(0, 0, 1, 1, 1))), 2, SIZE, few) == [False]
    assert find_persistent(sightings(there=(0, 0, 1, 1, 1)), 2, SIZE, few) == [True]
