"""The loop of a live run goes on after errors, and sheds load."""

import time
from typing import Any

import numpy as np
import pytest

from tests.live.streams import FakeClock
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.errors import InputError
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.runner import Feed, LoadShedding, RepeatedFailure, record_result, results, send_result
from torchvision_dddas.live.watchdog import Watchdog
from torchvision_dddas.types import Adjustment, Detections, Frame, FrameResult, Telemetry, TrackedFrame, Tracks

PICTURE = np.zeros((4, 4), np.uint8)


class Camera:
    """Frames 1 to n; who iterates again goes on."""

    name, rate_hz, size, last = "camera", 10.0, (4, 4), 0

    def __init__(self, count, taken_s=float("nan")):
        self.frames = iter([Frame(n, (n - 1) / 10, PICTURE, taken_s=taken_s) for n in range(1, count + 1)])

    def __iter__(self):
        for frame in self.frames:
            self.last = frame.number
            yield frame


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
    """One result a frame, but for those that break it."""

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


def test_an_error_costs_its_frame_alone_and_identities_after_it_are_new():
    health = Health()
    seen: list[Frame] = []
    got = list(results(path(broken=(4, 7), seen=seen), feed_of(health=health), health))
    assert numbers(got) == [1, 2, 3, 5, 6, 8, 9, 10]
    events = [event for event in health.snapshot().events if event.kind == "run"]
    assert [event.frame for event in events] == [4, 7]
    assert all("ZeroDivisionError: that frame" in event.text for event in events)
    assert health.snapshot().counts["begun_anew"] == 2
    # To the pipeline that begins anew no frame before counts as missing.
    assert {frame.number: frame.skipped for frame in seen if frame.skipped} == {5: 4, 8: 7}
    assert [located.tracked.tracks.identity.tolist() for located, _ in got] == [[1]] * 3 + [[2]] * 2 + [[3]] * 3
    found = [people.tracks.identity.tolist() for _, people in got if people is not None]
    assert found == [[2]] * 3 + [[4]] * 2 + [[6]] * 3


def test_it_fails_where_no_result_comes_any_more_and_goes_on_where_results_come_between():
    with pytest.raises(RepeatedFailure, match=r"25 times in a row .* ZeroDivisionError: that frame"):
        list(results(path(broken=range(5, 100)), feed_of(100), Health()))
    assert len(list(results(path(broken=range(2, 200, 2)), feed_of(200), Health()))) == 101


def test_a_source_that_breaks_is_iterated_again():
    class Breaking(Camera):
        def __iter__(self):
            for frame in self.frames:
                yield frame
                if frame.number == 3:
                    raise OSError("the driver")

    health = Health()
    source: Any = Breaking(6)
    feed = Feed(source, health, Watchdog(health, 0))
    assert numbers(results(path(), feed, health)) == [1, 2, 3, 4, 5, 6]


def test_what_was_seen_is_still_settled_after_a_stop():
    feed = feed_of()

    def late(feed):
        held = []
        for frame in feed:
            held.append(frame)
            if frame.number == 4:
                feed.stop()
        yield from map(result_of, held)

    assert numbers(results(late, feed, Health())) == [1, 2, 3, 4]


def test_a_run_that_was_stopped_too_early_for_a_window_ends_well():
    def short(feed):
        yield from (result_of(frame) for frame in feed if frame.number > 2)
        raise InputError("the clip has 2 frames that can be read, a window needs 3: 1 missing")

    health = Health()
    assert list(results(short, feed_of(2), health)) == []
    assert "a window needs 3" in health.snapshot().events[-1].text


def test_telemetry_that_falls_silent_and_comes_back_is_told_once_each():
    time_s = np.arange(12) / 10
    altitude_m = np.where((time_s > 0.45) & (time_s < 0.75), np.nan, 30.0)
    health = Health()
    list(feed_of(40, health, Telemetry(time_s, altitude_m, np.full(12, 5.0))))
    events = health.snapshot().events
    # Seconds 0.5 to 0.7, and from one second after the end of the log on.
    assert [(event.kind, event.frame) for event in events] == [("telemetry", n) for n in (6, 9, 23)]
    assert ["silent" in event.text for event in events] == [True, False, True]


def test_latency_is_of_the_newest_picture_and_lateness_is_counted():
    health, feed = Health(), feed_of(1, taken_s=time.monotonic() - 1.0)
    (frame,) = feed
    record_result(result_of(frame, person=1), feed, health, 80.0)
    now = health.snapshot()
    assert now.counts["late"] == now.counts["results"] == 1
    assert now.seconds["latency"][0] >= 1.0
    assert now.gauges["targets"] == now.gauges["people"] == 1
    record_result(result_of(frame), feed, health, 1e9)
    assert health.snapshot().counts["late"] == 1


