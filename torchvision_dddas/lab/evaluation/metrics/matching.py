"""Match true and found boxes frame by frame, and choose the found boxes that count neither as right nor as false."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.metrics.boxes import areas, iou
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth, Ignoring, TrackTable, rows_by_frame

LEAST = 0.5
"""IoU from which a box counts as found."""

WITHIN = 0.5
"""A found box lies in a region that covers more than this share of its area."""

EPSILON = float(np.finfo(float).eps)


class FramePair(NamedTuple):
    """One frame: identities of its true (n,) and found (m,) boxes, counted from 0, and their IoU (n, m)."""

    true: np.ndarray
    found: np.ndarray
    overlap: np.ndarray


class Paired(NamedTuple):
    """The frames of a clip with any box, in order, and the number of boxes of each true and each found identity.

    numbers: numbers of the frames.
    """

    numbers: np.ndarray
    frames: list[FramePair]
    true_boxes: np.ndarray
    found_boxes: np.ndarray


def pair(
    truth: TrackTable, found: TrackTable, ignored: TrackTable | None = None, ignoring: Ignoring = "dropped"
) -> Paired:
    """Pair a clip's true and found boxes by frame. All tracking measures start here.

    ignored: true boxes that do not count. "dropped": treat them as unlabelled, so that a found box on one is false, as
    TrackEval does for MOT15. "removed": remove a found box whose best match (IoU ≥ 0.5, among all true boxes) is one of
    them, as TrackEval does for the distractors of later benchmarks. Frames without any box change no measure. Raise
    InputError if an identity has two boxes in a frame.
    """
    for table, what in ((truth, "truth"), (found, "result")):
        both, counts = np.unique(np.stack([table.frame, table.identity], axis=1), axis=0, return_counts=True)
        if (counts > 1).any():
            frame, identity = both[counts > 1][0]
            raise InputError(
                f"the {what} has identity {identity} twice in frame {frame}; an identity has one box a frame"
            )
    if ignoring == "removed" and ignored is not None and len(ignored.frame):
        on_ignored, _ = _match_labels(found.frame, found.box_px, [truth.boxes_by_frame()], ignored.boxes_by_frame())
        found = found.at(~on_ignored)
    _, true_id, true_boxes = np.unique(truth.identity, return_inverse=True, return_counts=True)
    _, found_id, found_boxes = np.unique(found.identity, return_inverse=True, return_counts=True)
    true_rows, found_rows, nothing = rows_by_frame(truth.frame), rows_by_frame(found.frame), np.zeros(0, np.int64)
    frames, numbers = [], np.union1d(truth.frame, found.frame)
    for number in numbers.tolist():
        i, j = true_rows.get(number, nothing), found_rows.get(number, nothing)
        frames.append(FramePair(true_id[i], found_id[j], iou(truth.box_px[i], found.box_px[j])))
    return Paired(numbers, frames, true_boxes, found_boxes)


def match(overlap: np.ndarray, least: float = LEAST) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of an IoU matrix (n, m) that match one to one at `least` or more, for the largest sum."""
    worth = np.where(overlap >= least - EPSILON, overlap, 0.0)
    i, j = linear_sum_assignment(worth, maximize=True)
    hit = worth[i, j] > 0
    return i[hit], j[hit]


def counted(truth: ClipTruth, frame: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """Return whether each found box counts, (N,) bool. frame: (N,), box_px: (N, 4), in any order.

    A box does not count if its best match (IoU ≥ 0.5, among all labelled boxes of the frame, also `others`) is an
    ignored box and `truth.ignoring` is "removed". A box without a match does not count if more than half of its area
    lies in a region. TrackEval does so for MOTChallenge from 2016 on and for KITTI.
    """
    ignored = truth.ignored if truth.ignoring == "removed" else None
    if ignored is None and truth.regions is None:
        return np.ones(len(frame), bool)
    others, distracting, unlabelled = (
        {} if table is None else table.boxes_by_frame() for table in (truth.others, ignored, truth.regions)
    )
    on_ignored, matched = _match_labels(frame, box_px, [truth.boxes, others], distracting)
    counts = ~on_ignored
    for number, rows in rows_by_frame(frame).items():
        if number in unlabelled:
            rest = rows[~matched[rows]]
            counts[rest[lie_within(box_px[rest], unlabelled[number])]] = False
    return counts


def lie_within(box_px: np.ndarray, region_px: np.ndarray) -> np.ndarray:
    """Return (N,) bool, whether one of the regions (M, 4) covers more than half of the area of each box (N, 4)."""
    if not len(region_px) or not len(box_px):
        return np.zeros(len(box_px), bool)
    inside, _ = areas(box_px[:, None], region_px[None])
    share: np.ndarray = inside / np.maximum(np.prod(box_px[:, 2:], axis=1), EPSILON)[:, None]
    return np.asarray((share > WITHIN + EPSILON).any(axis=1))


def _match_labels(
    frame: np.ndarray,
    box_px: np.ndarray,
    counting: Sequence[Mapping[int, np.ndarray]],
    ignored: Mapping[int, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return which found boxes match an ignored label, and which match any, (M,) bool. Labels: (n, 4) by frame."""
    on_ignored, matched, nothing = np.zeros(len(frame), bool), np.zeros(len(frame), bool), np.zeros((0, 4))
    for number, rows in rows_by_frame(frame).items():
        labelled = [boxes.get(number, nothing) for boxes in (*counting, ignored)]
        i, j = match(iou(np.concatenate(labelled), box_px[rows]))
        matched[rows[j]] = True
        on_ignored[rows[j]] = i >= sum(map(len, labelled[:-1]))
    return on_ignored, matched
