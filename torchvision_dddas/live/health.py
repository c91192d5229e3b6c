"""The health of a live run: counts, gauges, durations and the latest events. Any thread may write and read it."""

import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.io.output import Event

_DURATIONS = 4096  # kept of each kind: percentiles are of the latest
_EVENTS = 64


@dataclass(frozen=True)
class Snapshot:
    """Health at one moment. since_s: since the start. idle_s: since the last result, or the start.

    counts: since the start. gauges: now. seconds: 50, 95 and 99 % quantiles of the latest durations, by name.
    """

    since_s: float
    idle_s: float
    counts: Mapping[str, int]
    gauges: Mapping[str, float]
    seconds: Mapping[str, tuple[float, float, float]]
    events: tuple[Event, ...] = ()


class Health:
    """Written by the capture and the run; read by the page, the watchdog and run.json."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._start = self._result = time.monotonic()
        self._counts: Counter[str] = Counter()
        self._gauges: dict[str, float] = {}
        self._seconds: dict[str, deque[float]] = {}
        self._events: deque[Event] = deque(maxlen=_EVENTS)

    def count(self, name: str, by: int = 1) -> None:
        """Add to a count."""
        with self._lock:
            self._counts[name] += by

    def gauge(self, name: str, value: float) -> None:
        """Set a gauge."""
        with self._lock:
            self._gauges[name] = value

    def took(self, name: str, seconds: float) -> None:
        """Add a duration."""
        with self._lock:
            self._seconds.setdefault(name, deque(maxlen=_DURATIONS)).append(seconds)

    def result(self) -> None:
        """Count a result; the run is not idle."""
        with self._lock:
            self._counts["results"] += 1
            self._result = time.monotonic()

    def event(self, kind: str, text: str, frame: int = 0) -> Event:
        """Add an event of one word's kind, and return it. frame: 0 if it belongs to none."""
        event = Event(time.time(), frame, kind, text)
        with self._lock:
            self._counts[f"events_{kind}"] += 1
            self._events.append(event)
        return event

    def events_since(self, known: int) -> tuple[int, tuple[Event, ...]]:
        """The number of events so far, and those of the kept ones that came after the first `known`."""
        with self._lock:
            total = sum(count for name, count in self._counts.items() if name.startswith("events_"))
            new = min(total - known, len(self._events))
            return total, tuple(self._events)[len(self._events) - new :]

    def snapshot(self) -> Snapshot:
        """The health now."""
        with self._lock:
            now = time.monotonic()
            since_s, idle_s = now - self._start, now - self._result
            counts, gauges, events = dict(self._counts), dict(self._gauges), tuple(self._events)
            taken = {name: list(values) for name, values in self._seconds.items()}
        # Sorting thousands of times takes a millisecond, which a frame must not wait for.
        seconds = {name: tuple(np.percentile(values, (50, 95, 99)).tolist()) for name, values in taken.items()}
        return Snapshot(since_s, idle_s, counts, gauges, seconds, events)
