"""Sources of frames: video files, folders and globs of images, cameras, network streams."""

import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import accumulate
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np

from torchvision_dddas.errors import InputError, LostInputError, without_secrets
from torchvision_dddas.io.captures import (
    AvCapture,
    Capture,
    announced_hz,
    is_cut_to_8_bits,
    is_live,
    open_capture,
)
from torchvision_dddas.io.images import (
    IMAGE_SUFFIXES,
    Levels,
    Scale,
    images_of_folder,
    images_of_glob,
    quiet_opencv,
    read_image,
)
from torchvision_dddas.memory import SMALL_FILE, cost_of_pictures
from torchvision_dddas.types import Frame, Problem, Source, is_sampled

_WANTED = "a video file, a folder or glob of images, camera:0, rtsp://... or sim:SCENARIO"


def open_source(
    spec: str | Path, *, rate_hz: float | None = None, full_scale: int | Scale = None, single: bool = False
) -> Source:
    """Open a clip: a video file, a folder or glob of images, `camera:0`, `rtsp://...`.

    rate_hz: frames a second; None: the video's own rate, or 10 for images.
    full_scale: the value of 16-bit pictures that becomes white (255), or the values that become black and white. None:
    `images.Levels` takes them from the clip; the source's `levels` holds them.
    single: accept one image as a clip of one frame. By default it is refused, because nothing can move in it.
    Raise InputError with one line if the clip cannot be read.
    """
    text = str(spec)
    if rate_hz is not None and not 0 < rate_hz <= 1000:
        raise InputError(f"the frame rate must be more than 0 and at most 1000 per second, got {rate_hz}")
    scale = (0, full_scale) if isinstance(full_scale, int) else full_scale
    if scale is not None and not (len(scale) == 2 and 0 <= scale[0] < scale[1] <= 65535):
        raise InputError(f"the full scale must be black below white, both between 0 and 65535, got {full_scale}")
    if not text:
        raise InputError(f"the input's name is empty; give {_WANTED}")
    if (target := stream_target(text)) is not None:
        return VideoSource(target, without_secrets(text), rate_hz, scale)
    path = Path(text)
    try:
        path.stat()
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:  # such as a long name, a forbidden folder, a name with a NUL
        raise InputError(f"{text[:200]} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if path.is_file() and path.suffix.lower() not in IMAGE_SUFFIXES:
        return VideoSource(text, text, rate_hz, scale)
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
        raise InputError(f"{path} does not exist; give {_WANTED}")
    return ImageSource(files, text, rate_hz, scale)


# After this many consecutive pictures of another size, a tolerant reader adopts that size.
_LASTING = 10


class _Clip(ABC):
    """The common base of recordings.

    tolerant: leave out frames of another size or depth, and adopt a size that persists. If it is not set, such a frame
    raises InputError.

    levels: conversion of 16-bit pictures to 8 bits; None for other pictures.
    """

    levels: Levels | None = None
    exact = True
    tolerant = False
    count: int | None
    size: tuple[int, int]

    def __init__(self, name: str) -> None:
        self.name, self.last = name, 0
        self.problems: list[Problem] = []
        self.notes: list[str] = []
        self.concealed = 0  # frames read so far in which the decoder concealed errors
        self._odd = 0  # consecutive pictures of another size

    def __iter__(self) -> Iterator[Frame]:
        return self.every(1)

    @abstractmethod
    def every(self, interval: int) -> Iterator[Frame]:
        """Yield frames 1, 1 + interval, ...; do not decode the others into pictures."""

    def _note(self, number: int, what: str) -> None:
        self.problems.append(Problem(number, what))

    def _fits(self, image: np.ndarray, number: int, this: str, first: str) -> bool:
        """Return whether a picture has the clip's size. this, first: names of this picture and of the first."""
        (width, height), size = self.size, (image.shape[1], image.shape[0])
        self._odd = 0 if size == self.size else self._odd + 1
        if self.tolerant and self._odd >= _LASTING:
            self.size, self._odd = size, 0
        if self._odd:
            self._leave_out(number, f"{this} is {size[0]}x{size[1]} but {first} is {width}x{height}", "size")
        return not self._odd

    def _begin(self) -> None:
        self.problems.clear()
        self._saturated = False
        if self.levels is not None:
            self.levels.begin()

    def _to_bytes(self, image: np.ndarray, number: int) -> np.ndarray:
        """Return the picture in 8 bits; note once if much of it is beyond the range."""
        if self.levels is None:
            return image
        image, is_beyond = self.levels.to_bytes(image)
        if is_beyond and not self._saturated:
            self._saturated = True
            self._note(number, f"over 5 % of frame {number} lies beyond the range and is cut; {self.levels}")
        return image

    def _leave_out(self, number: int, what: str, must: str) -> None:
        if not self.tolerant:
            raise InputError(f"{what}; all frames of a clip must have one {must}")
        self._note(number, f"{what}: it was left out")


# --------------------------------------------------------------------------------------------------------------------
# Images.

_SAMPLES = 9


class ImageSource(_Clip):
    """The files of a folder or glob in natural order (frame2 before frame10), one a frame.

    rate_hz: images carry no frame rate, so the caller gives one; otherwise 10 is assumed (`assumes_rate`).
    scale: the values of 16-bit images that become black and white; by default nine images spread over the clip
    determine them. The first picture with many values beyond the range is recorded as a problem. The first image
    decides whether the clip is grey or colour; the others are converted. Raise InputError if the first image cannot be
    read, or, when it is reached, for an image of another size or depth.
    """

    def __init__(self, files: Sequence[Path], name: str, rate_hz: float | None = None, scale: Scale = None) -> None:
        super().__init__(name)
        if not files:
            raise InputError(f"{name} holds no images")
        self.files, self.count, self.rate_hz = list(files), len(files), rate_hz or 10.0
        self.assumes_rate = rate_hz is None
        # All pictures together are one input, so a few hundred photos do not count as a small input.
        sizes = accumulate(file.stat().st_size for file in files if file.is_file())
        size = next((size for size in sizes if size >= SMALL_FILE), None)
        self._read = partial(read_image, cost=cost_of_pictures(len(files)), size=size)
        first = self._read(self.files[0])
        if first is None:
            raise InputError(f"the first image, {self.files[0]}, cannot be decoded; repair it or leave it out")
        if first.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{self.files[0]} holds {first.dtype} pixels; wanted 8 or 16 bits")
        self.size = (first.shape[1], first.shape[0])
        self._depth, self._grey = first.dtype, first.ndim == 2
        if self._depth == np.uint16:
            samples = np.unique(np.linspace(0, len(files) - 1, _SAMPLES if scale is None else 1).astype(int))
            images = (first, *(self._read(self.files[i]) for i in samples[1:]))
            self.levels = Levels([i for i in images if i is not None and i.dtype == np.uint16], scale)

    def every(self, interval: int) -> Iterator[Frame]:
        """Yield frames 1, 1 + interval, ...; do not open the other files."""
        self._begin()
        for number, file in enumerate(self.files, start=1):
            self.last = number
            if not is_sampled(number, interval):
                continue
            image = self._read(file)
            if image is None:
                self._note(number, f"frame {number} ({file.name}) could not be decoded and was left out")
                continue
            if not self._fits(image, number, str(file), self.files[0].name):
                continue
            if image.dtype != self._depth:
                what = f"{file} holds {image.dtype} pixels but {self.files[0].name} {self._depth}"
                self._leave_out(number, what, "depth")
                continue
            image = self._to_bytes(image, number)
            if self._grey != (image.ndim == 2):
                image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if self._grey else cv2.COLOR_GRAY2BGR)
            yield Frame(number, (number - 1) / self.rate_hz, image)


