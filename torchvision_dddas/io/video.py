"""Video files, cameras and network streams through OpenCV."""

import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

# FFmpeg reads this when OpenCV first opens a video; without it a damaged file fills the terminal with decoder messages.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.images import quiet_opencv
from torchvision_dddas.types import Frame, Problem, is_sampled

# FFmpeg draws any text file as an old terminal would; nobody means that.
_TEXT_AS_VIDEO = {b"ansi", b"xbin", b"bin "}
_SECRETS = re.compile(r"(?<=://)[^/\s]*@")
# Pictures in a row that may fail to be decoded at the start: a stream is joined in the middle.
_MOST_UNDECODED = 100
# These containers count their frames; others guess from the duration, often one off.
_EXACT_COUNT = {".mp4", ".m4v", ".mov", ".avi"}
# Reads that may fail in a row before the clip counts as ended, however many frames it announced.
_MOST_LOST = 1000
_MOST_LOST_LIVE = 10
# How far a time stamp may lie from its place on a constant frame rate, in frames.
_REGULAR = 0.25


class VideoSource:
    """A video file, a camera's index or a stream's address. Frames are BGR, also those of grey videos.

    A file's rotation is applied, so size is that of the upright picture. rate_hz: the file's own, unless the caller
    gives one. Frames that cannot be decoded leave a gap in the numbers. A clip of constant rate is numbered by its time
    stamps, which stay true when a damaged stretch comes out short or out of order; other clips are numbered by
    counting. Time is the file's, a live stream's is the clock's.
    tolerant: a frame of another size is left out.
    Raises InputError: cannot be opened, is no video, the first frame cannot be decoded, the size changes.
    """

    def __init__(self, target: str | int, name: str, rate_hz: float | None = None, fallback_hz: float = 10.0) -> None:
        self.name = name
        self.last = 0
        self.problems: list[Problem] = []
        self.tolerant = False
        self._target = target
        self._live = isinstance(target, int) or "://" in target
        capture = self._open()
        try:
            own_rate = capture.get(cv2.CAP_PROP_FPS)
            count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            decoded, first = capture.read()
        finally:
            capture.release()
        if not decoded:
            raise InputError(f"the first frame of {name} cannot be decoded; the file is damaged or its codec unknown")
        self.size = (first.shape[1], first.shape[0])
        self._own_hz = own_rate if np.isfinite(own_rate) and 0 < own_rate <= 1000 else fallback_hz
        self._given_hz = rate_hz
        self.rate_hz = rate_hz or self._own_hz
        self.count: int | None = int(count) if not self._live and 0 < count < 1e8 else None
        self.exact = self.count is not None and Path(str(target)).suffix.lower() in _EXACT_COUNT

    def __iter__(self) -> Iterator[Frame]:
        return self.every(1)

    def every(self, interval: int) -> Iterator[Frame]:
        """Frames 1, 1 + interval, ...: the others are not turned into pictures."""
        self.problems.clear()
        capture = self._open()
        try:
            yield from self._read_live(capture, interval) if self._live else self._read_file(capture, interval)
        finally:
            capture.release()

    def _read_file(self, capture: cv2.VideoCapture, interval: int) -> Iterator[Frame]:
        number, lost, start_s, time_s, regular, damaged = 0, 0, 0.0, 0.0, True, False
        while lost < self._patience(number):
            if not capture.grab():
                lost += 1
                continue
            damaged = damaged or lost > 0
            stamp_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            start_s = start_s if number else stamp_s
            place = round((stamp_s - start_s) * self._own_hz)
            # Stamps off the constant rate, or out of step although every read succeeded, mean a varying rate.
            on_rate = abs((stamp_s - start_s) * self._own_hz - place) < _REGULAR
            regular = regular and on_rate and (damaged or place == number)
            following = place + 1 if regular else number + lost + 1
            lost = 0
            if following <= number:
                what = f"after frame {number} a frame came out of order and was left out"
                self.problems.append(Problem(number, what))
                continue
            if following > number + 1:
                self.problems.append(Problem(number + 1, _lost_words(number + 1, following - 1)))
            self.last = number = following
            stamp_s -= start_s
            if self._given_hz or (number > 1 and stamp_s <= time_s):  # some files carry no stamps
                stamp_s = max((number - 1) / self.rate_hz, time_s)
            time_s = stamp_s
            if not is_sampled(number, interval):
                continue
            decoded, image = capture.retrieve()
            if not decoded:
                self.problems.append(Problem(number, _lost_words(number, number)))
                continue
            if self._fits(image, number):
                yield Frame(number, time_s, image)
        # A count guessed from the duration means something only where the rate is constant.
        exact = self.exact
        if exact and self.count and self.count > number:
            # Of the frames announced, those whose data are in the file belong to the clip.
            self.last = max(number, min(self.count, self._stored()))
            if self.last > number:
                self.problems.append(Problem(number + 1, _lost_words(number + 1, self.last)))
        allowed = 0 if exact else max(2, number // 50) if regular else number
        if self.count and self.count - self.last > allowed:
            what = f"the clip ends after frame {self.last} but announces {self.count}: it is cut short or damaged"
            self.problems.append(Problem(self.last + 1, what))

    def _read_live(self, capture: cv2.VideoCapture, interval: int) -> Iterator[Frame]:
        number, lost, start_s = 0, 0, time.monotonic()
        while lost < _MOST_LOST_LIVE:
            wanted = number % interval == 0
            decoded, image = capture.read() if wanted else (capture.grab(), np.zeros((0, 0), np.uint8))
            number += 1
            if not decoded:
                lost += 1
                continue
            if lost:
                self.problems.append(Problem(number - lost, _lost_words(number - lost, number - 1)))
                lost = 0
            self.last = number
            start_s = start_s if number > 1 else time.monotonic()
            if not wanted:
                continue
            if self._fits(image, number):
                yield Frame(number, time.monotonic() - start_s, image)

    def _patience(self, number: int) -> int:
        """Failed reads in a row that end the clip: as many as it still owes, and a few where it does not say."""
        return min(max((self.count or 0) - number, 0) + 4, _MOST_LOST)

    def _stored(self) -> int:
        """How many frames a file holds the data of, whether or not they can be decoded."""
        capture = cv2.VideoCapture(str(self._target), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
        try:
            count = 0
            while capture.grab():
                count += 1
        finally:
            capture.release()
        return count

    def _open(self) -> cv2.VideoCapture:
        return open_capture(self._target, self.name)

    def _fits(self, image: np.ndarray, number: int) -> bool:
        if (size := (image.shape[1], image.shape[0])) == self.size:
            return True
        what = f"frame {number} of {self.name} is {size[0]}x{size[1]} but the first is {self.size[0]}x{self.size[1]}"
        if not self.tolerant:
            raise InputError(f"{what}; all frames of a clip must have one size")
        self.problems.append(Problem(number, f"{what}: it was left out"))
        return False


def open_capture(target: str | int, name: str, limits_s: tuple[float, float] | None = None) -> cv2.VideoCapture:
    """A file, a camera's index or a stream's address through OpenCV.

    limits_s: after which opening a stream, and later reading from it, fails; None: after FFmpeg's own 30 s.
    Raises InputError: cannot be opened, is no video.
    """
    names = (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC)
    given = [n for name, limit_s in zip(names, limits_s or (), strict=False) for n in (name, int(1000 * limit_s))]
    with quiet_opencv():
        # A camera needs the system's own driver; files and streams go to FFmpeg alone, because other back ends take
        # a numbered image or a text file for a video.
        capture = (
            cv2.VideoCapture(target) if isinstance(target, int) else cv2.VideoCapture(target, cv2.CAP_FFMPEG, given)
        )
    live = isinstance(target, int) or "://" in target
    if not capture.isOpened():
        kind = "stream" if live else "video"
        what = f"camera {target}" if isinstance(target, int) else f"{name} as a {kind}"
        raise InputError(f"cannot open {what}; " + ("is it there?" if live else "it is damaged or no video file"))
    if int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True) in _TEXT_AS_VIDEO:
        capture.release()
        raise InputError(f"{name} is a text file, not a video")
    return capture


def _lost_words(first: int, last: int) -> str:
    which = f"frame {first}" if first == last else f"frames {first} to {last}"
    return f"{which} could not be decoded and {'was' if first == last else 'were'} left out"


# --------------------------------------------------------------------------------------------------------------------
# Live streams, picture by picture: the camera or the sender may fall silent at any time.


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


def stream_target(spec: str) -> str | int | None:
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
