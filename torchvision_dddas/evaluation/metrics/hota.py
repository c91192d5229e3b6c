"""HOTA: detection and association weighed evenly, averaged over how well boxes must fit."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.evaluation.metrics.matching import EPSILON, Paired

ALPHA = np.arange(0.05, 0.99, 0.05)
"""The nineteen IoUs from which a box counts as found; the same numbers to the last bit as TrackEval's."""

_NONE = np.zeros(len(ALPHA))


class Hota(NamedTuple):
    """Sums that may be added over clips, each (19,): one a value of ALPHA.

    tp, fn, fp: boxes found, missed, false. association, recall, precision: sums over the boxes found of how well the
    two identities go together over the whole clip. overlap: sum of the IoU of the boxes found.
    """

    tp: np.ndarray = _NONE
    fn: np.ndarray = _NONE
    fp: np.ndarray = _NONE
    association: np.ndarray = _NONE
    recall: np.ndarray = _NONE
    precision: np.ndarray = _NONE
    overlap: np.ndarray = _NONE

    def plus(self, other: "Hota") -> "Hota":
        """The sums of both."""
        return Hota(*(a + b for a, b in zip(self, other, strict=True)))


def count(clip: Paired) -> Hota:
    """Match each frame's boxes by IoU times how well their identities go together over the clip.

    Source: Luiten et al., 2021, with TrackEval's matching, which is the same for every alpha.
    """
    true_boxes, found_boxes = clip.true_boxes[:, None], clip.found_boxes[None]
    likely = np.zeros((len(clip.true_boxes), len(clip.found_boxes)))
    for true, found, score in clip.frames:
        rivals = score.sum(axis=0)[None] + score.sum(axis=1)[:, None] - score
        likely[true[:, None], found[None]] += np.divide(score, rivals, out=np.zeros_like(score), where=rivals > EPSILON)
    likely = likely / (true_boxes + found_boxes - likely)

    together = np.zeros((len(ALPHA), *likely.shape))
    overlap = np.zeros(len(ALPHA))
    for true, found, score in clip.frames:
        i, j = linear_sum_assignment(likely[true[:, None], found[None]] * score, maximize=True)
        fits = score[i, j] >= ALPHA[:, None] - EPSILON
        together[:, true[i], found[j]] += fits
        overlap += fits @ score[i, j]
    tp = together.sum(axis=(1, 2))
    return Hota(
        tp=tp,
        fn=clip.true_boxes.sum() - tp,
        fp=clip.found_boxes.sum() - tp,
        association=(together**2 / (true_boxes + found_boxes - together)).sum(axis=(1, 2)),
        recall=(together**2 / true_boxes).sum(axis=(1, 2)),
        precision=(together**2 / found_boxes).sum(axis=(1, 2)),
        overlap=overlap,
    )


def curves(sums: Hota) -> dict[str, np.ndarray]:
    """Each measure (19,) over ALPHA. LocA is 1 where nothing is found, as in TrackEval; all are NaN without truth."""
    tp, fn, fp, association, recall, precision, overlap = sums
    known = np.where(tp + fn > 0, 1.0, np.nan)
    some = np.maximum(tp, 1)
    detection = tp / np.maximum(tp + fn + fp, 1)
    return {
        "hota": known * np.sqrt(detection * association / some),
        "deta": known * detection,
        "assa": known * association / some,
        "loca": known * np.where(tp > 0, overlap / some, 1.0),
        "detre": known * tp / np.maximum(tp + fn, 1),
        "detpr": known * tp / np.maximum(tp + fp, 1),
        "assre": known * recall / some,
        "asspr": known * precision / some,
    }


def measures(sums: Hota) -> dict[str, float]:
    """HOTA, its parts DetA and AssA, LocA, and recall and precision of both parts: means over ALPHA."""
    return {name: float(curve.mean()) for name, curve in curves(sums).items()}
