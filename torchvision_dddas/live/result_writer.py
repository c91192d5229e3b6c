"""The outputs of a live run: a thread writes results to all streams while the next picture is processed."""

import threading
import time
from collections import deque
from collections.abc import Sequence
from math import isfinite, nan
from types import TracebackType
from typing import Self

from torchvision_dddas import control
from torchvision_dddas.io.streams import About, Stream
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.runner import Result, where_raised

_ROOM = 100  # results that may wait


class ResultWriter:
    """Writes results to streams in a thread of its own, in order, and records their latency in the health.

    No result is lost: `put` waits while 100 results wait already. Use it as a context, which writes the rest at its
    end. Errors of the thread are raised by `put` and at the end.
    """

    def __init__(self, streams: Sequence[Stream], about: About, health: Health, deadline_ms: float) -> None:
        """about: gets the start time of each result. deadline_ms: latency above which a result is late."""
        self._streams, self._about, self._health, self._deadline_ms = streams, about, health, deadline_ms
        self._changed = threading.Condition()
        self._waiting: deque[tuple[Result, float, float]] = deque()
        self._ended = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="writing", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join()
        if self._error is not None and error is None:
            raise self._error

    def put(self, result: Result, start_utc_s: float, newest_s: float = nan) -> None:
        """Write a result soon. start_utc_s: as in `About`. newest_s: monotonic time of the newest taken picture."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._waiting) < _ROOM or self._error is not None)
            if self._error is not None:
                raise self._error
            self._waiting.append((result, start_utc_s, newest_s))
            self._changed.notify_all()

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._waiting or self._ended)
                    if not self._waiting:
                        return
                    result, self._about.start_utc_s, newest_s = self._waiting.popleft()
                    self._changed.notify_all()
                send_result(result, self._streams, self._health)
                record_result(result, newest_s, self._health, self._deadline_ms)
        except BaseException as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()


def send_result(result: Result, streams: Sequence[Stream], health: Health) -> None:
    """Write a result to all streams. If a stream raises, that stream omits the result, and an event records it."""
    for stream in streams:
        try:
            stream.write(*result)
        except Exception as error:
            words = f"{stream.name}: left out, {type(error).__name__}: {error} ({where_raised(error)})"
            health.event("sink", words, result[0].tracked.number)


def record_result(result: Result, newest_s: float, health: Health, deadline_ms: float) -> None:
    """Record the latency of a result that was sent, and its contents, in the health. newest_s: as for ResultWriter."""
    located, people = result
    if located.tracks.provisional:
        if located.frame is not None and isfinite(located.frame.taken_s):
            health.took("provisional", time.monotonic() - located.frame.taken_s)
        return
    now_s, frame = time.monotonic(), located.tracked.frame
    if frame is not None and isfinite(frame.taken_s):  # results for missing pictures are not late
        health.took("age", now_s - frame.taken_s)
        if isfinite(newest_s):
            health.took("latency", now_s - newest_s)
            health.timed(1000 * (now_s - newest_s) > deadline_ms)
    health.gauge("targets", len(located.tracked.tracks))
    if people is not None:
        health.gauge("people", len(people.tracks))
    health.count("unreliable", int(bool(located.tracked.cause)))
    health.adjusted(located.adjustments, control.SHED)
    if (use := located.tracks.appearance) is not None:
        health.count("appearance_decisions")
        health.count("appearance_looked_at", int(use.looked))
    health.result()
