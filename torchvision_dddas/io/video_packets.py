"""Encode pictures as H.264 once, and put the packets into several files and streams. It needs PyAV (extra `video`)."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import PartFile, utf8_name

HZ = 90_000
"""Units of a packet's time stamp in a second."""

_KEY_S = 1.0  # time between two key pictures, at which files and receivers can begin


class VideoPacket(NamedTuple):
    """An encoded picture, with its headers if it is a key picture. pts: its time in 1/HZ s."""

    content: bytes
    pts: int
    is_key: bool


def check_encoder(option: str) -> None:
    """Raise InputError if PyAV is not installed. option: for the message."""
    try:
        import av  # noqa: F401
    except ImportError:
        raise InputError(f"{option} needs PyAV: pip install 'torchvision-dddas[video]'") from None


def usual_rate(rate_hz: float) -> Fraction:
    """Return the rate of a video, from 1 to 240 pictures a second, as a fraction that containers can hold."""
    return Fraction(min(max(rate_hz, 1.0), 240.0)).limit_denominator(1001)


def add_h264(container: Any, size_px: tuple[int, int], rate: Fraction, options: Mapping[str, str] | None = None) -> Any:
    """Add a stream of H.264 to a container of PyAV, and return it. size_px: (width, height), both even.

    options: options of x264 beside the usual ones, or in place of them.
    """
    # Look-ahead would hold tens of frames in memory. The preset takes 3.1 ms of processor time a frame at 768x576, and
    # `veryfast` takes 7.5 ms. With this preset, the file is 1.5 times as large.
    usual = {"preset": "ultrafast", "tune": "zerolatency", "crf": "22"}
    stream = container.add_stream("libx264", rate=rate, options={**usual, **(options or {})})
    stream.width, stream.height = size_px
    stream.pix_fmt = "yuv420p"
    stream.codec_context.thread_count = 2  # so memory does not depend on the number of cores
    return stream


def pad_to_even(picture: np.ndarray) -> np.ndarray:
    """Return a picture with an even number of rows and columns: repeat the last one of an odd number.

    H.264 stores colour for blocks of 2×2 pixels.
    """
    height, width = picture.shape[:2]
    if not (height % 2 or width % 2):
        return picture
    return cv2.copyMakeBorder(picture, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)


def frame_of(picture: np.ndarray) -> Any:
    """Return the frame of PyAV for a picture, (H, W, 3) uint8 BGR, with even H and W."""
    import av

    # OpenCV's conversion is as quick as FFmpeg's and needs no second copy of the picture in colour.
    planes = cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420).astype(np.uint8, copy=False)
    return av.VideoFrame.from_ndarray(planes, format="yuv420p")


class VideoEncoder:
    """Encodes pictures of one size at their own times. stream: the template of streams that take its packets."""

    def __init__(self, size_px: tuple[int, int], rate_hz: float, factor: int = 22) -> None:
        """size_px: (width, height), both even. rate_hz: usual pictures a second. factor: crf of x264."""
        import av

        self.size_px, self._av = size_px, av
        self._container: Any = av.open(_Nowhere(), "w", format="h264")
        options = {"crf": f"{factor}", "forced-idr": "1", "x264-params": "repeat-headers=1"}
        self.stream: Any = add_h264(self._container, size_px, usual_rate(rate_hz), options)
        self.stream.codec_context.time_base = Fraction(1, HZ)
        self._last, self._due = -1, 0

    def encode(self, picture: np.ndarray, time_s: float) -> list[VideoPacket]:
        """Return the packets of a picture (H, W, 3) BGR. Each time is moved behind the one before."""
        frame = frame_of(picture)
        frame.pts = self._last = max(round(time_s * HZ), self._last + 1)
        frame.time_base = Fraction(1, HZ)
        if frame.pts >= self._due:
            frame.pict_type, self._due = self._av.video.frame.PictureType.I, frame.pts + round(_KEY_S * HZ)
        packets = self.stream.encode(frame)
        return [VideoPacket(bytes(packet), packet.pts, packet.is_keyframe) for packet in packets]


class _Nowhere:
    """A file that discards its content. The container is needed for its encoder only."""

    def write(self, content: bytes) -> int:
        return len(content)


class VideoFile:
    """An MP4 file of packets, which takes its place when it is closed. Its time begins with its first packet."""

    def __init__(self, path: Path, encoder: VideoEncoder, is_short: bool = False) -> None:
        """is_short: put the index before the pictures, for which the file is written twice. Raise OSError."""
        import av

        self.path = path
        self._part = PartFile(path)
        options = {"movflags": "faststart"} if is_short else {}
        try:
            self._container: Any = av.open(utf8_name(self._part.path), "w", format="mp4", options=options)
            self._stream = self._container.add_stream_from_template(encoder.stream)
        except BaseException:
            self._part.discard()
            raise
        self.begin = self.end = -1
        self._last_for = round(HZ / float(encoder.stream.codec_context.framerate))

    def write(self, packet: VideoPacket) -> None:
        """Add a packet; the first is a key picture. Raise OSError if the disk refuses."""
        self.begin = packet.pts if self.begin < 0 else self.begin
        self.end = packet.pts
        made = _stamped(self._stream, packet, self.begin)
        made.duration = self._last_for  # without it players leave out the last picture
        self._container.mux(made)

    def close(self) -> None:
        """Finish the file, and move it to its place. Raise OSError if the disk refuses."""
        self._container.close()
        self._part.keep()

    def discard(self) -> None:
        """Remove the unfinished file. Never raise."""
        with suppress(Exception):  # a full disk refuses the last pictures again
            self._container.close()
        self._part.discard()


class TransportStream:
    """Puts packets and metadata in KLV into an MPEG transport stream. write: takes bytes from the muxer."""

    def __init__(self, encoder: VideoEncoder) -> None:
        import av

        self._written = bytearray()
        # A stated length lets receivers take a picture before the next one begins.
        options = {"flush_packets": "1", "max_interleave_delta": "1", "omit_video_pes_length": "0"}
        opened: Any = av.open(self, "w", format="mpegts", buffer_size=1 << 17, container_options=options)
        self._video = opened.add_stream_from_template(encoder.stream)
        self._data, self._container = opened.add_data_stream("klv"), opened

    def write(self, content: bytes) -> int:
        """Take bytes from the muxer."""
        self._written += content
        return len(content)

    def mux(self, packets: Sequence[VideoPacket], metadata: bytes, pts: int) -> bytes:
        """Return the stream's next bytes. metadata: a packet at pts, or no bytes."""
        made = [_stamped(self._data, VideoPacket(metadata, pts, True))] if metadata else []
        self._container.mux(made + [_stamped(self._video, packet) for packet in packets])
        return self._taken()

    def close(self) -> bytes:
        """End the stream, and return its last bytes."""
        self._container.close()
        return self._taken()

    def _taken(self) -> bytes:
        content, self._written = bytes(self._written), bytearray()
        return content


def _stamped(stream: Any, packet: VideoPacket, begin: int = 0) -> Any:
    """Return a packet as PyAV writes it into a stream. begin: the time that becomes 0, in units of 1/HZ s."""
    import av

    made = av.Packet(packet.content)
    made.stream, made.time_base, made.is_keyframe = stream, Fraction(1, HZ), packet.is_key
    made.pts = made.dts = packet.pts - begin
    return made
