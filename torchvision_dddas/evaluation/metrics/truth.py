"""Truth of a clip: masks, one labelled box a frame, or MOTChallenge boxes."""

import configparser
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.images import decode_image
from torchvision_dddas.io.tables import check_crowding
from torchvision_dddas.memory import MASK

UNNAMED = 1 << 24
"""The label of a mover whose value is 0, where 0 is not the background; no picture of 8 bits holds it."""


Ignoring = Literal["dropped", "removed"]
"""What becomes of a found box on an ignored true one, see `matching.pair`."""


class TrackTable(NamedTuple):
    """A clip's boxes with identities, one row a box, in any order.

    frame: (N,) int64 from 1. identity: (N,) int64, any numbers. box_px: (N, 4), x, y, width, height.
    """

    frame: np.ndarray
    identity: np.ndarray
    box_px: np.ndarray

    @classmethod
    def of(cls, frame: np.ndarray, identity: np.ndarray, box_px: np.ndarray) -> "TrackTable":
        """A table of columns of any number type."""
        return cls(frame.astype(np.int64), identity.astype(np.int64), box_px)

    def at(self, rows: np.ndarray) -> "TrackTable":
        """The rows that an index or a mask picks."""
        return TrackTable(self.frame[rows], self.identity[rows], self.box_px[rows])

    def every(self, interval: int) -> "TrackTable":
        """The rows of frames 1, 1 + interval, 1 + 2 interval, ..."""
        return self.at((self.frame - 1) % interval == 0)

    def boxes_by_frame(self) -> dict[int, np.ndarray]:
        """The boxes (n, 4) of each frame that has any, in the table's order."""
        return {number: self.box_px[rows] for number, rows in rows_by_frame(self.frame).items()}


def rows_by_frame(frame: np.ndarray) -> dict[int, np.ndarray]:
    """The rows of each number in frame (N,), in order."""
    order = np.argsort(frame, kind="stable")
    numbers, starts = np.unique(frame[order], return_index=True)
    return dict(zip(numbers.tolist(), np.split(order, starts[1:]), strict=True)) if len(frame) else {}


@dataclass(frozen=True)
class Labels:
    """What the values of a mask mean. background: nothing moves there. unscored: unknown, or outside what counts.

    Each other value is a mover; movers: where given, only these are, and any other value is unscored. separate: each is
    one target, so that boxes can be scored too.
    """

    background: tuple[int, ...] = (0,)
    unscored: tuple[int, ...] = ()
    separate: bool = True
    movers: tuple[int, ...] = ()


@dataclass(frozen=True)
class Positions:
    """Where the targets truly are on the ground. frame, identity: (N,) int64. east_north_m: (N, 2), local metres.

    lonlat_deg: (N, 2), None where unknown; needed where results have another origin of their metres.
    """

    frame: np.ndarray
    identity: np.ndarray
    east_north_m: np.ndarray
    lonlat_deg: np.ndarray | None = None


@dataclass(frozen=True)
class Truth:
    """The truth of one clip, frames from 1. masks: the file of each labelled frame. boxes: (N, 4) of each.

    tracks: the boxes with their identities, None where the truth has none. ignored: boxes that do not count.
    length: frames of the clip, 0 where unknown. labels: of the masks. positions: None where unknown; fleet: those of
    the landmarks, with identities of their own. ignoring, others and regions are for `matching.counted`: what becomes
    of a found box on an ignored one; boxes that are neither true nor ignored but may take a found box; and regions
    that are unlabelled, whose identities mean nothing.
    """

    kind: Literal["masks", "one target", "boxes"]
    place: Path
    masks: dict[int, Path]
    boxes: dict[int, np.ndarray]
    tracks: TrackTable | None = None
    ignored: TrackTable | None = None
    length: int = 0
    labels: Labels = Labels()
    positions: Positions | None = None
    fleet: Positions | None = None
    ignoring: Ignoring = "dropped"
    others: TrackTable | None = None
    regions: TrackTable | None = None

    @property
    def frames(self) -> list[int]:
        """The labelled frames in order."""
        return sorted(self.masks or self.boxes)


def find_truth(place: Path) -> Path | None:
    """Where the truth of a clip lies: a file, a folder of PNGs, or what a clip's folder holds; None if it has none."""
    if place.is_file() or _numbered(place):
        return place
    for inside in (place / "masks", place / "boxes_xywh.txt", place / "gt.txt", place / "gt" / "gt.txt"):
        if inside.is_file() or _numbered(inside):
            return inside
    return None


def load_truth(place: Path, first_frame: int | None = None) -> Truth:
    """Read the truth. first_frame is the number in a mask's name that is the clip's first frame.

    By default it is 0 if there is a file of that number, else 1. Raises InputError if nothing usable is there.
    """
    if not place.exists():
        raise InputError(f"no truth at {place}")
    found = find_truth(place)
    if found is None:
        raise InputError(f"{place} holds no truth: wanted numbered PNG masks, boxes_xywh.txt or a MOTChallenge gt.txt")
    if found.is_dir():
        numbers = _numbered(found)
        first = first_frame if first_frame is not None else 0 if 0 in numbers else 1
        early = [n for n in numbers if n < first]
        if early:
            raise InputError(f"{numbers[early[0]]} is numbered below the first frame, {first}: see --first-frame")
        return Truth("masks", found, {n - first + 1: path for n, path in numbers.items()}, {})
    return _load_boxes(found)


