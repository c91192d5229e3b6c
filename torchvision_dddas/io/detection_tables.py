"""Detections from a table: MOTChallenge text of any tool, or the CSV that `dddas detect` writes."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import DetectionTable

COLUMNS = ("frame", "x_px", "y_px", "width_px", "height_px")
"""The named columns that a CSV must have; `score` may be there as well, any other is ignored."""

FEET = ("feet_u_px", "feet_v_px")
"""Columns of the point between the feet, from the first pixel's centre."""

LAST_FRAME = 10_000_000
"""A higher frame number is taken for a mistake, such as a time stamp."""

FARTHEST_PX = 1e9
"""A place or size beyond is no pixel's."""

LEAST_PX = 1e-3
"""A smaller width or height is no target's."""

FEW_SHARE = 0.01
"""Where fewer of the scores lie outside [0, 1], they are mistakes among probabilities and not another scale."""


def read_detections(path: str | Path) -> DetectionTable:
    """Read `frame,id,x,y,w,h[,score[,...]]`, by commas or blanks; or a CSV whose first line names COLUMNS.

    An id, or a column `identity`, that is no whole number from 1 is none. A column `cut` of 0 and 1 is kept, and so are
    FEET; any other and all that follows the score are ignored. Rows may come in any order; blank lines are skipped. A
    table without rows is valid: `dddas detect` writes one for a clip in which nothing moves.
    Raises InputError with file and line: unreadable, too few columns, not a finite number, a frame that is not whole,
    below 1 or above LAST_FRAME, a width or height below LEAST_PX, a place or size beyond FARTHEST_PX, a column named
    twice, a few scores outside [0, 1] (see FEW_SHARE), a cut that is neither 0 nor 1.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(f"detections {path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"detections {path} is no text: {error}") from None
    content = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    own = ours = cuts = feet = False
    if content and _named(content[0][1]):
        number, header = content.pop(0)
        rows = list(_by_name(content, header, f"detections {path}", number))
        own = _all_moving(content, header)
        ours = own or {"identity", "kind", "row", "speed_px_per_frame"} <= set(_cells(header))
        cuts, feet = "cut" in _cells(header), set(FEET) <= set(_cells(header))
    else:
        rows = list(_by_place(content, f"detections {path}"))
    table = np.array(rows, np.float64).reshape(-1, 11)
    _refuse_few_outside(table[:, 5], table[:, 6], f"detections {path}")
    table = table[np.argsort(table[:, 0], kind="stable")]
    return DetectionTable(
        str(path),
        table[:, 0].astype(np.int64),
        table[:, 1:5],
        table[:, 5],
        table[:, 6].astype(np.int64),
        own,
        table[:, 7].astype(np.int64),
        table[:, 8] > 0 if cuts else None,
        table[:, 9:11] if feet else None,
        ours,
    )


def _named(line: str) -> bool:
    """Whether a line names columns: its first cell begins with a letter and is no number such as nan."""
    first = line.replace(",", " ").replace('"', " ").split()[:1]
    return bool(first) and first[0][0].isalpha() and _number(first[0]) is None


def _by_place(content: Sequence[tuple[int, str]], name: str) -> Iterator[list[float]]:
    for number, line in content:
        cells = [cell.strip() for cell in line.split(",")] if "," in line else line.split()
        if len(cells) < 6:
            raise InputError(
                f"{name}, line {number}: {len(cells)} column{'s' * (len(cells) != 1)}; wanted frame,id,x,y,w,h[,score]"
            )
        row = _row((cells[0], *cells[2:6]), cells[6] if len(cells) > 6 else "", number, name)
        yield [*row, _identity(cells[1]), 0.0, math.nan, math.nan]


def _by_name(content: Sequence[tuple[int, str]], header: str, name: str, line: int) -> Iterator[list[float]]:
    names = _cells(header)
    if missing := [column for column in COLUMNS if column not in names]:
        raise InputError(
            f"{name}, line {line}: its columns are {', '.join(names)}; {', '.join(missing)} missing. Wanted numbers as "
            f"frame,id,x,y,w,h[,score], or a first line that names {', '.join(COLUMNS)}"
        )
    if twice := [column for column in names if column and names.count(column) > 1]:
        raise InputError(f"{name}, line {line}: column {twice[0]} is named twice; wanted each name once")
    places = [names.index(column) for column in COLUMNS]
    # A column that is not there is read as an empty cell after the last.
    score, identity, cut, *feet = (
        names.index(n) if n in names else len(names) for n in ("score", "identity", "cut", *FEET)
    )
    for number, text in content:
        cells = _cells(text)
        if len(cells) != len(names):
            raise InputError(f"{name}, line {number}: {len(cells)} columns; the first line names {len(names)}")
        cells = [*cells, ""]
        row = _row([cells[place] for place in places], cells[score], number, name)
        if cells[cut] not in ("", "0", "1"):
            raise InputError(f"{name}, line {number}: cut is '{cells[cut]}'; wanted 1 where the border cuts it, else 0")
        standing = [_number(cells[place]) if cells[place] else math.nan for place in feet]
        for value, place, column in zip(standing, feet, FEET, strict=True):
            if value is None or abs(value) > FARTHEST_PX:
                raise InputError(f"{name}, line {number}: {column} is '{cells[place]}'; wanted pixels, or nothing")
        yield [*row, _identity(cells[identity]), float(cells[cut] == "1"), *(v for v in standing if v is not None)]


def _cells(line: str) -> list[str]:
    """The cells of a line, without the quotes that some tools put around names."""
    return [cell.strip().strip('"').strip() for cell in line.split(",")]


def _identity(text: str) -> float:
    """The identity that a cell names; -1 where it names none."""
    value = _number(text)
    return value if value is not None and 1 <= value <= 2**53 and value == int(value) else -1.0


def _all_moving(content: Sequence[tuple[int, str]], header: str) -> bool:
    """Whether the column `kind` says so of each row, as `dddas detect` does."""
    names = _cells(header)
    if not content or "kind" not in names:
        return False
    place = names.index("kind")
    return all(_cells(line)[place] == "moving" for _, line in content)


def _refuse_few_outside(score: np.ndarray, line: np.ndarray, name: str) -> None:
    """One score of 1.3 among thousands of probabilities must not make all of these certain."""
    outside = (score < 0) | (score > 1)
    if 0 < outside.sum() < FEW_SHARE * len(score):
        first = outside.argmax()
        raise InputError(
            f"{name}, line {line[first]:.0f}: score is {score[first]:g}; {outside.sum()} of {len(score)} scores lie "
            "outside [0, 1]. Wanted probabilities in [0, 1], or scores on another scale throughout"
        )


def _row(cells: Sequence[str], score: str, line: int, name: str) -> list[float]:
    """frame, x, y, width, height, score, line: checked."""
    values = [_number(cell) for cell in cells]
    values.append(_number(score) if score else 1.0)
    for value, cell, column in zip(
        values, (*cells, score), ("frame", "x", "y", "width", "height", "score"), strict=True
    ):
        if value is None or not math.isfinite(value):
            raise InputError(f"{name}, line {line}: {column} is '{cell}'; wanted a finite number")
        if column == "frame" and not (value == int(value) and 1 <= value <= LAST_FRAME):
            raise InputError(f"{name}, line {line}: frame is '{cell}'; wanted a whole number from 1 to {LAST_FRAME}")
        if column in ("width", "height") and value < LEAST_PX:
            raise InputError(f"{name}, line {line}: {column} is '{cell}'; wanted pixels, {LEAST_PX:g} at least")
        if column not in ("frame", "score") and abs(value) > FARTHEST_PX:
            raise InputError(f"{name}, line {line}: {column} is '{cell}'; wanted pixels, {FARTHEST_PX:g} at most")
    return [*(value for value in values if value is not None), float(line)]


def _number(text: str) -> float | None:
    try:
        return float(text) if "_" not in text else None  # 1_0 is a number to Python alone
    except ValueError:
        return None
