"""Signals that end a run: Ctrl-C, SIGTERM and SIGHUP. They wait while a frame is written, to keep outputs whole."""

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self

from torchvision_dddas.errors import InputError

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

KEPT = "results up to here are kept"
"""The note on an exception that ended a run early, if its outputs are whole."""

TOGETHER_S = 2.0
"""Signals within this time of the first count as one request: a second Ctrl-C, or SIGTERM and SIGHUP together."""

_DEAF_S = 1.0  # after this time without reaction the main thread counts as stuck in a library
_POLL_S = 0.01


def _heeded() -> list[int]:
    """Return the signals that the process does not ignore; under nohup it ignores some."""
    return [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]


def ignore_signals() -> None:
    """Ignore signals from now on. Callers use this at the end of the process, when a signal would kill it."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


class Stopped(KeyboardInterrupt):
    """Raised when a signal requests the end of the run. number: the signal's number. Notes name any kept outputs."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def is_stop(error: BaseException | None) -> bool:
    """Return whether a signal caused an exception, even if a library replaced the exception by another.

    Libraries raise ImportError or SystemError instead, and some omit the original exception. An InputError has another
    cause, even if it was raised while a signal was handled.
    """
    if isinstance(error, (ImportError, SystemError)) and _heard:
        return True
    while error is not None and not isinstance(error, InputError):
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


class StopSignals:
    """A context in which SIGNALS are requests to stop.

    signal: the first signal, None before; noticed: the first signal that the main thread received.
    Signals wake a thread of this class, because the main thread may be busy in a library, hold a lock, or hang.
    Signals that the process ignores, as under nohup, stay ignored.
    """

    def __init__(
        self,
        ask: Callable[[int], object],
        at_once: Callable[[int], object] = os._exit,
        notice: Callable[[int, FrameType | None], object] = lambda number, frame: None,
        together_s: float = TOGETHER_S,
    ) -> None:
        """ask: called in another thread at the first signal. notice: called in the main thread at each signal.

        at_once: called with the exit code at a signal that comes more than together_s after the first.
        """
        self._ask, self._at_once, self._notice, self._together_s = ask, at_once, notice, together_s
        self.signal: int | None = None
        self.noticed: int | None = None
        self._first_s = 0.0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        # Python handles signals in the main thread only.
        if threading.current_thread() is not threading.main_thread():
            return self
        self._ours, self._theirs = socket.socketpair()
        self._theirs.setblocking(False)
        self._wakeup = signal.set_wakeup_fd(self._theirs.fileno(), warn_on_full_buffer=False)
        self._before = {number: signal.signal(number, self._notice) for number in _heeded()}
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
                if number not in self._before:
                    continue
                if self.signal is None:
                    self.signal, self._first_s = number, time.monotonic()
                    self._ask(number)
                elif time.monotonic() - self._first_s >= self._together_s:
                    self._at_once(128 + number)


Rescue = Callable[[], bool]
"""A function that makes the outputs of an open run whole, from another thread. It returns whether there are outputs."""

_rescues: list[Rescue] = []
# Signals that the main thread has received; it acts on them when allowed. An Event would take a lock, and a handler
# interrupted by a second signal would wait for itself.
_heard: list[int] = []


@contextmanager
def rescued_by(rescue: Rescue) -> Iterator[None]:
    """While the block runs, call `rescue` before the process ends if the main thread cannot receive a signal."""
    _rescues.append(rescue)
    try:
        yield
    finally:
        _rescues.remove(rescue)


def raising_signals(end: Callable[[int, bool], object]) -> StopSignals:
    """Return StopSignals that raise Stopped once, in the main thread.

    If that thread is stuck in a library, another thread makes open outputs whole and then calls `end` with the signal
    and whether anything was kept; `end` ends the process.
    """
    taken, is_rescued = threading.Lock(), threading.Event()  # taken: held by the thread that ends the run
    _heard.clear()

    def notice(number: int, frame: FrameType | None) -> None:
        _heard.append(number)
        signals.noticed = signals.noticed or number
        if taken.acquire(blocking=False):
            raise Stopped(number)
        if is_rescued.is_set():  # this thread was stuck, and the other thread is about to end the process
            time.sleep(_DEAF_S)

    def ask(number: int) -> None:
        until = time.monotonic() + _DEAF_S
        while not _heard and time.monotonic() < until:
            time.sleep(_POLL_S)
        if not _heard and taken.acquire(blocking=False):
            is_rescued.set()
            kept = [rescue() for rescue in reversed(_rescues)]
            end(number, any(kept))

    signals = StopSignals(ask, notice=notice)
    return signals


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay signals until the block ends, so that an item is written to every file or to none."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []

    def hold(number: int, frame: FrameType | None) -> None:
        _heard.append(number)
        held.append(number)

    before = {number: signal.signal(number, hold) for number in _heeded()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
    if not held:
        return
    if callable(handler := before[held[0]]):
        handler(held[0], None)  # a new signal would count as the user's second signal
    else:
        signal.raise_signal(held[0])
