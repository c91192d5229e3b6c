"""Open videos and streams with PyAV if it is installed. Open cameras, and videos without PyAV, with OpenCV."""

import os
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, cast

# FFmpeg reads this variable when OpenCV first opens a video. Without it a damaged file floods the terminal.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import utf8_name
from torchvision_dddas.io.images import quiet_opencv
from torchvision_dddas.memory import VIDEO, check_memory

# FFmpeg draws any text file as an old terminal would. Such input is refused.
_TEXT_AS_VIDEO = {"ansi", "xbin", "bin ", "bintext"}
# A stream is the cover of a file if it is marked as an attached picture, a thumbnail or a still image, or if it holds a
# single picture in one of the codecs of pictures.
_COVER_MARKS, _COVER_CODECS = 1024 | 2048 | 1048576, {"mjpeg", "png", "bmp", "webp", "gif", "tiff"}
_TABLES = (".csv", ".txt", ".json", ".xml", ".parquet")  # the endings of tables of boxes
# The variable with FFmpeg's options for streams, `name;value|name;value`, and its default. Both are as in OpenCV.
_OPTIONS, _DEFAULT_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS", "rtsp_transport;tcp"

# Number of pictures after which a stream without key frames has replaced damaged content.
_HEALED = 250
# Number of pictures whose time stamps give a rate, and the smallest sufficient number of steps between time stamps.
_MEASURED, _LEAST_MEASURED = 64, 8


class Capture(Protocol):
    """The calls of cv2.VideoCapture that reading needs."""

    def grab(self) -> bool: ...  # noqa: D102
    def retrieve(self) -> tuple[bool, Any]: ...  # noqa: D102
    def read(self) -> tuple[bool, Any]: ...  # noqa: D102
    def get(self, propId: int, /) -> float: ...  # noqa: D102
    def release(self) -> None: ...  # noqa: D102


def open_capture(target: str | int, name: str, limits_s: tuple[float, float] | None = None) -> Capture:
    """Open a file, a camera by its index, or a stream by its address.

    limits_s: timeouts for opening a stream and for reading from it. Without PyAV an address is refused, because OpenCV
    (4.14) silently resizes pictures of another size to the size of the first picture (OpenCV issue 27116).
    Raise InputError if the target cannot be opened or is not a video.
    """
    if isinstance(target, str):
        try:
            return AvCapture(target, name, limits_s)
        except ImportError:
            if is_live(target):
                raise InputError(f"{name} needs PyAV: pip install 'torchvision-dddas[video]'") from None
    return open_by_opencv(target, name)


def open_by_opencv(target: str | int, name: str) -> cv2.VideoCapture:
    """Open a camera by its index, or a file without PyAV. Arguments and errors are those of `open_capture`."""
    with quiet_opencv():
        if isinstance(target, int):
            capture = cv2.VideoCapture(target)  # a camera needs the system's own driver
        else:  # back ends other than FFmpeg would accept a numbered image or a text file as a video
            capture = cv2.VideoCapture(utf8_name(target), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise InputError(_refusal(target, name))
    code = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True)
    if code.decode("latin-1") in _TEXT_AS_VIDEO:
        capture.release()
        raise InputError(f"{name} is a text file, not a video; {_as_boxes(name)}")
    _check_size(
        target, name, *(int(capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    )
    return capture


def is_cut_to_8_bits(capture: Capture) -> bool:
    """Return whether OpenCV (4.14) delivers grey pictures without their lower bits."""
    if isinstance(capture, AvCapture):
        return False
    tag = int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)).to_bytes(4, "little", signed=True)
    return b"Y1\x00" in (tag[:3], tag[:0:-1])  # FFmpeg's tag of deep grey, in either byte order


