"""Annotations as text, a row a box: columns of numbers, one of which may be a word."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.mot_text import FARTHEST

LAST = 1_000_000
"""No frame has a larger number: nine hours at 30 Hz."""

_WHOLE = ("frame", "identity")
_AROUND = "\"' \t"


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
    line, texts = np.array([n for n, _ in lines], np.int64), [text for _, text in lines]
    values, words = _quickly(texts, columns, word) or _carefully(path, lines, columns, word)
    for k, name in enumerate(columns):
        if name == word:
            continue
        column = values[:, k]
        low, high = (first, LAST) if name == "frame" else (-FARTHEST, FARTHEST)
        bad = ~((column >= low) & (column <= high))
        if name in _WHOLE:
            bad |= ~bad & (column != np.floor(column))
        if bad.any():
            i = int(bad.argmax())
            number = "a whole number" if name in _WHOLE else "a number"
            cell = _cells(texts[i])[k]
            raise InputError(f"{path}, line {line[i]}: {name} is '{cell}'; wanted {number}, {low:g} to {high:g}")
    return Rows(values, np.array(words, object), line)


def _cells(text: str) -> list[str]:
    return [cell.strip() for cell in text.split(",")] if "," in text else text.split()


def _quickly(texts: Sequence[str], columns: Sequence[str], word: str) -> tuple[np.ndarray, list[str]] | None:
    """Values (N, C) and words, where NumPy's own reader takes all lines, which is several times as fast; else None."""
    values, words = np.full((len(texts), len(columns)), np.nan), [""] * len(texts)
    if not texts:
        return values, words
    numbers = [k for k, name in enumerate(columns) if name != word]
    separator = "," if "," in texts[0] else None
    try:
        values[:, numbers] = np.loadtxt(texts, delimiter=separator, comments=None, usecols=numbers, ndmin=2)
        if word:
            at = columns.index(word)
            words = [text.split(separator, at + 1)[at].strip(_AROUND) for text in texts]
    except (ValueError, IndexError):
        return None
    return values, words


def _carefully(
    path: Path, lines: Sequence[tuple[int, str]], columns: Sequence[str], word: str
) -> tuple[np.ndarray, list[str]]:
    """The same, NaN where a cell is no number. Raises InputError where a line has too few columns."""
    rows = []
    for n, text in lines:
        rows.append(cells := _cells(text))
        if len(cells) < len(columns):
            count = f"{len(cells)} column{'s' * (len(cells) != 1)}"
            raise InputError(f"{path}, line {n}: {count}; wanted {','.join(columns)}")
    kept = [[_number(cell) for cell in row[: len(columns)]] for row in rows]
    words = [row[columns.index(word)].strip(_AROUND) if word else "" for row in rows]
    return np.array(kept, float), words


def _number(cell: str) -> float:
    try:
        return float(cell) if "_" not in cell else np.nan
    except ValueError:
        return np.nan
