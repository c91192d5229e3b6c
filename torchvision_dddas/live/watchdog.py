"""Supervision of a live run: a watchdog that ends a hung run, and notifications to a supervisor such as systemd."""

import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from types import TracebackType
from typing import Self

from torchvision_dddas.live.health import Health

HUNG = 70
"""Exit code of a run that hung or failed repeatedly: EX_SOFTWARE of sysexits.h."""
UNWRITTEN = 74
"""Exit code of a run that succeeded but could not write all files to the disk: EX_IOERR."""

_CHECK_S = 1.0


class Supervisor:
    """Notify systemd about a service with Type=notify; do nothing without NOTIFY_SOCKET.

    every_s: half the interval in which systemd expects WATCHDOG=1; 0: never.
    Source: sd_notify(3), sd_watchdog_enabled(3).
    """

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        wanted = environ.get("WATCHDOG_USEC", "")
        mine = environ.get("WATCHDOG_PID", "") in ("", str(os.getpid()))
        self.every_s = int(wanted) / 2e6 if wanted.isdigit() and mine and self._address else 0.0

    def say(self, *words: str) -> None:
        """Send words such as READY=1. Never raise."""
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as way:
            way.settimeout(1.0)
            way.sendto("\n".join(words).encode(), self._address)


class Watchdog:
    """Report a step that takes longer than hung_s as an event, and end the process after twice that time.

    While its context is open, a thread checks the step, and notifies the supervisor as long as no step hangs and
    results come. idle_s: seconds since the last result while one is due.
    """

    def __init__(
        self,
        health: Health,
        hung_s: float,
        supervisor: Supervisor | None = None,
        abort: Callable[[str], object] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """hung_s: 0 for no limit. abort: called with the reason; by default it ends the process."""
        self._health, self._hung_s, self._clock = health, hung_s, clock
        self._supervisor = supervisor or Supervisor({})
        self._abort = abort or abort_process
        self._step: tuple[int, float] | None = None  # frame and start; one attribute needs no lock
        self._reported = 0  # frame of the step that was reported
        self._notified_s = -float("inf")
        self.idle_s: Callable[[], float] = lambda: 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def begin(self, frame: int) -> None:
        """Note that work on a frame begins."""
        self._step = frame, self._clock()

    def done(self) -> None:
        """Note that the work is done; waiting for frames has no limit."""
        self._step = None

    @property
    def hung(self) -> str:
        """Description of the step that hangs; empty if none does."""
        step = self._step
        if step is None or not self._hung_s or self._clock() - step[1] <= self._hung_s:
            return ""
        return f"the work on frame {step[0]} has taken {self._clock() - step[1]:.0f} s"

    def check(self) -> None:
        """Check the step once: report it, end the process, or notify the supervisor."""
        hung, step = self.hung, self._step
        if not hung or step is None:
            self._reported = 0
            if self._hung_s and self.idle_s() > self._hung_s:
                return
            if self._supervisor.every_s and self._clock() - self._notified_s >= self._supervisor.every_s / 2:
                self._notified_s = self._clock()
                self._supervisor.say("WATCHDOG=1")
            return
        if self._reported != step[0]:
            self._reported = step[0]
            self._health.event("watchdog", f"{hung}: it counts as hung", step[0])
        if self._clock() - step[1] > 2 * self._hung_s:
            self._abort(f"{hung}: ended, to be restarted (live.watchdog_s = {self._hung_s:g})")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        waits = [_CHECK_S, *(wait / 4 for wait in (self._hung_s, self._supervisor.every_s) if wait)]
        while not self._ended.wait(min(waits)):
            self.check()


def abort_process(words: str) -> None:
    """End a process whose main thread hangs, without clean-up."""
    print(f"dddas: {words}", file=sys.stderr, flush=True)  # noqa: T201
    os._exit(HUNG)
