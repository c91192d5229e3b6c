"""Boxes with identities as the truth of a clip whose every frame is labelled."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.annotations import LAST
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.metrics.mot_text import MotRows, with_identities
from torchvision_dddas.evaluation.metrics.truth import Positions, Truth
from torchvision_dddas.evaluation.metrics.uncounted import within


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
