"""How alike the targets of two or three frames are, without torch: one window of `ops.affinity` (appendix C, eq. 1-5).

Features are non-negative vectors, one row a target; newest frame first. The results have a dummy target at index 0 of
each axis, of which `dummy` says what it is like.
"""

from typing import Literal

import numpy as np

from torchvision_dddas.types import Float

Dummy = Literal["zero", "formula"]


def centres(box_px: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 2"]:
    """The boxes' centres (u, v) in pixels from the picture's corner; 0 where they lie beyond it."""
    return np.maximum(box_px[:, :2] + box_px[:, 2:] / 2, 0.0)


def per_channel(histogram: Float[np.ndarray, "N 768"]) -> Float[np.ndarray, "N 768"]:
    """Each channel's 256 bins divided by their sum; zeros stay zeros."""
    channels = np.asarray(histogram, float).reshape(len(histogram), 3, 256)
    total = channels.sum(axis=-1, keepdims=True)
    return (channels / np.where(total > 0, total, 1.0)).reshape(len(histogram), 768)


def similarity(a: Float[np.ndarray, "N D"], b: Float[np.ndarray, "M D"]) -> Float[np.ndarray, "N M"]:
    """S = Σ min / Σ max in [0, 1], 0 for two vectors of zeros. The dissimilarity is 1 - S."""
    return _share(*_overlap(a, b))


def pairs(a: Float[np.ndarray, "N D"], b: Float[np.ndarray, "M D"]) -> Float[np.ndarray, "N1 M1"]:
    """The similarities (N + 1, M + 1) with a dummy first on each axis: nothing resembles it, by eq. 1 too."""
    return np.pad(similarity(a, b), ((1, 0), (1, 0)))


def triplets(
    a: Float[np.ndarray, "N D"],
    b: Float[np.ndarray, "M D"],
    c: Float[np.ndarray, "L D"],
    dummy: Dummy = "zero",
) -> Float[np.ndarray, "N1 M1 L1"]:
    """Eq. 4 and 5: numerators of (a, b) and (b, c) added, denominators too; (N + 1, M + 1, L + 1).

    dummy: zero: an entry with a dummy is 0, as the source says in words; formula: as eq. 4 and 5 give it when the dummy
    is a vector of zeros, which is up to one half for (i, j, 0) and (0, j, k).
    """
    if dummy == "formula":
        a, b, c = (np.pad(rows, ((1, 0), (0, 0))) for rows in (a, b, c))
    (ab_smaller, ab_larger), (bc_smaller, bc_larger) = _overlap(a, b), _overlap(b, c)
    share = _share(ab_smaller[:, :, None] + bc_smaller[None], ab_larger[:, :, None] + bc_larger[None])
    return share if dummy == "formula" else np.pad(share, ((1, 0), (1, 0), (1, 0)))


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
