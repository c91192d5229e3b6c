"""Where frames come from: video files, folders and globs of images, cameras, network streams."""

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import urlsplit

# FFmpeg reads this when OpenCV first opens a video; without it a damaged file fills the terminal with decoder messages.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2
import numpy as np

from torchvision_dddas.errors import InputError, LostInputError, without_secrets
from torchvision_dddas.io.atomic_files import utf8_name
from torchvision_dddas.io.images import IMAGE_SUFFIXES, images_of_folder, images_of_glob, quiet_opencv, read_image
from torchvision_dddas.types import Frame, Problem, Source, is_sampled

_WANTED = "a video file, a folder or glob of images, camera:0, rtsp://... or sim:SCENARIO"


def open_source(
    spec: str | Path, *, rate_hz: float | None = None, full_scale: int | None = None, single: bool = False
) -> Source:
    """Open a clip: a video file, a folder or glob of images, `camera:0`, `rtsp://...`.

    rate_hz: frames a second; None takes the video's own, and 10 for images. full_scale: see ImageSource.
    single: a file that is one image is a clip of one frame; else it is refused, since nothing can move in it.
    Raises InputError with one line when it cannot be read.
    """
    text = str(spec)
    if rate_hz is not None and not 0 < rate_hz <= 1000:
        raise InputError(f"the frame rate must be more than 0 and at most 1000 per second, got {rate_hz}")
    if full_scale is not None and not 1 <= full_scale <= 65535:
        raise InputError(f"the full scale must be between 1 and 65535, got {full_scale}")
    if not text:
        raise InputError(f"the input's name is empty; wanted {_WANTED}")
    if (target := stream_target(text)) is not None:
        return VideoSource(target, without_secrets(text), rate_hz)
    path = Path(text)
    try:
        path.stat()
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:  # a name too long, a folder that may not be entered, a name with a NUL
        raise InputError(f"{text[:200]} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if path.is_file() and path.suffix.lower() not in IMAGE_SUFFIXES:
        return VideoSource(text, text, rate_hz)
    if path.is_file() and not single:
        raise InputError(
            f"{path} is one image, not a clip; give its folder, or a glob in quotes such as 'frames/*.png'"
        )
    if path.is_file():
        files = [path]
    elif path.is_dir():
        files = images_of_folder(path)
    elif any(sign in text for sign in "*?["):
        files = images_of_glob(text)
    else:
        raise InputError(f"{path} does not exist; wanted {_WANTED}")
    return ImageSource(files, text, rate_hz or 10.0, full_scale)


class _Clip(ABC):
    """What recordings share. tolerant: a frame of another size or depth is left out, else it raises InputError."""

    exact = True
    tolerant = False
    count: int | None

    def __init__(self, name: str) -> None:
        self.name, self.last = name, 0
        self.problems: list[Problem] = []

    def __iter__(self) -> Iterator[Frame]:
        return self.every(1)

    @abstractmethod
    def every(self, interval: int) -> Iterator[Frame]:
        """Frames 1, 1 + interval, ...: the others are not turned into pictures."""

    def _note(self, number: int, what: str) -> None:
        self.problems.append(Problem(number, what))

    def _leave_out(self, number: int, what: str, must: str) -> None:
        if not self.tolerant:
            raise InputError(f"{what}; all frames of a clip must have one {must}")
        self._note(number, f"{what}: it was left out")


# --------------------------------------------------------------------------------------------------------------------
# Images.

_SENSOR_BITS = (8, 10, 12, 14, 16)
_SAMPLES = 9


class ImageSource(_Clip):
    """The files of a folder or glob in natural order (frame2 before frame10), one a frame.

    rate_hz: images carry no frame rate, so the caller gives one.
    full_scale: the 16-bit value that becomes white (255). One value serves the whole clip, so that brightness does not
    flicker. By default nine images spread over the clip are read, and it is the top of the smallest sensor (8, 10,
    12, 14 or 16 bits) that holds their brightest pixel. Brighter pixels elsewhere saturate, which is recorded once.
    The first image decides whether the clip is grey or colour; the others follow it.
    Raises InputError: the first image cannot be read, an image of another size or depth (when it is reached).
    """

    def __init__(self, files: Sequence[Path], name: str, rate_hz: float = 10.0, full_scale: int | None = None) -> None:
        super().__init__(name)
        if not files:
            raise InputError(f"{name} holds no images")
        self.files, self.count, self.rate_hz = list(files), len(files), rate_hz
        first = read_image(self.files[0])
        if first is None:
            raise InputError(f"the first image, {self.files[0]}, cannot be decoded; repair it or leave it out")
        if first.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{self.files[0]} holds {first.dtype} pixels; wanted 8 or 16 bits")
        self.size = (first.shape[1], first.shape[0])
        self._depth, self._grey = first.dtype, first.ndim == 2
        self.full_scale = (full_scale or self._sensor_top()) if self._depth == np.uint16 else 255

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
                self._note(number, f"frame {number} ({file.name}) could not be decoded and was left out")
                continue
            if (size := (image.shape[1], image.shape[0])) != self.size:
                what = f"{file} is {size[0]}x{size[1]} but {self.files[0].name} is {self.size[0]}x{self.size[1]}"
                self._leave_out(number, what, "size")
                continue
            if image.dtype != self._depth:
                what = f"{file} holds {image.dtype} pixels but {self.files[0].name} {self._depth}"
                self._leave_out(number, what, "depth")
                continue
            if self._depth == np.uint16:
                if not saturated and image.max() > self.full_scale:
                    saturated = True
                    what = f"frame {number} ({file.name}) holds {image.max()}; above {self.full_scale} all is white"
                    self._note(number, what)
                image = cv2.convertScaleAbs(image, alpha=255.0 / self.full_scale)
            if self._grey != (image.ndim == 2):
                image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if self._grey else cv2.COLOR_GRAY2BGR)
            yield Frame(number, (number - 1) / self.rate_hz, image)

    def _sensor_top(self) -> int:
        samples = np.unique(np.linspace(0, len(self.files) - 1, _SAMPLES).astype(int))
        images = (read_image(self.files[i]) for i in samples)
        brightest = max(int(image.max()) for image in images if image is not None)
        return next(2**bits - 1 for bits in _SENSOR_BITS if brightest < 2**bits)


