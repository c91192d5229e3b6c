"""Picture files: read and decode them, find them in folders, and write one PNG a frame for masks."""

import math
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from glob import glob
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import OutputPart, write_whole
from torchvision_dddas.memory import MASK, PICTURE, check_memory
from torchvision_dddas.types import Scene

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm", ".webp", ".jp2", ".gif"}
)
NUMBERED = re.compile(r"\d{6,}\.(png|jpg)")
"""Names of the pictures that a run writes, one a frame."""

OPENCV_LOGGING = getattr(cv2.utils, "logging", cv2)
"""The module with the log level of OpenCV's own messages, which version 4.13 moved."""

# Keep 8 or 16 bits and the EXIF rotation, and drop alpha.
_FLAGS = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
_PNG = b"\x89PNG\r\n\x1a\n"


def read_image(file: Path, cost: int = PICTURE, size: int | None = None) -> np.ndarray | None:
    """Return the picture as stored, (H, W) or (H, W, 3) BGR, turned upright; None if it is incomplete.

    cost: bytes of memory a pixel. size: bytes of the input that contains it; None: bytes of its own file.
    """
    try:
        return decode_image(file.read_bytes(), _FLAGS, file, cost, size)
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}") from None


def read_mask(path: Path) -> np.ndarray:
    """Return the labels of a mask file, (H, W) int32, from its values or colours. Raise InputError if unreadable."""
    try:
        image = decode_image(path.read_bytes(), cv2.IMREAD_UNCHANGED, path, MASK)
    except OSError:
        image = None
    if image is None:
        raise InputError(f"{path} cannot be read as a picture")
    if image.ndim == 2:
        return image.astype(np.int32)
    blue, green, red = (image[..., k].astype(np.int32) for k in range(3))
    return blue + 256 * green + 65536 * red


def read_colour_image(file: Path) -> np.ndarray:
    """Read a picture as (H, W, 3) uint8 BGR. Raise InputError if it is unreadable, broken, grey, or not 8 bits deep."""
    image = read_image(file)
    if image is None:
        raise InputError(f"{file} is not a whole picture; give a PNG, JPEG or TIFF")
    if image.dtype != np.uint8 or image.ndim != 3:
        raise InputError(f"{file} is not a colour picture of 8 bits; give a colour picture, as the camera delivers it")
    return np.ascontiguousarray(image[:, :, :3])


def read_ignored(file: Path, size: tuple[int, int]) -> np.ndarray:
    """Return (H, W) uint8, 255 for ignored pixels, where a mask is not black. size: (width, height) of the frames.

    Values up to a sixteenth of white count as black, because the edges of a JPEG ring.
    Raise InputError if the picture cannot be read, has another size than the frames, or ignores every pixel.
    """
    image = read_image(file)
    if image is None:
        raise InputError(f"{file} is not a whole picture; give a PNG of the frames' size, white for ignored pixels")
    white = np.iinfo(image.dtype).max if image.dtype.kind == "u" else 1.0
    shown = (image if image.ndim == 2 else image[:, :, :3].max(axis=2)) > white / 16
    if shown.shape[::-1] != size:
        got, wanted = (f"{width}x{height}" for width, height in (shown.shape[::-1], size))
        raise InputError(f"{file} has {got} pixels and the frames {wanted}; give a mask of the frames' size")
    if shown.all():
        raise InputError(f"{file} has no black pixel, so all pixels are ignored; make the pixels to search black")
    return np.where(shown, 255, 0).astype(np.uint8)


def decode_image(
    data: bytes, flags: int, name: object = "a picture", cost: int = PICTURE, input_size: int | None = None
) -> np.ndarray | None:
    """Decode the bytes of a picture file, (H, W) or (H, W, C); None if it is incomplete. flags: cv2.IMREAD_...

    name: the file's name, for messages. cost, input_size: cost and size of `read_image`. A picture without a size in
    its header is not decoded. Raise InputError, before decoding, if the picture is too large for the size of the input.
    """
    size = size_in_header(data)
    if size is None or not _is_whole(data):
        return None
    check_memory(cost * size[0] * size[1], f"{name} is {size[0]}x{size[1]} pixels", input_size or len(data))
    with quiet_opencv():
        try:
            image: np.ndarray | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except (cv2.error, MemoryError):  # damaged, or too large for the memory
            return None
    return image


