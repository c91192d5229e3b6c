"""How large a picture is, by the head of its file where that tells."""

import re
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.images import read_image

# Start of frame, baseline to progressive lossless; C4, C8 and CC are tables.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def size_of(path: Path) -> tuple[int, int]:
    """(width, height), px. Only what is no PNG, BMP, PNM or plain JPEG is decoded.

    Raises InputError where it is no picture.
    """
    try:
        with path.open("rb") as file:
            head = file.read(32)
            if head[:2] == b"\xff\xd8":
                head += file.read(65536)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    size = _told(head)
    if size is not None and min(size) > 0:
        return size
    image = read_image(path)
    if image is None:
        raise InputError(f"{path} is no picture that can be read")
    return image.shape[1], image.shape[0]


def _told(head: bytes) -> tuple[int, int] | None:
    """The size that the head of a file tells."""
    if head[:8] == b"\x89PNG\r\n\x1a\n" and head[12:16] == b"IHDR" and len(head) >= 24:
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    if head[:2] == b"BM" and len(head) >= 26:
        return int.from_bytes(head[18:22], "little"), abs(int.from_bytes(head[22:26], "little", signed=True))
    if pnm := re.match(rb"P[1-6]\s+([0-9]{1,6})\s+([0-9]{1,6})\s", head):
        return int(pnm[1]), int(pnm[2])
    # A camera's notes may say that the picture is to be turned.
    return _jpeg(head) if head[:2] == b"\xff\xd8" and b"Exif" not in head else None


def _jpeg(head: bytes) -> tuple[int, int] | None:
    place = 2
    while place + 9 <= len(head) and head[place] == 0xFF:
        if head[place + 1] == 0xFF:  # filling
            place += 1
            continue
        if head[place + 1] in _JPEG_FRAMES:
            height, width = head[place + 5 : place + 7], head[place + 7 : place + 9]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        place += 2 + int.from_bytes(head[place + 2 : place + 4], "big")
    return None
