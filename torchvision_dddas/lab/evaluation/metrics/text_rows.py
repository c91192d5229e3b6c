"""Annotations as text, one row per box: numbers in named columns, read quickly. Errors name file and line."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError

FARTHEST = 1e9
"""Largest absolute value of a place, size or mark."""

LAST = 1_000_000
"""Largest frame number of a data set: nine hours at 30 Hz."""

_MOST = 2**53  # largest whole number up to which floats represent every whole number
_WHOLE = ("frame", "identity")
_QUOTES = "\"' \t"


@dataclass(frozen=True)
class Rows:
    """The rows of a file. columns: (N,) by name, numbers or words. line: (N,) line in the file, from 1."""

    path: Path
    columns: Mapping[str, np.ndarray]
    line: np.ndarray

    def __len__(self) -> int:
        return len(self.line)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def at(self, mask: np.ndarray) -> "Rows":
        """Return the rows that a mask (N,) selects."""
        return Rows(self.path, {name: column[mask] for name, column in self.columns.items()}, self.line[mask])

    def stack(self, *names: str) -> np.ndarray:
        """Return some columns side by side, (N, C)."""
        return np.stack([self.columns[name] for name in names], axis=1)

    def check_known(self, name: str, known: Collection[Any], wanted: str) -> None:
        """Raise InputError with file and line if a value of a column is not among the known values."""
        unknown = ~np.isin(self[name], list(known))
        if unknown.any():
            i = int(unknown.argmax())
            value = self[name][i]
            shown = value if isinstance(value, str) else f"{value:g}"
            raise InputError(f"{self.path}, line {self.line[i]}: the {name} is '{shown}'; wanted {wanted}")


def read_columns(
    path: Path,
    columns: Sequence[str],
    word: str = "",
    first: int = 1,
    last: int = LAST,
    what: str = "",
    may_end_early: bool = False,
) -> Rows:
    """Read a table separated by commas or blanks; columns after the named columns are ignored.

    columns: names; "frame" and "identity" are whole, frames from `first` to `last`. word: the column that holds a word;
    quotes around it are removed. what: the content, for messages. may_end_early: read the last cell as 1 if a line
    lacks it. Raise InputError with file and line for too few columns and for numbers that are not finite.
    """
    file = f"{what} {path}".strip()
    lines = [(n, text) for n, text in enumerate(read_text(path, name=file).splitlines(), 1) if text.strip()]
    texts = [text for _, text in lines]
    values, words = _read_fast(texts, columns, word) or _read_slowly(file, lines, columns, word, may_end_early)
    for k, name in enumerate(columns):
        if name == word:
            continue
        column = values[:, k]
        low, high = {"frame": (first, last), "identity": (-_MOST, _MOST)}.get(name, (-FARTHEST, FARTHEST))
        bad = ~((column >= low) & (column <= high))
        if name in _WHOLE:
            bad |= ~bad & (column != np.floor(column))
        if bad.any():
            line, text = lines[int(bad.argmax())]
            number = "a whole number" if name in _WHOLE else "a number"
            cell = split_cells(text)[k]
            raise InputError(f"{file}, line {line}: {name} is '{cell}'; wanted {number}, {low:g} to {high:g}")
    found = {name: values[:, k] for k, name in enumerate(columns)}
    if word:
        found[word] = np.array(words, str)
    return Rows(path, found, np.array([n for n, _ in lines], np.int64))


def _read_fast(texts: Sequence[str], columns: Sequence[str], word: str) -> tuple[np.ndarray, list[str]] | None:
    """Return values (N, C) and words by NumPy's reader, which is several times as fast; None if it fails."""
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
    name: str, lines: Sequence[tuple[int, str]], columns: Sequence[str], word: str, may_end_early: bool
) -> tuple[np.ndarray, list[str]]:
    rows = []
    for n, text in lines:
        cells = split_cells(text)
        if len(cells) < len(columns) - may_end_early:
            count = f"{len(cells)} column{'s' * (len(cells) != 1)}"
            raise InputError(f"{name}, line {n}: {count}; wanted {','.join(columns)}")
        rows.append([*cells, "1"])
    values = [[to_number(cell) for cell in row[: len(columns)]] for row in rows]
    words = [row[columns.index(word)].strip(_QUOTES) if word else "" for row in rows]
    return np.array(values, float), words


def read_text(path: Path, encoding: str = "utf-8-sig", name: str = "") -> str:
    """Return a file's text. name: for messages, by default the path. Raise InputError if it cannot be read as text."""
    try:
        return path.read_text(encoding=encoding)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise InputError(f"{name or path} cannot be read: {reason}") from None


def split_cells(line: str) -> list[str]:
    """Split the cells of a line, separated by commas, or by blanks if there are no commas."""
    return [cell.strip() for cell in line.split(",")] if "," in line else line.split()


def to_number(cell: str) -> float:
    """Return a cell's number; NaN if it is not a number."""
    try:
        return float(cell) if "_" not in cell else math.nan  # only Python reads 1_0 as a number
    except ValueError:
        return math.nan
