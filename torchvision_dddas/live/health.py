"""The health of a live run: counts, gauges, durations, events; and the thread that writes it to disk."""

import math
import os
import threading
import time
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from torchvision_dddas.errors import InputError, readable, without_secrets
from torchvision_dddas.io.output import EVENTS, RUN_JSON, AdjustmentList, Event, SessionLog
from torchvision_dddas.io.streams import Stream
from torchvision_dddas.types import Adjustment

BOUNDS_S = (0.01, 0.02, 0.03, 0.04, 0.06, 0.08, 0.12, 0.16, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Upper ends of the intervals in which durations are counted, seconds."""

_DURATIONS = 4096  # durations of each kind that are kept for the percentiles
_EVENTS = 64
_ADJUSTMENTS = 100  # listed changes of a parameter: run.json is written every few seconds
_LATE = 25  # results are late if most of this many were late


@dataclass(frozen=True)
class Snapshot:
    """Health at one moment. since_s: seconds since the start. idle_s: seconds since the last result, or the start.

    troubles: current problems, in words. platforms: the state of further platforms.
    histograms: of all durations since the start, the number in each interval that BOUNDS_S ends, and their sum, s.
    counts: since the start. gauges: current values. seconds: 50, 95 and 99 % quantiles of recent durations, by name.
    """

    since_s: float
    idle_s: float
    counts: Mapping[str, int]
    gauges: Mapping[str, float]
    seconds: Mapping[str, tuple[float, float, float]]
    events: tuple[Event, ...] = ()
    troubles: tuple[str, ...] = ()
    platforms: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    histograms: Mapping[str, tuple[tuple[int, ...], float]] = field(default_factory=dict)


class Health:
    """The health of a run, written by the capture and the run; read by the page, the watchdog and run.json."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._start = self._result = time.monotonic()
        self._counts: Counter[str] = Counter()
        self._gauges: dict[str, float] = {}
        self._seconds: dict[str, deque[float]] = {}
        self._histograms: dict[str, list[int]] = {}
        self._sums_s: dict[str, float] = {}
        self._events: deque[Event] = deque(maxlen=_EVENTS)
        self._troubles: dict[str, tuple[str, float]] = {}  # text, and the time until which it holds
        self._asked: list[Callable[[], str]] = []
        self.platforms: Callable[[], Mapping[str, Mapping[str, Any]]] = dict
        self._late: deque[bool] = deque(maxlen=_LATE)
        self._adjustments, self._unwritten = AdjustmentList(_ADJUSTMENTS), list[Event]()

    def count(self, name: str, by: int = 1) -> None:
        """Add to a count."""
        with self._lock:
            self._counts[name] += by

    def gauge(self, name: str, value: float) -> None:
        """Set a gauge."""
        with self._lock:
            self._gauges[name] = value

    def begin(self) -> None:
        """Restart the idle time, because the awaited camera is there."""
        self._result = time.monotonic()

    def took(self, name: str, seconds: float) -> None:
        """Add a duration."""
        with self._lock:
            self._seconds.setdefault(name, deque(maxlen=_DURATIONS)).append(seconds)
            self._histograms.setdefault(name, [0] * (len(BOUNDS_S) + 1))[bisect_left(BOUNDS_S, seconds)] += 1
            self._sums_s[name] = self._sums_s.get(name, 0.0) + seconds

    def result(self) -> None:
        """Count a result; the run is not idle."""
        with self._lock:
            self._counts["results"] += 1
            self._result = time.monotonic()

    def timed(self, is_late: bool) -> None:
        """Count whether a result came late; lateness is a trouble while most recent results are late."""
        self.count("late", int(is_late))
        self._late.append(is_late)
        late = sum(self._late)
        self.trouble("late", f"{late} of the latest {len(self._late)} results are late" if late > _LATE // 2 else "")

    @property
    def is_late(self) -> bool:
        """Whether most of the latest results are late."""
        return "late" in self._troubles

    def trouble(self, name: str, words: str = "", for_s: float = math.inf) -> None:
        """Report a trouble for `for_s` seconds, or until this is called without words."""
        with self._lock:
            if words:
                self._troubles[name] = words, time.monotonic() + for_s
            else:
                self._troubles.pop(name, None)

    def ask(self, trouble: Callable[[], str]) -> None:
        """Register a function that is asked for a trouble at every reading; it returns "" if all is well."""
        self._asked.append(trouble)

    def adjusted(self, adjustments: Sequence[Adjustment], told: Collection[str] = ()) -> None:
        """Add changes of parameters, for run.json and events.log only. told: parameters already reported as events."""
        with self._lock:
            for a in self._adjustments.add(adjustments):
                if a.parameter not in told:
                    words = f"{a.describe()}: {a.cause}"
                    self._unwritten.append(Event(time.time(), a.frame, "adjusted", words))

    def log(self, kind: str, text: str) -> None:
        """Add an event for events.log only: one that is too frequent for the terminal and the page."""
        with self._lock:
            self._unwritten.append(Event(time.time(), 0, kind, readable(without_secrets(text))))

    def take_adjusted(self) -> list[Event]:
        """Return the events for events.log only, such as changes of parameters, since the last call."""
        with self._lock:
            taken, self._unwritten = self._unwritten, []
        return taken

    def adjustments(self) -> dict[str, Any]:
        """Return changed parameters for run.json: the first changes of each, and the number of changes."""
        with self._lock:
            return {"adjustments": list(self._adjustments.rows), "adjustments_made": dict(self._adjustments.made)}

    @property
    def idle_s(self) -> float:
        """Seconds since the last result, or the start."""
        return time.monotonic() - self._result

    def event(self, kind: str, text: str, frame: int = 0) -> Event:
        """Add an event, and return it. kind: one word. frame: 0 if it belongs to no frame."""
        event = Event(time.time(), frame, kind, readable(without_secrets(text)))
        with self._lock:
            self._counts[f"events_{kind}"] += 1
            self._events.append(event)
        return event

    def events_since(self, known: int) -> tuple[int, tuple[Event, ...]]:
        """Return the number of events so far, and the kept events that came after the first `known`."""
        with self._lock:
            total = sum(count for name, count in self._counts.items() if name.startswith("events_"))
            new = min(total - known, len(self._events))
            return total, tuple(self._events)[len(self._events) - new :]

    def snapshot(self) -> Snapshot:
        """Return the current health."""
        with self._lock:
            now = time.monotonic()
            since_s, idle_s = now - self._start, now - self._result
            counts, gauges, events = dict(self._counts), dict(self._gauges), tuple(self._events)
            troubles = [words for words, until_s in self._troubles.values() if now < until_s]
            taken = {name: list(values) for name, values in self._seconds.items()}
            histograms = {name: (tuple(counts), self._sums_s[name]) for name, counts in self._histograms.items()}
        # Sorting thousands of durations takes a millisecond, so it is done without the lock, which a frame may need.
        seconds = {name: tuple(np.percentile(values, (50, 95, 99)).tolist()) for name, values in taken.items()}
        troubles += filter(None, [trouble() for trouble in self._asked])
        platforms = self.platforms()
        return Snapshot(since_s, idle_s, counts, gauges, seconds, events, tuple(troubles), platforms, histograms)


_EVENTS_S = 0.2
_MOST_WAITING = 1000  # events kept while the disk refuses them


class StatusWriter:
    """A context whose thread writes events and state; both are written once more at its end.

    The run never waits for it. If the disk refuses to write, this is an event and a trouble, but the run continues.
    """

    def __init__(
        self,
        health: Health,
        log: SessionLog,
        streams: Sequence[Stream],
        status_s: float,
        say: Callable[[Event], object] = lambda event: None,
        show: Callable[[Snapshot], object] = lambda now: None,
    ) -> None:
        """say: called with each event. show: called with the health every status_s. Both are for the terminal."""
        self._health, self._log, self._streams, self._status_s = health, log, streams, status_s
        self._say, self._show = say, show
        self.state = "running"
        self._known, self._waiting = 0, list[Event]()
        self._failing = dict[str, str]()  # error text by file
        self._measured_s, self._results = time.monotonic(), 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="status", daemon=True)

    def begin(self) -> None:
        """Begin both files. Raise InputError if the disk refuses one; the other file then records this."""
        self._is_written(EVENTS, lambda: self._log.append([]))
        self._write_state()
        if self.refused:
            self.state = "failed"
            self._write_state()
            self._is_written(EVENTS, lambda: self._log.append(self._health.snapshot().events))
            raise InputError(f"{self._log.folder}: {self.refused}; free some space or choose another --out")

    @property
    def refused(self) -> str:
        """Reason why files are incomplete; empty if the disk accepted all."""
        return "; ".join(f"{name} cannot be written: {why}" for name, why in self._failing.items())

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if kind is not None:
            self.state = "failed"
        self._ended.set()
        self._thread.join()
        self.events()
        self.status()
        self.events()  # writing the status may have failed

    def events(self) -> None:
        """Write and show the new events."""
        self._known, new = self._health.events_since(self._known)
        for event in new:
            self._say(event)
        new = tuple(sorted([*new, *self._health.take_adjusted()], key=lambda event: event.utc_s))
        self._waiting = [*self._waiting, *new][-_MOST_WAITING:]
        if self._waiting and self._is_written(EVENTS, lambda: self._log.append(self._waiting)):
            self._waiting = []

    def status(self) -> None:
        """Write the state, and sync the streams to the disk."""
        for stream in self._streams:
            stream.sync()
        self._measure()
        self._show(self._health.snapshot())
        self._write_state()

    def _measure(self) -> None:
        now_s, results = time.monotonic(), self._health.snapshot().counts.get("results", 0)
        if now_s - self._measured_s > 0.1:
            self._health.gauge("rate_hz", (results - self._results) / (now_s - self._measured_s))
        self._measured_s, self._results = now_s, results
        with suppress(OSError, ValueError):  # /proc exists only on Linux
            pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
            self._health.gauge("resident_bytes", pages * os.sysconf("SC_PAGE_SIZE"))

    def _write_state(self) -> None:
        facts = {**snapshot_facts(self._health.snapshot()), **self._health.adjustments()}
        self._is_written(RUN_JSON, lambda: self._log.write_state(self.state, facts))

    def _is_written(self, name: str, write: Callable[[], object]) -> bool:
        """Write a file. Only a new refusal becomes an event; otherwise each failed event would cause another."""
        before = set(self._failing.values())
        try:
            write()
            self._failing.pop(name, None)
        except OSError as error:
            self._failing[name] = error.strerror or str(error)
            if self._failing[name] not in before:
                self._health.event("sink", f"{self.refused}; tried again")
        self._health.trouble("files", self.refused)
        return name not in self._failing

    def _run(self) -> None:
        due = time.monotonic() + self._status_s
        while not self._ended.wait(_EVENTS_S):
            self.events()
            if time.monotonic() >= due:
                due = time.monotonic() + self._status_s
                self.status()


def snapshot_facts(now: Snapshot) -> dict[str, Any]:
    """Return the health in the form of run.json and /health.json."""
    return {
        "since_s": round(now.since_s, 3),
        "idle_s": round(now.idle_s, 3),
        "counts": now.counts,
        "gauges": now.gauges,
        "seconds": {
            name: dict(zip(("p50", "p95", "p99"), values, strict=True)) for name, values in now.seconds.items()
        },
        "events": [asdict(event) for event in now.events],
        **({"platforms": now.platforms} if now.platforms else {}),
    }
