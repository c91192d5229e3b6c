"""The source's affinities of two or three frames, without torch (appendix C, III).

Features are non-negative vectors, one row a target, newest frame first. Affinities have a dummy target at index 0 of
each axis. `functional.affinity` holds the same operations for batches of tensors.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from torchvision_dddas.config import PaperParameters
from torchvision_dddas.types import Float, Int


def pair_affinity(a: Float[np.ndarray, "N D"], b: Float[np.ndarray, "M D"]) -> Float[np.ndarray, "N1 M1"]:
    """Eq. 1: similarities (N + 1, M + 1), 0 with a dummy."""
    return np.pad(similarity(a, b), ((1, 0), (1, 0)))


def triplet_affinity(
    a: Float[np.ndarray, "N D"],
    b: Float[np.ndarray, "M D"],
    c: Float[np.ndarray, "L D"],
    dummy: Literal["zero", "formula"] = "zero",
) -> Float[np.ndarray, "N1 M1 L1"]:
    """Eq. 4 and 5: numerators of (a, b) and (b, c) added, and denominators; (N + 1, M + 1, L + 1).

    dummy: zero: an entry with a dummy is 0, as the source says in words. formula: as eq. 4 and 5 give it for a dummy of
    zeros, up to one half for (i, j, 0) and (0, j, k).
    """
    if dummy == "formula":
        a, b, c = (np.pad(rows, ((1, 0), (0, 0))) for rows in (a, b, c))
    (ab_smaller, ab_larger), (bc_smaller, bc_larger) = _overlap(a, b), _overlap(b, c)
    share = _share(ab_smaller[:, :, None] + bc_smaller[None], ab_larger[:, :, None] + bc_larger[None])
    return share if dummy == "formula" else np.pad(share, ((1, 0), (1, 0), (1, 0)))


def similarity(a: Float[np.ndarray, "N D"], b: Float[np.ndarray, "M D"]) -> Float[np.ndarray, "N M"]:
    """Generalized Jaccard similarity Σ min / Σ max in [0, 1], 0 for two vectors of zeros."""
    return _share(*_overlap(a, b))


def dissimilarity(feature: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N N"]:
    """1 - similarity of each two targets of a frame, 0 of a target to itself."""
    apart = 1 - similarity(feature, feature)
    np.fill_diagonal(apart, 0.0)
    return apart


def _overlap(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Σ min and Σ max of each pair: min + max = a + b and max - min = |a - b|."""
    if not len(a) or not len(b):
        return np.zeros((len(a), len(b))), np.zeros((len(a), len(b)))
    from scipy.spatial.distance import cdist  # here, as only the source's association needs it

    total = a.sum(axis=1)[:, None] + b.sum(axis=1)[None]
    apart = cdist(a, b, "cityblock")
    return np.maximum(total - apart, 0.0) / 2, (total + apart) / 2


def _share(smaller: np.ndarray, larger: np.ndarray) -> np.ndarray:
    return np.divide(smaller, larger, out=np.zeros_like(larger), where=larger > 0)


