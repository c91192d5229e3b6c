"""Write overlay.mp4 and overlay.png, the pictures of a run. The video is encoded in a separate thread."""

from collections.abc import Callable
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Generic, TypeVar

import cv2
import numpy as np

from torchvision_dddas.io.atomic_files import OutputPart, PartFile, utf8_name, write_whole
from torchvision_dddas.io.video_packets import add_h264, frame_of, pad_to_even, usual_rate

Item = TypeVar("Item")


class OverlayVideo(Generic[Item]):
    """Write overlay.mp4 as H.264, which browsers play, if PyAV is installed (extra `video`), else as OpenCV's mp4v."""

    def __init__(
        self, folder: Path, rate_hz: float, draw: Callable[[Item], np.ndarray], name: str = "overlay.mp4"
    ) -> None:
        """draw: a function that returns a new picture of an item, (H, W, 3) uint8 BGR."""
        self._path = folder / name
        self._part: PartFile | None = None
        self._rate = usual_rate(rate_hz)
        self._writer: ThreadedWriter | None = None
        self._draw = draw

    def write(self, item: Item) -> None:
        """Draw a frame and add it. Raise OSError if the disk refuses."""
        picture = pad_to_even(self._draw(item))
        if self._writer is None:
            self._part = PartFile(self._path)
            self._writer = _open_writer(self._part.path, self._rate, (picture.shape[1], picture.shape[0]))
        self._writer.write(picture)

    def close(self, complete: bool) -> None:
        """Finish the video and move it to its place. A run without frames has no video."""
        if self._writer is None or self._part is None:
            return
        writer, self._writer = self._writer, None
        writer.close()
        # OpenCV's writer does not report a full disk, so check that the video can be opened again.
        if not cv2.VideoCapture(utf8_name(self._part.path)).isOpened():
            raise OSError(f"{self._path.name} could not be finished")
        self._part.keep()

    def discard(self) -> None:
        """Remove the unfinished video."""
        if self._writer is not None:
            with suppress(Exception):  # a full disk refuses the last frames again; an encoder may raise anything
                self._writer.close()
            self._writer = None
        if self._part is not None:
            self._part.discard()


class OverlayPicture(OutputPart[Item]):
    """Write overlay.png, the picture of the last item."""

    def __init__(self, folder: Path, draw: Callable[[Item], np.ndarray]) -> None:
        self._path, self._draw = folder / "overlay.png", draw
        self._content = b""

    def write(self, item: Item) -> None:
        """Draw the item."""
        self._content = cv2.imencode(".png", self._draw(item))[1].tobytes()

    def close(self, complete: bool) -> None:
        """Write the picture, if there is one. Raise OSError if the disk refuses."""
        if self._content:
            write_whole(self._path, self._content)


class ThreadedWriter:
    """Encode pictures in a thread, so that encoding and other work use two cores.

    A picture must not be changed after it was given. The next call raises an error of the thread.
    """

    def __init__(self, waiting: int = 2) -> None:
        """waiting: largest number of pictures in the queue. `write` waits if the queue is full."""
        self._queue: Queue[np.ndarray | None] = Queue(waiting)
        self._error: Exception | None = None
        self._thread = Thread(target=self._work, daemon=True)
        self._thread.start()

    def encode(self, picture: np.ndarray) -> None:
        """Add a picture, (H, W, 3) uint8 BGR with even H and W, to the file."""
        raise NotImplementedError

    def finish(self) -> None:
        """Finish the file."""

    def write(self, picture: np.ndarray) -> None:
        """Add a picture to the queue."""
        self._raise()
        self._queue.put(picture)

    def close(self) -> None:
        """Wait until all pictures are encoded, and finish the file."""
        self._queue.put(None)
        self._thread.join()
        self.finish()
        self._raise()

    def _work(self) -> None:
        while (picture := self._queue.get()) is not None:
            if self._error is None:
                try:
                    self.encode(picture)
                except Exception as error:
                    self._error = error

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error


def _open_writer(path: Path, rate: Fraction, size: tuple[int, int]) -> ThreadedWriter:
    """Return a writer of H.264 if PyAV is installed, else of mp4v. size: (width, height). Raise OSError on failure."""
    try:
        return _H264(path, rate, size)
    except ImportError:
        return _OpenCv(path, rate, size)


class _H264(ThreadedWriter):
    def __init__(self, path: Path, rate: Fraction, size: tuple[int, int]) -> None:
        import av

        self._container = av.open(utf8_name(path), "w", options={"movflags": "faststart"})
        self._stream = add_h264(self._container, size, rate)
        super().__init__()

    def encode(self, picture: np.ndarray) -> None:
        self._container.mux(self._stream.encode(frame_of(picture)))

    def finish(self) -> None:
        try:
            self._container.mux(self._stream.encode(None))
        finally:
            self._container.close()


class _OpenCv(ThreadedWriter):
    def __init__(self, path: Path, rate: Fraction, size: tuple[int, int]) -> None:
        self._writer = cv2.VideoWriter(utf8_name(path), cv2.VideoWriter.fourcc(*"mp4v"), float(rate), size)
        if not self._writer.isOpened():
            raise OSError(
                "OpenCV cannot write mp4v video here; install the extra `video`, or leave overlay out of --save"
            )
        super().__init__()

    def encode(self, picture: np.ndarray) -> None:
        self._writer.write(picture)

    def finish(self) -> None:
        self._writer.release()
