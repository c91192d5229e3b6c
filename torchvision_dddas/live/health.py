"""How a live run is doing: counts, how long things take, what happened last. Many threads may tell and ask."""

import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

_REMEMBERED = 4096  # times of each kind: percentiles are of the latest
_EVENTS = 64


@dataclass(frozen=True)
class Event:
    """Something that happened. utc_s: seconds since 1970; frame: 0 where it belongs to none; kind: one word."""

    utc_s: float
    frame: int
    kind: str
    text: str


@dataclass(frozen=True)
class Snapshot:
    """Health at a moment. counts: since the start. gauges: now. seconds: (50, 95, 99 %) of the latest, by name.

    since_s: for how long the run goes on; idle_s: since the last result, since the start while there is none.
    """

    since_s: float
    idle_s: float
    counts: Mapping[str, int]
    gauges: Mapping[str, float]
    seconds: Mapping[str, tuple[float, float, float]]
    events: tuple[Event, ...] = field(default=())


class Health:
    """Filled by the capture and by the run; asked by the page, the watchdog and the record of the run."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._start = self._result = time.monotonic()
        self._counts: Counter[str] = Counter()
        self._gauges: dict[str, float] = {}
        self._seconds: dict[str, deque[float]] = {}
        self._events: deque[Event] = deque(maxlen=_EVENTS)

    def count(self, name: str, by: int = 1) -> None:
        """Something happened so many times more."""
        with self._lock:
            self._counts[name] += by

    def gauge(self, name: str, value: float) -> None:
        """Something is so large now."""
        with self._lock:
            self._gauges[name] = value

    def took(self, name: str, seconds: float) -> None:
        """Something took so long."""
        with self._lock:
            self._seconds.setdefault(name, deque(maxlen=_REMEMBERED)).append(seconds)

    def result(self) -> None:
        """A result was handed on: the run is alive."""
        with self._lock:
            self._counts["results"] += 1
            self._result = time.monotonic()

    def event(self, kind: str, text: str, frame: int = 0) -> Event:
        """Something to tell a person."""
        event = Event(time.time(), frame, kind, text)
        with self._lock:
            self._counts[f"events_{kind}"] += 1
            self._events.append(event)
        return event

    def events_since(self, known: int) -> tuple[int, tuple[Event, ...]]:
        """How many events there were, and those after the first `known` of them, of the latest that are remembered."""
        with self._lock:
            told = sum(count for name, count in self._counts.items() if name.startswith("events_"))
            new = min(told - known, len(self._events))
            return told, tuple(self._events)[len(self._events) - new :]

    def snapshot(self) -> Snapshot:
        """All of it, as it is now."""
        with self._lock:
            now = time.monotonic()
            since_s, idle_s = now - self._start, now - self._result
            counts, gauges, events = dict(self._counts), dict(self._gauges), tuple(self._events)
            taken = {name: list(values) for name, values in self._seconds.items()}
        # Sorting thousands of times takes a millisecond, which a frame must not wait for.
        seconds = {name: tuple(np.percentile(values, (50, 95, 99)).tolist()) for name, values in taken.items()}
        return Snapshot(since_s, idle_s, counts, gauges, seconds, events)
