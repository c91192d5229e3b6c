"""Cameras that follow a test's script, and a clock that a test moves."""

import threading
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.live.frame_queue import Clock

# Nothing that a test waits for takes this long: a hang becomes a failure.
PATIENCE_S = 30.0


class FakeClock(Clock):
    """A clock that only `pass_s` moves, and the sleeps of the camera's thread, which end at once."""

    def __init__(self) -> None:
        self.now_s, self.utc_ahead_s = 100.0, 1.7e9
        self.slept_s: list[float] = []
        self._waited: set[threading.Condition] = set()

    def now(self) -> float:
        return self.now_s

    def utc(self) -> float:
        return self.now_s + self.utc_ahead_s

    def wait(self, changed: threading.Condition, seconds: float | None = None) -> None:
        self._waited.add(changed)
        if seconds is None or threading.current_thread() is threading.main_thread():
            assert changed.wait(PATIENCE_S), "nothing happens any more"
            return
        self.slept_s.append(seconds)
        self.now_s += seconds

    def pass_s(self, seconds: float) -> None:
        """Move on, and wake all threads that wait."""
        self.now_s += seconds
        for changed in self._waited:
            with changed:
                changed.notify_all()


def grey(level: int, width: int = 64, height: int = 48) -> np.ndarray:
    return np.full((height, width, 3), level, np.uint8)


class FakeStream:
    """Plays a script of pictures: an array or a grey level, None (cannot be decoded), False (no picture came).

    Between them, a float lets seconds pass on the clock, and a function is called: it may wait or raise.
    """

    def __init__(self, script: Iterable[Any], rate_hz: float | None = 25.0, clock: FakeClock | None = None) -> None:
        self.rate_hz, self.clock, self.concealed = rate_hz, clock, False
        self.released = threading.Event()
        self._script = iter(script)
        self._image: np.ndarray | None = None

    def grab(self) -> bool:
        for step in self._script:
            if callable(step):
                step()
            elif isinstance(step, float):
                assert self.clock is not None
                self.clock.now_s += step
            else:
                self._image = None if step is None or step is False else grey(step) if np.ndim(step) == 0 else step
                return step is not False
        return False

    def retrieve(self) -> np.ndarray | None:
        return self._image

    def release(self) -> None:
        self.released.set()


class Streams:
    """An opener: one stream after the other; None is one that cannot be opened."""

    def __init__(self, *streams: FakeStream | None) -> None:
        self.streams, self.opened = streams, 0

    def __call__(self) -> FakeStream:
        stream = self.streams[self.opened] if self.opened < len(self.streams) else None
        self.opened += 1
        if stream is None:
            raise InputError("cannot open it; is it there?")
        return stream


class Gate:
    """A step where a camera's thread waits until the test lets it go on. reached: it is there."""

    def __init__(self) -> None:
        self.reached, self.open = threading.Event(), threading.Event()

    def __call__(self) -> None:
        self.reached.set()
        assert self.open.wait(PATIENCE_S), "the test never opened the gate"


def after(event: threading.Event, act: Callable[[], object]) -> threading.Thread:
    """Do something after an event, in a thread of its own."""

    def run() -> None:
        assert event.wait(PATIENCE_S)
        act()

    thread = threading.Thread(target=run)
    thread.start()
    return thread
