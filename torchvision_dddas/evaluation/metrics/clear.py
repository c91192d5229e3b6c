"""The CLEAR measures: boxes found, missed and false over a clip, and switches of identity."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.evaluation.metrics.matching import EPSILON, LEAST, Paired
from torchvision_dddas.evaluation.metrics.segmentation import ratio


class Clear(NamedTuple):
    """Counts that may be added over clips.

    tp, fn, fp: boxes found, missed, false. switches: a target is found under another identity than the last time.
    fragmentations: a target is found again after frames without, also those in which the truth itself has a gap.
    mostly_tracked, partly_tracked, mostly_lost: targets found in over 80 %, in 20 to 80 %, in under 20 % of their
    frames. overlap: sum of the IoU.
    """

    tp: int = 0
    fn: int = 0
    fp: int = 0
    switches: int = 0
    fragmentations: int = 0
    mostly_tracked: int = 0
    partly_tracked: int = 0
    mostly_lost: int = 0
    overlap: float = 0.0

    def plus(self, other: "Clear") -> "Clear":
        """The counts of both."""
        return Clear._make(a + b for a, b in zip(self, other, strict=True))


PER_FRAME = ("tp", "fn", "fp", "switches", "overlap")
"""The counts that are those of single frames."""


def count(clip: Paired, least: float = LEAST) -> Clear:
    """Match each frame's boxes at an IoU of at least `least`: pairs of the frame before are kept, then IoU decides.

    The frame before is the last in which there were both true and found boxes, as TrackEval has it; a switch is seen
    over any gap. Source: Bernardin and Stiefelhagen, 2008, with TrackEval's matching.
    """
    return by_frame(clip, least)[0]


def by_frame(clip: Paired, least: float = LEAST) -> tuple[Clear, np.ndarray]:
    """The same, and (F, 5) what of it each of the clip's frames adds, in the order of PER_FRAME."""
    targets = len(clip.true_boxes)
    last = np.full(targets, -1)  # the identity that each target was last found under, whenever that was
    before = np.full(targets, -1)  # the same, of the frame before alone
    found_boxes, begun = np.zeros(targets, int), np.zeros(targets, int)
    switches, overlap = 0, 0.0
    each = np.zeros((len(clip.frames), len(PER_FRAME)))
    for row, (true, found, score) in zip(each, clip.frames, strict=True):
        row[1:3] = len(true), len(found)
        if len(true) == 0 or len(found) == 0:
            continue
        kept = before[true][:, None] == found[None]
        worth = np.where(score >= least - EPSILON, 1000.0 * kept + score, 0.0)
        i, j = linear_sum_assignment(worth, maximize=True)
        hit = worth[i, j] > EPSILON
        i, j = i[hit], j[hit]
        target, identity = true[i], found[j]
        switched = int(((last[target] >= 0) & (last[target] != identity)).sum())
        switches += switched
        begun[target] += before[target] < 0
        last[target] = identity
        before[:] = -1
        before[target] = identity
        found_boxes[target] += 1
        shared = float(score[i, j].sum())
        overlap += shared
        row[:] = len(i), len(true) - len(i), len(found) - len(i), switched, shared
    share = found_boxes / clip.true_boxes
    mostly, hardly = int((share > 0.8).sum()), int((share < 0.2).sum())
    tp = int(found_boxes.sum())
    whole = Clear(
        tp=tp,
        fn=int(clip.true_boxes.sum()) - tp,
        fp=int(clip.found_boxes.sum()) - tp,
        switches=switches,
        fragmentations=int(np.maximum(begun - 1, 0).sum()),
        mostly_tracked=mostly,
        partly_tracked=targets - mostly - hardly,
        mostly_lost=hardly,
        overlap=overlap,
    )
    return whole, each


def measures(counts: Clear) -> dict[str, float]:
    """MOTA, MOTP (mean IoU of the boxes found), recall, precision, shares of targets mostly tracked and lost.

    NaN where a clip has no true box; 0 where there are some and nothing was found, as in TrackEval.
    """
    true = counts.tp + counts.fn
    targets = counts.mostly_tracked + counts.partly_tracked + counts.mostly_lost
    return {
        "mota": ratio(counts.tp - counts.fp - counts.switches, true),
        "motp": ratio(counts.overlap, max(counts.tp, min(1, true))),
        "recall": ratio(counts.tp, true),
        "precision": ratio(counts.tp, max(counts.tp + counts.fp, min(1, true))),
        "mostly_tracked": ratio(counts.mostly_tracked, targets),
        "mostly_lost": ratio(counts.mostly_lost, targets),
    }
