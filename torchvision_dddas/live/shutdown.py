"""Ctrl-C and a supervisor's SIGTERM: the first asks a run to end with valid outputs, the second ends it at once."""

import os
import signal
import socket
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self

ASKED = (signal.SIGINT, signal.SIGTERM)


class Stopping:
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
