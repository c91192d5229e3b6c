"""Boxes with identities as the truth of a clip."""

from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.metrics.matching import lie_within
from torchvision_dddas.lab.evaluation.metrics.text_rows import LAST
from torchvision_dddas.lab.evaluation.metrics.truth import (
    ClipTruth,
    TrackTable,
    check_identities,
    check_sizes,
    rows_by_frame,
)


def boxes_of_corners(corners_px: np.ndarray) -> np.ndarray:
    """Return (N, 4) x, y, width, height of left, top, right, bottom."""
    return np.column_stack([corners_px[:, :2], corners_px[:, 2:] - corners_px[:, :2]])


def table_of(path: Path, frame: np.ndarray, identity: np.ndarray, box_px: np.ndarray, line: np.ndarray) -> TrackTable:
    """Return rows as a table. line: (N,) line in the file, for messages.

    Raise InputError with file and line for sizes not above 0, and identities that are -1 or twice in a frame.
    """
    check_sizes(box_px, line, str(path))
    table = TrackTable.of(frame, identity, box_px)
    check_identities(table, line, path)
    return table


def truth_of(
    place: Path,
    table: TrackTable,
    counts: np.ndarray,
    length: int,
    regions: TrackTable | None = None,
    uncounted: str = "",
) -> ClipTruth:
    """Return the truth, with boxes of every frame up to the clip's length, or to the last labelled frame if it is 0.

    counts: (N,) which rows count; found boxes on the other rows are neither right nor false. regions: unlabelled
    regions; rows in them do not count. uncounted: the kinds of boxes that do not count, for the message. Raise
    InputError for rows beyond the clip's end, and if no row counts.
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
        raise InputError(f"{place} holds no box that counts{uncounted and ': '}{uncounted}")
    kept = table.at(counts)
    return ClipTruth(
        "boxes",
        place,
        {},
        boxes_by_frame(kept, length or last),
        kept,
        None if counts.all() else table.at(~counts),
        length,
        ignoring="removed",
        regions=regions,
    )


def boxes_by_frame(table: TrackTable, length: int) -> dict[int, np.ndarray]:
    """Return the boxes (N, 4) of each frame from 1 to length, in the table's order."""
    return {frame: np.zeros((0, 4)) for frame in range(1, length + 1)} | table.boxes_by_frame()
