"""People in pictures and clips, and beside what moves in the scenes of a run."""

from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import PeopleParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.people.detector import UNREAD, PersonDetector, PersonTracker, detect_in_clip
from torchvision_dddas.tracking import FrameTracker, track_scenes
from torchvision_dddas.types import Detections, DetectionTable, Frame, Registration, Scene

SIZE = (320, 240)


class Brightest:
    """A recognizer for which a window is a person where its middle is white; it counts what it is asked for."""

    name = "stub"

    def __init__(self):
        self.calls, self.windows = [], 0

    def scores(self, images, parts):
        self.calls.append(len(images))
        return [[self._map(image, part) for part in wanted] for image, wanted in zip(images, parts, strict=True)]

    def _map(self, image, part):
        level = cv2.resize(image, part.level).astype(np.float32)
        if level.ndim == 3:
            level = level.mean(axis=2)
        nx, ny = (part.width - 64) // 8 + 1, (part.height - 128) // 8 + 1
        self.windows += nx * ny
        return np.array(
            [[level[part.y + 8 * j + 63, part.x + 8 * i + 31] / 127.5 - 1 for i in range(nx)] for j in range(ny)],
            np.float32,
        ).reshape(ny, nx)


@dataclass
class Clip:
    """Frames at hand, some of them missing."""

    numbers: tuple[int, ...] = tuple(range(1, 13))
    last: int = 12
    rate_hz: float = 10.0
    step_px: float = 4.0
    images: dict = field(default_factory=dict)

    def __iter__(self):
        for number in self.numbers:
            image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
            cv2.circle(image, (round(80 + self.step_px * number), 120), 6, (255, 255, 255), -1)
            yield Frame(number, (number - 1) / self.rate_hz, self.images.get(number, image))


def settings(**parameters):
    return Settings(people=PeopleParameters(**parameters))


def table(rows):
    rows = np.array(rows, float).reshape(-1, 5)
    return DetectionTable("t", rows[:, 0].astype(int), rows[:, 1:], np.ones(len(rows)), np.arange(len(rows)))


def same(one, other):
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("box_px", "score", "margin", "cut", "window_px")
    )


def test_who_is_there_is_found_where_he_is_in_every_frame():
    made = list(detect_in_clip(Clip(), Brightest(), settings()))
    assert [r.frame.number for r in made] == list(range(1, 13))
    for r in made:
        middle = r.people.window_px[0, :2] + r.people.window_px[0, 2:] / 2
        assert middle == pytest.approx([80 + 4 * r.frame.number, 120], abs=20)
        assert (r.regions_px, r.share, r.cause, r.adjustments) == (None, 1.0, "", ())
        assert set(r.seconds) == {"read", "plan", "score", "people"}


@pytest.mark.parametrize("around", [None, table([[n, 60 + 4 * n, 70, 40, 100] for n in (1, 2, 5, 9)])])
@pytest.mark.parametrize("batch", [2, 5, 40])
def test_the_result_does_not_depend_on_the_batch(batch, around):
    clip = Clip(numbers=(1, 2, 3, 5, 6, 9, 10), last=11)
    alone = list(detect_in_clip(clip, Brightest(), settings(), around, batch=1))
    engine = Brightest()
    together = list(detect_in_clip(clip, engine, settings(), around, batch=batch))
    assert max(engine.calls) > 1
    assert [r.frame.number for r in together] == list(range(1, 12))
    for one, other in zip(alone, together, strict=True):
        assert same(one.people, other.people)
        assert (one.share, one.cause) == (other.share, other.cause)


def test_in_regions_a_frame_waits_for_the_one_before_and_finds_the_same_with_fewer_windows():
    whole, parts = Brightest(), Brightest()
    everywhere = list(detect_in_clip(Clip(), whole, settings()))
    regions = list(detect_in_clip(Clip(), parts, settings(search="regions"), batch=8))
    assert set(parts.calls) == {1}
    assert parts.windows < 0.5 * whole.windows
    assert len(everywhere) == len(regions) == 12
    for r in regions:
        middle = r.people.window_px[0, :2] + r.people.window_px[0, 2:] / 2
        assert middle == pytest.approx([80 + 4 * r.frame.number, 120], abs=20)
    assert [a.frame for r in regions for a in r.adjustments][:1] == [2]


def test_frames_that_could_not_be_read_are_black_and_say_so():
    made = list(detect_in_clip(Clip(numbers=(2, 3, 6), last=8), Brightest(), settings(), batch=2))
    assert [r.frame.number for r in made] == list(range(1, 9))
    unread = [r for r in made if r.cause]
    assert [r.frame.number for r in unread] == [1, 4, 5, 7, 8]
    for r in unread:
        assert (r.cause, len(r.people), r.share) == (UNREAD, 0, 0)
        assert r.frame.image.shape == (SIZE[1], SIZE[0], 3) and not r.frame.image.any()
        assert r.frame.time_s == pytest.approx((r.frame.number - 1) / 10)


def test_around_a_table_nobody_is_found_elsewhere():
    boxes = table([[2, 68, 70, 40, 100], [3, 200, 70, 40, 100]])
    made = {r.frame.number: r for r in detect_in_clip(Clip(), Brightest(), settings(), boxes)}
    assert len(made[2].people) and not len(made[3].people)
    assert made[1].share == 0 and len(made[1].people) == 0
    assert 0 < made[2].share < 1
    assert made[2].regions_px is not None and made[2].regions_px.shape == (1, 4)


