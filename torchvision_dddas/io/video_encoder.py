"""A film that is encoded beside the work that makes its pictures: on two cores the slower of the two sets the pace."""

from queue import Queue
from threading import Thread
from typing import Protocol

import numpy as np


class Writer(Protocol):
    """What writes pictures into a video file."""

    def write(self, picture: np.ndarray) -> None:
        """Add a picture, (H, W, 3) uint8 BGR with even H and W."""

    def close(self) -> None:
        """Finish the file."""


class Beside:
    """A writer whose work is done in a thread. A picture must not be changed after it was given.

    An error of the work is raised by the next call, also by `close`.
    """

    def __init__(self, writer: Writer, waiting: int = 2) -> None:
        """waiting: pictures held at most; a further one waits until there is room."""
        self._writer = writer
        self._queue: Queue[np.ndarray | None] = Queue(waiting)
        self._error: Exception | None = None
        self._thread = Thread(target=self._work, daemon=True)
        self._thread.start()

    def write(self, picture: np.ndarray) -> None:
        """Add a picture."""
        self._raise()
        self._queue.put(picture)

    def close(self) -> None:
        """Finish the file, once all pictures are in it."""
        self._queue.put(None)
        self._thread.join()
        self._writer.close()
        self._raise()

    def _work(self) -> None:
        while (picture := self._queue.get()) is not None:
            if self._error is None:
                try:
                    self._writer.write(picture)
                except Exception as error:
                    self._error = error

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error
