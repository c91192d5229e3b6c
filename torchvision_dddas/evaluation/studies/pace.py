"""Frames told in groups, a few times a second."""

import time
from collections.abc import Callable

EVERY_S = 0.25


class Ticker:
    """Called once a frame; tells how many there were since it told last."""

    def __init__(self, tell: Callable[[int], object]) -> None:
        self._tell, self._count, self._told = tell, 0, time.monotonic()

    def __call__(self) -> None:
        """Another frame."""
        self._count += 1
        if time.monotonic() - self._told >= EVERY_S:
            self.flush()

    def flush(self) -> None:
        """Tell what is left."""
        if self._count:
            self._tell(self._count)
        self._count, self._told = 0, time.monotonic()
