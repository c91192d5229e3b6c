"""Small data sets on disk, in the layouts that the adapters read."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.evaluation.datasets import kinds
from torchvision_dddas.evaluation.datasets.record import Clip, Dataset, Source

SIZE = (32, 24)
"""Of pictures and masks, px."""


def read(kind: str, folder: Path, clips: Iterable[str] = ("*",), **options: Any) -> Dataset:
    """The data set that a study's file would name so."""
    return kinds.read(Source(kind, folder, tuple(clips), options), Path())


def clip(kind: str, folder: Path, **options: Any) -> Clip:
    """The one clip of a data set of which nothing is missing."""
    found = read(kind, folder, **options)
    assert found.missing == ()
    (only,) = found.clips
    return only


def complaint(kind: str, folder: Path, **options: Any) -> str:
    """The one line that a data set without a clip tells."""
    found = read(kind, folder, **options)
    assert found.clips == ()
    (line,) = found.missing
    assert "\n" not in line
    return line


def pictures(folder: Path, names: Iterable[str], size: tuple[int, int] = SIZE) -> None:
    """Pictures of these names, each with its own brightness."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        depth = () if name.endswith(".pgm") else (3,)
        _write(folder / name, np.full((size[1], size[0], *depth), 10 + number % 200, np.uint8))


def mask(
    path: Path, regions: Mapping[tuple[int, int, int, int], int], size: tuple[int, int] = SIZE, ground: int = 0
) -> None:
    """A mask with boxes (x, y, width, height) of values; ground: the value of all else."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.full((size[1], size[0]), ground, np.uint8)
    for (x, y, w, h), value in regions.items():
        values[y : y + h, x : x + w] = value
    _write(path, values)


def colours(path: Path, regions: Mapping[tuple[int, int, int, int], int], ground: int) -> None:
    """The same in colours, each given as red, green and blue in one number."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.full((SIZE[1], SIZE[0]), ground, np.int64)
    for (x, y, w, h), value in regions.items():
        values[y : y + h, x : x + w] = value
    _write(path, np.stack([values & 255, values >> 8 & 255, values >> 16 & 255], axis=-1).astype(np.uint8))


def text(path: Path, content: str) -> Path:
    """A file of text."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content, encoding="utf-8")
    return path


def video(path: Path, frames: int, size: tuple[int, int] = SIZE) -> None:
    """A video, 10 frames a second."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, size)
    for number in range(frames):
        writer.write(np.full((size[1], size[0], 3), 10 + number, np.uint8))
    writer.release()


def _write(path: Path, image: np.ndarray) -> None:
    ok, content = cv2.imencode(path.suffix, image)
    assert ok
    path.write_bytes(content.tobytes())
