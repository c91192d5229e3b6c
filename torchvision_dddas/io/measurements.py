"""Heights of a person in pictures and how far off the person stood, from a CSV of `distance_m,height_px`."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.csv_text import Line, opened

COLUMNS = ("distance_m", "height_px")


def has_measurements(path: str | Path) -> bool:
    """Whether the first line of a file names COLUMNS. A file that cannot be read does not."""
    try:
        with Path(path).open(encoding="utf-8-sig") as file:
            return set(COLUMNS) <= {name.strip() for name in file.readline().split(",")}
    except (OSError, UnicodeDecodeError):
        return False


def read_measurements(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """(N,) distances in metres and (N,) heights in pixels; further columns are ignored, blank lines skipped.

    Raises InputError with file and line: unreadable, a column missing, no rows, not a number above 0.
    """
    with opened(path, "measurements") as (header, lines):
        return _parse(header, lines, str(path))


def _parse(header: list[str], lines: Iterator[Line], path: str) -> tuple[np.ndarray, np.ndarray]:
    if missing := [name for name in COLUMNS if name not in header]:
        raise InputError(f"measurements {path} lacks {', '.join(missing)}; wanted {','.join(COLUMNS)}")
    places = [header.index(name) for name in COLUMNS]
    rows = []
    for number, row in lines:
        cells = [row[place] if place < len(row) else "" for place in places]
        rows.append([_number(c, n, path, number) for c, n in zip(cells, COLUMNS, strict=True)])
    if not rows:
        raise InputError(f"measurements {path} has a header but no rows")
    distance, height = np.array(rows, float).T
    return distance, height


def _number(text: str, name: str, path: str, line: int) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"measurements {path}, line {line}: {name} is '{text}'; wanted a number above 0")
    return value
