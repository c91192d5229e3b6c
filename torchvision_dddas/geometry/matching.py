"""Optimal one-to-one assignment of rows to columns. SciPy's solver is loaded alone, and only if needed."""

from collections.abc import Callable
from functools import cache
from importlib.machinery import PathFinder
from importlib.util import find_spec, module_from_spec
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Float, Int


def cheapest(cost: Float[np.ndarray, "N M"]) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """Return the rows, ascending, and the columns of the min(N, M) pairs with the smallest sum of finite costs."""
    cost = np.asarray(cost, float)
    # If the best columns of all rows differ, they are the optimal pairs. Otherwise SciPy's solver is needed.
    tall = cost.shape[0] > cost.shape[1]
    best = (cost.T if tall else cost).argmin(axis=1) if cost.size else np.zeros(0, np.int64)
    if len(set(best.tolist())) == len(best):
        if not tall:
            return np.arange(len(best)), best
        order = np.argsort(best)
        return best[order], order
    return load_assignment_solver()(cost)


@cache
def load_assignment_solver() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """Return `scipy.optimize.linear_sum_assignment`.

    Load its extension module alone. `scipy.optimize` takes 0.5 s and 45 MB to load, as much as the rest of an onboard
    run, and a live run would lose the pictures of that time. Load the package if there is no such module.
    """
    scipy = find_spec("scipy")
    folders = [str(Path(place) / "optimize") for place in (scipy.submodule_search_locations or ())] if scipy else []
    spec = PathFinder.find_spec("scipy.optimize._lsap", folders)
    if spec is not None and spec.loader is not None:
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        if solver := getattr(module, "linear_sum_assignment", None):
            return solver
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment


def best_pairs(score: Float[np.ndarray, "N M"], least: float = 0.0) -> Int[np.ndarray, "K 2"]:
    """Return one-to-one pairs (row, column) with the largest sum of scores, sorted by row.

    An unpaired row or column scores 0, so only scores above 0 and above `least` are used. -inf forbids a pair.
    Raises InputError if the score is not a matrix, or contains NaN or +inf.
    """
    score = np.asarray(score, float)
    if score.ndim != 2:
        raise InputError(f"best_pairs needs scores of shape (N, M), got {score.shape}. Give each target one row.")
    if score.size and not score.max() < np.inf:  # this comparison is also false for NaN
        raise InputError("best_pairs needs scores below infinity; got NaN or +inf. Forbid a pair with -inf.")
    # A forbidden pair counts as unpaired, so that a complete assignment always exists.
    fits = score > max(least, 0.0)
    gain = np.where(fits, score, 0.0)
    # Leave out rows and columns without a usable score. This avoids SciPy in most calls.
    rows, columns = np.flatnonzero(fits.any(axis=1)), np.flatnonzero(fits.any(axis=0))
    row, column = cheapest(-gain[np.ix_(rows, columns)])
    row, column = rows[row], columns[column]
    used = gain[row, column] > 0
    return np.stack([row[used], column[used]], axis=1).astype(np.int64)