# --------------------------------------------------------------------------------------------------------------------
# Videos through OpenCV.

# FFmpeg draws any text file as an old terminal would, which is never wanted.
_TEXT_AS_VIDEO = {b"ansi", b"xbin", b"bin "}
# These containers count their frames; others guess from the duration, often one off.
_EXACT_COUNT = {".mp4", ".m4v", ".mov", ".avi"}
# Reads that may fail in a row before the clip counts as ended, however many frames it announced.
_MOST_LOST, _MOST_LOST_LIVE = 1000, 10
STALL_S = 30.0
"""An address that sends nothing for so long counts as lost."""
# A read that fails after this share of the time was ended by it.
_STALLED = 0.9
# How far a time stamp may lie from its place on a constant frame rate, in frames.
_REGULAR = 0.25


class VideoSource(_Clip):
    """A video file, a camera's index or a stream's address. Frames are BGR, also those of grey videos.

    A file's rotation is applied, so size is that of the upright picture. rate_hz: the file's own, unless the caller
    gives one. Frames that cannot be decoded leave a gap in the numbers. A clip of constant rate is numbered by its time
    stamps, which stay true when a damaged stretch comes out short or out of order; other clips are numbered by
    counting. Time is the file's, a live stream's is the clock's.
    Raises InputError: cannot be opened, is no video, the first frame cannot be decoded, the size changes.
    """

    def __init__(self, target: str | int, name: str, rate_hz: float | None = None) -> None:
        super().__init__(name)
        self._target = target
        self._live = _is_live(target)
        capture = self._open()
        try:
            own_hz = announced_hz(capture)
            count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            is_counted = Path(urlsplit(str(target)).path if self._live else str(target)).suffix.lower() in _EXACT_COUNT
            decoded, first = capture.read()
        finally:
            capture.release()
        if not decoded:
            raise InputError(f"the first frame of {name} cannot be decoded; the file is damaged or its codec unknown")
        self.size = (first.shape[1], first.shape[0])
        self._own_hz, self._given_hz = own_hz or 10.0, rate_hz
        self.rate_hz = rate_hz or self._own_hz
        self.count = int(count) if not self._live and 0 < count < 1e8 else None
        self.exact = self.count is not None and is_counted
        self._announced = int(count) if self._live and is_counted and 0 < count < 1e8 else 0

    def every(self, interval: int) -> Iterator[Frame]:
        """Frames 1, 1 + interval, ...: the others are not turned into pictures."""
        self.problems.clear()
        capture = self._open()
        try:
            if not self._live:
                yield from self._read_file(capture, interval)
                return
            with quiet_opencv():
                yield from self._read_live(capture, interval)
        finally:
            capture.release()

    def _read_file(self, capture: cv2.VideoCapture, interval: int) -> Iterator[Frame]:
        number, lost, start_s, time_s, regular, damaged = 0, 0, 0.0, 0.0, True, False
        # As many reads in a row may fail as frames are still announced, and a few where none are.
        while lost < min(max((self.count or 0) - number, 0) + 4, _MOST_LOST):
            if not capture.grab():
                lost += 1
                continue
            damaged = damaged or lost > 0
            stamp_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            start_s = start_s if number else stamp_s
            stamp_s -= start_s
            place = round(stamp_s * self._own_hz)
            # Stamps off the constant rate, or out of step although every read succeeded, mean a varying rate.
            on_rate = abs(stamp_s * self._own_hz - place) < _REGULAR
            regular = regular and on_rate and (damaged or place == number)
            following = place + 1 if regular else number + lost + 1
            lost = 0
            if following <= number:
                self._note(number, f"after frame {number} a frame came out of order and was left out")
                continue
            self._note_lost(number + 1, following - 1)
            self.last = number = following
            if self._given_hz or (number > 1 and stamp_s <= time_s):  # some files carry no stamps
                stamp_s = max((number - 1) / self.rate_hz, time_s)
            time_s = stamp_s
            if not is_sampled(number, interval):
                continue
            decoded, image = capture.retrieve()
            if not decoded:
                self._note_lost(number, number)
            elif self._fits(image, number):
                yield Frame(number, time_s, image)
        if self.exact and self.count and self.count > number:
            # Of the frames announced, those whose data are in the file belong to the clip.
            self.last = max(number, min(self.count, self._stored()))
            self._note_lost(number + 1, self.last)
        # A count guessed from the duration means something only where the rate is constant.
        allowed = 0 if self.exact else max(2, number // 50) if regular else number
        if self.count and self.count - self.last > allowed:
            what = f"the clip ends after frame {self.last} but announces {self.count}: it is cut short or damaged"
            self._note(self.last + 1, what)

    def _read_live(self, capture: cv2.VideoCapture, interval: int) -> Iterator[Frame]:
        number, lost, read, silent_s, start_s = 0, 0, 0, 0.0, time.monotonic()
        while lost < _MOST_LOST_LIVE:
            number += 1
            is_wanted = is_sampled(number, interval)
            asked_s = time.monotonic()
            decoded, image = capture.read() if is_wanted else (capture.grab(), np.zeros((0, 0), np.uint8))
            # After it a decoder still gives the pictures that it holds.
            silent_s = max(silent_s, time.monotonic() - asked_s)
            if not decoded:
                lost += 1
                continue
            read += 1
            self._note_lost(number - lost, number - 1)
            lost, self.last = 0, number
            start_s = start_s if number > 1 else time.monotonic()
            if is_wanted and self._fits(image, number):
                yield Frame(number, time.monotonic() - start_s, image)
        if silent_s > _STALLED * STALL_S:
            raise LostInputError(f"{self.name} sent nothing for {silent_s:.0f} s: it ends after frame {self.last}")
        if read < self._announced:
            raise LostInputError(f"{self.name} ended after frame {self.last} of {self._announced}")

    def _note_lost(self, first: int, last: int) -> None:
        if first == last:
            self._note(first, f"frame {first} could not be decoded and was left out")
        elif first < last:
            self._note(first, f"frames {first} to {last} could not be decoded and were left out")

    def _stored(self) -> int:
        """How many frames a file holds the data of, whether or not they can be decoded."""
        capture = cv2.VideoCapture(utf8_name(str(self._target)), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
        try:
            count = 0
            while capture.grab():
                count += 1
        finally:
            capture.release()
        return count

    def _open(self) -> cv2.VideoCapture:
        return open_capture(self._target, self.name, (STALL_S, STALL_S) if self._live else None)

    def _fits(self, image: np.ndarray, number: int) -> bool:
        width, height = image.shape[1], image.shape[0]
        if (width, height) != self.size:
            what = f"frame {number} of {self.name} is {width}x{height} but the first is {self.size[0]}x{self.size[1]}"
            self._leave_out(number, what, "size")
        return (width, height) == self.size


def open_capture(target: str | int, name: str, limits_s: tuple[float, float] | None = None) -> cv2.VideoCapture:
    """A file, a camera's index or a stream's address through OpenCV.

    limits_s: after which opening a stream, and later reading from it, fails; None: after FFmpeg's own 30 s.
    Raises InputError: cannot be opened, is no video.
    """
    names = (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC)
    limits = [n for name, limit_s in zip(names, limits_s or (), strict=False) for n in (name, int(1000 * limit_s))]
    with quiet_opencv():
        if isinstance(target, int):
            capture = cv2.VideoCapture(target)  # a camera needs the system's own driver
        else:  # other back ends than FFmpeg take a numbered image or a text file for a video
            capture = cv2.VideoCapture(utf8_name(target), cv2.CAP_FFMPEG, limits)
    if not capture.isOpened():
        live = _is_live(target)
        what = f"camera {target}" if isinstance(target, int) else f"{name} as a {'stream' if live else 'video'}"
        raise InputError(f"cannot open {what}; " + ("is it there?" if live else "it is damaged or no video file"))
    if int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True) in _TEXT_AS_VIDEO:
        capture.release()
        raise InputError(f"{name} is a text file, not a video")
    return capture


def _is_live(target: str | int) -> bool:
    return isinstance(target, int) or "://" in target


def announced_hz(capture: cv2.VideoCapture) -> float | None:
    """The rate that a video or stream announces; None where nothing credible is."""
    return credible_hz(float(capture.get(cv2.CAP_PROP_FPS)))


def credible_hz(rate_hz: float) -> float | None:
    """An announced rate that can be true, else None."""
    return rate_hz if 0 < rate_hz <= 1000 else None


def stream_target(spec: str) -> str | int | None:
    """What OpenCV is to open for `camera:0` or an address; None for anything else. Raises InputError."""
    if spec.startswith("camera:"):
        index = spec.removeprefix("camera:")
        if not index.isdecimal() or len(index) > 4:
            raise InputError(f"'{spec}' names no camera; wanted camera:0, camera:1, ...")
        return int(index)
    return spec if "://" in spec else None