def size_in_header(data: bytes) -> tuple[int, int] | None:
    """Return (width, height), px, from the header of a picture file, before any rotation; None if missing."""
    try:
        return next((find(data) for magic, find in _SIZES if data.startswith(magic)), None)
    except (struct.error, IndexError):  # too short
        return None


def _at(form: str, place: int) -> Callable[[bytes], tuple[int, int]]:
    """Return a function that reads a size at a fixed place. form: the format of the size for `struct`."""
    return lambda data: struct.unpack_from(form, data, place)


def _size_in_bmp(data: bytes) -> tuple[int, int]:
    is_old = data[14:18] == b"\x0c\0\0\0"
    width, height = struct.unpack_from("<HH" if is_old else "<ii", data, 18)
    return abs(width), abs(height)


def _size_in_pnm(data: bytes) -> tuple[int, int] | None:
    found = _PNM.match(data, 0, 65536)
    return (int(found[1]), int(found[2])) if found else None


def _size_in_webp(data: bytes) -> tuple[int, int] | None:
    if data[8:16] == b"WEBPVP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if data[8:16] == b"WEBPVP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", data, 26)
    return (width & 0x3FFF, height & 0x3FFF) if data[8:12] == b"WEBP" else None


def _size_in_tiff(data: bytes) -> tuple[int, int] | None:
    """Return the size of the first page, or of its tiles if they are larger: the decoder allocates a whole tile."""
    order = "<" if data[:1] == b"I" else ">"
    is_big = data[2:4] in (b"\x2b\0", b"\0\x2b")
    (place,) = struct.unpack_from(order + ("Q" if is_big else "I"), data, 8 if is_big else 4)
    (count,) = struct.unpack_from(order + ("Q" if is_big else "H"), data, place)
    place, step, at = (place + 8, 20, 12) if is_big else (place + 2, 12, 8)
    found = dict[int, int]()
    for entry in range(place, min(place + min(count, 4096) * step, len(data) - step + 1), step):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if tag in (256, 257, 322, 323):  # width and height of the page, and of a tile
            (value,) = struct.unpack_from(order + {3: "H", 16: "Q"}.get(kind, "I"), data, entry + at)
            found[tag] = max(value, found.get(tag, 0))
    page, tile = ((found.get(tag, 0), found.get(tag + 1, 0)) for tag in (256, 322))
    return max(page, tile, key=math.prod) if math.prod(page) else None


def _size_in_jpeg2000(data: bytes) -> tuple[int, int] | None:
    """Return the size of the codestream, or of the header around it if that is larger."""
    place = data.find(b"\xff\x4f\xff\x51")
    right, bottom, left, top = struct.unpack_from(">4I", data, place + 8) if place >= 0 else (0, 0, 0, 0)
    box = data.find(b"ihdr", 0, 4096)
    height, width = struct.unpack_from(">II", data, box + 4) if box >= 0 else (0, 0)
    return max((right - left, bottom - top), (width, height), key=math.prod) if place >= 0 else None


def _size_in_jpeg(data: bytes) -> tuple[int, int] | None:
    place = 2
    while (place := data.find(b"\xff", place)) >= 0:
        marker = data[place + 1]
        if marker in (0x00, 0xFF):  # a stray byte or a fill byte
            place += 1
        elif 0xC0 <= marker < 0xD0 and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame; the others are tables
            height, width = struct.unpack_from(">HH", data, place + 5)
            return width, height
        else:
            place += 2 if 0xD0 <= marker < 0xDA or marker == 0x01 else 2 + int.from_bytes(data[place + 2 : place + 4])
    return None


