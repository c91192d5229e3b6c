"""Results are written in a thread of their own: in order, all of them, and without holding up the run."""

import threading
import time
from dataclasses import replace
from typing import Any

import pytest

from tests.live.test_runner import PICTURE, result_of
from torchvision_dddas.io.streams import About
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.result_writer import ResultWriter, record_result, send_result
from torchvision_dddas.types import Frame

FIRST_S = 1e9


def test_latency_is_of_the_newest_picture_and_late_results_are_counted():
    health, frame = Health(), Frame(1, 0.0, PICTURE, taken_s=time.monotonic() - 1.0)
    record_result(result_of(frame, person=1), frame.taken_s, health, 80.0)
    now = health.snapshot()
    assert now.counts["late"] == now.counts["results"] == 1
    assert now.seconds["latency"][0] >= 1.0
    assert now.gauges["targets"] == now.gauges["people"] == 1
    record_result(result_of(frame), frame.taken_s, health, 1e9)
    assert health.snapshot().counts["late"] == 1


def test_the_row_of_a_picture_that_never_came_is_not_late():
    health, frame = Health(), Frame(1, 0.0, PICTURE, taken_s=time.monotonic() - 5.0)
    record_result(result_of(replace(frame, taken_s=float("nan"))), frame.taken_s, health, 80.0)
    assert "late" not in health.snapshot().counts or health.snapshot().counts["late"] == 0


class Sink:
    def __init__(self, name, error=None):
        self.name, self.error, self.got = name, error, 0

    def write(self, surveyed, people=None):
        self.got += 1
        if self.error is not None:
            raise self.error


def test_a_stream_that_cannot_write_a_frame_does_not_stop_the_others():
    health = Health()
    sinks: list[Any] = [Sink("bad", ValueError("no such digit")), Sink("good")]
    send_result(result_of(Frame(3, 0.0, PICTURE)), sinks, health)
    assert sinks[1].got == 1
    (event,) = health.snapshot().events
    assert (event.kind, event.frame) == ("sink", 3)
    assert "bad: left out, ValueError: no such digit" in event.text


class SlowStream:
    """A stream that writes only after `go` is set. starts_s: the start times at which results were written."""

    name = "slow"

    def __init__(self, about: About) -> None:
        self.go, self.written, self.starts_s, self.about = threading.Event(), list[int](), list[float](), about

    def write(self, result: Any, people: Any = None) -> None:
        assert self.go.wait(30)
        self.written.append(result.number)
        self.starts_s.append(self.about.start_utc_s)


def writer_to(stream: Any, about: About, health: Health) -> ResultWriter:
    return ResultWriter([stream], about, health, 80.0)


def test_a_slow_stream_does_not_hold_up_the_run_and_gets_every_result_in_order_with_its_start_time() -> None:
    about, health = About(), Health()
    stream = SlowStream(about)
    with writer_to(stream, about, health) as writer:
        for number in range(1, 51):
            writer.put(result_of(Frame(number, 0.0, PICTURE)), FIRST_S + number)
        assert stream.written == []
        stream.go.set()
    assert stream.written == list(range(1, 51))
    assert stream.starts_s == [FIRST_S + number for number in range(1, 51)]
    assert health.snapshot().counts["results"] == 50


def test_a_run_that_is_far_ahead_of_its_streams_waits_and_loses_nothing() -> None:
    about, health = About(), Health()
    stream = SlowStream(about)
    put: list[int] = []

    def run(writer: ResultWriter) -> None:
        for number in range(1, 301):
            writer.put(result_of(Frame(number, 0.0, PICTURE)), FIRST_S)
            put.append(number)

    with writer_to(stream, about, health) as writer:
        thread = threading.Thread(target=run, args=(writer,))
        thread.start()
        thread.join(0.2)
        assert len(put) < 300
        stream.go.set()
        thread.join(30)
        assert not thread.is_alive()
    assert stream.written == list(range(1, 301))


def test_an_error_of_the_writing_thread_ends_the_run(monkeypatch) -> None:
    def broken(*_: object) -> None:
        raise MemoryError("no room")

    monkeypatch.setattr("torchvision_dddas.live.result_writer.record_result", broken)
    with pytest.raises(MemoryError, match="no room"), writer_to(Sink("good"), About(), Health()) as writer:
        writer.put(result_of(Frame(1, 0.0, PICTURE)), FIRST_S)