class AvCapture:
    """A file or stream, read by PyAV. Arguments and errors: as in `open_capture`. Pixels equal those of OpenCV.

    Pictures keep the size in which they were sent. If there are several video streams, the first that is not a cover is
    read. concealed: whether the last grabbed picture has errors that the decoder concealed, or damaged data. damaged:
    whether the picture may depend on a concealed picture: until the next key frame, or for _HEALED pictures.
    stored: number of pictures in the data read so far, whether or not they can be decoded. metadata: time stamps and
    contents of the newest KLV packets, which the reader takes out; None unless it is a live stream that announces KLV.
    Raise ImportError if PyAV is not installed.
    """

    def __init__(self, target: str, name: str, limits_s: tuple[float, float] | None = None) -> None:
        import av
        from av.video.reformatter import VideoReformatter

        self._limit_s = float("inf") if limits_s is None else limits_s[1]
        self._failures = (av.FFmpegError, OSError)
        try:
            where, open_any = target if is_live(target) else utf8_name(target), cast(Any, av.open)
            known = {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}
            self._container = open_any(where, options=_read_options(), timeout=limits_s, **known)
        except (*self._failures, ValueError):
            raise InputError(_refusal(target, name)) from None
        videos = [video for video in self._container.streams.video if video.codec_context is not None]
        films = [video for video in videos if not _is_cover(video)] or videos
        if not films or films[0].codec_context.name in _TEXT_AS_VIDEO:
            self._container.close()
            raise InputError(f"{name} is {f'a text file, not a video; {_as_boxes(name)}' if films else 'not a video'}")
        _check_size(target, name, films[0].width, films[0].height)
        self._video, self._reformatter = films[0], cast(Any, VideoReformatter())
        self._tick_s = float(self._video.time_base or 0)
        # The H.264 decoder reports concealed errors only if slices are not decoded in parallel. Decoding frames in
        # parallel adds a delay, which matters only for live input.
        if limits_s is None:
            self._video.thread_type, self._video.codec_context.thread_count = "FRAME", cv2.getNumberOfCPUs()
        elif self._video.codec_context.name == "h264":
            self._video.codec_context.thread_count = 1
        # Allocate and free a large block once. Without it, glibc maps new memory for each picture: 2 ms at 1080p.
        np.empty(min(4 * self._video.width * self._video.height, 2**25), np.uint8)
        form = self._video.format if limits_s is None else None
        self._is_deep = form is not None and form.name.startswith("gray") and form.bits_per_pixel > 8
        klv = [] if limits_s is None else [one for one in self._container.streams.data if one.name == "klv"]
        self.metadata = deque[tuple[float, bytes]](maxlen=256) if klv else None
        self._read_streams = [self._video, *klv]
        self._packets: Iterator[Any] = self._container.demux(*self._read_streams)
        self._waiting: list[Any] = []  # frames of the last packet
        self._spoiled: set[int | None] = set()  # time stamps of damaged packets
        self._frame: Any = None
        self.concealed = self.damaged = False
        self.stored, self._since = 0, _HEALED  # pictures since errors were concealed

    def grab(self) -> bool:
        """Wait for the next picture. Return False if none came or it cannot be decoded."""
        self._frame, until_s = None, time.monotonic() + self._limit_s
        while not self._waiting:
            if time.monotonic() > until_s:  # packets arrive, but no picture
                return False
            try:
                packet = next(self._packets)
            except StopIteration:
                return False
            except self._failures:
                self._packets = self._container.demux(*self._read_streams)  # a generator that raised has ended
                return False
            if packet.stream is not self._video:
                # A packet without a time stamp belongs to the picture before it.
                stamp_s = (
                    self.get(cv2.CAP_PROP_POS_MSEC) / 1000 if packet.pts is None else packet.pts * packet.time_base
                )
                if packet.size and self.metadata is not None:
                    self.metadata.append((float(stamp_s), bytes(packet)))
                continue
            self.stored += packet.size > 0
            if packet.is_corrupt:
                self._spoiled.add(packet.pts)
            try:
                self._waiting = packet.decode()
            except self._failures:  # after a damaged packet, a file lacks one picture and a stream continues
                self._since = 0
                if self._limit_s == float("inf"):
                    return False
        self._frame = self._waiting.pop(0)
        self.concealed = bool(self._frame.is_corrupt) or self._frame.pts in self._spoiled
        self._since = 0 if self.concealed else _HEALED if self._frame.key_frame else self._since + 1
        self.damaged = self._since < _HEALED
        self._spoiled.discard(self._frame.pts)
        return True

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        """Return the last grabbed picture, upright, BGR; False and None if it cannot be decoded.

        The picture is uint8 (H, W, 3), or uint16 (H, W) for a file with grey pictures of more than 8 bits.
        """
        if self._frame is None:
            return False, None
        with suppress(*self._failures, ValueError):
            if self._is_deep:
                deep: np.ndarray = self._frame.to_ndarray(format="gray16le")
                return True, np.ascontiguousarray(np.rot90(deep, round(self._frame.rotation / 90) % 4))
            frame = self._reformatter.reformat(self._frame, format="bgr24", interpolation="BICUBIC")
            plane, turns = frame.planes[0], round(self._frame.rotation / 90) % 4
            # frame.to_ndarray would copy; this array refers to the plane.
            rows = np.frombuffer(plane, np.uint8).reshape(frame.height, plane.line_size)
            image = rows[:, : 3 * frame.width].reshape(frame.height, frame.width, 3)
            return True, np.ascontiguousarray(np.rot90(image, turns))
        return False, None

    def read(self) -> tuple[bool, np.ndarray | None]:
        """Return whether there is a next picture, and the picture, as OpenCV's `read` does."""
        return self.retrieve() if self.grab() else (False, None)

    def get(self, propId: int, /) -> float:
        """Return, as OpenCV does, the announced rate, the frame count, or the last time stamp, ms (NaN if missing)."""
        video, frame = self._video, self._frame
        rate_hz = float(video.guessed_rate or video.average_rate or 0)
        if propId == cv2.CAP_PROP_FPS:
            return rate_hz
        if propId == cv2.CAP_PROP_FRAME_COUNT:
            return float(video.frames or int((self._container.duration or 0) / 1e6 * rate_hz + 0.5))
        stamp = None if frame is None else frame.dts if frame.pts is None else frame.pts
        return float("nan") if stamp is None else 1000 * self._tick_s * stamp

    def sample(self, count: int) -> list[np.ndarray]:
        """Return up to `count` - 1 pictures spread over a file. Afterwards the file cannot be read in order."""
        found = []
        for share in np.linspace(0, 1, count)[1:].tolist():
            with suppress(*self._failures):  # seek goes to the last key frame before the place
                self._container.seek(int(share * (self._container.duration or 0)))
            self._packets, self._waiting = self._container.demux(self._video), []
            decoded, image = self.read()
            found += [image] if decoded and image is not None else []
        return found

    def stamps_s(self, most: int | None = None) -> list[float]:
        """Return the time stamps of up to `most` next pictures, s, NaN if missing. Do not decode the pictures."""
        packets, stamps = islice(self._packets, most), list[int | None]()
        with suppress(*self._failures):
            stamps.extend(packet.dts if packet.pts is None else packet.pts for packet in packets if packet.size)
        return [float("nan") if stamp is None else self._tick_s * stamp for stamp in stamps]

    def measure_hz(self) -> float | None:
        """Return the usual rate of the next pictures by their time stamps, None if unknown. Do not decode pictures."""
        stamps_s = np.array(self.stamps_s(_MEASURED))
        steps_s = np.diff(np.unique(stamps_s[np.isfinite(stamps_s)]))
        if len(steps_s) < _LEAST_MEASURED:
            return None
        usual_s = np.median(steps_s)  # average the steps near it: stamps may be rounded to milliseconds
        step_s = float(steps_s[abs(steps_s - usual_s) <= 0.25 * usual_s].mean())
        return 1 / step_s if 0.001 <= step_s <= 100 else None

    def release(self) -> None:
        """Close the file or the connection."""
        self._container.close()


