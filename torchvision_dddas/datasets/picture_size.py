"""How large a picture is, by its first bytes where they tell."""

from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.sources.images import read_image

_PNG = b"\x89PNG\r\n\x1a\n"


def size_of(path: Path) -> tuple[int, int]:
    """(width, height), px. Raises InputError where it is no picture."""
    try:
        with path.open("rb") as file:
            head = file.read(24)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    if head[:8] == _PNG and head[12:16] == b"IHDR":
        size = int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
        if min(size) > 0:
            return size
    image = read_image(path)
    if image is None:
        raise InputError(f"{path} is no picture that can be read")
    return image.shape[1], image.shape[0]