def centres(box_px: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 2"]:
    """The boxes' centres (u, v) in pixels from the picture's corner, clipped to 0."""
    return np.maximum(box_px[:, :2] + box_px[:, 2:] / 2, 0.0)


def normalize_channels(histogram: Float[np.ndarray, "N 768"]) -> Float[np.ndarray, "N 768"]:
    """Each channel's 256 bins divided by their sum; zeros stay zeros."""
    channels = np.asarray(histogram, float).reshape(len(histogram), 3, 256)
    total = channels.sum(axis=-1, keepdims=True)
    return (channels / np.where(total > 0, total, 1.0)).reshape(len(histogram), 768)


def gate(
    score: Float[np.ndarray, "..."], threshold: float, reading: Literal["one_dummy", "every_dummy", "off"]
) -> Float[np.ndarray, "..."]:
    """A copy in which an entry with a dummy is 1 - threshold where all real alternatives are below that (III-E).

    score: two or three axes, index 0 of each the dummy. reading: one_dummy raises entries with exactly one dummy;
    every_dummy is the text to the letter, so that entries with two dummies are raised too and the best assignment
    leaves every target alone; off raises none. The entry of dummies alone is never raised.
    """
    score = np.array(score, float)
    is_raised = (best_alternatives(score, reading) < 1 - threshold).astype(float)
    return blend_gate(score, is_raised, threshold)


def best_alternatives(score: Float[np.ndarray, "..."], reading: str) -> Float[np.ndarray, "..."]:
    """For each entry the best real alternative, which must be below 1 - threshold to raise it; inf where never.

    Of an entry with two dummies the smaller of both indices' alternatives counts. score, reading: as for `gate`.
    """
    best = np.full(score.shape, np.inf)
    if reading == "off":
        return best
    firsts = [tuple(0 if a == axis else slice(None) for a in range(score.ndim)) for axis in range(score.ndim)]
    dummies = np.zeros(score.shape, np.int64)
    for first in firsts:
        dummies[first] += 1
    allowed = dummies == 1 if reading == "one_dummy" else dummies < score.ndim
    for axis, first in enumerate(firsts):
        real = score.take(np.arange(1, score.shape[axis]), axis).max(axis=axis, initial=-np.inf)
        best[first] = np.where(allowed[first], np.minimum(best[first], real), best[first])
    return best


def blend_gate(score: Any, raised: Any, threshold: Any) -> Any:
    """Entries raised to 1 - threshold by a share: not where it is 0, wholly where it is 1. Arrays or tensors."""
    return raised * (1 - threshold) + (1 - raised) * score


def pair_gain_over_alone(score: Any) -> Any:
    """What each pair scores above both left with the dummy: (..., N + 1, M + 1) -> (..., N, M), arrays or tensors."""
    return score[..., 1:, 1:] - score[..., 1:, :1] - score[..., :1, 1:]


def dispersion(feature: Float[np.ndarray, "N D"], cut: float) -> float:
    """How far apart a frame's targets are in a feature: the normalized entropy of their clusters (III-D)."""
    return normalized_entropy(clusters(dissimilarity(feature), cut))


def normalized_entropy(cluster: Int[np.ndarray, "N"]) -> float:
    """Ndm of eq. 9: 1 when every target is a cluster of its own, 0 when all are one; 1 for one target or none."""
    if len(cluster) < 2:
        return 1.0
    share = np.unique(cluster, return_counts=True)[1] / len(cluster)
    return float(np.abs((share * np.log2(share)).sum()) / np.log2(len(cluster)))


def clusters(dissimilarity: Float[np.ndarray, "N N"], cut: float) -> Int[np.ndarray, "N"]:
    """Cluster number of each target: average linkage, the tree cut at a dissimilarity (eq. 10 and G)."""
    if len(dissimilarity) < 2:
        return np.ones(len(dissimilarity), np.int64)
    from scipy.cluster.hierarchy import fcluster  # here, as only the source's association needs it

    return fcluster(_tree(dissimilarity), cut, "distance").astype(np.int64)


def joined_at(dissimilarity: Float[np.ndarray, "N N"]) -> Float[np.ndarray, "N N"]:
    """The least cut at which each two targets are in one of `clusters`."""
    if len(dissimilarity) < 2:
        return np.zeros_like(dissimilarity)
    from scipy.cluster.hierarchy import cophenet
    from scipy.spatial.distance import squareform

    return np.asarray(squareform(cophenet(_tree(dissimilarity))))


def _tree(dissimilarity: Float[np.ndarray, "N N"]) -> np.ndarray:
    from scipy.cluster.hierarchy import linkage
    from scipy.spatial.distance import squareform

    return np.asarray(linkage(squareform(dissimilarity, checks=False), "average"))


def frames_considered(counts: Sequence[int], parameters: PaperParameters) -> int:
    """Of how many frames of a window, from the newest on, the smallest dispersion counts, by `dispersion_of`."""
    differ = len(set(counts)) > 1
    of_all = parameters.dispersion_of == "smallest" or (
        parameters.dispersion_of == "smallest_if_counts_differ" and differ
    )
    return len(counts) if of_all else 1


def location_weight(location: float, appearance: Callable[[], float], lowest: float) -> tuple[float, float | None]:
    """The weight of location, and the dispersion of appearance where it had to be computed.

    1 while locations tell the targets apart; else 0 if appearance does; else one half. The second feedback rule.
    """
    if location > lowest:
        return 1.0, None
    found = appearance()
    return (0.0 if found > lowest else 0.5), found
