"""Live streams, picture by picture: the camera or the sender may fall silent at any time."""

from typing import Protocol

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.captures import Capture, announced_hz, open_capture

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


def open_stream(target: str | int, name: str, limits_s: tuple[float, float]) -> Stream:
    """An address through PyAV, a camera of this machine through OpenCV; arguments and errors of `open_capture`."""
    return OpenedStream(open_capture(target, name, limits_s))


class OpenedStream:
    """The Stream of a capture."""

    def __init__(self, capture: Capture) -> None:
        self._capture, self.rate_hz = capture, announced_hz(capture)
        # The reader reports failures from now on; OpenCV would write a line for each.
        cv2.utils.logging.setLogLevel(0)

    @property
    def concealed(self) -> bool:
        """Whether the decoder concealed errors in the picture grabbed last; False where it does not say."""
        return getattr(self._capture, "concealed", False)

    @property
    def damaged(self) -> bool:
        """As `concealed`, also where the picture may build on such a one."""
        return getattr(self._capture, "damaged", False)

    def grab(self) -> bool:
        """Wait for the next picture; False: none came."""
        return self._capture.grab()

    def retrieve(self) -> np.ndarray | None:
        """The picture grabbed last; None where it cannot be decoded."""
        decoded, image = self._capture.retrieve()
        return image if decoded else None

    def release(self) -> None:
        """Let go of the camera or the connection."""
        self._capture.release()


def first_picture(stream: Stream, name: str) -> np.ndarray:
    """The first picture that can be decoded. Raises InputError where there is none."""
    for _ in range(_MOST_UNDECODED):
        if not stream.grab():
            raise InputError(f"no picture comes from {name}; is it sending, in a codec that FFmpeg knows?")
        if (image := stream.retrieve()) is not None:
            return image
    raise InputError(f"no picture of {name} can be decoded; its codec is unknown, or the connection too poor")
