"""People beside what moves, scene by scene."""

import numpy as np
import pytest

from tests.people.test_detector import SIZE, Brightest, Clip
from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.people.detector import UNREAD, PersonTracker
from torchvision_dddas.tracking import FrameTracker
from torchvision_dddas.types import Detections, Registration, Scene

SETTINGS = Settings.model_validate({"people": {"search": "regions"}})
STILL = Registration(np.eye(3), 100, 100, 0.1, 0.0)


def person_tracker(scorer, settings, interval, size):
    tracker = FrameTracker(settings, interval, size, pictures=False)
    return PersonTracker(scorer, settings, interval, size, tracker)


class Sure(Brightest):
    """Certain enough for an identity."""

    def _map(self, image, part):
        return 5 * super()._map(image, part)


def scenes(clip=None, interval=1):
    for frame in clip or Clip():
        yield Scene(frame, np.zeros(SIZE[::-1], np.uint16), Detections(), interval, step=STILL)


def spotted(scenes, interval=1, settings=SETTINGS):
    spotter = person_tracker(Sure(), settings, interval, SIZE)
    for scene in scenes:
        spotter.update(scene)
    return spotter


def test_one_who_walks_keeps_an_identity_and_each_frame_is_told_once():
    spotter = spotted(scenes())
    found = [spotter.people_of(number, True) for number in range(1, 13)]
    assert [followed.number for followed in found] == list(range(1, 13))
    assert all(followed.detections.kind == "person" for followed in found)
    (identity,) = {name for followed in found for name in followed.tracks.identity.tolist()}
    assert identity == 1
    at = [followed.tracks.box_px[0, 0] for followed in found if len(followed.tracks)]
    assert len(at) >= 10
    assert at[-1] - at[0] > 20  # it went along
    assert spotter.people_of(12, True) is None


def test_what_is_not_settled_is_not_told_before_the_end():
    spotter = spotted(scenes())
    assert spotter.people_of(12, False) is None
    assert spotter.people_of(12, True) is not None


def test_people_settle_with_the_frames_of_what_moves():
    from torchvision_dddas.tracking import track_scenes

    spotter = person_tracker(Sure(), SETTINGS, 1, SIZE)

    def seen():
        for scene in scenes():
            spotter.update(scene)
            yield scene

    settled = []
    for followed in track_scenes(seen(), SETTINGS, 1, SIZE):
        people = spotter.people_of(followed.number, False)
        settled.append(people is not None)
    # Only the frames that the end itself settles wait for it.
    assert sum(settled) >= 6
    assert settled == sorted(settled, reverse=True)


def test_only_frames_that_are_followed_are_searched():
    spotter = spotted(scenes(), interval=3)
    assert [number for number in range(1, 13) if spotter.people_of(number, True) is not None] == [1, 4, 7, 10]


def test_a_frame_that_could_not_be_read_has_nobody():
    (scene,) = scenes(Clip(numbers=(1,)))
    unread = Scene(scene.frame, scene.mask, scene.detections, 1, False, UNREAD)
    spotter = person_tracker(Brightest(), SETTINGS, 1, SIZE)
    spotter.update(unread)
    people = spotter.people_of(1, True)
    assert people is not None
    assert len(people.detections) == 0


def test_a_narrower_search_looks_at_less():
    def windows(settings):
        recognizer = Brightest()
        spotter = person_tracker(recognizer, SETTINGS, 1, SIZE)
        for scene in scenes():
            if scene.frame.number == 3:
                spotter.retune(settings)
            spotter.update(scene)
        return recognizer.windows

    narrow = Settings.model_validate({"people": {"search": "regions", "look_share": 0.05}})
    assert windows(narrow) < windows(SETTINGS)


def test_pictures_smaller_than_the_window_are_one_line():
    with pytest.raises(InputError):
        person_tracker(Brightest(), SETTINGS, 1, (40, 60))
