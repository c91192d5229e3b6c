"""Score how likely tracklets are targets, and choose the targets.

`python eval/tracklets.py` learns the weights of the logistic scores, and prints their results on kinds of clips that
were left out of the learning.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from torchvision_dddas.detection.candidates import LEVELS, Candidates, overlaps, weigh
from torchvision_dddas.detection.tracklets import Tracklets
from torchvision_dddas.geometry import shared_px

TRACKLET_WEIGHTS = {
    "own": 0.277,
    "mean": 0.928,
    "travel_px": 0.686,
    "sureness": -0.307,
    "stays": -0.853,
    "growth_y": -0.898,
    "slender": 1.011,
    "constant": -1.369,
}
"""Weights of the features that `describe_tracklets` computes."""


class Worth(NamedTuple):
    """Bonus of a blob on the score of its tracklet, because a blob has strong evidence in one piece.

    wide: bonus of a blob at least as wide as the closing that made it. narrow: bonus of a less wide blob. The box of a
    narrow blob is too wide, so it becomes a target only if no other candidate is there. hits: number of the seven looks
    that must show a blob.
    """

    wide: float
    narrow: float
    hits: int = 2


BLOB = Worth(2.5, 3.0)
"""The bonus without telemetry, chosen by `python eval/tracklets.py learn DATA --blob 1 2 3`."""
BLOB_SIZED = Worth(4.0, 4.0, hits=4)
"""The bonus with telemetry, which shows whether a blob has the size and the speed of a target."""
BLOB_TINY = Worth(9.0, 9.0, hits=4)
"""The bonus if people are tiny. It outweighs nearly every score, because the scores are learned on larger people."""

_LEAST_HITS, _LEAST_TRAVEL_PX = 2, 1.0
_SCORE_BOUNDS = (-8.0, 6.0)
# If two boxes share more than _COVERED of the smaller box, only one is chosen. Boxes with an IoU above _SAME show the
# same target.
_COVERED, _SAME = 0.3, 0.5
# A blob that joins several targets has background between them: there its mean evidence, noise units, is below this.
_BACKGROUND = 1.8
# A candidate is a part of a blob if the share _INSIDE of it lies in the blob and it is smaller than _PART of the blob.
_INSIDE, _PART = 0.8, 0.6


def describe_tracklets(
    candidates: Candidates, tracklets: Tracklets, others: Mapping[int, Candidates]
) -> dict[str, np.ndarray]:
    """Return the features of tracklets, (N,) each, by their names in TRACKLET_WEIGHTS.

    others: the candidates of the other looks of the tracklets, by offset.
    """
    own = np.clip(candidates.score, *_SCORE_BOUNDS)
    total, count = own.copy(), np.ones(len(own))
    for offset, index in tracklets.members.items():
        if len(others[offset]):
            found = index >= 0
            total += np.where(found, np.clip(others[offset].score, *_SCORE_BOUNDS)[np.maximum(index, 0)], 0)
            count += found
    return {
        "own": own,
        "mean": total / count,
        "travel_px": np.log1p(tracklets.travel_px),
        "sureness": np.log1p(np.minimum(tracklets.sureness, 100)),
        "stays": tracklets.stays,
        "growth_y": tracklets.growth_y,
        "slender": np.log(candidates.box_px[:, 3] / candidates.box_px[:, 2]),
    }


def score_tracklets(
    candidates: Candidates,
    tracklets: Tracklets,
    others: Mapping[int, Candidates],
    weights: Mapping[str, float] = TRACKLET_WEIGHTS,
    hits: int = BLOB.hits,
) -> np.ndarray:
    """Return (N,) log odds that tracklets are targets.

    others: the candidates of the other looks of the tracklets, by offset. hits: looks that must show a blob; other
    candidates need two. Tracklets with fewer hits, and tracklets that do not travel, are flicker: their score is -inf.
    """
    scores = weigh(describe_tracklets(candidates, tracklets, others), weights)
    if others:
        least = np.minimum(np.where(candidates.silhouette < 0, hits, _LEAST_HITS), 1 + len(others))
        scores[(tracklets.hits < least) | (tracklets.travel_px < _LEAST_TRAVEL_PX)] = -np.inf
    return scores


def choose(
    candidates: Candidates, scores: np.ndarray, accept: float, close_px: float, worth: Worth = BLOB
) -> list[int]:
    """Return the indices of the candidates that are targets, the likeliest first, only one of overlapping candidates.

    scores: (N,) log odds. accept: lowest score of a target. close_px: side of the closing that made the blobs. A blob
    that joins several targets is replaced by them. A wide blob with nearly the same box as a chosen candidate replaces
    that candidate, because the blob has an outline.
    """
    box, is_blob = candidates.box_px, candidates.silhouette < 0
    is_wide = is_blob & (box[:, 2:].min(axis=1, initial=np.inf) >= close_px)
    is_narrow = is_blob & ~is_wide
    rank = scores + np.where(is_wide, worth.wide, np.where(is_narrow, worth.narrow, 0))
    able = rank > accept
    able[[i for i in np.flatnonzero(able & is_blob).tolist() if _is_joined(candidates, scores, i, accept)]] = False
    order = np.lexsort((-rank, is_narrow))
    order = order[able[order]]
    box = box[order]
    chosen = _take_apart(box)
    if not chosen:
        return []
    alike = np.where(is_wide[order], overlaps(box[chosen], box), 0)
    same = np.where(alike.max(axis=1) > _SAME, alike.argmax(axis=1), chosen)
    return list(dict.fromkeys(order[same].tolist()))


def _take_apart(box: np.ndarray) -> list[int]:
    """Return the indices of boxes (N, 4), in order, that overlap no box chosen before by more than _COVERED."""
    area = box[:, 2:].prod(axis=1)
    covers = shared_px(box[:, None], box) > _COVERED * np.minimum(area[:, None], area)
    free, taken = np.ones(len(box), bool), []
    for place in range(len(box)):
        if free[place]:
            taken.append(place)
            free &= ~covers[place]
    return taken


def _is_joined(candidates: Candidates, scores: np.ndarray, blob: int, accept: float) -> bool:
    """Return whether a blob joins targets: accepted candidates lie in it, and the rest of it shows background."""
    box, area = candidates.box_px, candidates.box_px[:, 2:].prod(axis=1)
    lies_inside = shared_px(box[blob], box) > _INSIDE * area
    parts = np.flatnonzero(lies_inside & (area < _PART * area[blob]) & (scores > accept))
    parts = parts[np.argsort(-scores[parts], kind="stable")]
    parts = parts[_take_apart(box[parts])]
    if not len(parts):
        return False
    evidence = candidates.inside[:, :LEVELS] * area[:, None]
    rest = evidence[blob] - evidence[parts].sum(axis=0)
    return bool(rest.max() < _BACKGROUND * max(area[blob] - area[parts].sum(), 1))
