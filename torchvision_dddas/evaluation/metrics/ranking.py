"""Detections ranked by their score: average precision, and the miss rate at so many false positives an image."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchvision_dddas.evaluation.metrics.detection import iou
from torchvision_dddas.evaluation.metrics.segmentation import ratio

SAME = 0.5
"""IoU from which a detection is right."""

RATES = np.logspace(-2, 0, 9)
"""False positives an image over which the miss rate is averaged: nine, evenly in the logarithm from 0.01 to 1."""

LEAST_MISS = 1e-10
"""So small a miss rate stands for none: the logarithm of 0 is no number."""


def judged(found: np.ndarray, score: np.ndarray, truth: np.ndarray, least: float = SAME) -> np.ndarray:
    """(N,) 1.0 for detections that are right, 0.0 for others, in one image; each true box takes at most one.

    The best score first takes the true box that it fits best of those left; of equal scores the better fit is first.
    found: (N, 4), score: (N,), truth: (M, 4), x, y, width, height.
    """
    right = np.zeros(len(found))
    if len(found) and len(truth):
        overlap = iou(found, truth)
        for i in np.lexsort([-overlap.max(axis=1), -score]):
            j = int(np.argmax(overlap[i]))
            if overlap[i, j] >= least:
                right[i] = 1.0
                overlap[:, j] = -1
    return right


class Curve(NamedTuple):
    """Over all thresholds of the score, falling. score: (K,). right, false: (K,) detections at or above it."""

    score: np.ndarray
    right: np.ndarray
    false: np.ndarray


@dataclass(frozen=True)
class Ranking:
    """Detections of many images or clips, to be pooled with any weights.

    right: (M,) 1 or 0, best score first. unit: (M,) int64, which image or clip each is of. ends: (K,) the last row of
    each score, for detections of one score come together. score: (K,). true, images: (U,) true boxes and images of each
    unit.
    """

    right: np.ndarray
    unit: np.ndarray
    ends: np.ndarray
    score: np.ndarray
    true: np.ndarray
    images: np.ndarray

    def curve(self, weight: np.ndarray | None = None) -> Curve:
        """weight: (U,) how often each unit counts; once if not said."""
        if not len(self.right):
            return Curve(*np.zeros((3, 0)))
        of_each = np.ones(len(self.right)) if weight is None else weight[self.unit]
        right = np.cumsum(of_each * self.right)[self.ends]
        return Curve(self.score, right, np.cumsum(of_each)[self.ends] - right)

    def measures(self, weight: np.ndarray | None = None) -> dict[str, float]:
        """AP, log-average miss rate, and the miss rate at 0.1 and at 1 false positives an image."""
        once = np.ones(len(self.true)) if weight is None else weight
        true, images = float(once @ self.true), float(once @ self.images)
        curve = self.curve(weight)
        return {
            "ap": average_precision(curve, true),
            "log_average_miss_rate": log_average_miss_rate(curve, true, images),
            "miss_rate_at_0.1": miss_rate(curve, true, images, 0.1),
            "miss_rate_at_1": miss_rate(curve, true, images, 1.0),
        }


def ranking(
    score: np.ndarray, right: np.ndarray, unit: np.ndarray, true: np.ndarray, images: np.ndarray | None = None
) -> Ranking:
    """Rank (M,) detections. right: 1, 0, or NaN for what does not count. true, images: (U,) of each unit.

    images: 1 each if not said.
    """
    known = ~np.isnan(right)
    score, right, unit = score[known], right[known], unit[known]
    order = np.argsort(-score, kind="stable")
    score, right, unit = score[order], right[order], unit[order]
    ends = np.flatnonzero(np.append(score[1:] != score[:-1], True)[: len(score)])
    return Ranking(
        right, unit.astype(np.int64), ends, score[ends], true, np.ones(len(true)) if images is None else images
    )


def precision_recall(curve: Curve, true: float) -> tuple[np.ndarray, np.ndarray]:
    """(K,) precision and (K,) recall over the thresholds; NaN for 0/0."""
    found = curve.right + curve.false
    precision = np.divide(curve.right, found, out=np.full_like(found, np.nan), where=found > 0)
    return precision, curve.right / true if true else np.full_like(found, np.nan)


def average_precision(curve: Curve, true: float) -> float:
    """The area under the precision-recall curve, made to fall; NaN without a true box, 0 if nothing right is found.

    The precision at a recall is the best one at that recall or above. Source: PASCAL VOC from 2010 on.
    """
    if not true:
        return float("nan")
    precision, recall = precision_recall(curve, true)
    best = np.maximum.accumulate(np.nan_to_num(precision)[::-1])[::-1]
    return float(np.diff(recall, prepend=0.0) @ best)


def miss_rate(curve: Curve, true: float, images: float, false: float) -> float:
    """Share of true boxes missed with at most so many false positives an image; NaN without true boxes or images."""
    if not true or not images:
        return float("nan")
    within = curve.false <= false * images
    return 1.0 - ratio(float(curve.right[within].max(initial=0.0)), true)


def log_average_miss_rate(curve: Curve, true: float, images: float) -> float:
    """The geometric mean of the miss rate over RATES. Source: Dollar et al., 2012."""
    misses = np.array([miss_rate(curve, true, images, rate) for rate in RATES])
    return float(np.exp(np.mean(np.log(np.maximum(misses, LEAST_MISS)))))
