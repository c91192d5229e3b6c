"""Who is who between two or three frames: one-to-one assignment of the largest total score (appendix C, eq. 1-3).

Two frames: see `matching`. Three frames in which a gate left few triplets: see `columns`. Three frames with the
source's dummy targets and any triplet possible: exactly here, to within a gap in `relaxation`.
"""

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import cheapest
from torchvision_dddas.tracking.lagrangian import triplets
from torchvision_dddas.types import Float, Int


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
    # Whom nobody fits is left out, so that he stands in nobody's way.
    rows, columns = np.flatnonzero((gain > 0).any(axis=1)), np.flatnonzero((gain > 0).any(axis=0))
    row, column = cheapest(-gain[np.ix_(rows, columns)])
    row, column = rows[row], columns[column]
    used = gain[row, column] > 0
    return np.stack([row[used], column[used]], axis=1).astype(np.int64)


def triplets_exact(score: Float[np.ndarray, "N1 M1 L1"]) -> Int[np.ndarray, "Z 3"]:
    """The triplets (i, j, k) with the largest sum of scores, every real target of each frame in exactly one.

    score: (N + 1, M + 1, L + 1); index 0 of each axis is the dummy, used any number of times; (0, 0, 0) never is, and
    its score is not read. Scores may be zero or negative. Rows are sorted by i, then j, then k.
    Exact (to 1e-9 of the largest gain), so it may take for ever where many targets are alike: `relaxation.triplets`
    stops at a gap.
    Raises InputError if the score is no 3-D tensor with a dummy on each axis, or holds what is not finite.
    """
    return triplets(score, gap=0.0, most_exact=None).triplets
