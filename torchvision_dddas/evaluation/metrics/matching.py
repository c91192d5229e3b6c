"""True and found boxes with identities, set beside each other frame by frame: all tracking measures start here."""

from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.boxes import iou

LEAST = 0.5
"""IoU from which a box counts as found."""

EPSILON = float(np.finfo(float).eps)

Ignoring = Literal["dropped", "removed"]


class TrackTable(NamedTuple):
    """A clip's boxes with identities, one row a box, in any order.

    frame: (N,) int64 from 1. identity: (N,) int64, any numbers. box_px: (N, 4), x, y, width, height.
    """

    frame: np.ndarray
    identity: np.ndarray
    box_px: np.ndarray

    def at(self, rows: np.ndarray) -> "TrackTable":
        """The rows that an index or a mask picks."""
        return TrackTable(self.frame[rows], self.identity[rows], self.box_px[rows])

    def every(self, interval: int) -> "TrackTable":
        """The rows of frames 1, 1 + interval, 1 + 2 interval, ..."""
        return self.at((self.frame - 1) % interval == 0)


class FramePair(NamedTuple):
    """One frame: identities of its true (n,) and found (m,) boxes, counted from 0, and their IoU (n, m)."""

    true: np.ndarray
    found: np.ndarray
    overlap: np.ndarray


class Paired(NamedTuple):
    """A clip's frames that hold any box, in order, and the boxes of each true and each found identity, counted.

    numbers: of the frames.
    """

    numbers: np.ndarray
    frames: list[FramePair]
    true_boxes: np.ndarray
    found_boxes: np.ndarray


def pair(
    truth: TrackTable, found: TrackTable, ignored: TrackTable | None = None, ignoring: Ignoring = "dropped"
) -> Paired:
    """Set a clip's true and found boxes beside each other.

    ignored: true boxes that do not count. "dropped": they are as if never labelled, so that whoever finds one has a
    false box; TrackEval does so for MOT15. "removed": a found box whose best match (IoU ≥ 0.5, all true boxes taking
    part) is one of them is taken out; TrackEval does so for the distractors of later benchmarks. Frames without any
    box change no measure. Raises InputError if an identity stands twice in a frame.
    """
    for table, what in ((truth, "truth"), (found, "result")):
        _check(table, what)
    if ignoring == "removed" and ignored is not None and len(ignored.frame):
        found = found.at(~_on_ignored(truth, found, ignored))
    _, true_id, true_boxes = np.unique(truth.identity, return_inverse=True, return_counts=True)
    _, found_id, found_boxes = np.unique(found.identity, return_inverse=True, return_counts=True)
    frames, numbers = [], np.union1d(truth.frame, found.frame)
    for true_rows, found_rows in _rows_by_frame(truth.frame, found.frame):
        overlap = iou(truth.box_px[true_rows], found.box_px[found_rows])
        frames.append(FramePair(true_id[true_rows], found_id[found_rows], overlap))
    return Paired(numbers, frames, true_boxes, found_boxes)


def _check(table: TrackTable, what: str) -> None:
    both, counts = np.unique(np.stack([table.frame, table.identity], axis=1), axis=0, return_counts=True)
    if (counts > 1).any():
        frame, identity = both[counts > 1][0]
        raise InputError(f"the {what} has identity {identity} twice in frame {frame}; an identity has one box a frame")


def _rows_by_frame(*frames: np.ndarray) -> Iterable[tuple[np.ndarray, ...]]:
    """For each frame number that any table has, in order, the rows of each table in their order."""
    orders = [np.argsort(f, kind="stable") for f in frames]
    numbers = np.unique(np.concatenate(frames))
    cuts = [np.searchsorted(f[o], [numbers, numbers + 1]) for f, o in zip(frames, orders, strict=True)]
    for i in range(len(numbers)):
        yield tuple(order[cut[0, i] : cut[1, i]] for order, cut in zip(orders, cuts, strict=True))


def _on_ignored(truth: TrackTable, found: TrackTable, ignored: TrackTable) -> np.ndarray:
    """(M,) which found boxes match a true box that does not count."""
    gone = np.zeros(len(found.frame), bool)
    for true_rows, found_rows, ignored_rows in _rows_by_frame(truth.frame, found.frame, ignored.frame):
        if len(found_rows) == 0 or len(ignored_rows) == 0:
            continue
        labelled = np.concatenate([truth.box_px[true_rows], ignored.box_px[ignored_rows]])
        overlap = iou(labelled, found.box_px[found_rows])
        overlap[overlap < LEAST - EPSILON] = 0
        i, j = linear_sum_assignment(overlap, maximize=True)
        gone[found_rows[j[(overlap[i, j] > 0) & (i >= len(true_rows))]]] = True
    return gone
