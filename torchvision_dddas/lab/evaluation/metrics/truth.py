"""The truth of a clip: masks, one labelled box for each frame, or MOTChallenge boxes."""

import configparser
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.io.images import read_mask as read_mask
from torchvision_dddas.io.tables import LAST_FRAME, check_crowding
from torchvision_dddas.lab.evaluation.metrics.text_rows import FARTHEST, read_columns, read_text

UNNAMED = 1 << 24
"""The label of a mover whose value is 0, if 0 is not the background. No 8-bit picture contains it."""


Ignoring = Literal["dropped", "removed"]
"""The treatment of a found box on an ignored true box, see `matching.pair`."""


class TrackTable(NamedTuple):
    """The boxes of a clip with identities, one row per box, in any order.

    frame: (N,) int64 from 1. identity: (N,) int64, any numbers. box_px: (N, 4), x, y, width, height.
    """

    frame: np.ndarray
    identity: np.ndarray
    box_px: np.ndarray

    @classmethod
    def of(cls, frame: np.ndarray, identity: np.ndarray, box_px: np.ndarray) -> "TrackTable":
        """Return a table of columns of any number type."""
        return cls(frame.astype(np.int64), identity.astype(np.int64), box_px)

    def at(self, rows: np.ndarray) -> "TrackTable":
        """Return the rows that an index or a mask selects."""
        return TrackTable(self.frame[rows], self.identity[rows], self.box_px[rows])

    def every(self, interval: int) -> "TrackTable":
        """Return the rows of frames 1, 1 + interval, 1 + 2 interval, ..."""
        return self.at((self.frame - 1) % interval == 0)

    def boxes_by_frame(self) -> dict[int, np.ndarray]:
        """Return the boxes (n, 4) of each frame that has any, in the table's order."""
        return {number: self.box_px[rows] for number, rows in rows_by_frame(self.frame).items()}


def rows_by_frame(frame: np.ndarray) -> dict[int, np.ndarray]:
    """Return the rows of each number in frame (N,), in order."""
    order = np.argsort(frame, kind="stable")
    numbers, starts = np.unique(frame[order], return_index=True)
    return dict(zip(numbers.tolist(), np.split(order, starts[1:]), strict=True)) if len(frame) else {}


@dataclass(frozen=True)
class Labels:
    """The meaning of the values of a mask. background: nothing moves there. unscored: unknown, or not to be scored.

    Each other value is a mover. movers: if given, only these values are movers, and all others are unscored. separate:
    each value is one target, so that boxes can be scored too.
    """

    background: tuple[int, ...] = (0,)
    unscored: tuple[int, ...] = ()
    separate: bool = True
    movers: tuple[int, ...] = ()


@dataclass(frozen=True)
class TruePositions:
    """The true positions of targets on the ground. frame, identity: (N,) int64. east_north_m: (N, 2), local metres.

    lonlat_deg: (N, 2), None if unknown; needed if the metres of results have another origin.
    """

    frame: np.ndarray
    identity: np.ndarray
    east_north_m: np.ndarray
    lonlat_deg: np.ndarray | None = None


@dataclass(frozen=True)
class ClipTruth:
    """The truth of one clip, frames from 1. masks: the file of each labelled frame. boxes: (N, 4) of each.

    tracks: the boxes with their identities; None if the truth has none. ignored: boxes that do not count. length:
    frames of the clip, 0 if unknown. labels: meaning of the masks' values. positions: None if unknown. fleet: positions
    of the landmarks, with their own identities. `matching.counted` uses ignoring, others and regions. ignoring: the
    treatment of a found box on an ignored box. others: boxes that are neither true nor ignored but may match a found
    box. regions: unlabelled regions, whose identities have no meaning. notes: how a file was read.
    """

    kind: Literal["masks", "one target", "boxes"]
    place: Path
    masks: dict[int, Path]
    boxes: dict[int, np.ndarray]
    tracks: TrackTable | None = None
    ignored: TrackTable | None = None
    length: int = 0
    labels: Labels = Labels()
    positions: TruePositions | None = None
    fleet: TruePositions | None = None
    ignoring: Ignoring = "dropped"
    others: TrackTable | None = None
    regions: TrackTable | None = None
    notes: tuple[str, ...] = ()

    @property
    def frames(self) -> list[int]:
        """The labelled frames in order."""
        return sorted(self.masks or self.boxes)


