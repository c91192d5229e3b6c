"""A table's own words: its column names and cells as they stand, to be written again with more beside them."""

from collections.abc import Sequence
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.csv_text import opened

MOT = ("frame", "identity", "x_px", "y_px", "width_px", "height_px", "score")
"""What the columns of MOTChallenge text are, which has no first line that names them."""


def header_of(path: str | Path) -> list[str]:
    """The column names of a table, MOT where its first line holds numbers, none where it is empty.

    Raises InputError where it cannot be read.
    """
    header, rows = _read(path)
    return header if rows or header != [*MOT] else []


def read_rows(path: str | Path, count: int, without: Sequence[str] = ()) -> tuple[list[str], list[list[str]]]:
    """The column names and the cells of a table that its reader found valid, sorted by frame, as readers sort it.

    count: the rows that the reader found. without: columns to leave out. Raises InputError where it cannot be read, or
    its rows are not those of the reader, as when a quoted cell goes over several lines.
    """
    header, rows = _read(path)
    if len(rows) != count:
        raise InputError(f"{path} has cells that go over several lines; wanted a line a row, without quotes")
    frame = header.index("frame")
    try:
        rows.sort(key=lambda row: float(row[frame]))  # a stable sort
    except ValueError:
        raise InputError(f"{path} has quotes about more than one cell; wanted a line a row, without quotes") from None
    kept = [place for place, name in enumerate(header) if name not in without]
    return [header[place] for place in kept], [[row[place] for place in kept] for row in rows]


def _read(path: str | Path) -> tuple[list[str], list[list[str]]]:
    with opened(path) as (first, lines):
        rows = [*([first] if any(first) else []), *(line.cells for line in lines)]
    # The first name may be empty: so a table with an index begins.
    if rows and next(cell for cell in rows[0] if cell)[0].isalpha():
        return rows[0], [[*row, *[""] * (len(rows[0]) - len(row))] for row in rows[1:]]
    rows = [row if len(row) > 1 else row[0].split() for row in rows]
    widest = max((len(row) for row in rows), default=len(MOT))
    header = [*MOT, *(f"column_{place}" for place in range(len(MOT) + 1, widest + 1))][: max(widest, 1)]
    return header, [[*row, *[""] * (widest - len(row))] for row in rows]
