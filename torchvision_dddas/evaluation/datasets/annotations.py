"""Annotations as text, a row a box, and boxes with identities as the truth of a clip."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.matching import lie_within
from torchvision_dddas.evaluation.metrics.truth import (
    FARTHEST,
    Positions,
    TrackTable,
    Truth,
    check_identities,
    read_text,
    rows_by_frame,
    split_cells,
    to_number,
)

LAST = 1_000_000
"""No frame has a larger number: nine hours at 30 Hz."""

_WHOLE = ("frame", "identity")
_QUOTES = "\"' \t"


@dataclass(frozen=True)
class Rows:
    """The rows of a file. columns: (N,) by name, numbers or words. line: (N,) of the file, from 1."""

    path: Path
    columns: Mapping[str, np.ndarray]
    line: np.ndarray

    def __len__(self) -> int:
        return len(self.line)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def at(self, mask: np.ndarray) -> "Rows":
        """The rows that a mask (N,) picks."""
        return Rows(self.path, {name: column[mask] for name, column in self.columns.items()}, self.line[mask])

    def stack(self, *names: str) -> np.ndarray:
        """(N, C) some columns side by side."""
        return np.stack([self.columns[name] for name in names], axis=1)

    def check_known(self, name: str, known: Collection[Any], wanted: str) -> None:
        """Raises InputError with file and line where a value of a column is not among the known ones."""
        unknown = ~np.isin(self[name], list(known))
        if unknown.any():
            i = int(unknown.argmax())
            value = self[name][i]
            shown = value if isinstance(value, str) else f"{value:g}"
            raise InputError(f"{self.path}, line {self.line[i]}: the {name} is '{shown}'; wanted {wanted}")


def read_rows(path: Path, columns: Sequence[str], word: str = "", first: int = 1) -> Rows:
    """Read a table separated by commas or blanks; columns after the named ones are ignored.

    columns: names; "frame" and "identity" are whole, frames not below `first`. word: the column that holds a word,
    whose quotes are taken off. Raises InputError with file and line: too few columns, no finite number.
    """
    lines = [(n, text) for n, text in enumerate(read_text(path).splitlines(), 1) if text.strip()]
    texts = [text for _, text in lines]
    values, words = _read_fast(texts, columns, word) or _read_slowly(path, lines, columns, word)
    for k, name in enumerate(columns):
        if name == word:
            continue
        column = values[:, k]
        low, high = (first, LAST) if name == "frame" else (-FARTHEST, FARTHEST)
        bad = ~((column >= low) & (column <= high))
        if name in _WHOLE:
            bad |= ~bad & (column != np.floor(column))
        if bad.any():
            line, text = lines[int(bad.argmax())]
            number = "a whole number" if name in _WHOLE else "a number"
            cell = split_cells(text)[k]
            raise InputError(f"{path}, line {line}: {name} is '{cell}'; wanted {number}, {low:g} to {high:g}")
    found = {name: values[:, k] for k, name in enumerate(columns)}
    if word:
        found[word] = np.array(words, str)
    return Rows(path, found, np.array([n for n, _ in lines], np.int64))


def _read_fast(texts: Sequence[str], columns: Sequence[str], word: str) -> tuple[np.ndarray, list[str]] | None:
    """Values (N, C) and words by NumPy's own reader, which is several times as fast; None where it fails."""
    values, words = np.full((len(texts), len(columns)), np.nan), [""] * len(texts)
    if not texts:
        return values, words
    numbers = [k for k, name in enumerate(columns) if name != word]
    separator = "," if "," in texts[0] else None
    try:
        values[:, numbers] = np.loadtxt(texts, delimiter=separator, comments=None, usecols=numbers, ndmin=2)
        if word:
            at = columns.index(word)
            words = [text.split(separator, at + 1)[at].strip(_QUOTES) for text in texts]
    except (ValueError, IndexError):
        return None
    return values, words


def _read_slowly(
    path: Path, lines: Sequence[tuple[int, str]], columns: Sequence[str], word: str
) -> tuple[np.ndarray, list[str]]:
    rows = []
    for n, text in lines:
        rows.append(cells := split_cells(text))
        if len(cells) < len(columns):
            count = f"{len(cells)} column{'s' * (len(cells) != 1)}"
            raise InputError(f"{path}, line {n}: {count}; wanted {','.join(columns)}")
    values = [[to_number(cell) for cell in row[: len(columns)]] for row in rows]
    words = [row[columns.index(word)].strip(_QUOTES) if word else "" for row in rows]
    return np.array(values, float), words


def boxes_of_corners(corners_px: np.ndarray) -> np.ndarray:
    """(N, 4) x, y, width, height of left, top, right, bottom."""
    return np.column_stack([corners_px[:, :2], corners_px[:, 2:] - corners_px[:, :2]])


def table_of(path: Path, frame: np.ndarray, identity: np.ndarray, box_px: np.ndarray, line: np.ndarray) -> TrackTable:
    """Rows as a table. line: (N,) of the file, for messages.

    Raises InputError with file and line: a size that is not above 0, an identity twice in a frame, or -1 for one.
    """
    if (flat := ~(box_px[:, 2:] > 0).all(axis=1)).any():
        i = int(flat.argmax())
        size = f"{box_px[i, 2]:g}×{box_px[i, 3]:g}"
        raise InputError(f"{path}, line {line[i]}: the box is {size} pixels; wanted more than 0")
    table = TrackTable.of(frame, identity, box_px)
    check_identities(table, line, path)
    return table


def truth_of(
    place: Path,
    table: TrackTable,
    counts: np.ndarray,
    length: int,
    regions: TrackTable | None = None,
    positions: Positions | None = None,
) -> Truth:
    """The truth, with boxes of every frame up to the clip's length, or the last labelled one where it is 0.

    counts: (N,) which rows count; found boxes on the others neither count nor harm. regions: where nobody labelled; a
    row that lies there does not count. Raises InputError: rows beyond the clip's end, or none that count at all.
    """
    last = int(table.frame.max()) if len(table.frame) else 0
    if length and last > length:
        raise InputError(f"{place} labels frame {last}, but the clip has {length}; is it the same clip?")
    if length > LAST:
        raise InputError(f"{place}: a clip must have at most {LAST} frames, got {length}")
    if regions is not None and not len(regions.frame):
        regions = None
    if regions is not None:
        counts, by_frame = counts.copy(), rows_by_frame(table.frame)
        for number, region_px in regions.boxes_by_frame().items():
            rows = by_frame.get(number, np.zeros(0, np.int64))
            counts[rows] &= ~lie_within(table.box_px[rows], region_px)
    if not counts.any():
        raise InputError(f"{place} holds no box that counts")
    kept = table.at(counts)
    return Truth(
        "boxes",
        place,
        {},
        boxes_by_frame(kept, length or last),
        kept,
        None if counts.all() else table.at(~counts),
        length,
        positions=positions if positions is not None and len(positions.frame) else None,
        ignoring="removed",
        regions=regions,
    )


def boxes_by_frame(table: TrackTable, length: int) -> dict[int, np.ndarray]:
    """The boxes (N, 4) of each frame from 1 to length, in the table's order."""
    return {frame: np.zeros((0, 4)) for frame in range(1, length + 1)} | table.boxes_by_frame()
