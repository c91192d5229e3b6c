"""Annotations as text, a row a box: columns of numbers, one of which may be a word."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.metrics.mot_text import FARTHEST

LAST = 1_000_000
"""No frame has a larger number: nine hours at 30 Hz."""

_WHOLE = ("frame", "identity")


class Rows(NamedTuple):
    """The rows of a file. values: (N, C), NaN in the column of words. word: (N,) str. line: (N,), from 1."""

    values: np.ndarray
    word: np.ndarray
    line: np.ndarray


def text_of(path: Path) -> str:
    """A file's text. Raises InputError where it cannot be read or is none."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise InputError(f"{path} cannot be read: {reason}") from None


def read_rows(path: Path, columns: Sequence[str], word: str = "", first: int = 1) -> Rows:
    """Read a table by commas or blanks; columns after the named ones are left.

    columns: what each is; "frame" and "identity" are whole, frames not below `first`. word: the one that holds a word,
    of which quotes are taken off. Raises InputError with file and line: too few columns, no finite number.
    """
    lines = [(n, text) for n, text in enumerate(text_of(path).splitlines(), 1) if text.strip()]
    rows = [[cell.strip() for cell in text.split(",")] if "," in text else text.split() for _, text in lines]
    line = np.array([n for n, _ in lines], np.int64)
    for n, cells in zip(line, rows, strict=True):
        if len(cells) < len(columns):
            count = f"{len(cells)} column{'s' * (len(cells) != 1)}"
            raise InputError(f"{path}, line {n}: {count}; wanted {','.join(columns)}")
    values = np.full((len(rows), len(columns)), np.nan)
    words = np.full(len(rows), "", object)
    for k, name in enumerate(columns):
        cells = [row[k] for row in rows]
        if name == word:
            words[:] = [cell.strip("\"'") for cell in cells]
            continue
        values[:, k] = column = _numbers(cells)
        low, high = (first, LAST) if name == "frame" else (-FARTHEST, FARTHEST)
        bad = ~((column >= low) & (column <= high))
        whole = name in _WHOLE
        if whole:
            bad |= ~bad & (column != np.floor(column))
        if bad.any():
            i = int(bad.argmax())
            number = "a whole number" if whole else "a number"
            raise InputError(f"{path}, line {line[i]}: {name} is '{cells[i]}'; wanted {number}, {low:g} to {high:g}")
    return Rows(values, words, line)


def _numbers(cells: Sequence[str]) -> np.ndarray:
    """(N,), NaN where a cell is no number."""
    try:
        if not any("_" in cell for cell in cells):  # 1_0 is a number to Python alone
            return np.array(cells, float)
    except ValueError:
        pass
    return np.array([_number(cell) for cell in cells])


def _number(cell: str) -> float:
    try:
        return float(cell) if "_" not in cell else np.nan
    except ValueError:
        return np.nan