def find_truth(place: Path) -> Path | None:
    """Return the place of a clip's truth: a file, a folder of PNGs, or either in the clip's folder; None if absent."""
    if place.is_file() or _numbered(place):
        return place
    for inside in (place / "masks", place / "boxes_xywh.txt", place / "gt.txt", place / "gt" / "gt.txt"):
        if inside.is_file() or _numbered(inside):
            return inside
    return None


def load_truth(place: Path, first_frame: int | None = None) -> ClipTruth:
    """Read the truth. first_frame: the number in a mask's name that denotes the clip's first frame.

    By default it is 0 if there is a file of that number, else 1. Raise InputError if nothing usable is there.
    """
    if not place.exists():
        raise InputError(f"no truth at {place}")
    found = find_truth(place)
    if found is None:
        inside = place / "truth" / "gt.txt"  # of dddas simulate
        more = f"; {inside} holds the true boxes of this film: give it" if inside.is_file() else ""
        wanted = "wanted numbered PNG masks, boxes_xywh.txt or a MOTChallenge gt.txt"
        raise InputError(f"{place} holds no truth: {wanted}{more}")
    if found.is_dir():
        numbers = _numbered(found)
        first = first_frame if first_frame is not None else 0 if 0 in numbers else 1
        early = [n for n in numbers if n < first]
        if early:
            raise InputError(f"{numbers[early[0]]} is numbered below the first frame, {first}: see --first-frame")
        return ClipTruth("masks", found, {n - first + 1: path for n, path in numbers.items()}, {})
    return _load_boxes(found)


def labels_of(truth: ClipTruth, frame: int) -> np.ndarray:
    """Return (H, W) int32 of a frame's mask: 0 background, above 0 movers, -1 unscored. Raise as `read_mask` does."""
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


def _load_boxes(path: Path) -> ClipTruth:
    if path.suffix.lower() in (".json", ".xml", ".parquet"):
        return _load_table(path)
    lines = [line.replace(",", " ").split() for line in read_text(path).splitlines() if line.strip()]
    if not lines:
        raise InputError(f"{path} is empty: wanted one box a line")
    if path.suffix.lower() == ".csv" and lines[0][:1] != ["nan"] and "".join(lines[0])[:1].isalpha():
        return _load_table(path)
    if len(lines[0]) == 4:
        try:
            boxes_px = np.array([[float(v) for v in row] for row in lines])
        except ValueError as error:
            raise InputError(f"{path} is not a table of boxes: {error}") from error
        if (is_far := (np.abs(boxes_px) > FARTHEST).any(axis=1)).any():
            far = ",".join(lines[int(is_far.argmax())])
            raise InputError(f"{path}: a box is {far}; wanted numbers from {-FARTHEST:g} to {FARTHEST:g}")
        there = np.flatnonzero(~np.isnan(boxes_px).any(axis=1))
        tracks = TrackTable(there + 1, np.ones(len(there), np.int64), boxes_px[there])
        by_frame = {frame: row[None] for frame, row in enumerate(boxes_px, 1)}
        return ClipTruth("one target", path, {}, by_frame, tracks, None, len(boxes_px))
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
        return ClipTruth("boxes", path, {}, boxes)
    table = rows.table
    check_identities(table, rows.line, path)
    # The clip's length is in MOTChallenge's seqinfo.ini, beside the truth or above its folder.
    ini = next((p for p in (path.parent / "seqinfo.ini", path.parent.parent / "seqinfo.ini") if p.is_file()), None)
    length = read_seqinfo(ini).length if ini is not None else 0
    return ClipTruth("boxes", path, {}, boxes, table.at(counts), table.at(~counts), length)


def _load_table(path: Path) -> ClipTruth:
    """Read the true boxes of a file in another format, such as COCO or CVAT. Raise InputError as `read_boxes` does."""
    rows, notes = read_boxes(path)
    if not len(rows.line):
        raise InputError(f"{path} holds no boxes; wanted the true boxes of a clip")
    if rows.named:
        check_identities(rows.table, rows.line, path)
    boxes = rows.table.boxes_by_frame()
    return ClipTruth("boxes", path, {}, boxes, rows.table if rows.named else None, notes=notes)


