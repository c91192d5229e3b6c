"""Found boxes that neither count as right nor as false: on what a benchmark ignores, or where nobody labelled."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.evaluation.metrics.boxes import areas, iou
from torchvision_dddas.evaluation.metrics.matching import EPSILON, LEAST, TrackTable
from torchvision_dddas.evaluation.metrics.truth import Truth

WITHIN = 0.5
"""Share of a found box in a region from which on it lies there."""


def counted(truth: Truth, frame: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """(N,) bool: whether each found box counts. frame: (N,), box_px: (N, 4), in any order.

    Out are boxes whose best match (IoU ≥ 0.5, all labelled boxes of the frame taking part, those of `others` too) is
    an ignored one, where `truth.ignoring` is "removed"; and of those that match none, boxes that lie by more than half
    of their area in one of the regions. TrackEval does so for MOTChallenge from 2016 on and for KITTI.
    """
    counts: np.ndarray = np.ones(len(frame), bool)
    ignored = truth.ignored if truth.ignoring == "removed" else None
    if ignored is None and truth.regions is None:
        return counts
    other, distracting, unlabelled = (_by_frame(table) for table in (truth.others, ignored, truth.regions))
    nothing = np.zeros((0, 4))
    for number, rows in _rows_by_frame(frame).items():
        before = [truth.boxes.get(number, nothing), other.get(number, nothing)]
        labelled = np.concatenate([*before, distracting.get(number, nothing)])
        overlap = iou(labelled, box_px[rows])
        overlap[overlap < LEAST - EPSILON] = 0
        i, j = linear_sum_assignment(overlap, maximize=True)
        i, j = i[overlap[i, j] > 0], j[overlap[i, j] > 0]
        counts[rows[j[i >= sum(map(len, before))]]] = False
        rest = np.setdiff1d(rows, rows[j])
        counts[rest[within(box_px[rest], unlabelled.get(number, nothing))]] = False
    return counts


def within(box_px: np.ndarray, region_px: np.ndarray) -> np.ndarray:
    """(N,) bool: whether more than half of the area of each box (N, 4) lies in one of the regions (M, 4)."""
    if not len(region_px) or not len(box_px):
        return np.zeros(len(box_px), bool)
    inside, _ = areas(box_px[:, None], region_px[None])
    share: np.ndarray = inside / np.maximum(np.prod(box_px[:, 2:], axis=1), EPSILON)[:, None]
    return np.asarray((share > WITHIN + EPSILON).any(axis=1))


def _by_frame(table: TrackTable | None) -> dict[int, np.ndarray]:
    return {} if table is None else {n: table.box_px[rows] for n, rows in _rows_by_frame(table.frame).items()}


def _rows_by_frame(frame: np.ndarray) -> dict[int, np.ndarray]:
    order = np.argsort(frame, kind="stable")
    numbers, starts = np.unique(frame[order], return_index=True)
    return dict(zip(numbers.tolist(), np.split(order, starts[1:]), strict=True)) if len(frame) else {}
