"""Heights of a person in pictures and how far off the person stood, from a CSV of `distance_m,height_px`."""

import csv
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError

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
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            return _parse(file, str(path))
    except OSError as error:
        raise InputError(f"measurements {path} cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"measurements {path} is no CSV text: {error}") from None


def _parse(lines: Iterable[str], path: str) -> tuple[np.ndarray, np.ndarray]:
    reader = csv.reader(lines, skipinitialspace=True)
    header = [name.strip() for name in next(reader, [])]
    if missing := [name for name in COLUMNS if name not in header]:
        raise InputError(f"measurements {path} lacks {', '.join(missing)}; wanted {','.join(COLUMNS)}")
    places = [header.index(name) for name in COLUMNS]
    rows = []
    for row in reader:
        if any(cell.strip() for cell in row):
            cells = [row[place].strip() if place < len(row) else "" for place in places]
            rows.append([_number(c, n, path, reader.line_num) for c, n in zip(cells, COLUMNS, strict=True)])
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
