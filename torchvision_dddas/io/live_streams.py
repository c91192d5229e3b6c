"""Read live streams picture by picture. The camera or the sender may stop sending at any time."""

from collections import deque
from typing import Protocol

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.captures import Capture, announced_hz, open_capture
from torchvision_dddas.io.images import OPENCV_LOGGING

# Number of pictures in a row that may fail to be decoded at the start, because a stream is joined in the middle.
_MOST_UNDECODED = 100


class LiveStream(Protocol):
    """The interface of an open camera or stream for a live run; its calls may block for any time."""

    rate_hz: float | None  # as announced; None if not credible

    def grab(self) -> bool:
        """Wait for the next picture. Return False if none came."""
        ...

    def retrieve(self) -> np.ndarray | None:
        """Return the last grabbed picture, uint8 (H, W) or (H, W, 3) BGR; None if it cannot be decoded."""
        ...

    def release(self) -> None:
        """Close the camera or the connection."""
        ...


def open_stream(target: str | int, name: str, limits_s: tuple[float, float]) -> LiveStream:
    """Open an address through PyAV, or a local camera through OpenCV; arguments and errors as in `open_capture`."""
    return OpenedStream(open_capture(target, name, limits_s))


class OpenedStream:
    """A LiveStream that reads from a capture."""

    def __init__(self, capture: Capture) -> None:
        self._capture, self.rate_hz = capture, announced_hz(capture)
        # From now on the reader reports failures, and OpenCV's own messages are switched off.
        OPENCV_LOGGING.setLogLevel(0)

    @property
    def concealed(self) -> bool:
        """Whether the decoder concealed errors in the last grabbed picture; False if it does not report them."""
        return getattr(self._capture, "concealed", False)

    @property
    def damaged(self) -> bool:
        """Whether the last grabbed picture has concealed errors or may depend on such a picture."""
        return getattr(self._capture, "damaged", False)

    @property
    def metadata(self) -> deque[tuple[float, bytes]] | None:
        """Time stamps (s) and contents of the newest KLV packets, which the reader takes out; None without any."""
        return getattr(self._capture, "metadata", None)

    @property
    def stamp_s(self) -> float:
        """Time stamp of the last grabbed picture; NaN for none."""
        return self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000

    def grab(self) -> bool:
        """Wait for the next picture. Return False if none came."""
        return self._capture.grab()

    def retrieve(self) -> np.ndarray | None:
        """Return the last grabbed picture; None if it cannot be decoded."""
        decoded, image = self._capture.retrieve()
        return image if decoded else None

    def release(self) -> None:
        """Close the camera or the connection."""
        self._capture.release()


def first_picture(stream: LiveStream, name: str) -> np.ndarray:
    """Return the first picture that can be decoded. Raise InputError if there is none."""
    for _ in range(_MOST_UNDECODED):
        if not stream.grab():
            raise InputError(f"no picture comes from {name}; is it sending, in a codec that FFmpeg knows?")
        if (image := stream.retrieve()) is not None:
            return image
    raise InputError(f"no picture of {name} can be decoded; its codec is unknown, or the connection is too poor")
