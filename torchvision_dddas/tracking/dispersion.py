"""How far apart a frame's targets are in a feature, and the weight of location that follows (appendix C, III-D)."""

from collections.abc import Callable, Sequence

import numpy as np

from torchvision_dddas.config import PaperParameters
from torchvision_dddas.tracking.jaccard import similarity
from torchvision_dddas.types import Float, Int


def clusters(dissimilarity: Float[np.ndarray, "N N"], cut: float) -> Int[np.ndarray, "N"]:
    """A number for each target: average linkage, the tree cut at a dissimilarity (eq. 10 and G)."""
    if len(dissimilarity) < 2:
        return np.ones(len(dissimilarity), np.int64)
    from scipy.cluster.hierarchy import fcluster  # here, as only the source's association needs it

    return fcluster(_tree(dissimilarity), cut, "distance").astype(np.int64)


def joined_at(dissimilarity: Float[np.ndarray, "N N"]) -> Float[np.ndarray, "N N"]:
    """The cut from which each two targets are in one of `clusters`: what is within a cut of a target is its cluster."""
    if len(dissimilarity) < 2:
        return np.zeros_like(dissimilarity)
    from scipy.cluster.hierarchy import cophenet
    from scipy.spatial.distance import squareform

    return np.asarray(squareform(cophenet(_tree(dissimilarity))))


def _tree(dissimilarity: Float[np.ndarray, "N N"]) -> np.ndarray:
    from scipy.cluster.hierarchy import linkage
    from scipy.spatial.distance import squareform

    return np.asarray(linkage(squareform(dissimilarity, checks=False), "average"))


def normalized_entropy(cluster: Int[np.ndarray, "N"]) -> float:
    """Ndm of eq. 9: 1 when every target is a cluster of its own, 0 when all are one; 1 for one target or none."""
    if len(cluster) < 2:
        return 1.0
    share = np.unique(cluster, return_counts=True)[1] / len(cluster)
    return float(np.abs((share * np.log2(share)).sum()) / np.log2(len(cluster)))


def dispersion(feature: Float[np.ndarray, "N D"], cut: float) -> float:
    """Ndm of a frame's targets by the Jaccard dissimilarity of a feature."""
    return normalized_entropy(clusters(dissimilarity(feature), cut))


def dissimilarity(feature: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N N"]:
    """1 - S of each two targets of a frame, 0 of a target to itself."""
    apart = 1 - similarity(feature, feature)
    np.fill_diagonal(apart, 0.0)
    return apart


def of_window(of_frames: Sequence[float], counts: Sequence[int], parameters: PaperParameters) -> float:
    """The dispersion that speaks for a window, newest frame first, by the reading that `dispersion_of` names."""
    return min(of_frames[: speaking(counts, parameters)])


def speaking(counts: Sequence[int], parameters: PaperParameters) -> int:
    """How many frames of a window, from the newest on, have a say: the smallest of their dispersions counts."""
    differ = len(set(counts)) > 1
    smallest = parameters.dispersion_of == "smallest" or (
        parameters.dispersion_of == "smallest_if_counts_differ" and differ
    )
    return len(counts) if smallest else 1


def location_weight(location: float, appearance: Callable[[], float], lowest: float) -> tuple[float, float | None]:
    """The weight of location, and the dispersion of appearance where it had to be computed.

    1 while locations tell the targets apart; else 0 if appearance does; else one half. The second feedback rule.
    """
    if location > lowest:
        return 1.0, None
    found = appearance()
    return (0.0 if found > lowest else 0.5), found
