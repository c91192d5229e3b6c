"""Measures of boxes: precision, recall and F1; average precision and miss rate of ranked detections."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.lab.evaluation.metrics.pixels import ratio

LEAST_PX = 40
"""A labelled region of fewer pixels has no true box: it is a sliver at the border or behind an object."""


class BoxCounts(NamedTuple):
    """Numbers of matched boxes, of found boxes without a target, and of missed boxes."""

    hit: int = 0
    false: int = 0
    missed: int = 0


class OneTarget(NamedTuple):
    """Frames with the one labelled target, frames with a hit, frames with a box at IoU 0.3, and blobs elsewhere."""

    frames: int = 0
    hit: int = 0
    near: int = 0
    other: int = 0


def boxes_of(labels: np.ndarray, least_px: int = LEAST_PX) -> np.ndarray:
    """Return (N, 4) boxes x, y, width, height of the values above 0 that cover at least `least_px` pixels."""
    boxes = []
    for value in np.unique(labels[labels > 0]):
        mine = labels == value
        if np.count_nonzero(mine) >= least_px:
            boxes.append(cv2.boundingRect(mine.astype(np.uint8)))
    return np.array(boxes, float).reshape(-1, 4)


def areas(box_px: np.ndarray, other_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the area of the intersection and of the union of boxes (..., 4), px²; the arrays broadcast.

    The pipeline has its own formula: measures share no code with it.
    """
    low = box_px[..., :2].clip(min=other_px[..., :2])
    high = (box_px[..., :2] + box_px[..., 2:]).clip(max=other_px[..., :2] + other_px[..., 2:])
    common = (high - low).clip(min=0).prod(-1)
    return common, box_px[..., 2:].prod(-1) + other_px[..., 2:].prod(-1) - common