def test_a_stream_that_cannot_write_a_frame_keeps_no_other_from_it():
    class Good(Any):
        name, got = "good", 0

        def write(self, surveyed, people=None):
            self.got += 1

    class Bad(Any):
        name = "bad"

        def write(self, surveyed, people=None):
            raise ValueError("no such digit")

    health, good = Health(), Good()
    send_result(result_of(Frame(3, 0.0, PICTURE)), [Bad(), good], health)
    assert good.got == 1
    (event,) = health.snapshot().events
    assert (event.kind, event.frame) == ("sink", 3)
    assert "bad: left out, ValueError: no such digit" in event.text


# -- load --------------------------------------------------------------------------------------------------------------

BASE = with_parameters(
    Settings(),
    {"registration.keypoints": 400, "live.least_keypoints": 100, "live.maximum_every": 4, "live.load": 0.8},
)


class Source(Any):
    """A live source whose looks take what a test says."""

    def __init__(self) -> None:
        self.apart_s, self.busy_s, self.every = 0.04, 0.0, 1

    def look_at(self, every: int) -> None:
        self.every = every


def fed(shedding: LoadShedding, source: Source, costs_s: list[float], clock: FakeClock) -> list[Adjustment]:
    moved: list[Adjustment] = []
    for number, cost_s in enumerate(costs_s, start=1):
        _, some = shedding(Frame(number, 0.0, np.zeros((2, 2), np.uint8)))
        moved += some
        source.busy_s = cost_s
        clock.now_s += source.apart_s * source.every
    return moved


def test_a_single_long_look_sheds_nothing() -> None:
    source, clock = Source(), FakeClock()
    shedding = LoadShedding(source, BASE, clock=clock)
    assert fed(shedding, source, [0.02] * 20 + [2.0] + [0.02] * 20, clock) == []
    assert shedding.settings is BASE


def test_long_looks_change_settings_and_the_source_and_are_told() -> None:
    source, clock, health = Source(), FakeClock(), Health()
    shedding = LoadShedding(source, BASE, health, clock=clock)
    moved = fed(shedding, source, [0.1] * 7, clock)
    assert {(a.parameter, a.new) for a in moved} == {("registration.keypoints", 100), ("sampling.every", 4)}
    assert shedding.settings.registration.keypoints == 100
    assert shedding.settings == with_parameters(BASE, {"registration.keypoints": 100})
    assert source.every == 4
    told = health.snapshot()
    assert (told.gauges["every"], told.gauges["keypoints"]) == (4, 100)
    assert [event.kind for event in told.events] == ["load"]
    assert "keypoints 400 -> 100" in told.events[0].text
    assert "100 ms" in told.events[0].text


def test_what_was_measured_before_a_change_does_not_count_and_after_a_burst_all_is_as_it_was() -> None:
    source, clock = Source(), FakeClock()
    shedding = LoadShedding(source, BASE, clock=clock)
    moved = fed(shedding, source, [0.036] * 6 + [0.02] * 30, clock)
    assert [(a.parameter, a.new) for a in moved] == [("registration.keypoints", 200)]
    fed(shedding, source, [0.1] * 10, clock)
    assert source.every == 4
    fed(shedding, source, [0.01] * 800, clock)
    assert (source.every, shedding.settings.registration.keypoints) == (1, 400)


def test_people_are_searched_for_less_widely_before_pictures_are_left_out() -> None:
    settings = with_parameters(BASE, {"people.search": "regions"})
    source, clock = Source(), FakeClock()
    shedding = LoadShedding(source, settings, people=True, clock=clock)
    moved = fed(shedding, source, [0.036] * 22, clock)
    assert [(a.parameter, a.new) for a in moved if a.parameter.startswith("people")][:1] == [("people.look_share", 0.5)]
    assert source.every == 1
    assert shedding.settings.people.look_share < settings.people.look_share


@pytest.mark.parametrize("keypoints", [60, 150])
def test_other_settings_between_frames_are_what_the_next_frames_are_seen_with(keypoints: int) -> None:
    rng = np.random.default_rng(3)
    ground = rng.integers(0, 255, (140, 200), np.uint8).repeat(2, 0).repeat(2, 1)
    frames = [Frame(k + 1, k / 10, np.ascontiguousarray(ground[:240, k : 320 + k])) for k in range(14)]
    later = with_parameters(BASE, {"registration.keypoints": keypoints})
    record = Adjustment(8, "registration.keypoints", 400, keypoints, "a test")

    def retune(frame: Frame) -> tuple[Settings, tuple[Adjustment, ...]]:
        return (BASE, ()) if frame.number < 8 else (later, (record,) if frame.number == 8 else ())

    class Clip(list):
        rate_hz = 10.0

    scenes = list(detect_motion(Clip(frames), BASE, "onboard", retune=retune))
    assert [scene.frame.number for scene in scenes] == list(range(1, 15))
    assert [record in scene.adjustments for scene in scenes] == [n == 8 for n in range(1, 15)]
    assert all(scene.reliable for scene in scenes)
    tracked = [scene.step.tracked for scene in scenes[1:] if scene.step is not None]
    assert min(tracked[:6]) > keypoints
    assert max(tracked[6:]) <= keypoints
