"""What is written of a live run while it goes on, and told a person: events at once, its state every so often."""

import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from torchvision_dddas.live.health import Event, Health, Snapshot

_EVENTS_S = 0.2
_KEPT = 1000  # events that wait for a disk that refuses them


class Log(Protocol):
    """Where it is written, as io.output.live_session.SessionLog; its methods raise OSError and may be tried again."""

    def tell(self, events: Iterable[Event]) -> None:
        """Append events."""

    def state(self, state: str, now: dict[str, Any]) -> None:
        """Replace the state."""


class Synced(Protocol):
    """A stream that can put what it wrote on the disk; it never raises."""

    def sync(self) -> None:
        """As io.streams.Stream has it."""


class StatusWriter:
    """A context: a thread writes within it, and the last word is written when it is left.

    The work itself never waits for it, and a disk that refuses is an event, not an end.
    """

    def __init__(
        self,
        health: Health,
        log: Log,
        streams: Sequence[Synced],
        status_s: float,
        say: Callable[[Event], object] = lambda event: None,
        show: Callable[[Snapshot], object] = lambda now: None,
    ) -> None:
        """say: called with each event, for a person; show: with how it goes, every status_s."""
        self._health, self._log, self._streams, self._status_s = health, log, streams, status_s
        self._say, self._show = say, show
        self.state = "running"
        self._known, self._waiting = 0, list[Event]()
        self._trouble = ""
        self._measured_s, self._results = time.monotonic(), 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="keeping", daemon=True)

    def begin(self) -> None:
        """Write the state for the first time. Raises OSError where that cannot be."""
        self._log.state(self.state, snapshot_facts(self._health.snapshot()))

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
        """Write and say the events that are new."""
        self._known, new = self._health.events_since(self._known)
        for event in new:
            self._say(event)
        self._waiting = [*self._waiting, *new][-_KEPT:]
        if not self._waiting:
            return
        try:
            self._log.tell(self._waiting)
            self._waiting = []
        except OSError as error:
            self._refused(error)

    def status(self) -> None:
        """Replace the state of the run, and put results on the disk."""
        for stream in self._streams:
            stream.sync()
        self._measure()
        now = self._health.snapshot()
        self._show(now)
        try:
            self._log.state(self.state, snapshot_facts(now))
            self._trouble = ""
        except OSError as error:
            self._refused(error)

    def _measure(self) -> None:
        """Gauges that are of a while, or of the process."""
        now_s, results = time.monotonic(), self._health.snapshot().counts.get("results", 0)
        if now_s - self._measured_s > 0.1:
            self._health.gauge("rate_hz", (results - self._results) / (now_s - self._measured_s))
        self._measured_s, self._results = now_s, results
        with suppress(OSError, ValueError):  # Linux says it
            pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
            self._health.gauge("resident_bytes", pages * os.sysconf("SC_PAGE_SIZE"))

    def _refused(self, error: OSError) -> None:
        trouble = f"the state of the run cannot be written: {error.strerror or error}; tried again"
        if trouble != self._trouble:  # said once: else each event would make another
            self._trouble = trouble
            self._health.event("sink", trouble)

    def _keep(self) -> None:
        due = time.monotonic() + self._status_s
        while not self._ended.wait(_EVENTS_S):
            self.events()
            if time.monotonic() >= due:
                due = time.monotonic() + self._status_s
                self.status()


def snapshot_facts(now: Snapshot) -> dict[str, Any]:
    """What run.json and /health.json say of how it goes."""
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
