"""MOTChallenge text: `frame,id,x,y,width,height[,score[,...]]`, by commas or blanks, rows in any order."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.matching import TrackTable

FARTHEST = 1e9
"""No place, size or mark is larger."""

_COLUMNS = ("frame", "id", "x", "y", "width", "height", "the seventh column")


class MotRows(NamedTuple):
    """The rows of a file. mark: (N,) its seventh column, 1 where there is none. line: (N,) of the file, from 1."""

    table: TrackTable
    mark: np.ndarray
    line: np.ndarray

    @property
    def named(self) -> bool:
        """Whether the rows have identities: -1 stands for none. A file without rows may be either."""
        return not len(self.line) or bool((self.table.identity != -1).any())


def read_rows(path: Path, what: str) -> MotRows:
    """Read a file; `what` says in errors what it was taken for.

    Raises InputError with file and line: unreadable, too few columns, not a finite number, a frame that is not whole
    or below 1, an identity that is not whole, a size that is not positive.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise InputError(f"{what} {path} cannot be read: {reason}") from None
    rows = [
        [*_row(_cells(line), f"{what} {path}, line {number}"), number]
        for number, line in enumerate(lines, 1)
        if line.strip()
    ]
    values = np.array(rows, float).reshape(-1, 8)
    table = TrackTable(values[:, 0].astype(np.int64), values[:, 1].astype(np.int64), values[:, 2:6])
    return MotRows(table, values[:, 6], values[:, 7].astype(np.int64))


def with_identities(rows: MotRows, path: Path) -> TrackTable:
    """The table, once each row has an identity of its own in its frame. Raises InputError with file and lines."""
    table = rows.table
    unnamed = np.flatnonzero(table.identity == -1)
    if len(unnamed):
        raise InputError(f"{path}, line {rows.line[unnamed[0]]}: identity -1 stands for none; other rows have one")
    order = np.lexsort([rows.line, table.identity, table.frame])
    frame, identity, line = table.frame[order], table.identity[order], rows.line[order]
    again = np.flatnonzero((frame[1:] == frame[:-1]) & (identity[1:] == identity[:-1]))
    if len(again):
        k = again[0]
        raise InputError(
            f"{path}, lines {line[k]} and {line[k + 1]}: identity {identity[k]} twice in frame {frame[k]}; "
            "an identity has one box a frame"
        )
    return table


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split(",")] if "," in line else line.split()


def _row(cells: list[str], where: str) -> list[float]:
    if len(cells) < 6:
        count = f"{len(cells)} column{'s' * (len(cells) != 1)}"
        raise InputError(f"{where}: {count}; wanted frame,id,x,y,w,h[,score]")
    values = []
    for cell, column in zip(cells, _COLUMNS, strict=False):
        try:
            value = float(cell) if "_" not in cell else math.nan  # 1_0 is a number to Python alone
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{where}: {column} is '{cell}'; wanted a finite number")
        if column in ("frame", "id") and (value != int(value) or abs(value) > 2**53):
            raise InputError(f"{where}: {column} is '{cell}'; wanted a whole number")
        if column not in ("frame", "id") and abs(value) > FARTHEST:
            raise InputError(f"{where}: {column} is '{cell}'; wanted {-FARTHEST:g} to {FARTHEST:g}")
        values.append(value)
    if values[0] < 1:
        raise InputError(f"{where}: frame is '{cells[0]}'; frames count from 1")
    if min(values[4:6]) <= 0:
        raise InputError(f"{where}: the box is {cells[4]}×{cells[5]} pixels; wanted more than 0")
    return [*values, 1.0][:7]
