"""Annotations as text, a row a box, and boxes with identities as the truth of a clip."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.ignored_regions import within
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.metrics.truth import FARTHEST, MotRows, Positions, Truth, with_identities

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


def table_of(path: Path, frame: np.ndarray, identity: np.ndarray, box_px: np.ndarray, line: np.ndarray) -> TrackTable:
    """Rows as a table. line: (N,) of the file, for messages.

    Raises InputError with file and line: a size that is not above 0, an identity twice in a frame, or -1 for one.
    """
    if (flat := ~(box_px[:, 2:] > 0).all(axis=1)).any():
        i = int(flat.argmax())
        size = f"{box_px[i, 2]:g}×{box_px[i, 3]:g}"
        raise InputError(f"{path}, line {line[i]}: the box is {size} pixels; wanted more than 0")
    table = TrackTable(frame.astype(np.int64), identity.astype(np.int64), box_px)
    return with_identities(MotRows(table, np.ones(len(frame)), line), path)


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
        raise InputError(f"{place}: the clip is said to have {length} frames; wanted at most {LAST}")
    if regions is not None:
        counts = counts & ~_in_regions(table, regions)
    if not counts.any():
        raise InputError(f"{place} holds no box that counts")
    kept = table.at(counts)
    boxes = by_frame(kept, length or last)
    ignored = table.at(~counts) if not counts.all() else None
    said = positions if positions is not None and len(positions.frame) else None
    return Truth("boxes", place, {}, boxes, kept, ignored, length, positions=said, ignoring="removed", regions=regions)


def by_frame(table: TrackTable, length: int) -> dict[int, np.ndarray]:
    """The boxes (N, 4) of each frame from 1 to length, in the table's order."""
    order = np.argsort(table.frame, kind="stable")
    frames = table.frame[order]
    boxes = dict.fromkeys(range(1, length + 1), np.zeros((0, 4)))
    starts = np.flatnonzero(np.diff(frames, prepend=frames[0] - 1)) if len(frames) else np.zeros(0, int)
    for rows in np.split(order, starts[1:]) if len(starts) else ():
        boxes[int(table.frame[rows[0]])] = table.box_px[rows]
    return boxes


def asked(words: np.ndarray, wanted: Iterable[str], known: Iterable[str], what: str) -> np.ndarray:
    """(N,) bool: whose class is wanted. Raises InputError where a wanted one is not among the known."""
    wanted, known = list(wanted), list(known)
    for name in wanted:
        if name not in known:
            raise InputError(f"'{name}' is no class of {what}; wanted some of {', '.join(known)}")
    return np.isin(words.astype(str), wanted)


def _in_regions(table: TrackTable, regions: TrackTable) -> np.ndarray:
    lies = np.zeros(len(table.frame), bool)
    for number in np.unique(regions.frame):
        rows = np.flatnonzero(table.frame == number)
        lies[rows] = within(table.box_px[rows], regions.box_px[regions.frame == number])
    return lies
