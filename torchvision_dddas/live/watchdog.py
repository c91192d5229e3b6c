"""How a run ends: a watchdog ends one that hangs, signals ask it to stop with valid outputs or end it at once."""

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from types import FrameType, TracebackType
from typing import Any, Self

from torchvision_dddas.live.health import Health

HUNG = 70
"""Exit code of a run that was ended because it hung, or failed again and again: EX_SOFTWARE of sysexits.h."""

ASKED = (signal.SIGINT, signal.SIGTERM)
_LOOK_S = 1.0


class Supervisor:
    """What systemd wants to hear of a service with Type=notify. Says nothing where nobody asked.

    every_s: how often it wants to hear WATCHDOG=1; 0: never. Source: sd_notify(3), sd_watchdog_enabled(3).
    """

    def __init__(self, environ: Mapping[str, str] = os.environ) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        wanted = environ.get("WATCHDOG_USEC", "")
        mine = environ.get("WATCHDOG_PID", "") in ("", str(os.getpid()))
        self.every_s = int(wanted) / 2e6 if wanted.isdigit() and mine and self._address else 0.0

    def say(self, *words: str) -> None:
        """Such as READY=1. Never raises: a supervisor that is gone is no reason to stop."""
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as way:
            way.settimeout(1.0)
            way.sendto("\n".join(words).encode(), self._address)


class Watchdog:
    """Told when a step begins and is done; a step that takes longer than hung_s is an event, twice that the end.

    A context: a thread looks within it, and tells the supervisor that all is well while it is.
    """

    def __init__(
        self,
        health: Health,
        hung_s: float,
        supervisor: Supervisor | None = None,
        abort: Callable[[str], object] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """hung_s: 0 lets steps take as long as they want. abort: called with words; by default the process ends."""
        self._health, self._hung_s, self._clock = health, hung_s, clock
        self._supervisor = supervisor or Supervisor({})
        self._abort = abort or abort_process
        self._step: tuple[int, float] | None = None  # its frame, and when it began; one word, so that no lock is needed
        self._told = 0  # the frame of the step that was told
        self._heard = -float("inf")
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def begin(self, frame: int) -> None:
        """Work on a frame begins."""
        self._step = frame, self._clock()

    def done(self) -> None:
        """The work is done; until the next begins, the run waits for pictures, as long as it takes."""
        self._step = None

    @property
    def hung(self) -> str:
        """In words that a step hangs; empty where none does."""
        step = self._step
        if step is None or not self._hung_s or self._clock() - step[1] <= self._hung_s:
            return ""
        return f"the work on frame {step[0]} has taken {self._clock() - step[1]:.0f} s"

    def look(self) -> None:
        """Once: tell of a hung step, end the process if it hangs for too long, reassure the supervisor."""
        hung, step = self.hung, self._step
        if not hung or step is None:
            self._told = 0
            if self._supervisor.every_s and self._clock() - self._heard >= self._supervisor.every_s / 2:
                self._heard = self._clock()
                self._supervisor.say("WATCHDOG=1")
            return
        if self._told != step[0]:
            self._told = step[0]
            self._health.event("watchdog", f"{hung}: it counts as hung", step[0])
        if self._clock() - step[1] > 2 * self._hung_s:
            self._abort(f"{hung}: ended, to be started anew (live.watchdog_s = {self._hung_s:g})")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        waits = [_LOOK_S, *(wait / 4 for wait in (self._hung_s, self._supervisor.every_s) if wait)]
        while not self._ended.wait(min(waits)):
            self.look()


def abort_process(words: str) -> None:
    """The end of a process whose main thread hangs: nothing there can be asked to clean up."""
    print(f"dddas: {words}", file=sys.stderr, flush=True)  # noqa: T201
    os._exit(HUNG)


class StopSignals:
    """A context within which the two signals are requests. signal: the one that came first; None while none has.

    The system itself wakes a thread of our own: the main thread may be deep in a library, hold any lock, or hang.
    """

    def __init__(self, ask: Callable[[int], object], at_once: Callable[[int], object] = os._exit) -> None:
        """ask: called from another thread with the first signal. at_once: with the exit code, on the second."""
        self._ask, self._at_once = ask, at_once
        self.signal: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        # Elsewhere Python takes no signals: then whoever embeds the run ends it in his own way.
        if threading.current_thread() is not threading.main_thread():
            return self
        self._ours, self._theirs = socket.socketpair()
        self._theirs.setblocking(False)
        self._wakeup = signal.set_wakeup_fd(self._theirs.fileno(), warn_on_full_buffer=False)
        self._before = {number: signal.signal(number, _nothing) for number in ASKED}
        self._thread = threading.Thread(target=self._listen, name="stopping", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if not self._before:
            return
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._wakeup)
        self._theirs.close()
        self._thread.join()
        self._ours.close()

    def _listen(self) -> None:
        while numbers := self._ours.recv(64):
            for number in numbers:
                if number not in ASKED:
                    continue
                if self.signal is not None:
                    self._at_once(128 + number)
                    continue
                self.signal = number
                self._ask(number)


def _nothing(number: int, frame: FrameType | None) -> None:
    """A signal without a handler would end the process before the thread hears of it."""