_COLUMNS = ("frame", "identity", "x", "y", "width", "height", "counts")


class MotRows(NamedTuple):
    """The rows of a file. mark: (N,) its seventh column, 1 if absent. line: (N,) line in the file, from 1."""

    table: TrackTable
    mark: np.ndarray
    line: np.ndarray

    @property
    def named(self) -> bool:
        """Whether the rows have identities; -1 means none. A file without rows may be of either kind."""
        return not len(self.line) or bool((self.table.identity != -1).any())


def read_rows(path: Path, what: str) -> MotRows:
    """Read a file. what: its name in errors.

    Raise InputError as `read_columns` does, for a size that is not positive, and for too many boxes in a frame.
    """
    rows = read_columns(path, _COLUMNS, what=what, last=LAST_FRAME, may_end_early=True)
    check_crowding(rows["frame"], f"{what} {path}")
    boxes = TrackTable.of(rows["frame"], rows["identity"], rows.stack(*_COLUMNS[2:6]))
    check_sizes(boxes.box_px, rows.line, f"{what} {path}")
    return MotRows(boxes, rows["counts"], rows.line)


def read_boxes(path: Path) -> tuple[MotRows, tuple[str, ...]]:
    """Return the boxes of a file in any format that `read_detections` reads, and notes. Raise InputError as it does."""
    table = read_detections(path)
    table = table[~table.of_kind("untracked")]
    identity = np.full(len(table), -1) if table.identity is None else table.identity
    return MotRows(TrackTable(table.frame, identity, table.box_px), np.ones(len(table)), table.line), table.notes


def check_sizes(box_px: np.ndarray, line: np.ndarray, name: str) -> None:
    """Raise InputError with the line if a box has no size. line: (N,) line in the file. name: name of the file."""
    if (flat := ~(box_px[:, 2:] > 0).all(axis=1)).any():
        i = int(flat.argmax())
        size = f"{box_px[i, 2]:g}×{box_px[i, 3]:g}"
        raise InputError(f"{name}, line {line[i]}: the box is {size} pixels; wanted more than 0")


def check_identities(table: TrackTable, line: np.ndarray, path: Path) -> None:
    """Raise InputError with file and lines unless each row has its own identity in its frame.

    line: (N,) line in the file, or the number of the box in a file that is not a table.
    """
    is_text = path.is_file() and path.suffix.lower() not in (".json", ".xml")
    unit, units = ("line", "lines") if is_text else ("box", "boxes")
    unnamed = np.flatnonzero(table.identity == -1)
    if len(unnamed):
        first = f"{path}, {unit} {line[unnamed[0]]}"
        raise InputError(f"{first} has no identity (-1 or nothing), but other {units} have an identity")
    order = np.lexsort([line, table.identity, table.frame])
    frame, identity, line = table.frame[order], table.identity[order], line[order]
    again = np.flatnonzero((frame[1:] == frame[:-1]) & (identity[1:] == identity[:-1]))
    if len(again):
        k = again[0]
        raise InputError(
            f"{path}, {units} {line[k]} and {line[k + 1]}: identity {identity[k]} twice in frame {frame[k]}; "
            "an identity has one box a frame"
        )


_LONGEST_INI = 16_384
MOST_FRAMES = 10_000_000
"""Largest length of a clip, in frames."""


class SeqInfo(NamedTuple):
    """The content of seqinfo.ini. length: frames, 0 if absent. rate_hz: None if absent. pictures: their folder."""

    length: int = 0
    rate_hz: float | None = None
    pictures: str = "img1"


def read_seqinfo(path: Path) -> SeqInfo:
    """Read the file. Raise InputError for another format, and without a usable seqLength or imDir under [Sequence]."""
    ini = configparser.ConfigParser(interpolation=None)
    text = read_text(path)
    if len(text) > _LONGEST_INI:  # the time for bad lines grows with the square of their number
        raise InputError(f"{path} has {len(text)} characters; wanted at most {_LONGEST_INI}")
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
    if len(pictures.encode()) > 255:  # longest name of a folder
        raise InputError(f"{path}: imDir = {pictures} is not a folder's name")
    return SeqInfo(length, rate_hz if 0 < rate_hz <= 1000 else None, pictures)
