"""Whose each detection is: the true target that it shows, or nobody's."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.evaluation.metrics.matching import EPSILON, LEAST, TrackTable, pair
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.types import DetectionTable


class Owned(NamedTuple):
    """Boxes by who they are of, ordered by frame. table: identities, (N,) below 0 for a false alarm, each another.

    score: (N,), 1 for one that is certain. size: (width, height) that holds nearly all, None where too few tell.
    own: whether they are of moving targets that were found in the clip.
    """

    table: TrackTable
    score: np.ndarray
    size: tuple[float, float] | None = None
    own: bool = False


def owned(found: DetectionTable, truth: Truth, interval: int, min_score: float) -> Owned:
    """The detections of frames 1, 1 + interval, ... that count, matched in each frame as the measures match: IoU ≥ 0.5.

    min_score: of those that count, where scores are probabilities. Who does not count for the measures is nevertheless
    somebody to the tracker, and owns boxes as well. Raises InputError if an identity stands twice in a frame.
    """
    score = np.ones(len(found)) if found.certain else found.score
    rows = np.flatnonzero(((found.frame - 1) % interval == 0) & (score >= min_score))
    boxes = TrackTable(found.frame[rows], np.arange(len(rows)), found.box_px[rows])
    identity = -1 - np.arange(len(rows))
    everybody = _everybody(truth).every(interval)
    named = np.unique(everybody.identity)
    for true, here, overlap in pair(everybody, boxes).frames:
        overlap = np.where(overlap >= LEAST - EPSILON, overlap, 0)
        i, j = linear_sum_assignment(overlap, maximize=True)
        sure = overlap[i, j] > 0
        identity[here[j[sure]]] = named[true[i[sure]]]
    return Owned(boxes._replace(identity=identity), score[rows], found.extent, found.own)


def _everybody(truth: Truth) -> TrackTable:
    """The tracks, and where found boxes on others are taken out, those of the others; their numbers are not shared."""
    assert truth.tracks is not None, "asked for where there is truth"
    more = [t for t in (truth.ignored, truth.others) if t is not None] if truth.ignoring == "removed" else []
    parts = [truth.tracks, *more]
    first, columns = 0, []
    for part in parts:
        _, number = np.unique(part.identity, return_inverse=True)
        columns.append(part._replace(identity=number + first))
        first += int(number.max(initial=-1)) + 1
    frame, identity, box_px = (np.concatenate(values) for values in zip(*columns, strict=True))
    return TrackTable(frame, identity, np.asarray(box_px, float))
