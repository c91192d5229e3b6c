"""Pictures from the bytes of a file, as OpenCV decodes them, once it is sure that they end."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np

_PNG = b"\x89PNG\r\n\x1a\n"


def decoded(data: bytes, flags: int) -> np.ndarray | None:
    """(H, W) or (H, W, C); None where they are no whole picture. flags: cv2.IMREAD_..."""
    if not data or not _whole(data):
        return None
    with quiet_opencv():
        try:
            image: np.ndarray | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except (cv2.error, MemoryError):  # damaged, or of a size that no memory holds
            return None
    return image


def _whole(data: bytes) -> bool:
    """Whether a PNG or a JPEG goes on to its end; other kinds are left to the decoder."""
    if data[:2] == b"\xff\xd8":
        # Cut short it decodes to a picture with a grey bottom: its end marker is missing after the start of the scan.
        return data.rfind(b"\xff\xd9") >= data.rfind(b"\xff\xda")
    if data[:8] != _PNG:
        return True
    # OpenCV 4.14 asks for as much memory as a chunk says it is long, and may then never return.
    place = len(_PNG)
    while place + 12 <= len(data):
        if data[place + 4 : place + 8] == b"IEND":
            return True
        place += 12 + int.from_bytes(data[place : place + 4], "big")
    return False


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep OpenCV's own complaints off the terminal: the user gets our one line instead."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(0)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)