def is_live(target: str | int) -> bool:
    """Return whether a target is a camera's index or an address."""
    return isinstance(target, int) or "://" in target


def announced_hz(capture: Capture) -> float | None:
    """Return the rate that a video or stream announces; None if it is not credible."""
    rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
    return rate_hz if 0 < rate_hz <= 1000 else None


def _check_size(target: str | int, name: str, width: int, height: int) -> None:
    is_file = isinstance(target, str) and not is_live(target) and Path(target).is_file()  # not frame%d.png
    size = Path(str(target)).stat().st_size if is_file else None
    check_memory(VIDEO * width * height, f"{name} has frames of {width}x{height} pixels", size)


def _is_cover(video: Any) -> bool:
    marks = getattr(video, "disposition", 0)
    is_marked = int(getattr(marks, "value", marks)) & _COVER_MARKS  # PyAV 16 replaced the flag by a number
    return bool(is_marked) or (video.codec_context.name in _COVER_CODECS and video.frames <= 1)


def _refusal(target: str | int, name: str) -> str:
    live = is_live(target)
    what = f"camera {target}" if isinstance(target, int) else f"{name} as a {'stream' if live else 'video'}"
    if not live and Path(str(target)).suffix.lower() in _TABLES:
        return f"cannot open {what}; {_as_boxes(name)}"
    return f"cannot open {what}; " + ("is it there?" if live else "it is damaged or not a video file")


def _as_boxes(name: str) -> str:
    return f"give boxes beside their clip: CLIP --detections {name}"


def _read_options() -> dict[str, str]:
    pairs = (text.split(";", 1) for text in os.environ.get(_OPTIONS, _DEFAULT_OPTIONS).split("|"))
    return {pair[0]: pair[1] for pair in pairs if len(pair) == 2}
