"""Pictures in files: folders and globs of images as a clip, single pictures, and one PNG a frame for masks."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from glob import glob
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import write_whole
from torchvision_dddas.types import Frame, Problem, Scene, is_sampled

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm", ".webp", ".jp2", ".gif"}
)

# 8, 16 bits and EXIF rotation are kept, alpha is dropped.
_FLAGS = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
_PNG = b"\x89PNG\r\n\x1a\n"
_SENSOR_BITS = (8, 10, 12, 14, 16)
_LOOKS = 9


class ImageSource:
    """The files of a folder or glob in natural order (frame2 before frame10), one a frame.

    rate_hz: images carry no frame rate, so the caller gives one.
    full_scale: the 16-bit value that becomes white (255). One value serves the whole clip, so that brightness does not
    flicker. By default nine images spread over the clip are looked at, and it is the top of the smallest sensor (8, 10,
    12, 14 or 16 bits) that holds their brightest pixel. Brighter pixels elsewhere saturate, which is recorded once.
    The first image decides whether the clip is grey or colour; the others follow it.
    tolerant: an image of another size or depth is left out.
    Raises InputError: the first image cannot be read, an image of another size or depth (when it is reached).
    """

    def __init__(self, files: Sequence[Path], name: str, rate_hz: float = 10.0, full_scale: int | None = None) -> None:
        if not files:
            raise InputError(f"{name} holds no images")
        self.files = list(files)
        self.name = name
        self.count: int | None = len(self.files)
        self.exact = True
        self.rate_hz = rate_hz
        self.last = 0
        self.problems: list[Problem] = []
        self.tolerant = False
        first = read_image(self.files[0])
        if first is None:
            raise InputError(f"the first image, {self.files[0]}, cannot be decoded; repair it or leave it out")
        if first.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{self.files[0]} holds {first.dtype} pixels; wanted 8 or 16 bits")
        self.size = (first.shape[1], first.shape[0])
        self._depth, self._grey = first.dtype, first.ndim == 2
        self.full_scale = 255
        if self._depth == np.uint16:
            self.full_scale = full_scale or self._sensor_top()

    def __iter__(self) -> Iterator[Frame]:
        return self.every(1)

    def every(self, interval: int) -> Iterator[Frame]:
        """Frames 1, 1 + interval, ...: the other files are not opened."""
        self.problems.clear()
        saturated = False
        for number, file in enumerate(self.files, start=1):
            self.last = number
            if not is_sampled(number, interval):
                continue
            image = read_image(file)
            if image is None:
                self.problems.append(
                    Problem(number, f"frame {number} ({file.name}) could not be decoded and was left out")
                )
                continue
            if not self._fits(image, number, file):
                continue
            if self._depth == np.uint16:
                if not saturated and image.max() > self.full_scale:
                    saturated = True
                    what = f"frame {number} ({file.name}) holds {image.max()}; above {self.full_scale} all is white"
                    self.problems.append(Problem(number, what))
                image = cv2.convertScaleAbs(image, alpha=255.0 / self.full_scale)
            yield Frame(number, (number - 1) / self.rate_hz, self._as_first(image))

    def _fits(self, image: np.ndarray, number: int, file: Path) -> bool:
        what, all_must = "", ""
        if (size := (image.shape[1], image.shape[0])) != self.size:
            what = f"{file} is {size[0]}x{size[1]} but {self.files[0].name} is {self.size[0]}x{self.size[1]}"
            all_must = "all frames of a clip must have one size"
        elif image.dtype != self._depth:
            what = f"{file} holds {image.dtype} pixels but {self.files[0].name} {self._depth}"
            all_must = "all frames of a clip must have one depth"
        if what and not self.tolerant:
            raise InputError(f"{what}; {all_must}")
        if what:
            self.problems.append(Problem(number, f"{what}: it was left out"))
        return not what

    def _as_first(self, image: np.ndarray) -> np.ndarray:
        if self._grey == (image.ndim == 2):
            return image
        return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if self._grey else cv2.COLOR_GRAY2BGR)

    def _sensor_top(self) -> int:
        looks = np.unique(np.linspace(0, len(self.files) - 1, _LOOKS).astype(int))
        images = (read_image(self.files[i]) for i in looks)
        brightest = max(int(image.max()) for image in images if image is not None)
        return next(2**bits - 1 for bits in _SENSOR_BITS if brightest < 2**bits)


def read_image(file: Path) -> np.ndarray | None:
    """The picture as stored, (H, W) or (H, W, 3) BGR, turned upright; None when it is not a whole picture."""
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}") from None
    return decode_image(data, _FLAGS)


def read_colour_image(file: Path) -> np.ndarray:
    """A picture as (H, W, 3) uint8 BGR. Raises InputError if it cannot be read, is broken, grey or not of 8 bits."""
    image = read_image(file)
    if image is None:
        raise InputError(f"{file} is not a whole picture; give a PNG, JPEG or TIFF")
    if image.ndim == 3 and image.shape[2] == 4:
        image = image[:, :, :3]
    if image.dtype != np.uint8 or image.ndim != 3:
        raise InputError(f"{file} has no colours of 8 bits; give a colour picture, as the camera delivers it")
    return np.ascontiguousarray(image)


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
    files = [entry for entry in entries if entry.suffix.lower() in IMAGE_SUFFIXES and entry.is_file()]
    if not files:
        meant = [
            entry for entry in sorted(entries) if entry.is_dir() or entry.suffix.lower() in {".mp4", ".avi", ".mov"}
        ]
        hint = f"; did you mean {meant[0]}?" if meant else ""
        raise InputError(f"folder {folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}){hint}")
    return sorted(files, key=lambda file: natural_order(file.name))


def images_of_glob(pattern: str) -> list[Path]:
    """The images that match, in natural order. Raises InputError when none does."""
    matches = [Path(match) for match in glob(pattern, recursive=True)]  # noqa: PTH207 (a pattern may be absolute)
    files = [file for file in matches if file.suffix.lower() in IMAGE_SUFFIXES and file.is_file()]
    if not files:
        raise InputError(f"no image matches {pattern}" + (f" ({len(matches)} other files do)" if matches else ""))
    return sorted(files, key=lambda file: natural_order(str(file)))


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


MASK_NAME = re.compile(r"\d{6,}\.png")


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
