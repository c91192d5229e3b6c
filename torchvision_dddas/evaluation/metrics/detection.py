"""Boxes against true boxes: precision, recall and F1, and what can be said when only one target is labelled."""

from typing import Any, NamedTuple

import cv2
import numpy as np

from torchvision_dddas.evaluation.metrics.segmentation import ratio

LEAST_PX = 40
"""A labelled region of fewer pixels has no true box: it is a sliver at the border or behind something."""


class Boxes(NamedTuple):
    """Boxes matched, found where nothing is, and missed."""

    hit: int = 0
    false: int = 0
    missed: int = 0

    def plus(self, other: "Boxes") -> "Boxes":
        """The counts of both."""
        return Boxes(*(a + b for a, b in zip(self, other, strict=True)))


class OneTarget(NamedTuple):
    """Frames with the one labelled target; those where it is hit, where a box meets it at IoU 0.3; blobs elsewhere."""

    frames: int = 0
    hit: int = 0
    near: int = 0
    other: int = 0

    def plus(self, other: "OneTarget") -> "OneTarget":
        """The counts of both."""
        return OneTarget(*(a + b for a, b in zip(self, other, strict=True)))


def boxes_of(labels: np.ndarray, least_px: int = LEAST_PX) -> np.ndarray:
    """(N, 4) boxes x, y, width, height of the values above 0 that cover at least `least_px` pixels."""
    boxes = []
    for value in np.unique(labels[labels > 0]):
        mine = labels == value
        if np.count_nonzero(mine) >= least_px:
            boxes.append(cv2.boundingRect(mine.astype(np.uint8)))
    return np.array(boxes, float).reshape(-1, 4)


def areas(box_px: Any, other_px: Any) -> tuple[Any, Any]:
    """(...) what two boxes (..., 4) share and what they cover together, px²; broadcast against each other.

    Arrays, or tensors, whose gradients it keeps. The pipeline has a formula of its own, `targets.boxes`: measures share
    no code with what they measure.
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