def read_mask(path: Path) -> np.ndarray:
    """The labels of a mask file, (H, W) int32: a value or colour a target. Raises InputError if it is no picture."""
    try:
        image = decode_image(path.read_bytes(), cv2.IMREAD_UNCHANGED, path, MASK)
    except OSError:
        image = None
    if image is None:
        raise InputError(f"{path} is no picture that can be read")
    if image.ndim == 2:
        return image.astype(np.int32)
    blue, green, red = (image[..., k].astype(np.int32) for k in range(3))
    return blue + 256 * green + 65536 * red


def labels_of(truth: Truth, frame: int) -> np.ndarray:
    """(H, W) int32 of a frame's mask: 0 background, above it movers, -1 where nothing counts. Raises as `read_mask`."""
    values, meaning = read_mask(truth.masks[frame]), truth.labels
    if meaning == Labels():
        return values
    labels = np.where(np.isin(values, meaning.background), 0, np.where(values == 0, UNNAMED, values))
    labels[np.isin(values, meaning.unscored)] = -1
    if meaning.movers:
        labels[~np.isin(values, meaning.movers + meaning.background)] = -1
    return labels


def _numbered(folder: Path) -> dict[int, Path]:
    if not folder.is_dir():
        return {}
    return {int(p.stem): p for p in sorted(folder.glob("*.png")) if p.stem.isdecimal()}


def _load_boxes(path: Path) -> Truth:
    lines = [line.replace(",", " ").split() for line in read_text(path).splitlines() if line.strip()]
    if not lines:
        raise InputError(f"{path} is empty: wanted one box a line")
    if len(lines[0]) == 4:
        try:
            boxes_px = np.array([[float(v) for v in row] for row in lines])
        except ValueError as error:
            raise InputError(f"{path} is no table of boxes: {error}") from error
        if (is_far := (np.abs(boxes_px) > FARTHEST).any(axis=1)).any():
            far = ",".join(lines[int(is_far.argmax())])
            raise InputError(f"{path}: a box is {far}; wanted numbers from {-FARTHEST:g} to {FARTHEST:g}")
        there = np.flatnonzero(~np.isnan(boxes_px).any(axis=1))
        tracks = TrackTable(there + 1, np.ones(len(there), np.int64), boxes_px[there])
        by_frame = {frame: row[None] for frame, row in enumerate(boxes_px, 1)}
        return Truth("one target", path, {}, by_frame, tracks, None, len(boxes_px))
    if len(lines[0]) < 6:
        raise InputError(
            f"{path} has {len(lines[0])} columns; wanted 4 (x,y,w,h) or MOTChallenge's (frame,id,x,y,w,h,...)"
        )
    rows = read_rows(path, "truth")
    # MOTChallenge: a 0 in the seventh column marks a box that does not count.
    counts = rows.mark != 0
    kept = rows.table.at(counts)
    boxes = dict.fromkeys(np.unique(rows.table.frame).tolist(), np.zeros((0, 4))) | kept.boxes_by_frame()
    if not rows.named:
        return Truth("boxes", path, {}, boxes)
    table = rows.table
    check_identities(table, rows.line, path)
    # The clip's length is in MOTChallenge's seqinfo.ini, beside the truth or above its folder.
    ini = next((p for p in (path.parent / "seqinfo.ini", path.parent.parent / "seqinfo.ini") if p.is_file()), None)
    length = read_seqinfo(ini).length if ini is not None else 0
    return Truth("boxes", path, {}, boxes, table.at(counts), table.at(~counts), length)


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
    """Read a file; `what` names it in errors.

    Raises InputError with file and line: unreadable, too few columns, not a finite number, a frame that is not whole
    or below 1, an identity that is not whole, a size that is not positive.
    """
    lines = [(n, line) for n, line in enumerate(read_text(path, what=f"{what} ").splitlines(), 1) if line.strip()]
    table = _read_fast([line for _, line in lines])
    if table is None:
        table = _read_slowly(lines, f"{what} {path}")
    check_crowding(table[:, 0], f"{what} {path}")
    boxes = TrackTable.of(table[:, 0], table[:, 1], table[:, 2:6])
    return MotRows(boxes, table[:, 6], np.array([number for number, _ in lines], np.int64))


def _read_fast(lines: list[str]) -> np.ndarray | None:
    """The seven columns (N, 7) by NumPy's own reader, ten times as fast; None where anything may be wrong with them."""
    first = split_cells(lines[0]) if lines else []
    if len(first) < 6 or (len(first) == 6 and not all(line.count(",") == 5 for line in lines)):
        return None
    count, separator = min(len(first), 7), "," if "," in lines[0] else None
    try:
        values = np.loadtxt(lines, delimiter=separator, comments=None, usecols=range(count), ndmin=2)
    except ValueError:
        return None
    table = np.column_stack([values, np.ones((len(values), 7 - count))])
    whole, box = table[:, :2], table[:, 2:6]
    is_right = (whole == np.floor(whole)).all(axis=1) & (np.abs(whole) <= 2**53).all(axis=1) & (whole[:, 0] >= 1)
    is_right &= (np.abs(table[:, 2:]) <= FARTHEST).all(axis=1) & (box[:, 2:] > 0).all(axis=1)
    return table if len(table) == len(lines) and is_right.all() else None


