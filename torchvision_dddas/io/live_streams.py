"""Live streams, picture by picture: the camera or the sender may fall silent at any time."""

import os
import time
from contextlib import suppress
from typing import Any, Protocol

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.sources import announced_hz, credible_hz, open_capture

# Pictures in a row that may fail to be decoded at the start: a stream is joined in the middle.
_MOST_UNDECODED = 100
# FFmpeg's options of a stream, `name;value|name;value`, as OpenCV reads them from this variable; by default as OpenCV.
_OPTIONS, _DEFAULT_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS", "rtsp_transport;tcp"


class Stream(Protocol):
    """What a live run needs of an open camera or stream; the calls may take as long as they like."""

    rate_hz: float | None  # as announced; None where nothing credible is

    def grab(self) -> bool:
        """Wait for the next picture; False: none came."""
        ...

    def retrieve(self) -> np.ndarray | None:
        """The picture grabbed last, uint8 (H, W) or (H, W, 3) BGR; None where it cannot be decoded."""
        ...

    def release(self) -> None:
        """Let go of the camera or the connection."""
        ...


def open_stream(target: str | int, name: str, limits_s: tuple[float, float]) -> Stream:
    """A stream through PyAV where it is installed, else, as a camera of this machine, through OpenCV.

    limits_s: an opening, or a read, that takes longer fails, where the driver heeds it. PyAV gives pictures as they
    come; OpenCV (4.14) squeezes them to the size of the first one where a stream changes it (OpenCV issue 27116).
    Raises InputError: cannot be opened, is no video.
    """
    if isinstance(target, str):
        with suppress(ImportError):
            return AvStream(target, name, limits_s)
    return OpenedStream(target, name, limits_s)


class OpenedStream:
    """A Stream through OpenCV; arguments and errors of `open_stream`."""

    def __init__(self, target: str | int, name: str, limits_s: tuple[float, float]) -> None:
        self._capture = open_capture(target, name, limits_s)
        # The reader reports failures from now on; OpenCV would write a line for each.
        cv2.utils.logging.setLogLevel(0)
        self.rate_hz = announced_hz(self._capture)

    def grab(self) -> bool:
        """Wait for the next picture; False: none came."""
        return bool(self._capture.grab())

    def retrieve(self) -> np.ndarray | None:
        """The picture grabbed last; None where it cannot be decoded."""
        decoded, image = self._capture.retrieve()
        return image if decoded else None

    def release(self) -> None:
        """Let go of the camera or the connection."""
        self._capture.release()


class AvStream:
    """A Stream through PyAV; arguments and errors of `open_stream`. Raises ImportError where PyAV is not installed."""

    def __init__(self, target: str, name: str, limits_s: tuple[float, float]) -> None:
        import av

        self._limit_s = limits_s[1]
        self._failures = (av.FFmpegError, OSError)
        try:
            self._container = av.open(target, options=_read_options(), timeout=limits_s, **_metadata_options(av))
        except (*self._failures, ValueError):
            raise InputError(f"cannot open {name} as a stream; is it there?") from None
        videos = self._container.streams.video
        if not videos or videos[0].codec_context is None or videos[0].codec_context.name == "ansi":
            self._container.close()
            raise InputError(f"{name} is no video")
        self._video = videos[0]
        self.rate_hz = credible_hz(float(self._video.average_rate or self._video.guessed_rate or 0))
        self._packets = self._container.demux(self._video)
        self._waiting: list[Any] = []  # frames of the packet read last
        self._frame: Any = None

    def grab(self) -> bool:
        """Wait for the next picture; False: none came."""
        self._frame, until_s = None, time.monotonic() + self._limit_s
        while not self._waiting:
            if time.monotonic() > until_s:  # packets come, and no picture of them
                return False
            try:
                packet = next(self._packets)
            except (StopIteration, *self._failures):
                return False
            with suppress(*self._failures):  # a damaged packet
                self._waiting = packet.decode()
        self._frame = self._waiting.pop(0)
        return True

    def retrieve(self) -> np.ndarray | None:
        """The picture grabbed last; None where it cannot be decoded."""
        if self._frame is None:
            return None
        with suppress(*self._failures, ValueError):
            image: np.ndarray = self._frame.to_ndarray(format="bgr24")
            return image
        return None

    def release(self) -> None:
        """Let go of the connection."""
        self._container.close()


def _metadata_options(av: Any) -> dict[str, Any]:
    """Make PyAV read metadata that is no UTF-8. Since release 19 it always does, and has no such argument."""
    return {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}


def _read_options() -> dict[str, str]:
    pairs = (text.split(";", 1) for text in os.environ.get(_OPTIONS, _DEFAULT_OPTIONS).split("|"))
    return {pair[0]: pair[1] for pair in pairs if len(pair) == 2}


def first_picture(stream: Stream, name: str) -> np.ndarray:
    """The first picture that can be decoded. Raises InputError where there is none."""
    for _ in range(_MOST_UNDECODED):
        if not stream.grab():
            raise InputError(f"no picture comes from {name}; is it sending, in a codec that FFmpeg knows?")
        if (image := stream.retrieve()) is not None:
            return image
    raise InputError(f"no picture of {name} can be decoded; its codec is unknown, or the connection too poor")
