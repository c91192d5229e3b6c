"""The loop of a live run: frames in, results out, and a restart after an error."""

import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from math import isfinite

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.streams import Stream
from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.watchdog import Watchdog
from torchvision_dddas.types import Frame, FrameResult, Telemetry, TrackedFrame

_MOST_FAILURES = 25
"""Restarts in a row without a result, after which the run gives up."""


class RepeatedFailure(Exception):
    """The work failed too often in a row. The message is for the user."""


class Feed:
    """The source as the pipeline sees it: one stream of frames, also after the pipeline was restarted.

    A step lasts from taking a frame to asking for the next one. newest: the frame taken last. telemetry: a function, as
    the pipeline expects of a source; None if there is none.
    """

    count = None
    exact = False

    def __init__(
        self, source: LiveSource, health: Health, watchdog: Watchdog, telemetry: Telemetry | None = None
    ) -> None:
        """telemetry: given if its gaps are to be reported."""
        self.name, self.rate_hz, self.size = source.name, source.rate_hz, source.size
        self.problems: list[object] = []
        self.newest: Frame | None = None
        self.ended = False
        self.telemetry = None if telemetry is None else lambda: telemetry
        self._source, self._health, self._watchdog = source, health, watchdog
        self._frames = iter(source)
        self._log, self._silent = telemetry, False
        self._first = True

    @property
    def last(self) -> int:
        """As in Source."""
        return self._source.last

    def restart(self) -> None:
        """Prepare for a new iteration by a pipeline that has seen no frame."""
        self._watchdog.done()
        self._frames = iter(self._source)  # the source's own iteration may have failed
        self._first = True

    def __iter__(self) -> Iterator[Frame]:
        while not self.ended:
            self._watchdog.done()
            frame = next(self._frames, None)
            if frame is None:
                self.ended = True
                return
            if self._first:
                # Earlier frames are not missing: the pipeline that failed has seen them.
                frame, self._first = replace(frame, skipped=frame.number - 1), False
            self._check_telemetry(frame)
            self.newest = frame
            self._watchdog.begin(frame.number)
            yield frame

    def stop(self) -> None:
        """Take no further frame; results of those taken still come."""
        self.ended = True

    def _check_telemetry(self, frame: Frame) -> None:
        if self._log is None:
            return
        flight = self._log.at(frame.time_s)
        silent = flight is None or not isfinite(flight.altitude_m)
        if silent != self._silent:
            self._silent = silent
            words = "silent: the altitude is not known any more" if silent else "there again"
            self._health.event("telemetry", f"telemetry is {words}", frame.number)


Result = tuple[FrameResult, TrackedFrame | None]
"""A frame and the people in it; None if people are not searched for."""


class _Renumbering:
    """Makes identities of targets and of people go on after a restart where they ended before it."""

    def __init__(self) -> None:
        self._before, self._highest = [0, 0], [0, 0]

    def __call__(self, result: Result) -> Result:
        located, people = result
        followed, grounded = self._shifted(0, located.tracked), located.locations
        if grounded is not None and self._before[0]:
            places = grounded.positions
            grounded = replace(grounded, positions=replace(places, target=places.target + self._before[0]))
        located = replace(located, tracked=followed, locations=grounded)
        return located, None if people is None else self._shifted(1, people)

    def restart(self) -> None:
        self._before = list(self._highest)

    def _shifted(self, kind: int, followed: TrackedFrame) -> TrackedFrame:
        before, tracks = self._before[kind], followed.tracks
        self._highest[kind] = max(self._highest[kind], before + int(tracks.identity.max(initial=0)))
        return replace(followed, tracks=replace(tracks, identity=tracks.identity + before)) if before else followed


def results(begin: Callable[[Feed], Iterable[Result]], feed: Feed, health: Health) -> Iterator[Result]:
    """Yield the results of `begin(feed)`; after an error it is called again and goes on with the frames that follow.

    Each error is an event. Raises RepeatedFailure after 25 errors without a result between them.
    """
    renumbered, failures = _Renumbering(), 0
    while True:
        try:
            for result in begin(feed):
                failures = 0
                yield renumbered(result)
        except Exception as error:
            if feed.ended and isinstance(error, InputError):  # as of a clip that was stopped after its second frame
                health.event("run", str(error))
                return
            failures += 1
            number = feed.newest.number if feed.newest is not None else 0
            words = f"{type(error).__name__}: {error} ({_where(error)})"
            if failures >= _MOST_FAILURES:
                raise RepeatedFailure(
                    f"{failures} times in a row the work on a frame failed, at last: {words}"
                ) from error
            health.event("run", f"{words}; begun anew with the next frame", number)
            health.count("begun_anew")
        if feed.ended:
            return
        feed.restart()
        renumbered.restart()


def send_result(result: Result, streams: Iterable[Stream], health: Health) -> None:
    """Write a result to all streams. A stream that raises leaves it out; that is an event."""
    for stream in streams:
        try:
            stream.write(*result)
        except Exception as error:
            number = result[0].tracked.number
            health.event("sink", f"{stream.name}: left out, {type(error).__name__}: {error} ({_where(error)})", number)


def record_result(result: Result, feed: Feed, health: Health, deadline_ms: float) -> None:
    """Record the latency of a result that was sent, and what it holds, in the health."""
    located, people = result
    now_s, frame = time.monotonic(), located.tracked.frame
    if feed.newest is not None and isfinite(feed.newest.taken_s):
        latency_s = now_s - feed.newest.taken_s
        health.took("latency", latency_s)
        health.count("late", int(1000 * latency_s > deadline_ms))
    if frame is not None and isfinite(frame.taken_s):
        health.took("age", now_s - frame.taken_s)
    health.gauge("targets", len(located.tracked.tracks))
    if people is not None:
        health.gauge("people", len(people.tracks))
    health.count("unreliable", int(bool(located.tracked.cause)))
    health.result()


def _where(error: BaseException) -> str:
    """The innermost line of this package in the traceback."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "torchvision_dddas" in f.filename] or frames
    return f"{ours[-1].filename.rpartition('torchvision_dddas/')[2]}:{ours[-1].lineno}" if ours else "nowhere"
