"""True and found boxes matched frame by frame, and found boxes that count neither as right nor as false."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.boxes import areas, iou
from torchvision_dddas.evaluation.metrics.truth import Ignoring, TrackTable, Truth, rows_by_frame

LEAST = 0.5
"""IoU from which a box counts as found."""

WITHIN = 0.5
"""A found box lies in a region if more than this share of its area does."""

EPSILON = float(np.finfo(float).eps)


class FramePair(NamedTuple):
    """One frame: identities of its true (n,) and found (m,) boxes, counted from 0, and their IoU (n, m)."""

    true: np.ndarray
    found: np.ndarray
    overlap: np.ndarray


class Paired(NamedTuple):
    """A clip's frames that hold any box, in order, and how many boxes each true and each found identity has.

    numbers: of the frames.
    """

    numbers: np.ndarray
    frames: list[FramePair]
    true_boxes: np.ndarray
    found_boxes: np.ndarray


def pair(
    truth: TrackTable, found: TrackTable, ignored: TrackTable | None = None, ignoring: Ignoring = "dropped"
) -> Paired:
    """A clip's true and found boxes by frame; all tracking measures start here.

    ignored: true boxes that do not count. "dropped": they are as if never labelled, so that a found box on one is
    false; TrackEval does so for MOT15. "removed": a found box whose best match (IoU ≥ 0.5, all true boxes taking
    part) is one of them is taken out; TrackEval does so for the distractors of later benchmarks. Frames without any
    box change no measure. Raises InputError if an identity has two boxes in a frame.
    """
    for table, what in ((truth, "truth"), (found, "result")):
        _check_unique(table, what)
    if ignoring == "removed" and ignored is not None and len(ignored.frame):
        found = found.at(~_is_on_ignored(truth, found, ignored))
    _, true_id, true_boxes = np.unique(truth.identity, return_inverse=True, return_counts=True)
    _, found_id, found_boxes = np.unique(found.identity, return_inverse=True, return_counts=True)
    frames, numbers = [], np.union1d(truth.frame, found.frame)
    for true_rows, found_rows in _rows_of_each(truth.frame, found.frame):
        overlap = iou(truth.box_px[true_rows], found.box_px[found_rows])
        frames.append(FramePair(true_id[true_rows], found_id[found_rows], overlap))
    return Paired(numbers, frames, true_boxes, found_boxes)


def match(overlap: np.ndarray, least: float = LEAST) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of an IoU matrix (n, m) that match one to one, of at least so much, for the largest sum."""
    worth = np.where(overlap >= least - EPSILON, overlap, 0.0)
    i, j = linear_sum_assignment(worth, maximize=True)
    hit = worth[i, j] > 0
    return i[hit], j[hit]


def counted(truth: Truth, frame: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """(N,) bool: whether each found box counts. frame: (N,), box_px: (N, 4), in any order.

    Boxes do not count whose best match (IoU ≥ 0.5, all labelled boxes of the frame taking part, those of `others` too)
    is an ignored one, where `truth.ignoring` is "removed"; and of those that match none, boxes that lie by more than
    half of their area in one of the regions. TrackEval does so for MOTChallenge from 2016 on and for KITTI.
    """
    counts: np.ndarray = np.ones(len(frame), bool)
    ignored = truth.ignored if truth.ignoring == "removed" else None
    if ignored is None and truth.regions is None:
        return counts
    other, distracting, unlabelled = (
        {} if table is None else table.boxes_by_frame() for table in (truth.others, ignored, truth.regions)
    )
    nothing = np.zeros((0, 4))
    for number, rows in rows_by_frame(frame).items():
        before = [truth.boxes.get(number, nothing), other.get(number, nothing)]
        labelled = np.concatenate([*before, distracting.get(number, nothing)])
        i, j = match(iou(labelled, box_px[rows]))
        counts[rows[j[i >= sum(map(len, before))]]] = False
        rest = np.setdiff1d(rows, rows[j])
        counts[rest[lie_within(box_px[rest], unlabelled.get(number, nothing))]] = False
    return counts


def lie_within(box_px: np.ndarray, region_px: np.ndarray) -> np.ndarray:
    """(N,) bool: whether more than half of the area of each box (N, 4) lies in one of the regions (M, 4)."""
    if not len(region_px) or not len(box_px):
        return np.zeros(len(box_px), bool)
    inside, _ = areas(box_px[:, None], region_px[None])
    share: np.ndarray = inside / np.maximum(np.prod(box_px[:, 2:], axis=1), EPSILON)[:, None]
    return np.asarray((share > WITHIN + EPSILON).any(axis=1))


def _check_unique(table: TrackTable, what: str) -> None:
    both, counts = np.unique(np.stack([table.frame, table.identity], axis=1), axis=0, return_counts=True)
    if (counts > 1).any():
        frame, identity = both[counts > 1][0]
        raise InputError(f"the {what} has identity {identity} twice in frame {frame}; an identity has one box a frame")


def _rows_of_each(*frames: np.ndarray) -> Iterable[tuple[np.ndarray, ...]]:
    """For each frame number that any table has, in order, the rows of each table in their order."""
    orders = [np.argsort(f, kind="stable") for f in frames]
    numbers = np.unique(np.concatenate(frames))
    cuts = [np.searchsorted(f[o], [numbers, numbers + 1]) for f, o in zip(frames, orders, strict=True)]
    for i in range(len(numbers)):
        yield tuple(order[cut[0, i] : cut[1, i]] for order, cut in zip(orders, cuts, strict=True))


def _is_on_ignored(truth: TrackTable, found: TrackTable, ignored: TrackTable) -> np.ndarray:
    """(M,) bool: which found boxes match a true box that does not count."""
    gone = np.zeros(len(found.frame), bool)
    for true_rows, found_rows, ignored_rows in _rows_of_each(truth.frame, found.frame, ignored.frame):
        labelled = np.concatenate([truth.box_px[true_rows], ignored.box_px[ignored_rows]])
        i, j = match(iou(labelled, found.box_px[found_rows]))
        gone[found_rows[j[i >= len(true_rows)]]] = True
    return gone
