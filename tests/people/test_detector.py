"""People in pictures and clips, and beside the motion of a run."""

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
    """A scorer for which a window is a person where its middle is white; it counts what it is asked for."""

    name = "stub"

    def __init__(self, scale=1.0):
        self.calls, self.windows, self.scale = [], 0, scale

    def scores(self, images, parts):
        self.calls.append(len(images))
        return [[self._map(image, part) for part in wanted] for image, wanted in zip(images, parts, strict=True)]

    def _map(self, image, part):
        level = cv2.resize(image, part.level).astype(np.float32)
        level = level.mean(axis=2) if level.ndim == 3 else level
        middles = level[part.y + 63 : part.y + part.height - 64 : 8, part.x + 31 : part.x + part.width - 32 : 8]
        self.windows += middles.size
        return self.scale * (middles / 127.5 - 1)


@dataclass
class Clip:
    """Frames of a white disk that moves by 4 px a frame; some may be missing."""

    numbers: tuple[int, ...] = tuple(range(1, 13))
    last: int = 12
    rate_hz: float = 10.0
    images: dict = field(default_factory=dict)

    def __iter__(self):
        for number in self.numbers:
            image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
            cv2.circle(image, (80 + 4 * number, 120), 6, (255, 255, 255), -1)
            yield Frame(number, (number - 1) / self.rate_hz, self.images.get(number, image))


def is_at_the_disk(result):
    x, y, width, height = result.people.window_px[0]
    return (x + width / 2, y + height / 2) == pytest.approx((80 + 4 * result.frame.number, 120), abs=20)


def settings(**parameters):
    return Settings(people=PeopleParameters(**parameters))


def same(one, other):
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("box_px", "score", "margin", "cut", "window_px")
    )


ROWS = np.array([[200.0 if n == 3 else 60 + 4 * n, 70, 40, 100] for n in (1, 2, 3, 5, 9)])
TABLE = DetectionTable("t", np.array([1, 2, 3, 5, 9]), ROWS, np.ones(5), np.arange(5))


@pytest.mark.parametrize("around", [None, TABLE])
@pytest.mark.parametrize("batch", [2, 40])
def test_a_person_is_detected_in_every_frame_whatever_the_batch(batch, around):
    clip = Clip(numbers=(1, 2, 3, 5, 6, 9, 10), last=11)
    alone = list(detect_in_clip(clip, Brightest(), settings(), around, batch=1))
    engine = Brightest()
    together = list(detect_in_clip(clip, engine, settings(), around, batch=batch))
    assert max(engine.calls) > 1
    assert [r.frame.number for r in together] == list(range(1, 12))
    for one, other in zip(alone, together, strict=True):
        assert same(one.people, other.people)
        assert (one.share, one.cause) == (other.share, other.cause)
        read = one.frame.number in clip.numbers
        assert set(one.seconds) == {name for name in ("read", "plan", "score", "people") if read}
        in_region = around is None or one.frame.number in (1, 2, 5, 9)  # in frame 3 the row is elsewhere
        assert len(one.people) == (read and in_region)
        assert not len(one.people) or is_at_the_disk(one)
        if around is None:
            assert one.share == float(read)
        elif read and one.regions_px is not None:
            assert (0 < one.share < 1) == (len(one.regions_px) == 1) == bool(np.isin(one.frame.number, around.frame))


def test_a_search_in_regions_detects_the_same_with_fewer_windows():
    whole, parts = Brightest(), Brightest()
    everywhere = list(detect_in_clip(Clip(), whole, settings()))
    regions = list(detect_in_clip(Clip(), parts, settings(search="regions"), batch=8))
    assert set(parts.calls) == {1}  # each frame needs the people of the one before
    assert parts.windows < 0.5 * whole.windows
    assert len(everywhere) == len(regions) == 12
    assert all(is_at_the_disk(result) for result in everywhere + regions)
    assert [a.frame for r in regions for a in r.adjustments][:1] == [2]