BAD_PICTURES = [
    (np.zeros((200, 100), np.float32), "frame 1 holds float32 pixels; wanted 8 bits"),
    (np.full((200, 100, 3), np.nan), "frame 1 holds float64 pixels, NaN among them"),
    (np.zeros((200, 100), np.uint16), "uint16"),
    (np.zeros((200, 100, 4), np.uint8), "200 x 100 x 4; wanted height x width, or these x 1 or 3 channels"),
    (np.zeros((1, 3, 200, 100), np.uint8), "1 x 3 x 200 x 100"),
    (np.zeros(0, np.uint8), "an array of 0"),
    (np.zeros((0, 100), np.uint8), "0 x 100"),
    (np.uint8(3), "a single uint8; wanted height x width"),
    (None, "is None; could its file be read?"),
]


@pytest.mark.parametrize(("image", "says"), BAD_PICTURES)
def test_what_is_no_picture_is_one_line(image, says):
    with pytest.raises(InputError) as error:
        list(detect_in_clip(Clip(numbers=(1,), images={1: image}), Brightest(), settings()))
    assert says in str(error.value) and "\n" not in str(error.value)


def test_the_public_detector_gives_the_people_of_one_picture_or_several(monkeypatch):
    monkeypatch.setattr("torchvision_dddas.people.detector.load_scorer", lambda parameters, backend: Brightest())
    detector = PersonDetector()
    picture = np.zeros((160, 120), np.uint8)
    alone, both = detector(picture), detector([picture, picture])
    assert len(both) == 2 and len(alone) == len(both[0]) == len(both[1])
    with pytest.raises(InputError, match="float64 pixels"):
        detector(np.zeros((160, 120)))
    with pytest.raises(InputError, match=r"^picture 2: a picture of 10 x 20 px"):
        detector([picture, np.zeros((20, 10), np.uint8)])
    monkeypatch.undo()
    with pytest.raises(InputError, match="no back end is named"):
        PersonDetector(backend="quantum")


SETTINGS = Settings.model_validate({"people": {"search": "regions"}})
STILL = Registration(np.eye(3), 100, 100, 0.1, 0.0)


def person_tracker(scorer, settings, interval, size):
    return PersonTracker(scorer, settings, interval, size, FrameTracker(settings, interval, size, pictures=False))


class Sure(Brightest):
    """Certain enough for an identity."""

    def _map(self, image, part):
        return 5 * super()._map(image, part)


def scenes(clip=None, interval=1):
    for frame in clip or Clip():
        yield Scene(frame, np.zeros(SIZE[::-1], np.uint16), Detections(), interval, step=STILL)


def tracked(scenes, interval=1, settings=SETTINGS):
    tracker = person_tracker(Sure(), settings, interval, SIZE)
    for scene in scenes:
        tracker.update(scene)
    return tracker


def test_one_who_walks_keeps_an_identity_and_each_frame_is_told_once():
    tracker = tracked(scenes())
    found = [tracker.people_of(number, True) for number in range(1, 13)]
    assert [frame.number for frame in found] == list(range(1, 13))
    assert all(frame.detections.kind == "person" for frame in found)
    (identity,) = {name for frame in found for name in frame.tracks.identity.tolist()}
    assert identity == 1
    at = [frame.tracks.box_px[0, 0] for frame in found if len(frame.tracks)]
    assert len(at) >= 10
    assert at[-1] - at[0] > 20  # it went along
    assert tracker.people_of(12, True) is None
    assert tracked(scenes()).people_of(12, False) is None
    of_third = tracked(scenes(), interval=3)
    assert [number for number in range(1, 13) if of_third.people_of(number, True) is not None] == [1, 4, 7, 10]
    with pytest.raises(InputError):
        person_tracker(Brightest(), SETTINGS, 1, (40, 60))


def test_people_settle_with_the_frames_of_what_moves():
    tracker = person_tracker(Sure(), SETTINGS, 1, SIZE)

    def seen():
        for scene in scenes():
            tracker.update(scene)
            yield scene

    settled = []
    for frame in track_scenes(seen(), SETTINGS, 1, SIZE):
        people = tracker.people_of(frame.number, False)
        settled.append(people is not None)
    # Only the frames that the end itself settles wait for it.
    assert sum(settled) >= 6
    assert settled == sorted(settled, reverse=True)


def test_a_frame_that_could_not_be_read_has_nobody():
    (scene,) = scenes(Clip(numbers=(1,)))
    unread = Scene(scene.frame, scene.mask, scene.detections, 1, False, UNREAD)
    tracker = person_tracker(Brightest(), SETTINGS, 1, SIZE)
    tracker.update(unread)
    people = tracker.people_of(1, True)
    assert people is not None
    assert len(people.detections) == 0


def test_a_narrower_search_looks_at_less():
    def windows(settings):
        scorer = Brightest()
        tracker = person_tracker(scorer, SETTINGS, 1, SIZE)
        for scene in scenes():
            if scene.frame.number == 3:
                tracker.retune(settings)
            tracker.update(scene)
        return scorer.windows

    narrow = Settings.model_validate({"people": {"search": "regions", "look_share": 0.05}})
    assert windows(narrow) < windows(SETTINGS)