_PNM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+([0-9]{1,9})(?:\s|#[^\n]*\n)+([0-9]{1,9})\s")

_SIZES: tuple[tuple[bytes, Callable[[bytes], tuple[int, int] | None]], ...] = (
    (_PNG, _at(">II", 16)),
    (b"\xff\xd8", _size_in_jpeg),
    (b"BM", _size_in_bmp),
    (b"P", _size_in_pnm),
    (b"GIF8", _at("<HH", 6)),
    (b"RIFF", _size_in_webp),
    (b"II", _size_in_tiff),
    (b"MM", _size_in_tiff),
    (b"\xff\x4f\xff\x51", _size_in_jpeg2000),
    (b"\0\0\0\x0cjP  ", _size_in_jpeg2000),
)
"""The first bytes of each kind of picture, and the function that finds its size."""


def _is_whole(data: bytes) -> bool:
    """Return whether a PNG or a JPEG is complete; other kinds are left to the decoder."""
    if data[:2] == b"\xff\xd8":
        # A truncated JPEG decodes to a picture with a grey bottom. It has no end marker after the start of the scan.
        return data.rfind(b"\xff\xd9") >= data.rfind(b"\xff\xda")
    if data[:8] != _PNG:
        return True
    # OpenCV 4.14 allocates as much memory as a chunk claims to need, and may then never return.
    place = len(_PNG)
    while place + 12 <= len(data):
        length = int.from_bytes(data[place : place + 4])
        if data[place + 4 : place + 8] == b"IEND":
            return length == 0
        place += 12 + length
    return False


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Suppress OpenCV's own messages. The user gets one line from this package instead."""
    level = OPENCV_LOGGING.getLogLevel()
    OPENCV_LOGGING.setLogLevel(0)
    try:
        yield
    finally:
        OPENCV_LOGGING.setLogLevel(level)


def natural_order(name: str) -> list[str | int]:
    """Return a sorting key that compares numbers by value: frame2 comes before frame10."""
    # Texts and numbers alternate; digits of other scripts count as text.
    return [int(part) if k % 2 else part.casefold() for k, part in enumerate(re.split(r"([0-9]+)", name))]


def images_of_folder(folder: Path) -> list[Path]:
    """Return the folder's images in natural order. If there are none, raise InputError with a guess at the input."""
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
    """Return the matching images in natural order. Raise InputError if none matches."""
    matches = [Path(match) for match in glob(pattern, recursive=True)]  # noqa: PTH207 (a pattern may be absolute)
    if files := _images(matches):
        return files
    raise InputError(f"no image matches {pattern}" + (f" ({len(matches)} other files do)" if matches else ""))


def _images(paths: Sequence[Path]) -> list[Path]:
    files = [path for path in paths if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
    return sorted(files, key=lambda file: natural_order(str(file)))


# Quantiles of a picture's values: the whole range without a few hot or dead pixels, and the core of the range.
_SHARES = (0.001, 0.05, 0.95, 0.999)
# The 8-bit pictures of thermal cameras have 2.2 to 2.3 times as many levels as the core (three clips of HIT-UAV).
_WIDTH = 2.5
# The share of the room beside the core that is kept free at either end of the range.
_GUARD = 0.25
# A value with at least this share of the pixels comes from the sensor, not from a faulty pixel.
_FREQUENT = 2e-4
# Values this many core widths away from all others are bars, padding or the sun, and not part of the scene. For a
# single constant value, such as that of bars, half the width suffices.
_APART, _APART_CONSTANT = 4.0, 0.5
# Largest number of levels for one step of the values. More levels would only show noise.
_MOST_GAIN = 4
_SENSOR_BITS = (8, 10, 12, 14, 16)


Scale = tuple[int, int] | None
"""The 16-bit values that become black and white; None: they are taken from the clip."""


class Levels:
    """Convert the 16-bit pictures of a clip to 8 bits with one constant gain, so that they do not flicker.

    black, white: the values that become 0 and 255. Samples of the clip determine the range. If their values span at
    most 256 steps, each step becomes one level, and nothing is lost; very few steps become up to four levels each.
    Otherwise the range is 2.5 times as wide as the middle 90 % of the values, at most that of the sensor. Bars, padding
    and the sun, far from all other values, do not count. If a picture's values drift towards an end of the range, the
    range follows by the smallest sufficient number of whole levels.
    """

    def __init__(self, samples: Sequence[np.ndarray], given: Scale = None) -> None:
        """given: values of black and white, which then stay fixed."""
        self.is_given, self._core, self._most = given is not None, 0.0, 0.0
        self._black, self.width = (0.0, 0.0) if given is None else (float(given[0]), float(given[1] - given[0]))
        if given is None:
            self._fit(samples)
        self.begin()

    def begin(self) -> None:
        """Reset the range for a new pass over the clip."""
        self.black = self._black

    @property
    def white(self) -> float:
        """The value that becomes 255."""
        return self.black + self.width

    def to_bytes(self, image: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return the next picture as uint8, and whether over 5 % of its values lie beyond an end of the range."""
        _, low, high, _ = _find_shares(image)
        if not self.is_given and high - low > self._core / 4:  # a blank picture does not move the range
            guard, unit = _GUARD * max(self.width - (high - low), 0.0), self.width / 255
            way = float(np.clip(self.black, *sorted((high + guard - self.width, low - guard)))) - self.black
            moved = self.black + math.copysign(math.ceil(abs(way) / unit - 1e-9), way) * unit
            self.black = min(max(moved, 0.0), self._most)
        black = round(self.black)
        gain = 255 / self.width
        levels = cv2.addWeighted(image, gain, image, 0.0, -black * gain, dtype=cv2.CV_8U)  # one pass, clipped to 0
        return levels, low < black or high > math.ceil(self.white)

    def _fit(self, samples: Sequence[np.ndarray]) -> None:
        shares = np.array([_find_shares(image) for image in samples])
        values, counts = np.unique(np.concatenate([_thin_out(image) for image in samples]), return_counts=True)
        frequent = values[counts > _FREQUENT * counts.sum()].astype(np.int64)
        step = int(np.gcd.reduce(np.diff(frequent))) if len(frequent) > 1 else 1
        whole = max(float(np.median(shares[:, 3] - shares[:, 0])), step)
        is_whole = whole <= 255 * step
        self._core = float(np.median(shares[:, 2] - shares[:, 1]))
        brightest = max(int(image.max()) for image in samples)
        top = next(2**bits - 1 for bits in _SENSOR_BITS if brightest < 2**bits)
        self.width = float(min(255 * step if is_whole else max(_WIDTH * self._core, 255), top))
        if is_whole and step == 1 and top > 255:  # a sensor with few counts: spread them over half of the levels
            self.width /= min(max(128 // whole, 1), _MOST_GAIN)
        self._most = top - self.width
        low, high = (shares[:, 0].min(), shares[:, 3].max()) if is_whole else (shares[:, 1].min(), shares[:, 2].max())
        if high - low > self.width:  # the values drift: begin with the first picture's range
            low, high = shares[0, 1:3]
        black = min(max((low + high - self.width) / 2, 0.0), self._most)
        self._black = black - (black - frequent[0]) % step if is_whole and len(frequent) > 1 and black else black

    def __str__(self) -> str:
        whence = "as given" if self.is_given else "taken from the clip; levels.black and levels.white set them"
        return f"16-bit pictures: values from {self.black:.0f} to {self.white:.0f} become black to white, {whence}"


def _thin_out(image: np.ndarray) -> np.ndarray:
    """Return a sample of a picture's values, sorted, without values that are not part of the scene."""
    values = np.sort(image[:: 1 + image.shape[0] // 64, :: 1 + image.shape[1] // 64], axis=None)
    while True:
        step = np.diff(values)
        if not step.any():
            return values
        at = int(step.argmax()) + 1
        # A side with a single constant value is not part of the scene, however large it is.
        rest, scene = sorted((values[:at], values[at:]), key=lambda part: (bool(np.ptp(part)), len(part)))
        low, high = scene[[round(share * (len(scene) - 1)) for share in _SHARES[1:3]]].astype(int)
        limit = (_APART if np.ptp(rest) else _APART_CONSTANT) * (high - low)
        if low == high or step[at - 1] <= limit or len(scene) < len(values) / 20:
            return values
        values = scene


def _find_shares(image: np.ndarray) -> np.ndarray:
    values = _thin_out(image)
    return values[[round(share * (len(values) - 1)) for share in _SHARES]].astype(float)


class Masks(OutputPart[Scene]):
    """Write masks/000001.png and so on, each whole or not at all. Masks with values over 255 have 16 bits, others 8."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "masks"

    def write(self, scene: Scene) -> None:
        """Write the mask of a frame. Raise OSError if the disk refuses."""
        self.add(scene.frame.number, scene.mask)

    def add(self, number: int, mask: np.ndarray) -> None:
        """Write the mask (H, W) of any frame, as `write` does."""
        self._folder.mkdir(exist_ok=True)
        kind = np.uint8 if mask.size == 0 or mask.max() <= 255 else np.uint16
        # Compression level 1: masks are nearly empty, and higher levels take more time for a few bytes.
        ok, png = cv2.imencode(".png", mask.astype(kind, copy=False), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not ok:
            raise OSError(f"mask of frame {number} could not be encoded")
        write_whole(self._folder / f"{number:06d}.png", png.tobytes())
