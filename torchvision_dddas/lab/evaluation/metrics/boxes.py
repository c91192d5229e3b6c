"""Measures of boxes: precision, recall and F1; average precision and miss rate of ranked detections."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.lab.evaluation.metrics.pixels import ratio

LEAST_PX = 40
"""A labelled region of fewer pixels has no true box: it is a sliver at the border or behind something."""


class Boxes(NamedTuple):
    """Boxes matched, found where nothing is, and missed."""

    hit: int = 0
    false: int = 0
    missed: int = 0


class OneTarget(NamedTuple):
    """Frames with the one labelled target; those where it is hit, where a box meets it at IoU 0.3; blobs elsewhere."""

    frames: int = 0
    hit: int = 0
    near: int = 0
    other: int = 0


def boxes_of(labels: np.ndarray, least_px: int = LEAST_PX) -> np.ndarray:
    """(N, 4) boxes x, y, width, height of the values above 0 that cover at least `least_px` pixels."""
    boxes = []
    for value in np.unique(labels[labels > 0]):
        mine = labels == value
        if np.count_nonzero(mine) >= least_px:
            boxes.append(cv2.boundingRect(mine.astype(np.uint8)))
    return np.array(boxes, float).reshape(-1, 4)


def areas(box_px: np.ndarray, other_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(...) what two boxes (..., 4) share and what they cover together, px²; broadcast against each other.

    The pipeline has its own formula: measures share no code with it.
    """
    low = box_px[..., :2].clip(min=other_px[..., :2])
    high = (box_px[..., :2] + box_px[..., 2:]).clip(max=other_px[..., :2] + other_px[..., 2:])
    common = (high - low).clip(min=0).prod(-1)
    return common, box_px[..., 2:].prod(-1) + other_px[..., 2:].prod(-1) - common


def iou(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(N, M) intersection over union of boxes (N, 4) and (M, 4), x, y, width, height."""
    common, union = areas(boxes[:, None], others[None])
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


def match(found: np.ndarray, truth: np.ndarray, least: float = 0.5) -> Boxes:
    """Each true box in turn takes its best remaining detection, if that reaches `least`."""
    scores, hits = iou(truth, found), 0
    for i in range(len(truth)):
        j = int(np.argmax(scores[i])) if len(found) else -1
        if j >= 0 and scores[i, j] >= least:
            hits += 1
            scores[:, j] = -1
    return Boxes(hits, len(found) - hits, len(truth) - hits)


def measures(boxes: Boxes) -> dict[str, float]:
    """Precision, recall and F1; NaN for 0/0."""
    hit, false, missed = boxes
    return {
        "precision": ratio(hit, hit + false),
        "recall": ratio(hit, hit + missed),
        "f1": ratio(2 * hit, 2 * hit + false + missed),
    }


def one_target(mask: np.ndarray, found: np.ndarray, target: np.ndarray) -> OneTarget:
    """One frame of a clip with one labelled target (4,), other movers unlabelled; a NaN box is a frame without it.

    Hit: over a tenth of the box is foreground. A blob is elsewhere if its box meets the target's at IoU below 0.05.
    """
    if np.isnan(target).any():
        return OneTarget()
    x, y, w, h = (round(float(v)) for v in target)
    inside = mask[max(y, 0) : max(y + h, 0), max(x, 0) : max(x + w, 0)] > 0
    scores = iou(found, target[None])[:, 0]
    hit = bool(inside.size) and float(inside.mean()) > 0.1
    return OneTarget(1, int(hit), int((scores >= 0.3).any()), int((scores < 0.05).sum()))


def one_target_measures(counts: OneTarget) -> dict[str, float]:
    """Shares of frames, and other blobs a frame."""
    frames, hit, near, other = counts
    return {"hit": ratio(hit, frames), "iou_0.3": ratio(near, frames), "other_blobs_per_frame": ratio(other, frames)}


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
    """Right and false detections (K,) of at least each score (K,), which falls."""

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
        """weight: (U,) how often each unit counts; by default once."""
        if not len(self.right):
            return Curve(*np.zeros((3, 0)))
        of_each = np.ones(len(self.right)) if weight is None else weight[self.unit]
        right = np.cumsum(of_each * self.right)[self.ends]
        return Curve(self.score, right, np.cumsum(of_each)[self.ends] - right)

    def measures(self, weight: np.ndarray | None = None) -> dict[str, float]:
        """AP, log-average miss rate, and the miss rate at 0.1 and at 1 false positives an image.

        AP: the area under the precision-recall curve, in which the precision at a recall is the best one at that recall
        or above; 0 if nothing right is found. Miss rate: the share of true boxes missed with at most so many false
        positives; its geometric mean is over RATES. NaN without a true box. Source: PASCAL VOC from 2010 on; Dollár et
        al., 2012.
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
    """Rank (M,) detections. right: 1, 0, or NaN for what does not count. true, images: (U,) of each unit.

    images: 1 each by default.
    """
    known = ~np.isnan(right)
    score, right, unit = score[known], right[known], unit[known]
    order = np.argsort(-score, kind="stable")
    score, right, unit = score[order], right[order], unit[order].astype(np.int64)
    ends = np.flatnonzero(np.append(score[1:] != score[:-1], True)[: len(score)])
    return Ranking(right, unit, ends, score[ends], true, np.ones(len(true)) if images is None else images)


def precision_recall(curve: Curve, true: float) -> tuple[np.ndarray, np.ndarray]:
    """(K,) precision and (K,) recall over the thresholds; NaN for 0/0."""
    found = curve.right + curve.false
    precision = np.divide(curve.right, found, out=np.full_like(found, np.nan), where=found > 0)
    return precision, curve.right / true if true else np.full_like(found, np.nan)
