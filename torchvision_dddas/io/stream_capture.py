"""Cameras and network streams picture by picture, as they come: what is behind them may fall silent at any time."""

import re
from typing import Protocol

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.video import open_capture

_SECRETS = re.compile(r"(?<=://)[^/\s]*@")
# Pictures in a row that may fail to be decoded at the start: a stream is joined in the middle.
_MOST_UNDECODED = 100


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


class OpenedStream:
    """A Stream through OpenCV. limits_s: an opening, or a read, that takes longer fails, where the driver heeds it.

    Raises InputError: cannot be opened, is no video.
    """

    def __init__(self, target: str | int, name: str, limits_s: tuple[float, float]) -> None:
        self._capture = open_capture(target, name, limits_s)
        # What goes wrong from now on is told by who reads; OpenCV would write a line for each time.
        cv2.utils.logging.setLogLevel(0)
        rate_hz = self._capture.get(cv2.CAP_PROP_FPS)
        self.rate_hz = float(rate_hz) if np.isfinite(rate_hz) and 0 < rate_hz <= 1000 else None

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


def target_of(spec: str) -> str | int | None:
    """What OpenCV is to open for `camera:0` or an address; None for anything else. Raises InputError."""
    if spec.startswith("camera:"):
        index = spec.removeprefix("camera:")
        if not index.isdecimal() or len(index) > 4:
            raise InputError(f"'{spec}' names no camera; wanted camera:0, camera:1, ...")
        return int(index)
    return spec if "://" in spec else None


def without_secrets(spec: str) -> str:
    """An address as it may be told to anyone: without a user's name and password."""
    return _SECRETS.sub("", spec)


def first_picture(stream: Stream, name: str) -> np.ndarray:
    """The first picture that can be decoded. Raises InputError where there is none."""
    for _ in range(_MOST_UNDECODED):
        if not stream.grab():
            raise InputError(f"no picture comes from {name}; is it sending, in a codec that FFmpeg knows?")
        if (image := stream.retrieve()) is not None:
            return image
    raise InputError(f"no picture of {name} can be decoded; its codec is unknown, or the connection too poor")


def scaled(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A picture brought to (width, height)."""
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
