"""Who is who between two or three frames: one-to-one assignment of the largest total score (appendix C, eq. 1-3).

Two frames are solved by SciPy. Three frames with the source's dummy targets are turned into the choice of disjoint
columns (`columns`): a triplet is worth what it gains over leaving its targets alone. The relaxation of many targets is
in `relaxation`.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.errors import InputError
from torchvision_dddas.targets.columns import best_columns


def pairs(score: Float[np.ndarray, "N M"], least: float = 0.0) -> Int[np.ndarray, "K 2"]:
    """The one-to-one pairs (row, column) with the largest sum of scores, in the order of the rows.

    Staying alone scores 0, so only pairs above zero, and above `least`, are used; -inf forbids a pair.
    Raises InputError if the score is no matrix or holds NaN or +inf.
    """
    score = np.asarray(score, float)
    if score.ndim != 2:
        raise InputError(f"pairs needs a matrix of scores (N, M); got shape {score.shape}. Give one row a target.")
    if np.isnan(score).any() or np.isposinf(score).any():
        raise InputError("pairs needs scores below infinity; got NaN or +inf. Forbid a pair with -inf.")
    # Forbidden and useless pairs gain nothing, as staying alone does: so a full matching always exists.
    gain = np.where(score > max(least, 0.0), score, 0.0)
    row, column = linear_sum_assignment(gain, maximize=True)
    used = gain[row, column] > 0
    return np.stack([row[used], column[used]], axis=1).astype(np.int64)


def triplets_exact(score: Float[np.ndarray, "N1 M1 L1"]) -> Int[np.ndarray, "Z 3"]:
    """The triplets (i, j, k) with the largest sum of scores, every real target of each frame in exactly one.

    score: (N + 1, M + 1, L + 1); index 0 of each axis is the dummy, used any number of times; (0, 0, 0) never is, and
    its score is not read. Scores may be zero or negative. Rows are sorted by i, then j, then k.
    Exact, and therefore slow beyond about 20 targets where every triplet is possible: see `relaxation`.
    Raises InputError if the score is no 3-D tensor with a dummy on each axis, or holds what is not finite.
    """
    tensor = checked_tensor(score)
    gain = gain_over_alone(tensor)
    columns = np.argwhere(gain > 0)
    chosen = columns[best_columns(columns - 1, gain[tuple(columns.T)])]
    return with_the_rest_alone(chosen, tensor.shape)


def checked_tensor(score: Float[np.ndarray, "N1 M1 L1"]) -> Float[np.ndarray, "N1 M1 L1"]:
    """A float64 copy with (0, 0, 0) set to 0. Raises InputError as `triplets_exact` says."""
    tensor = np.array(score, float)
    if tensor.ndim != 3 or 0 in tensor.shape:
        raise InputError(
            f"triplets need scores (N + 1, M + 1, L + 1), index 0 the dummy; got shape {tensor.shape}. "
            "Put a dummy first on each axis."
        )
    tensor[0, 0, 0] = 0.0
    if not np.isfinite(tensor).all():
        raise InputError("triplets need finite scores; got NaN or infinity. Give an impossible triplet a low score.")
    return tensor


def gain_over_alone(tensor: Float[np.ndarray, "N1 M1 L1"]) -> Float[np.ndarray, "N1 M1 L1"]:
    """What each triplet scores above its targets each with two dummies: 0 for those, and for (0, 0, 0)."""
    return tensor - tensor[:, :1, :1] - tensor[:1, :, :1] - tensor[:1, :1, :]


def with_the_rest_alone(chosen: Int[np.ndarray, "C 3"], shape: tuple[int, ...]) -> Int[np.ndarray, "Z 3"]:
    """The chosen triplets and, for each real target that none of them holds, one with two dummies; sorted."""
    rows = [chosen]
    for axis, size in enumerate(shape):
        rest = np.setdiff1d(np.arange(1, size), chosen[:, axis])
        alone = np.zeros((len(rest), 3), np.int64)
        alone[:, axis] = rest
        rows.append(alone)
    triplets = np.concatenate(rows).astype(np.int64)
    return triplets[np.lexsort(triplets.T[::-1])]
