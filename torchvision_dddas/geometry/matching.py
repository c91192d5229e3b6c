"""One-to-one pairs of rows and columns, by SciPy where it is needed."""

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Float, Int


def cheapest(cost: Float[np.ndarray, "N M"]) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """Rows, ascending, and the column of each: min(N, M) pairs of the least sum of finite costs."""
    cost = np.asarray(cost, float)
    # Where all rows have different best columns, no sum is less. SciPy's `optimize` takes 0.5 s and 45 MB to load, as
    # much as the rest of a run onboard: it is loaded when two rows have the same best column.
    tall = cost.shape[0] > cost.shape[1]
    best = (cost.T if tall else cost).argmin(axis=1) if cost.size else np.zeros(0, np.int64)
    if len(set(best.tolist())) == len(best):
        if not tall:
            return np.arange(len(best)), best
        order = np.argsort(best)
        return best[order], order
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(cost)


def best_pairs(score: Float[np.ndarray, "N M"], least: float = 0.0) -> Int[np.ndarray, "K 2"]:
    """One-to-one pairs (row, column) with the largest sum of scores, sorted by row.

    An unpaired row or column scores 0, so only scores above 0, and above `least`, are used; -inf forbids a pair.
    Raises InputError if the score is no matrix or holds NaN or +inf.
    """
    score = np.asarray(score, float)
    if score.ndim != 2:
        raise InputError(f"best_pairs needs a matrix of scores (N, M); got shape {score.shape}. Give one row a target.")
    if score.size and not score.max() < np.inf:  # a NaN is not either
        raise InputError("best_pairs needs scores below infinity; got NaN or +inf. Forbid a pair with -inf.")
    # A forbidden pair counts as unpaired, so that a full matching always exists.
    fits = score > max(least, 0.0)
    gain = np.where(fits, score, 0.0)
    # Rows and columns that fit nothing are left out: this spares SciPy in most calls.
    rows, columns = np.flatnonzero(fits.any(axis=1)), np.flatnonzero(fits.any(axis=0))
    row, column = cheapest(-gain[np.ix_(rows, columns)])
    row, column = rows[row], columns[column]
    used = gain[row, column] > 0
    return np.stack([row[used], column[used]], axis=1).astype(np.int64)