def iou(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the intersection over union, (N, M), of boxes (N, 4) and (M, 4), x, y, width, height."""
    common, union = areas(boxes[:, None], others[None])
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


def match(found: np.ndarray, truth: np.ndarray, least: float = 0.5) -> BoxCounts:
    """Match boxes: each true box in turn takes its best remaining detection, if their IoU reaches `least`."""
    scores, hits = iou(truth, found), 0
    for i in range(len(truth)):
        j = int(np.argmax(scores[i])) if len(found) else -1
        if j >= 0 and scores[i, j] >= least:
            hits += 1
            scores[:, j] = -1
    return BoxCounts(hits, len(found) - hits, len(truth) - hits)


def measures(boxes: BoxCounts) -> dict[str, float]:
    """Return precision, recall and F1; NaN for 0/0."""
    hit, false, missed = boxes
    return {
        "precision": ratio(hit, hit + false),
        "recall": ratio(hit, hit + missed),
        "f1": ratio(2 * hit, 2 * hit + false + missed),
    }


def one_target(mask: np.ndarray, found: np.ndarray, target: np.ndarray) -> OneTarget:
    """Count one frame of a clip with one labelled target (4,); other movers have no label. A NaN box: no target.

    A hit has foreground in over a tenth of the box. A blob with IoU below 0.05 to the box is elsewhere.
    """
    if np.isnan(target).any():
        return OneTarget()
    x, y, w, h = (round(float(v)) for v in target)
    inside = mask[max(y, 0) : max(y + h, 0), max(x, 0) : max(x + w, 0)] > 0
    scores = iou(found, target[None])[:, 0]
    hit = bool(inside.size) and float(inside.mean()) > 0.1
    return OneTarget(1, int(hit), int((scores >= 0.3).any()), int((scores < 0.05).sum()))


def one_target_measures(counts: OneTarget) -> dict[str, float]:
    """Return shares of frames, and other blobs for each frame."""
    frames, hit, near, other = counts
    return {"hit": ratio(hit, frames), "iou_0.3": ratio(near, frames), "other_blobs_per_frame": ratio(other, frames)}


SAME = 0.5
"""IoU from which a detection is right."""

RATES = np.logspace(-2, 0, 9)
"""Numbers of false positives for each image over which the miss rate is averaged: nine, logarithmic from 0.01 to 1."""

LEAST_MISS = 1e-10
"""Smallest miss rate in the mean of logarithms, because the logarithm of 0 is not finite."""


def judged(found: np.ndarray, score: np.ndarray, truth: np.ndarray, least: float = SAME) -> np.ndarray:
    """Return 1.0 for right detections of one image and 0.0 for others, (N,). Each true box takes at most one.

    By falling score, each detection takes the best of the remaining true boxes; of equal scores the better fit is
    first. found: (N, 4), score: (N,), truth: (M, 4), x, y, width, height.
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
    """Right and false detections (K,) with at least each score (K,). Scores fall."""

    score: np.ndarray
    right: np.ndarray
    false: np.ndarray


@dataclass(frozen=True)
class Ranking:
    """Detections of many images or clips, to be pooled with any weights.

    right: (M,) 1 or 0, best score first. unit: (M,) int64, the image or clip of each detection. ends: (K,) the last row
    of each score, because detections of one score are counted together. score: (K,). true, images: (U,) true boxes and
    images of each unit.
    """

    right: np.ndarray
    unit: np.ndarray
    ends: np.ndarray
    score: np.ndarray
    true: np.ndarray
    images: np.ndarray

    def curve(self, weight: np.ndarray | None = None) -> Curve:
        """Return the curve. weight: (U,) how often each unit counts; by default once."""
        if not len(self.right):
            return Curve(*np.zeros((3, 0)))
        of_each = np.ones(len(self.right)) if weight is None else weight[self.unit]
        right = np.cumsum(of_each * self.right)[self.ends]
        return Curve(self.score, right, np.cumsum(of_each)[self.ends] - right)

    def measures(self, weight: np.ndarray | None = None) -> dict[str, float]:
        """Return AP, log-average miss rate, and the miss rate at 0.1 and at 1 false positives for each image.

        AP is the area under the precision-recall curve, where the precision at a recall is the best precision at this
        recall or above; 0 if nothing right is found. The miss rate is the share of true boxes that are missed with at
        most this number of false positives; its geometric mean is over RATES. NaN without a true box. Source: PASCAL
        VOC from 2010 on; Dollár et al., 2012.
        """
        once = np.ones(len(self.true)) if weight is None else weight
        true, images = float(once @ self.true), float(once @ self.images)
        curve = self.curve(weight)
        area = math.nan
        if true:
            precision, recall = precision_recall(curve, true)
            best = np.maximum.accumulate(np.nan_to_num(precision)[::-1])[::-1]
            area = float(np.diff(recall, prepend=0.0) @ best)
        misses = np.full(len(RATES) + 2, np.nan)
        if true and images:
            found = [curve.right[curve.false <= rate * images].max(initial=0.0) for rate in (*RATES, 0.1, 1.0)]
            misses = 1.0 - np.array(found) / true
        return {
            "ap": area,
            "log_average_miss_rate": float(np.exp(np.mean(np.log(np.maximum(misses[:-2], LEAST_MISS))))),
            "miss_rate_at_0.1": float(misses[-2]),
            "miss_rate_at_1": float(misses[-1]),
        }


def ranking(
    score: np.ndarray, right: np.ndarray, unit: np.ndarray, true: np.ndarray, images: np.ndarray | None = None
) -> Ranking:
    """Rank detections (M,). right: 1, 0, or NaN for detections that do not count. true, images: (U,) of each unit.

    images: by default 1 for each unit.
    """
    known = ~np.isnan(right)
    score, right, unit = score[known], right[known], unit[known]
    order = np.argsort(-score, kind="stable")
    score, right, unit = score[order], right[order], unit[order].astype(np.int64)
    ends = np.flatnonzero(np.append(score[1:] != score[:-1], True)[: len(score)])
    return Ranking(right, unit, ends, score[ends], true, np.ones(len(true)) if images is None else images)


def precision_recall(curve: Curve, true: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (K,) precision and (K,) recall over the thresholds; NaN for 0/0."""
    found = curve.right + curve.false
    precision = np.divide(curve.right, found, out=np.full_like(found, np.nan), where=found > 0)
    return precision, curve.right / true if true else np.full_like(found, np.nan)
