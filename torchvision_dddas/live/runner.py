"""The loop that does not die: frames as they come, results as they settle, and a new beginning after an error."""

import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from math import isfinite
from typing import Protocol

from torchvision_dddas.errors import InputError
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.watchdog import Watchdog
from torchvision_dddas.pipeline import Clip
from torchvision_dddas.types import Frame, FrameResult, Telemetry, TrackedFrame

_IN_VAIN = 25
"""So many new beginnings in a row without any result are enough: it would go on like this for ever."""


class LiveFrames(Clip, Protocol):
    """What the run needs of a live source; see live.capture.LiveSource."""

    @property
    def name(self) -> str:
        """What to call it in messages."""
        ...

    @property
    def last(self) -> int:
        """Number of the last frame that was handed on."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """A further iteration goes on where the one before ended."""
        ...


class Stream(Protocol):
    """Where results go; see io.streams."""

    @property
    def name(self) -> str:
        """As the user wrote it."""
        ...

    def write(self, surveyed: FrameResult | None, people: TrackedFrame | None = None) -> None:
        """Send a frame."""


class RepeatedFailure(Exception):
    """The work fails again and again. Its words are for the user."""


class Feed:
    """The source as the path sees it: one stream of frames, however often the path begins anew.

    The work on a frame is what happens between its being taken and the next one being asked for. newest: the frame
    taken last. telemetry: as run.run asks of a source; None where there is none.
    """

    count = None
    exact = False

    def __init__(
        self, source: LiveFrames, health: Health, watchdog: Watchdog, telemetry: Telemetry | None = None
    ) -> None:
        """telemetry: where its silence is to be told."""
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

    def anew(self) -> None:
        """Whoever iterates next has seen nothing so far."""
        self._watchdog.done()
        self._frames = iter(self._source)  # what broke may have been the source's own iteration
        self._first = True

    def __iter__(self) -> Iterator[Frame]:
        while not self.ended:
            self._watchdog.done()
            frame = next(self._frames, None)
            if frame is None:
                self.ended = True
                return
            if self._first:
                # What was before is not missing: it was seen by the path that failed.
                frame, self._first = replace(frame, skipped=frame.number - 1), False
            self._listen(frame)
            self.newest = frame
            self._watchdog.begin(frame.number)
            yield frame

    def stop(self) -> None:
        """No further frame is taken; what was seen is still settled."""
        self.ended = True

    def _listen(self, frame: Frame) -> None:
        """Say when the telemetry falls silent, and when it speaks again."""
        if self._log is None:
            return
        flight = self._log.at(frame.time_s)
        silent = flight is None or not isfinite(flight.altitude_m)
        if silent != self._silent:
            self._silent = silent
            words = "silent: the altitude is not known any more" if silent else "there again"
            self._health.event("telemetry", f"telemetry is {words}", frame.number)


Result = tuple[FrameResult, TrackedFrame | None]
"""A frame, and the people in it; None where nobody is looked for."""


class _Renumbered:
    """Identities go on where those before a new beginning ended: of what moves, and of people."""

    def __init__(self) -> None:
        self._before, self._highest = [0, 0], [0, 0]

    def __call__(self, result: Result) -> Result:
        surveyed, people = result
        followed, grounded = self._known(0, surveyed.followed), surveyed.grounded
        if grounded is not None and self._before[0]:
            places = grounded.positions
            grounded = replace(grounded, positions=replace(places, target=places.target + self._before[0]))
        surveyed = replace(surveyed, followed=followed, grounded=grounded)
        return surveyed, None if people is None else self._known(1, people)

    def anew(self) -> None:
        self._before = list(self._highest)

    def _known(self, kind: int, followed: TrackedFrame) -> TrackedFrame:
        before, tracks = self._before[kind], followed.tracks
        self._highest[kind] = max(self._highest[kind], before + int(tracks.identity.max(initial=0)))
        return replace(followed, tracks=replace(tracks, identity=tracks.identity + before)) if before else followed


def results(begin: Callable[[Feed], Iterable[Result]], feed: Feed, health: Health) -> Iterator[Result]:
    """What `begin(feed)` yields; an error in it is an event, and it is begun anew with the frames that follow.

    Raises RepeatedFailure where that happens again and again without a result between.
    """
    renumbered, in_vain = _Renumbered(), 0
    while True:
        try:
            for result in begin(feed):
                in_vain = 0
                yield renumbered(result)
        except Exception as error:
            if feed.ended and isinstance(error, InputError):  # as of a clip that was stopped after its second frame
                health.event("run", str(error))
                return
            in_vain += 1
            number = feed.newest.number if feed.newest is not None else 0
            words = f"{type(error).__name__}: {error} ({_where(error)})"
            if in_vain >= _IN_VAIN:
                raise RepeatedFailure(
                    f"{in_vain} times in a row the work on a frame failed, at last: {words}"
                ) from error
            health.event("run", f"{words}; begun anew with the next frame", number)
            health.count("begun_anew")
        if feed.ended:
            return
        feed.anew()
        renumbered.anew()


def send_result(result: Result, streams: Iterable[Stream], health: Health) -> None:
    """To all streams; what one of them cannot write is left out of it, and told."""
    for stream in streams:
        try:
            stream.write(*result)
        except Exception as error:
            number = result[0].followed.number
            health.event("sink", f"{stream.name}: left out, {type(error).__name__}: {error} ({_where(error)})", number)


def told(result: Result, feed: Feed, health: Health, deadline_ms: float) -> None:
    """Take note of a result that was handed on: how late it is, and what it holds."""
    surveyed, people = result
    now_s, frame = time.monotonic(), surveyed.followed.frame
    if feed.newest is not None and isfinite(feed.newest.taken_s):
        latency_s = now_s - feed.newest.taken_s
        health.took("latency", latency_s)
        health.count("late", int(1000 * latency_s > deadline_ms))
    if frame is not None and isfinite(frame.taken_s):
        health.took("age", now_s - frame.taken_s)
    health.gauge("targets", len(surveyed.followed.tracks))
    if people is not None:
        health.gauge("people", len(people.tracks))
    health.count("unreliable", int(bool(surveyed.followed.cause)))
    health.result()


def _where(error: BaseException) -> str:
    """The innermost line of ours, for whoever mends it."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "torchvision_dddas" in f.filename] or frames
    return f"{ours[-1].filename.rpartition('torchvision_dddas/')[2]}:{ours[-1].lineno}" if ours else "nowhere"
