"""The detections as tables: MOTChallenge text for other tools, and CSV with named columns and the rest."""

import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TextIO

import numpy as np

from torchvision_dddas.io.atomic_files import remove, temporary
from torchvision_dddas.types import Scene

COLUMNS = (
    *("frame", "target", "x_px", "y_px", "width_px", "height_px", "score", "kind"),
    *("area_px", "heading_deg", "speed_px_per_frame"),
)


def mot_lines(scene: Scene) -> str:
    """`frame,-1,x,y,width,height,score,-1,-1,-1`, a line a target: frames from 1, pixels from 0, -1 for no identity."""
    return mot_rows(scene.frame.number, scene.detections.box_px, scene.detections.score)


def mot_rows(number: int, box_px: np.ndarray, score: np.ndarray) -> str:
    """The same for the boxes of any frame."""
    return "".join(
        f"{number},-1,{x:.2f},{y:.2f},{w:.2f},{h:.2f},{score:.4f},-1,-1,-1\n"
        for (x, y, w, h), score in zip(box_px, score, strict=True)
    )


def csv_lines(scene: Scene) -> str:
    """One line a target, in the order of COLUMNS; a cell is empty where the value is unknown.

    heading_deg is clockwise from the picture's upward direction, over the ground; speed is relative to the background.
    """
    d = scene.detections
    lines = []
    for i in range(len(d)):
        box = ",".join(_cell(v, 2) for v in d.box_px[i])
        heading = _cell(compass_deg(float(d.heading_rad[i])), 1)
        rest = f"{_cell(d.score[i], 4)},{d.kind},{_cell(d.area_px[i], 0)},{heading},{_cell(d.speed_px[i], 3)}"
        lines.append(f"{scene.frame.number},{i + 1},{box},{rest}\n")
    return "".join(lines)


def compass_deg(heading_rad: float) -> float:
    """Degrees clockwise from image up, in tenths below 360, of a heading in image axes (0 right, pi/2 down)."""
    return round(math.degrees(heading_rad) + 90, 1) % 360


def _cell(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


class Tables:
    """detections.txt and detections.csv, written as the clip goes by."""

    def __init__(self, folder: Path) -> None:
        self._files = TextFiles({folder / "detections.txt": "", folder / "detections.csv": ",".join(COLUMNS) + "\n"})

    def write(self, scene: Scene) -> None:
        """Add the targets of a frame."""
        self._files.write(mot_lines(scene), csv_lines(scene))

    def close(self, complete: bool) -> None:
        """Put the tables in their places. Raises OSError if the last lines cannot be written."""
        self._files.close()

    def discard(self) -> None:
        """Remove what was begun."""
        self._files.discard()


class TextFiles:
    """Text files that grow together and appear whole at the end. content: path -> the line that it begins with."""

    def __init__(self, content: Mapping[Path, str]) -> None:
        self._content = dict(content)
        self._files: list[TextIO] = []

    def write(self, *texts: str) -> None:
        """Add to each file, in the order of the paths."""
        for file, text in zip(self._open(), texts, strict=True):
            file.write(text)

    def close(self) -> None:
        """Put the files in their places, also those to which nothing was added. Raises OSError if they cannot be."""
        for file in self._open():
            file.close()
        for path in self._content:
            temporary(path).replace(path)

    def discard(self) -> None:
        """Remove what was begun."""
        for file in self._files:
            with suppress(OSError):  # a full disk refuses the last lines again
                file.close()
        for path in self._content:
            remove(temporary(path))

    def _open(self) -> list[TextIO]:
        if not self._files:
            for path, first in self._content.items():
                self._files.append(temporary(path).open("w", encoding="utf-8", newline=""))
                self._files[-1].write(first)
        return self._files
