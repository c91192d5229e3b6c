"""The identity measures: how many boxes carry the right identity under the best one-to-one naming of a whole clip."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.evaluation.metrics.matching import LEAST, Paired
from torchvision_dddas.evaluation.metrics.segmentation import ratio


class Identity(NamedTuple):
    """Boxes with the right identity, true boxes without it, found boxes without it."""

    idtp: int = 0
    idfn: int = 0
    idfp: int = 0

    def plus(self, other: "Identity") -> "Identity":
        """The counts of both."""
        return Identity(*(a + b for a, b in zip(self, other, strict=True)))


def count(clip: Paired, least: float = LEAST) -> Identity:
    """Name found identities after targets so that most boxes agree (IoU of at least `least`).

    Maximising the agreeing boxes is the same as minimising false and missing ones, since each pair that agrees takes
    one off both. Source: Ristani et al., 2016.
    """
    together = np.zeros((len(clip.true_boxes), len(clip.found_boxes)))
    for true, found, score in clip.frames:
        i, j = np.nonzero(score >= least)
        together[true[i], found[j]] += 1
    right = int(together[linear_sum_assignment(together, maximize=True)].sum())
    return Identity(right, int(clip.true_boxes.sum()) - right, int(clip.found_boxes.sum()) - right)


def measures(counts: Identity) -> dict[str, float]:
    """IDF1, IDP and IDR. NaN where a clip has no true box; 0 where there are some and nothing was found."""
    idtp, idfn, idfp = counts
    true = idtp + idfn
    return {
        "idf1": ratio(2 * idtp, 2 * idtp + idfn + idfp) if true else float("nan"),
        "idp": ratio(idtp, max(idtp + idfp, min(1, true))),
        "idr": ratio(idtp, true),
    }
