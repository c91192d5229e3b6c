"""The loop of a live run goes on after errors, and sheds load."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.live.streams import FakeClock
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.errors import InputError
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.receiver import DeadCamera
from torchvision_dddas.live.runner import Feed, LoadShedding, RepeatedFailure, results
from torchvision_dddas.live.watchdog import Watchdog
from torchvision_dddas.types import Adjustment, Detections, Frame, FrameResult, Telemetry, TrackedFrame, Tracks

PICTURE = np.zeros((4, 4), np.uint8)


class Camera:
    """Frames 1 to n; a second iteration goes on. breaks: the driver fails after that frame."""

    name, rate_hz, size, last = "camera", 10.0, (4, 4), 0

    def __init__(self, count, taken_s=float("nan"), breaks=0):
        self.frames = iter([Frame(n, (n - 1) / 10, PICTURE, taken_s=taken_s) for n in range(1, count + 1)])
        self.breaks = breaks

    def __iter__(self):
        for frame in self.frames:
            self.last = frame.number
            yield frame
            if frame.number == self.breaks:
                raise OSError("the driver")


def feed_of(count=10, health=None, telemetry=None, **how):
    health = health or Health()
    source: Any = Camera(count, **how)
    return Feed(source, health, Watchdog(health, 0), telemetry)


def result_of(frame, identity=1, person=None):
    def tracked(known):
        box_px, one = np.array([[0.0, 0, 2, 2]]), np.ones(1)
        found = Detections(box_px, one, one, one, one)
        return TrackedFrame(
            frame.number, frame, found, Tracks(frame.number, np.array([known]), box_px, one, np.zeros(1, int))
        )

    return FrameResult(tracked(identity)), None if person is None else tracked(person)


def path(broken=(), seen=None):
    """One result a frame, except for the broken ones, which raise."""

    def begin(feed):
        for frame in feed:
            if seen is not None:
                seen.append(frame)
            if frame.number in broken:
                raise ZeroDivisionError("that frame")
            yield result_of(frame, person=2)

    return begin


def numbers(got):
    return [located.tracked.number for located, _ in got]


def test_an_error_costs_only_its_frame_and_identities_after_it_are_new():
    health = Health()
    seen: list[Frame] = []
    got = list(results(path(broken=(4, 7), seen=seen), feed_of(health=health), health))
    assert numbers(got) == [1, 2, 3, 5, 6, 8, 9, 10]
    events = [event for event in health.snapshot().events if event.kind == "run"]
    assert [event.frame for event in events] == [4, 7]
    assert all("ZeroDivisionError: that frame" in event.text for event in events)
    assert health.snapshot().counts["begun_anew"] == 2
    # For the pipeline that begins anew, no frame before counts as missing.
    assert {frame.number: frame.skipped for frame in seen if frame.skipped} == {5: 4, 8: 7}
    assert [located.tracked.tracks.identity.tolist() for located, _ in got] == [[1]] * 3 + [[2]] * 2 + [[3]] * 3
    found = [people.tracks.identity.tolist() for _, people in got if people is not None]
    assert found == [[2]] * 3 + [[4]] * 2 + [[6]] * 3


def test_a_run_fails_after_many_errors_in_a_row_and_not_where_results_come_between():
    with pytest.raises(RepeatedFailure, match=r"25 times in a row .* ZeroDivisionError: that frame"):
        list(results(path(broken=range(5, 100)), feed_of(100), Health()))
    assert len(list(results(path(broken=range(2, 200, 2)), feed_of(200), Health()))) == 101


def test_provisional_results_do_not_hide_that_no_frame_is_settled():
    def begin(feed):
        for k, frame in enumerate(feed):
            if k == 1:
                raise ZeroDivisionError("the frame before")
            located, people = result_of(frame)
            tracks = replace(located.tracks, provisional=True)
            yield replace(located, tracked=replace(located.tracked, tracks=tracks)), people

    with pytest.raises(RepeatedFailure, match="25 times in a row"):
        list(results(begin, feed_of(100), Health()))


def test_a_source_that_breaks_is_iterated_again():
    assert numbers(results(path(), feed_of(6, breaks=3), Health())) == [1, 2, 3, 4, 5, 6]


def test_pictures_of_another_size_begin_anew_with_an_event_and_lose_no_frame():
    source: Any = Camera(0)
    health, sizes = Health(), []
    pictures = [PICTURE] * 3 + [np.zeros((8, 6), np.uint8)] * 3
    source.frames = iter([Frame(n, n / 10, picture) for n, picture in enumerate(pictures, 1)])
    feed = Feed(source, health, Watchdog(health, 0))

    def begin(feed):
        sizes.append(feed.size)
        yield from map(result_of, list(feed))  # a window that looks ahead is settled too

    assert numbers(results(begin, feed, health)) == [1, 2, 3, 4, 5, 6]
    assert sizes == [(4, 4), (6, 8)]
    assert [(e.frame, e.text) for e in health.snapshot().events] == [(4, "pictures are 6x8 from now on: begun anew")]


def test_a_dead_camera_ends_the_run_at_once():
    def begin(feed):
        raise DeadCamera("camera:0 is dead")

    health = Health()
    with pytest.raises(RepeatedFailure, match="camera:0 is dead"):
        list(results(begin, feed_of(), health))
    assert not health.snapshot().events


def test_a_stop_settles_the_frames_before_it_and_may_come_too_early_for_a_window():
    feed, health = feed_of(), Health()

    def late(feed):
        held = []
        for frame in feed:
            held.append(frame)
            if frame.number == 4:
                feed.stop()
        yield from map(result_of, held)

    def short(feed):
        yield from (result_of(frame) for frame in feed if frame.number > 2)
        raise InputError("the clip has 2 frames that can be read, a window needs 3: 1 missing")

    assert numbers(results(late, feed, Health())) == [1, 2, 3, 4]
    assert list(results(short, feed_of(2), health)) == []
    assert "a window needs 3" in health.snapshot().events[-1].text


def test_telemetry_that_falls_silent_and_comes_back_is_reported_once_each():
    time_s = np.arange(12) / 10
    altitude_m = np.where((time_s > 0.45) & (time_s < 0.75), np.nan, 30.0)
    health = Health()
    list(feed_of(40, health, Telemetry(time_s, altitude_m, np.full(12, 5.0))))
    events = health.snapshot().events
    # Seconds 0.5 to 0.7, and from one second after the end of the log on.
    assert [(event.kind, event.frame) for event in events] == [("telemetry", n) for n in (6, 9, 23)]
    assert ["silent" in event.text for event in events] == [True, False, True]


def test_a_log_that_loses_the_angles_of_the_camera_is_in_trouble_until_they_come_back():
    time_s, height_m = np.arange(30) / 10, np.full(30, 30.0)
    heading_rad = np.where((time_s > 0.95) & (time_s < 1.55), np.nan, 1.0)
    log = Telemetry(time_s, height_m, np.full(30, 5.0), heading_rad=heading_rad, pitch_rad=np.full(30, 1.0))
    health = Health()
    troubles = [health.snapshot().troubles for frame in feed_of(30, health, log) if frame.number in (9, 13, 20)]
    assert troubles == [(), ("telemetry gives no angles of the camera",), ()]
    texts = [event.text for event in health.snapshot().events]
    assert texts == ["telemetry gives no angles of the camera", "telemetry gives angles of the camera again"]


def test_telemetry_without_heights_above_ground_is_not_called_silent_while_it_speaks():
    health, time_s = Health(), np.arange(12) / 10
    list(feed_of(10, health, Telemetry(time_s, np.full(12, np.nan), np.full(12, 5.0), above_sea_m=np.full(12, 400.0))))
    assert health.snapshot().events == () and health.snapshot().troubles == ()


# -- load --------------------------------------------------------------------------------------------------------------

BASE = with_parameters(
    Settings(),
    {"registration.keypoints": 400, "live.least_keypoints": 100, "live.maximum_every": 4, "live.load": 0.8},
)


class Loaded:
    """A live source whose frames take as long as the test says, and the shedding of its load."""

    def __init__(self, health=None):
        self.apart_s, self.busy_s, self.every, self.clock = 0.04, 0.0, 1, FakeClock()
        source: Any = self
        self.shedding = LoadShedding(source, BASE, health, clock=self.clock)

    def look_at(self, every):
        self.every = every

    def feed(self, *costs_s):
        moved = list[Adjustment]()
        for number, cost_s in enumerate(costs_s, start=1):
            moved += self.shedding(Frame(number, 0.0, PICTURE))[1]
            self.busy_s = cost_s
            self.clock.now_s += self.apart_s * self.every
        return [(adjustment.parameter, adjustment.new) for adjustment in moved]

    @property
    def state(self):
        return self.every, self.shedding.settings.registration.keypoints


def test_long_steps_change_settings_and_the_source_and_are_reported():
    health = Health()
    source = Loaded(health)
    moved = source.feed(*[0.1] * 7)
    assert set(moved) == {("registration.keypoints", 100), ("sampling.every", 4)}
    assert source.shedding.settings == with_parameters(BASE, {"registration.keypoints": 100})
    now = health.snapshot()
    assert source.state == (4, 100) == (now.gauges["every"], now.gauges["keypoints"])
    (event,) = now.events
    assert event.kind == "load" and "keypoints 400 -> 100" in event.text and "100 ms" in event.text


def test_neither_one_long_step_nor_those_before_a_change_count_and_a_burst_passes():
    source = Loaded()
    assert source.feed(*[0.02] * 20, 2.0, *[0.02] * 20) == []
    assert source.shedding.settings is BASE
    source = Loaded()
    assert source.feed(*[0.036] * 6, *[0.02] * 30) == [("registration.keypoints", 200)]
    source.feed(*[0.1] * 10)
    assert source.every == 4
    source.feed(*[0.01] * 800)
    assert source.state == (1, 400)


def test_a_burst_of_slow_pictures_neither_sheds_load_nor_halves_the_rate_for_good():
    assert Loaded().feed(*[0.028] * 40, *[0.045] * 5, *[0.028] * 40) == []
    source = Loaded()
    source.feed(*[0.1] * 10, *[0.030] * 800)
    assert source.every == 1


@pytest.mark.parametrize("keypoints", [60, 150])
def test_settings_changed_between_frames_hold_from_the_next_frame_on(keypoints):
    ground = np.random.default_rng(3).integers(0, 255, (140, 200), np.uint8).repeat(2, 0).repeat(2, 1)
    frames = [Frame(k + 1, k / 10, np.ascontiguousarray(ground[:240, k : 320 + k])) for k in range(14)]
    later = with_parameters(BASE, {"registration.keypoints": keypoints})
    record = Adjustment(8, "registration.keypoints", 400, keypoints, "a test")

    def retune(frame):
        return (BASE, ()) if frame.number < 8 else (later, (record,) if frame.number == 8 else ())

    class Clip(list):
        rate_hz = 10.0

    scenes = list(detect_motion(Clip(frames), BASE, "onboard", retune=retune))
    assert [scene.frame.number for scene in scenes] == list(range(1, 15))
    assert [record in scene.adjustments for scene in scenes] == [n == 8 for n in range(1, 15)]
    assert all(scene.reliable for scene in scenes)
    tracked = [scene.step.tracked for scene in scenes[1:] if scene.step is not None]
    assert min(tracked[:6]) > keypoints >= max(tracked[6:])
