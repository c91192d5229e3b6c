"""Tiny clips whose frames say their own number, made by the tests that read them."""

import struct
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest


def picture(number: int, width: int = 64, height: int = 48) -> np.ndarray:
    """(H, W, 3) uint8; the top left block is as bright as six times the number."""
    image = np.full((height, width, 3), 90, np.uint8)
    image[:, (2 * number) % width :][:, :6] = (200, 160, 120)
    image[:16, :16] = min(6 * number, 255)
    return image


def number_of(image: np.ndarray) -> int:
    return round(float(image[2:12, 2:12].mean()) / 6)


def write_video(
    path: Path, codec: str, frames: int = 30, size: tuple[int, int] = (64, 48), rate_hz: float = 10
) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), rate_hz, size)
    assert writer.isOpened()
    for number in range(1, frames + 1):
        writer.write(picture(number, *size))
    writer.release()
    return path


def textured(number: int, width: int, height: int) -> np.ndarray:
    """(H, W, 3) uint8, a texture that moves: each picture takes some kilobytes."""
    ground = np.random.default_rng(0).integers(0, 255, (height + 200, width + 200, 3)).astype(np.uint8)
    return cv2.GaussianBlur(ground, (0, 0), 1.5)[number : number + height, 2 * number : 2 * number + width].copy()


def write_by_av(
    path: Path, codec: str, stamps_ms: list[int], size: tuple[int, int] = (64, 48), shot=picture, **options: str
) -> Path:
    """A clip with time stamps of its own; needs PyAV, which writes what OpenCV cannot."""
    av = pytest.importorskip("av")
    tick = Fraction(1, 1000)
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=10, options=options)
        stream.width, stream.height = size
        stream.pix_fmt = {"mjpeg": "yuvj420p", "ffv1": "bgr0"}.get(codec, "yuv420p")
        stream.time_base = stream.codec_context.time_base = tick
        for number, stamp in enumerate(stamps_ms, start=1):
            frame = av.VideoFrame.from_ndarray(shot(number, *size), format="bgr24")
            frame.pts, frame.time_base = stamp, tick
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return path


def write_images(folder: Path, numbers: range = range(1, 6), suffix: str = ".png") -> Path:
    folder.mkdir(exist_ok=True)
    for number in numbers:
        assert cv2.imwrite(str(folder / f"frame{number}{suffix}"), picture(number))
    return folder


def spoil_avi_frame(path: Path, number: int) -> None:
    """Overwrite the data of one frame of a Motion-JPEG AVI with zeros."""
    data = bytearray(path.read_bytes())
    place = data.index(b"movi")
    for _ in range(number):
        place = data.index(b"00dc", place + 1)
    length = struct.unpack("<I", data[place + 4 : place + 8])[0]
    data[place + 8 : place + 8 + length] = bytes(length)
    path.write_bytes(data)


def mark_rotated(path: Path) -> None:
    """Write a quarter turn into an MP4's track header."""
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 44
    data[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
