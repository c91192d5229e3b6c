"""How likely candidates and their tracklets are targets, and the targets that follow: two logistic scores.

The weights are learned by `python eval/tracklets.py`, which prints what they give on kinds of clips that were left out.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from torchvision_dddas.detection.candidates import Candidates, overlaps, weigh
from torchvision_dddas.detection.tracklets import Tracklets
from torchvision_dddas.geometry import shared_px

TRACKLET_WEIGHTS = {
    "own": 0.246,
    "mean": 0.971,
    "hits": 0.094,
    "travel_px": 0.336,
    "sureness": -0.286,
    "travel": 0.698,
    "stays": -1.658,
    "growth_x": 0.153,
    "growth_y": -1.393,
    "slender": 0.876,
    "constant": -0.826,
}
"""Weights of what a tracklet shows, see `describe_tracklets`."""

PERSISTENT, PERSISTENT_SIZED = 3.0, 4.0
"""What a blob that persists, by its links and its flow, has beyond the score of its tracklet.

The second value holds where telemetry shows that the blob has the size and the speed of a target. The first value is
chosen by `python eval/tracklets.py learn DATA --persistent 2 3 4`, the second so that faint simulated targets stay.
"""

_LEAST_HITS, _LEAST_TRAVEL_PX = 2, 1.0
_SCORE_BOUNDS = (-8.0, 6.0)
# Of two boxes that share more than this part of the smaller one, one is chosen; two with a larger IoU are the same.
_COVERED, _SAME = 0.3, 0.5


def describe_tracklets(
    candidates: Candidates, tracklets: Tracklets, others: Mapping[int, Candidates]
) -> dict[str, np.ndarray]:
    """What tracklets show, (N,) each, by the names of TRACKLET_WEIGHTS. others: looks that they cross, by offset."""
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
        "hits": tracklets.hits,
        "travel_px": np.log1p(tracklets.travel_px),
        "sureness": np.log1p(np.minimum(tracklets.sureness, 100)),
        "travel": np.minimum(np.log1p(tracklets.travel), 0.4),
        "stays": tracklets.stays,
        "growth_x": tracklets.growth_x,
        "growth_y": tracklets.growth_y,
        "slender": np.log(candidates.box_px[:, 3] / candidates.box_px[:, 2]),
    }


def score_tracklets(
    candidates: Candidates,
    tracklets: Tracklets,
    others: Mapping[int, Candidates],
    weights: Mapping[str, float] = TRACKLET_WEIGHTS,
) -> np.ndarray:
    """(N,) log odds that tracklets are targets. others: the looks that they cross, by offset.

    What shows in one look alone, though there are others, is none, nor what does not leave its place: they flicker.
    """
    scores = weigh(describe_tracklets(candidates, tracklets, others), weights)
    if others:
        scores[(tracklets.hits < _LEAST_HITS) | (tracklets.travel_px < _LEAST_TRAVEL_PX)] = -np.inf
    return scores


def choose(
    box: np.ndarray,
    scores: np.ndarray,
    persistent: Sequence[bool],
    accept: float,
    joined_px: float,
    worth: float = PERSISTENT,
) -> list[int]:
    """Indices of the candidates whose tracklets are targets, the likeliest first; of those that overlap only one.

    box: (N, 4). scores: (N,) log odds. persistent: of the blobs, which are the first candidates. accept: least score.
    joined_px: a persistent blob whose narrower side is shorter may be several things that were joined, and so gives
    way to likelier parts of it; one that is about the same as a target stands for it, since its outline is known.
    worth: what to persist adds to a score.
    """
    lasts = np.zeros(len(box), bool)
    lasts[: len(persistent)] = persistent
    is_whole = lasts & (box[:, 2:].min(axis=1, initial=np.inf) >= joined_px)
    rank = scores + worth * is_whole
    order = np.argsort(-rank, kind="stable")
    order = order[(scores + worth * lasts)[order] > accept]
    box = box[order]
    area = box[:, 2:].prod(axis=1)
    covers = shared_px(box[:, None], box) > _COVERED * np.minimum(area[:, None], area)
    free = np.ones(len(order), bool)
    chosen: list[int] = []
    for place in range(len(order)):
        if free[place]:
            chosen.append(place)
            free &= ~covers[place]
    if not chosen:
        return []
    alike = np.where(lasts[order], overlaps(box[chosen], box), 0)
    same = np.where(alike.max(axis=1) > _SAME, alike.argmax(axis=1), chosen)
    return list(dict.fromkeys(order[same].tolist()))