def _read_slowly(lines: list[tuple[int, str]], name: str) -> np.ndarray:
    """The seven columns (N, 7), checked cell by cell."""
    rows = []
    for number, line in lines:
        where, cells = f"{name}, line {number}", split_cells(line)
        if len(cells) < 6:
            count = f"{len(cells)} column{'s' * (len(cells) != 1)}"
            raise InputError(f"{where}: {count}; wanted frame,id,x,y,w,h[,score]")
        values = []
        for cell, column in zip(cells, _COLUMNS, strict=False):
            value, is_whole = to_number(cell), column in ("frame", "id")
            if not math.isfinite(value):
                raise InputError(f"{where}: {column} is '{cell}'; wanted a finite number")
            if is_whole and (value != int(value) or abs(value) > 2**53):
                raise InputError(f"{where}: {column} is '{cell}'; wanted a whole number")
            if not is_whole and abs(value) > FARTHEST:
                raise InputError(f"{where}: {column} is '{cell}'; wanted {-FARTHEST:g} to {FARTHEST:g}")
            values.append(value)
        if values[0] < 1:
            raise InputError(f"{where}: frame is '{cells[0]}'; frames count from 1")
        if min(values[4:6]) <= 0:
            raise InputError(f"{where}: the box is {cells[4]}×{cells[5]} pixels; wanted more than 0")
        rows.append([*values, 1.0][:7])
    return np.array(rows, float).reshape(-1, 7)


def check_identities(table: TrackTable, line: np.ndarray, path: Path) -> None:
    """Raises InputError with file and lines where a row has not an identity of its own in its frame.

    line: (N,) of the file.
    """
    unnamed = np.flatnonzero(table.identity == -1)
    if len(unnamed):
        raise InputError(f"{path}, line {line[unnamed[0]]}: identity -1 means none, but other rows have one")
    order = np.lexsort([line, table.identity, table.frame])
    frame, identity, line = table.frame[order], table.identity[order], line[order]
    again = np.flatnonzero((frame[1:] == frame[:-1]) & (identity[1:] == identity[:-1]))
    if len(again):
        k = again[0]
        raise InputError(
            f"{path}, lines {line[k]} and {line[k + 1]}: identity {identity[k]} twice in frame {frame[k]}; "
            "an identity has one box a frame"
        )


def read_text(path: Path, encoding: str = "utf-8-sig", what: str = "") -> str:
    """A file's text. Raises InputError where it cannot be read or is none."""
    try:
        return path.read_text(encoding=encoding)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise InputError(f"{what}{path} cannot be read: {reason}") from None


def split_cells(line: str) -> list[str]:
    """The cells of a line, separated by commas, or by blanks where there are none."""
    return [cell.strip() for cell in line.split(",")] if "," in line else line.split()


def to_number(cell: str) -> float:
    """A cell's number, NaN for none."""
    try:
        return float(cell) if "_" not in cell else math.nan  # 1_0 is a number to Python alone
    except ValueError:
        return math.nan


_LONGEST_INI = 16_384
MOST_FRAMES = 10_000_000
"""No clip is longer."""


class SeqInfo(NamedTuple):
    """The content of seqinfo.ini. length: frames, 0 if absent. rate_hz: None if absent. pictures: their folder."""

    length: int = 0
    rate_hz: float | None = None
    pictures: str = "img1"


def read_seqinfo(path: Path) -> SeqInfo:
    """Read the file. Raises InputError: no such format, no usable seqLength or imDir under [Sequence]."""
    ini = configparser.ConfigParser(interpolation=None)
    text = read_text(path)
    if len(text) > _LONGEST_INI:  # bad lines take time as their number squared
        raise InputError(f"{path} has {len(text)} characters; wanted at most {_LONGEST_INI}, none has more")
    try:
        ini.read_string(text)
        length = ini.getint("Sequence", "seqLength")
    except (configparser.Error, ValueError) as error:
        raise InputError(f"{path} does not hold seqLength under [Sequence]: {error}") from error
    if not 0 <= length <= MOST_FRAMES:
        raise InputError(f"{path}: seqLength is {length}; wanted 0 to {MOST_FRAMES}")
    try:
        rate_hz = ini.getfloat("Sequence", "frameRate", fallback=math.nan)
    except ValueError:
        rate_hz = math.nan
    pictures = Path(ini.get("Sequence", "imDir", fallback="") or "img1").name
    if len(pictures.encode()) > 255:  # no folder's name is longer
        raise InputError(f"{path}: imDir = {pictures} is no folder's name")
    return SeqInfo(length, rate_hz if 0 < rate_hz <= 1000 else None, pictures)