def test_unreadable_frames_are_black_with_the_cause():
    made = list(detect_in_clip(Clip(numbers=(2, 3, 6), last=8), Brightest(), settings(), batch=2))
    assert [r.frame.number for r in made] == list(range(1, 9))
    assert [r.frame.number for r in made if r.cause] == [1, 4, 5, 7, 8]
    for r in (r for r in made if r.cause):
        assert (r.cause, len(r.people), r.share) == (UNREAD, 0, 0)
        assert r.frame.image.shape == (SIZE[1], SIZE[0], 3) and not r.frame.image.any()
        assert r.frame.time_s == pytest.approx((r.frame.number - 1) / 10)


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (np.zeros((200, 100), np.float32), "frame 1 must be uint8 of shape (H, W) or (H, W, 3), got float32"),
        (np.zeros((0, 100), np.uint8), "got uint8 of shape (0, 100)"),
        (None, "is None; could its file be read?"),
    ],
)
def test_anything_but_a_picture_is_refused_in_one_line(image, says):
    with pytest.raises(InputError) as error:
        list(detect_in_clip(Clip(numbers=(1,), images={1: image}), Brightest(), settings()))
    assert says in str(error.value)


def test_the_public_detector_takes_one_picture_or_several(monkeypatch):
    monkeypatch.setattr("torchvision_dddas.people.detector.load_scorer", lambda parameters, backend: Brightest())
    detector = PersonDetector()
    picture = np.zeros((160, 120), np.uint8)
    alone, both = detector(picture), detector([picture, picture])
    assert len(both) == 2 and len(alone) == len(both[0]) == len(both[1])
    with pytest.raises(InputError, match="got float64"):
        detector(np.zeros((160, 120)))
    with pytest.raises(InputError, match=r"^picture 2: a picture of 10 x 20 px"):
        detector([picture, np.zeros((20, 10), np.uint8)])
    monkeypatch.undo()
    with pytest.raises(InputError, match="no backend is named"):
        PersonDetector(backend="quantum")


REGIONS = settings(search="regions")
STILL = Registration(np.eye(3), 100, 100, 0.1, 0.0)


def person_tracker(scorer, interval=1, size=SIZE):
    tracker = FrameTracker(REGIONS, interval, size, pictures=False)
    return PersonTracker(scorer, REGIONS, interval, size, tracker)


def tracked(tracker):
    for frame in Clip():
        scene = Scene(frame, np.zeros(SIZE[::-1], np.uint16), Detections(), 1, step=STILL)
        tracker.update(scene)
        yield scene


def test_a_walker_keeps_an_identity_and_each_frame_comes_out_once():
    tracker = person_tracker(Brightest(5))  # certain enough for an identity
    assert len(list(tracked(tracker))) == 12
    found = [tracker.people_of(number, True) for number in range(1, 13)]
    assert [frame.number for frame in found] == list(range(1, 13))
    assert all(frame.detections.kind == "person" for frame in found)
    assert {name for frame in found for name in frame.tracks.identity.tolist()} == {1}
    at = [frame.tracks.box_px[0, 0] for frame in found if len(frame.tracks)]
    assert len(at) >= 10 and at[-1] - at[0] > 20
    assert tracker.people_of(12, True) is None
    third = person_tracker(Brightest(5), interval=3)
    list(tracked(third))
    assert [number for number in range(1, 13) if third.people_of(number, True) is not None] == [1, 4, 7, 10]
    with pytest.raises(InputError):
        person_tracker(Brightest(), size=(40, 60))


def test_people_settle_with_the_frames_of_the_motion_but_for_the_last():
    tracker = person_tracker(Brightest(5))
    frames = track_scenes(tracked(tracker), REGIONS, 1, SIZE)
    settled = [tracker.people_of(frame.number, False) is not None for frame in frames]
    assert len(settled) == 12 and sum(settled) >= 6
    assert settled == sorted(settled, reverse=True)


def test_an_unreadable_frame_has_no_people():
    (frame,) = Clip(numbers=(1,))
    tracker = person_tracker(Brightest())
    tracker.update(Scene(frame, np.zeros(SIZE[::-1], np.uint16), Detections(), 1, False, UNREAD))
    people = tracker.people_of(1, True)
    assert people is not None and len(people.detections) == 0


def test_a_smaller_share_searches_fewer_windows():
    def windows(share):
        scorer = Brightest()
        tracker = person_tracker(scorer)
        for scene in tracked(tracker):
            if scene.frame.number == 3:
                tracker.retune(settings(search="regions", **share))
        return scorer.windows

    assert windows({"look_share": 0.05}) < windows({})
