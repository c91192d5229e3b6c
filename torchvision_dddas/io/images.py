"""Pictures in files: reading and decoding them, finding them in folders, and one PNG a frame for masks."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from glob import glob
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import write_whole
from torchvision_dddas.types import Scene

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm", ".webp", ".jp2", ".gif"}
)
MASK_NAME = re.compile(r"\d{6,}\.png")

# 8, 16 bits and EXIF rotation are kept, alpha is dropped.
_FLAGS = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
_PNG = b"\x89PNG\r\n\x1a\n"


def read_image(file: Path) -> np.ndarray | None:
    """The picture as stored, (H, W) or (H, W, 3) BGR, turned upright; None when it is not a whole picture."""
    try:
        return decode_image(file.read_bytes(), _FLAGS)
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}") from None


def read_colour_image(file: Path) -> np.ndarray:
    """A picture as (H, W, 3) uint8 BGR. Raises InputError if it cannot be read, is broken, grey or not of 8 bits."""
    image = read_image(file)
    if image is None:
        raise InputError(f"{file} is not a whole picture; give a PNG, JPEG or TIFF")
    if image.dtype != np.uint8 or image.ndim != 3:
        raise InputError(f"{file} has no colours of 8 bits; give a colour picture, as the camera delivers it")
    return np.ascontiguousarray(image[:, :, :3])


def decode_image(data: bytes, flags: int) -> np.ndarray | None:
    """The picture in the bytes of a file, (H, W) or (H, W, C); None where it is not whole. flags: cv2.IMREAD_..."""
    if not data or not _is_whole(data):
        return None
    with quiet_opencv():
        try:
            image: np.ndarray | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except (cv2.error, MemoryError):  # damaged, or of a size that no memory holds
            return None
    return image


def _is_whole(data: bytes) -> bool:
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


def natural_order(name: str) -> list[str | int]:
    """Sorting key under which numbers count as numbers: frame2 comes before frame10."""
    # Texts and numbers by turns; digits of other scripts are text.
    return [int(part) if k % 2 else part.casefold() for k, part in enumerate(re.split(r"([0-9]+)", name))]


def images_of_folder(folder: Path) -> list[Path]:
    """The folder's images in natural order. Raises InputError when there are none, with a guess at what was meant."""
    try:
        entries = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    except OSError as error:
        raise InputError(f"folder {folder} cannot be read: {error.strerror}") from None
    if files := _images(entries):
        return files
    videos = {".mp4", ".avi", ".mov"}
    meant = next((entry for entry in sorted(entries) if entry.is_dir() or entry.suffix.lower() in videos), None)
    hint = f"; did you mean {meant}?" if meant else ""
    raise InputError(f"folder {folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}){hint}")


def images_of_glob(pattern: str) -> list[Path]:
    """The images that match, in natural order. Raises InputError when none does."""
    matches = [Path(match) for match in glob(pattern, recursive=True)]  # noqa: PTH207 (a pattern may be absolute)
    if files := _images(matches):
        return files
    raise InputError(f"no image matches {pattern}" + (f" ({len(matches)} other files do)" if matches else ""))


def _images(paths: Sequence[Path]) -> list[Path]:
    files = [path for path in paths if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
    return sorted(files, key=lambda file: natural_order(str(file)))


class Masks:
    """masks/000001.png and so on, each whole once it is there. 8 bits, or 16 for frames with over 255 targets."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "masks"
        self._last = 0

    def write(self, scene: Scene) -> None:
        """Write the mask of a frame. Raises OSError if the disk refuses."""
        self.add(scene.frame.number, scene.mask)

    def add(self, number: int, mask: np.ndarray) -> None:
        """The same for the mask (H, W) of any frame."""
        self._folder.mkdir(exist_ok=True)
        kind = np.uint8 if mask.size == 0 or mask.max() <= 255 else np.uint16
        # Level 1: masks are nearly empty, and higher levels cost time for a few bytes.
        ok, png = cv2.imencode(".png", mask.astype(kind, copy=False), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not ok:
            raise OSError(f"mask of frame {number} could not be encoded")
        write_whole(self._folder / f"{number:06d}.png", png.tobytes())
        self._last = number

    def close(self, complete: bool) -> None:
        """Remove the masks of an earlier, longer clip, so that the folder holds one clip only."""
        for path in self._folder.glob("*.png"):
            if MASK_NAME.fullmatch(path.name) and int(path.stem) > self._last:
                path.unlink()

    def discard(self) -> None:
        """Nothing to do: each mask is whole already."""