# --------------------------------------------------------------------------------------------------------------------
# Videos.

# These containers store their number of frames; for others it is estimated from the duration, often off by one.
_EXACT_COUNT = {".mp4", ".m4v", ".mov", ".avi"}
# Number of consecutive failed reads after which a clip has ended, however many frames it announced.
_MOST_LOST, _MOST_LOST_LIVE = 1000, 10
STALL_S = 30.0
"""An address that sends nothing for this time counts as lost."""
# A failed read that took at least this share of the time limit was ended by the limit.
_STALLED = 0.9
# How far a time stamp may lie from its place on a constant frame rate, in frames.
_REGULAR = 0.25
# An announced rate is wrong if it differs from the rate of the time stamps by more than this share.
_OFF = 0.2
# Time stamps that run back by more than this start a new series, as in joined files.
_ANEW_S = 1.0


class _Stamps:
    """Numbers and times of the frames of a file.

    A clip of constant rate is numbered by its time stamps, which remain correct if a damaged stretch loses frames or
    returns them out of order; other clips are numbered by counting. regular: the rate has been constant so far.
    """

    def __init__(self, own_hz: float, given_hz: float | None) -> None:
        self.number, self.time_s, self.regular = 0, 0.0, True
        self._own_hz, self._given_hz, self._damaged, self._is_stamped = own_hz, given_hz, False, False
        self._start_s, self._before_s = math.nan, 0.0  # stamp of the first frame; latest time
        self._steps_ms = Counter[int]()  # steps between successive frames

    def add(self, stamp_s: float, lost: int, damaged: bool) -> int:
        """Number the next frame. Return how many frames are missing before it, or -1 if it came out of order.

        stamp_s: time stamp; NaN (none) counts as one step after the previous frame. lost: failed reads before the
        frame. damaged: whether its data are damaged.
        """
        self._damaged |= damaged or lost > 0
        # For a varying rate use the shortest step, so that the next stamp is not passed.
        steps_ms = () if self.regular else (step for step in self._steps_ms if step > 0)
        step_s = min(steps_ms, default=1000 / self._own_hz) / 1000
        expected_s = self._before_s + (lost + 1) * step_s if self.number else 0.0
        is_stamped = not math.isnan(stamp_s)
        if is_stamped and not stamp_s - self._start_s >= self._before_s - _ANEW_S:  # the first stamp, or a new series
            self._start_s = stamp_s - expected_s
        stamp_s = stamp_s - self._start_s if is_stamped else expected_s
        place = round(stamp_s * self._own_hz)
        # Stamps off the constant rate, or out of step although every read succeeded, indicate a varying rate.
        on_rate = abs(stamp_s * self._own_hz - place) < _REGULAR and place - self.number < _MOST_LOST
        self.regular = self.regular and on_rate and (self._damaged or place == self.number)
        missing = place - self.number if self.regular else lost
        if missing < 0:
            return -1
        is_step, self._is_stamped = is_stamped and self._is_stamped and not missing, is_stamped
        if is_step:
            self._steps_ms[round(1000 * (stamp_s - self._before_s))] += 1
        self.number += missing + 1
        self._before_s = max(stamp_s, self._before_s)
        if self._given_hz or (self.number > 1 and stamp_s <= self.time_s):  # some files carry no stamps
            stamp_s = max((self.number - 1) / (self._given_hz or self._own_hz), self.time_s)
        self.time_s = stamp_s
        return missing

    def describe(self) -> str:
        """Return a text on how the frame rate varies; "" for a constant rate, or if times are not from the file."""
        steps = [] if self._given_hz else sorted(self._steps_ms.elements())
        usual = steps[len(steps) // 2] if steps else 0
        odd = sum(abs(step - usual) > max(_REGULAR * usual, 2) for step in steps)
        if not usual or not odd:
            return ""
        return (
            f"the frame rate varies: pictures are {steps[0]} to {steps[-1]} ms apart, usually {usual} ms "
            f"(exceptions: {odd}); all times are from the file"
        )


class VideoSource(_Clip):
    """A video file, a camera's index or a stream's address. Frames are BGR, also for grey videos.

    A file's rotation is applied, so size is that of the upright picture. rate_hz: the file's own, unless the caller
    gives one. Frames that cannot be decoded leave a gap in the numbers. Times come from the file, or from the clock
    for a live stream.
    Raise InputError if it cannot be opened, is not a video, has no first frame to decode, or changes its size.
    """

    def __init__(self, target: str | int, name: str, rate_hz: float | None = None, scale: Scale = None) -> None:
        super().__init__(name)
        self._target = target
        self._live = is_live(target)
        capture = self._open()
        try:
            own_hz, count = announced_hz(capture), capture.get(cv2.CAP_PROP_FRAME_COUNT)
            is_counted = Path(urlsplit(str(target)).path if self._live else str(target)).suffix.lower() in _EXACT_COUNT
            decoded, first = capture.read()
            true_hz = None
            if isinstance(capture, AvCapture) and not self._live:
                true_hz = capture.measure_hz()
                if decoded and first.dtype == np.uint16:
                    self.levels = Levels([first, *capture.sample(_SAMPLES if scale is None else 1)], scale)
        finally:
            capture.release()
        if not decoded:
            raise InputError(f"the first frame of {name} cannot be decoded; the file is damaged or its codec unknown")
        self.size = (first.shape[1], first.shape[0])
        if true_hz and (own_hz is None or abs(true_hz / own_hz - 1) > _OFF):
            own_hz, count = true_hz, 0  # the count may be based on the announced rate
        self._own_hz, self._given_hz = own_hz or 10.0, rate_hz
        self.rate_hz, self.assumes_rate = rate_hz or self._own_hz, not (rate_hz or own_hz)
        self.count = int(count) if not self._live and 0 < count < 1e8 else None
        self.exact = self.count is not None and is_counted
        self._announced = int(count) if self._live and is_counted and 0 < count < 1e8 else 0

    def every(self, interval: int) -> Iterator[Frame]:
        """Yield frames 1, 1 + interval, ...; do not decode the others into pictures."""
        self._begin()
        self.notes.clear()
        capture = self._open()
        try:
            if not self._live:
                yield from self._read_file(capture, interval)
                return
            with quiet_opencv():
                yield from self._read_live(capture, interval)
        finally:
            capture.release()

    def _read_file(self, capture: Capture, interval: int) -> Iterator[Frame]:
        stamps, lost, self.concealed, first = _Stamps(self._own_hz, self._given_hz), 0, 0, 0
        # Consecutive reads may fail as often as frames are still announced, and a few times if none are.
        while lost < min(max((self.count or 0) - stamps.number, 0) + 4, _MOST_LOST):
            if not capture.grab():
                lost += 1
                continue
            concealed = getattr(capture, "concealed", False)
            missing, lost = stamps.add(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000, lost, concealed), 0
            self.last = number = stamps.number
            if missing < 0:
                self._note(number, f"after frame {number} a frame came out of order and was left out")
                continue
            self._note_lost(number - missing, number - 1)
            self.concealed += concealed
            if first and not concealed:
                self._note(first, f"the decoder concealed errors in {_span(first, number - 1)}")
            first = (first or number) if concealed else 0
            if not is_sampled(number, interval):
                continue
            decoded, image = capture.retrieve()
            if not decoded:
                self._note_lost(number, number)
            elif self._fits(image, number, f"frame {number} of {self.name}", "the first"):
                image = self._to_bytes(image, number)
                image = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
                yield Frame(number, stamps.time_s, image, damaged=getattr(capture, "damaged", False))
        number = self.last
        if 0 < first < number:  # a truncated clip conceals errors in its last frame only
            self._note(first, f"the decoder concealed errors in {_span(first, number)}")
        if words := stamps.describe():
            self.notes.append(words)
        if not isinstance(capture, AvCapture) and not self.exact:
            self.notes.append(
                "without PyAV a change of the pictures' size is not noticed: pip install 'torchvision-dddas[video]'"
            )
        if self.exact and self.count and self.count > number:
            # Announced frames belong to the clip if their data are in the file.
            self.last = max(number, min(self.count, getattr(capture, "stored", 0)))
            self._note_lost(number + 1, self.last)
        # A count estimated from the duration is meaningful only for a constant rate.
        allowed = 0 if self.exact else max(2, number // 50) if stamps.regular else number
        if self.count and self.count - self.last > allowed:
            what = f"the clip ends after frame {self.last} but announces {self.count}: it is cut short or damaged"
            self._note(self.last + 1, what)

    def _read_live(self, capture: Capture, interval: int) -> Iterator[Frame]:
        number, lost, read, silent_s, start_s = 0, 0, 0, 0.0, time.monotonic()
        while lost < _MOST_LOST_LIVE:
            number += 1
            is_wanted = is_sampled(number, interval)
            asked_s = time.monotonic()
            decoded, image = capture.read() if is_wanted else (capture.grab(), np.zeros((0, 0), np.uint8))
            # After a long silence the decoder still returns the pictures that it holds.
            silent_s = max(silent_s, time.monotonic() - asked_s)
            if not decoded:
                lost += 1
                continue
            read += 1
            self._note_lost(number - lost, number - 1)
            lost, self.last = 0, number
            start_s = start_s if number > 1 else time.monotonic()
            if is_wanted and self._fits(image, number, f"frame {number} of {self.name}", "the first"):
                yield Frame(number, time.monotonic() - start_s, image)
        if silent_s > _STALLED * STALL_S:
            raise LostInputError(f"{self.name} sent nothing for {silent_s:.0f} s: it ends after frame {self.last}")
        if read < self._announced:
            raise LostInputError(f"{self.name} ended after frame {self.last} of {self._announced}")

    def _note_lost(self, first: int, last: int) -> None:
        if first <= last:
            were = "was" if first == last else "were"
            self._note(first, f"{_span(first, last)} could not be decoded and {were} left out")

    def _open(self) -> Capture:
        capture = open_capture(self._target, self.name, (STALL_S, STALL_S) if self._live else None)
        if is_cut_to_8_bits(capture):
            self._note(1, "only the upper 8 bits of deep grey are read: pip install 'torchvision-dddas[video]'")
        return capture


def _span(first: int, last: int) -> str:
    return f"frame {first}" if first == last else f"frames {first} to {last}"


def frame_times(source: Source) -> dict[int, float]:
    """Return the time of each frame of a video file, s, from its stored data; empty if unknown."""
    if not isinstance(source, VideoSource) or source._live:
        return {}
    capture, stamps, times_s = source._open(), _Stamps(source._own_hz, source._given_hz), dict[int, float]()
    try:
        stored = capture.stamps_s() if isinstance(capture, AvCapture) else []
    finally:
        capture.release()
    # Sort by display order; packets without a stamp follow those stored before them.
    places_s = np.where(np.isnan(stored), np.fmax.accumulate(stored), stored)
    for stamp_s in np.array(stored)[np.argsort(places_s, kind="stable")].tolist():
        stamps.add(stamp_s, 0, False)
        times_s[stamps.number] = stamps.time_s
    return times_s


def names_file(spec: str) -> bool:
    """Return whether this name is that of a file, even if it begins with `camera:` or `sim:`."""
    try:
        return Path(spec).exists()
    except (OSError, ValueError):
        return False


def stream_target(spec: str) -> str | int | None:
    """Return the target to open for `camera:0` or an address, else None. Raise InputError for a wrong camera index."""
    if spec.startswith("camera:") and not names_file(spec):
        index = spec.removeprefix("camera:")
        if not index.isdecimal() or len(index) > 4:
            raise InputError(f"'{spec}' names no camera; give camera:0, camera:1, ...")
        return int(index)
    return spec if "://" in spec else None
