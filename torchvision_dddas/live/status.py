"""Writes the events of a live run at once and its state at intervals, in a thread of its own."""

import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from torchvision_dddas.io.output import Event, SessionLog
from torchvision_dddas.io.streams import Stream
from torchvision_dddas.live.health import Health, Snapshot

_EVENTS_S = 0.2
_MOST_WAITING = 1000  # events kept while the disk refuses them


class StatusWriter:
    """A context whose thread writes events and state; both are written once more when it is left.

    The run never waits for it. A disk that refuses to write is an event and does not end the run.
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
        self._trouble = ""
        self._measured_s, self._results = time.monotonic(), 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="status", daemon=True)

    def begin(self) -> None:
        """Write the state for the first time. Raises OSError if the disk refuses."""
        self._log.write_state(self.state, snapshot_facts(self._health.snapshot()))

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

    def events(self) -> None:
        """Write and show the new events."""
        self._known, new = self._health.events_since(self._known)
        for event in new:
            self._say(event)
        self._waiting = [*self._waiting, *new][-_MOST_WAITING:]
        if not self._waiting:
            return
        try:
            self._log.append(self._waiting)
            self._waiting = []
        except OSError as error:
            self._refused(error)

    def status(self) -> None:
        """Write the state, and sync the streams to the disk."""
        for stream in self._streams:
            stream.sync()
        self._measure()
        now = self._health.snapshot()
        self._show(now)
        try:
            self._log.write_state(self.state, snapshot_facts(now))
            self._trouble = ""
        except OSError as error:
            self._refused(error)

    def _measure(self) -> None:
        now_s, results = time.monotonic(), self._health.snapshot().counts.get("results", 0)
        if now_s - self._measured_s > 0.1:
            self._health.gauge("rate_hz", (results - self._results) / (now_s - self._measured_s))
        self._measured_s, self._results = now_s, results
        with suppress(OSError, ValueError):  # only Linux has it
            pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
            self._health.gauge("resident_bytes", pages * os.sysconf("SC_PAGE_SIZE"))

    def _refused(self, error: OSError) -> None:
        trouble = f"the state of the run cannot be written: {error.strerror or error}; tried again"
        if trouble != self._trouble:  # reported once; else writing the report would fail and make another
            self._trouble = trouble
            self._health.event("sink", trouble)

    def _run(self) -> None:
        due = time.monotonic() + self._status_s
        while not self._ended.wait(_EVENTS_S):
            self.events()
            if time.monotonic() >= due:
                due = time.monotonic() + self._status_s
                self.status()


def snapshot_facts(now: Snapshot) -> dict[str, Any]:
    """What run.json and /health.json say of the health."""
    return {
        "since_s": round(now.since_s, 3),
        "idle_s": round(now.idle_s, 3),
        "counts": now.counts,
        "gauges": now.gauges,
        "seconds": {
            name: dict(zip(("p50", "p95", "p99"), values, strict=True)) for name, values in now.seconds.items()
        },
        "events": [asdict(event) for event in now.events],
    }
