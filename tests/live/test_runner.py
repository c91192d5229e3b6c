"""The loop that does not die."""

import time
from typing import Any

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.runner import Feed, RepeatedFailure, record_result, results, send_result
from torchvision_dddas.live.watchdog import Watchdog
from torchvision_dddas.types import Detections, Frame, FrameResult, Telemetry, TrackedFrame, Tracks

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
    def followed(known):
        box_px, one = np.array([[0.0, 0, 2, 2]]), np.ones(1)
        found = Detections(box_px, one, one, one, one)
        return TrackedFrame(
            frame.number, frame, found, Tracks(frame.number, np.array([known]), box_px, one, np.zeros(1, int))
        )

    return FrameResult(followed(identity)), None if person is None else followed(person)


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
    return [surveyed.tracked.number for surveyed, _ in got]


def test_an_error_costs_its_frame_alone_and_is_told():
    health = Health()
    got = list(results(path(broken=(4, 7)), feed_of(health=health), health))
    assert numbers(got) == [1, 2, 3, 5, 6, 8, 9, 10]
    told_of = [event for event in health.snapshot().events if event.kind == "run"]
    assert [event.frame for event in told_of] == [4, 7]
    assert all("ZeroDivisionError: that frame" in event.text for event in told_of)
    assert health.snapshot().counts["begun_anew"] == 2


def test_after_an_error_no_frame_before_counts_as_missing():
    seen: list[Frame] = []
    list(results(path(broken=(4,), seen=seen), feed_of(6), Health()))
    assert {frame.number: frame.skipped for frame in seen} == {1: 0, 2: 0, 3: 0, 4: 0, 5: 4, 6: 0}


def test_identities_after_an_error_are_new_ones():
    got = list(results(path(broken=(4, 7)), feed_of(), Health()))
    assert [surveyed.tracked.tracks.identity.tolist() for surveyed, _ in got] == [[1]] * 3 + [[2]] * 2 + [[3]] * 3
    found = [people.tracks.identity.tolist() for _, people in got if people is not None]
    assert found == [[2]] * 3 + [[4]] * 2 + [[6]] * 3


def test_it_fails_where_no_result_comes_any_more():
    with pytest.raises(RepeatedFailure, match=r"25 times in a row .* ZeroDivisionError: that frame"):
        list(results(path(broken=range(5, 100)), feed_of(100), Health()))


def test_it_goes_on_for_ever_where_results_come_between():
    got = list(results(path(broken=range(2, 200, 2)), feed_of(200), Health()))
    assert len(got) == 101


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
