"""The clip with its targets drawn in: tint and outline, box, heading, and a caption that says when not to trust it."""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Generic, TypeVar

import cv2
import numpy as np

from torchvision_dddas.io.atomic_files import remove, temporary
from torchvision_dddas.io.overlay.drawing import colour_picture, line_width
from torchvision_dddas.io.video_encoder import Beside, Writer
from torchvision_dddas.types import Scene

TARGET = (40, 190, 255)  # BGR
WARNING = (60, 60, 255)
TEXT = (255, 255, 255)

Item = TypeVar("Item")


def drawn(scene: Scene) -> np.ndarray:
    """The frame with everything found in it, (H, W, 3) uint8 BGR."""
    picture = colour_picture(scene.frame.image)
    thick = line_width(picture)
    foreground = (scene.mask > 0).astype(np.uint8)
    if foreground.any():
        where = foreground > 0
        picture[where] = (0.7 * picture[where] + 0.3 * np.array(TARGET)).astype(np.uint8)
        outlines = cv2.findContours(foreground, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(picture, outlines, -1, TARGET, 1)
    found = scene.detections
    for box, heading, speed in zip(found.box_px, found.heading_rad, found.speed_px, strict=True):
        x, y, w, h = (round(float(v)) for v in box)
        cv2.rectangle(picture, (x, y), (x + w - 1, y + h - 1), TARGET, thick)
        if not math.isnan(heading):
            length = 14 * thick + 4 * min(float(np.nan_to_num(speed)), 12.0)
            middle = np.array([x + w / 2, y + h / 2])
            tip = middle + length * np.array([math.cos(heading), math.sin(heading)])
            cv2.arrowedLine(picture, _pixel(middle), _pixel(tip), TEXT, thick, cv2.LINE_AA, tipLength=0.35)
    lines = [(f"frame {scene.frame.number}  interval {scene.interval_frames}  targets {len(found)}", TEXT)]
    if not scene.reliable:
        lines.append((f"registration unreliable: {scene.cause}", WARNING))
    caption(picture, lines)
    return picture


def _pixel(point: np.ndarray) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))


def caption(picture: np.ndarray, lines: Sequence[tuple[str, tuple[int, int, int]]]) -> None:
    """Write lines, each with its BGR colour, along the lower edge, made to fit the width."""
    height, width = picture.shape[:2]
    scale, row, thick = height / 1000, max(12, round(height / 28)), line_width(picture)
    top = max(height - row * len(lines) - row // 3, 0)
    picture[top:] = picture[top:] // 3
    for i, (line, colour) in enumerate(lines):
        plain = line.replace("×", "x").replace("−", "-").encode("ascii", "replace").decode()  # OpenCV's font is ASCII
        size = max(scale, 0.35)
        while len(plain) > 8 and cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, size, thick)[0][0] > width - 8:
            plain = plain.removesuffix("...")[:-1] + "..." if len(plain) > 12 else plain[:-1]
        cv2.putText(picture, plain, (4, top + row * (i + 1) - row // 5), 0, size, colour, thick, cv2.LINE_AA)


class Overlay(Generic[Item]):
    """overlay.mp4: H.264, which browsers play, where PyAV is installed (extra `video`); else OpenCV's mp4v."""

    def __init__(
        self, folder: Path, rate_hz: float, draw: Callable[[Item], np.ndarray], name: str = "overlay.mp4"
    ) -> None:
        """draw: makes the picture of a scene or followed frame, a new one each time, (H, W, 3) uint8 BGR."""
        self._path = folder / name
        self._part = temporary(self._path)
        self._rate = Fraction(min(max(rate_hz, 1.0), 240.0)).limit_denominator(1001)
        self._writer: Writer | None = None
        self._draw = draw

    def write(self, item: Item) -> None:
        """Draw a frame and add it. Raises OSError if the disk refuses."""
        picture = self._draw(item)
        height, width = picture.shape[:2]
        # Colour is stored for blocks of 2×2 pixels: repeat the last row and column of odd sizes.
        if height % 2 or width % 2:
            picture = cv2.copyMakeBorder(picture, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        if self._writer is None:
            self._writer = Beside(open_writer(self._part, self._rate, (picture.shape[1], picture.shape[0])))
        self._writer.write(picture)

    def close(self, complete: bool) -> None:
        """Finish the film and put it in its place; a clip without frames has none."""
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        writer.close()
        # OpenCV's writer stays silent on a full disk: only a film that can be opened again is whole.
        if not cv2.VideoCapture(str(self._part)).isOpened():
            raise OSError(f"{self._path.name} could not be finished")
        self._part.replace(self._path)

    def discard(self) -> None:
        """Remove what was begun."""
        if self._writer is not None:
            with suppress(OSError):  # a full disk refuses the last frames again
                self._writer.close()
            self._writer = None
        remove(self._part)


def open_writer(path: Path, rate: Fraction, size: tuple[int, int]) -> Writer:
    """The best writer at hand for a film of (width, height). Raises OSError if the file cannot be begun."""
    try:
        import av  # noqa: F401
    except ImportError:
        return _OpenCv(path, rate, size)
    return _H264(path, rate, size)


class _H264:
    def __init__(self, path: Path, rate: Fraction, size: tuple[int, int]) -> None:
        import av

        self._av = av
        self._container = av.open(str(path), "w", options={"movflags": "faststart"})
        self._stream = self._container.add_stream("libx264", rate=rate)
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        self._stream.codec_context.thread_count = 2  # memory that does not depend on the machine's cores
        # No look-ahead: it would hold tens of frames in memory. The preset: 3.1 ms of processor time a frame at 768x576
        # instead of `veryfast`'s 7.5, for a file 1.5 times the size.
        self._stream.options = {"preset": "ultrafast", "tune": "zerolatency", "crf": "22"}

    def write(self, picture: np.ndarray) -> None:
        # OpenCV's conversion is as quick as FFmpeg's and needs no second copy of the picture in colour.
        planes = cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420).astype(np.uint8, copy=False)
        frame = self._av.VideoFrame.from_ndarray(planes, format="yuv420p")
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        try:
            self._container.mux(self._stream.encode(None))
        finally:
            self._container.close()


class _OpenCv:
    def __init__(self, path: Path, rate: Fraction, size: tuple[int, int]) -> None:
        self._writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), float(rate), size)
        if not self._writer.isOpened():
            raise OSError(
                "OpenCV cannot write mp4v video here; install the extra `video`, or leave overlay out of --save"
            )

    def write(self, picture: np.ndarray) -> None:
        self._writer.write(picture)

    def close(self) -> None:
        self._writer.release()
