"""Disjoint columns of the largest total score: three-frame assignment over the triplets that a gate left.

A column (i, j, k) names a node of each of three layers, -1 for none.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csr_array

from torchvision_dddas.errors import InputError


def best_columns(columns: Int[np.ndarray, "C 3"], score: Float[np.ndarray, "C"]) -> Int[np.ndarray, "Z"]:
    """The rows of the columns to choose, ascending: no two share a node of a layer, their scores sum to the most.

    A column that scores zero or less is never chosen; -inf forbids one. Exact. Among choices of the same sum the nodes'
    numbers decide, not the order of the columns.
    Raises InputError if the shapes do not fit, an index is below -1, a column has no node, or a score is NaN or +inf.
    """
    columns, score = _checked(columns, score)
    order = np.lexsort((-score, *columns.T[::-1]))
    order = order[score[order] > 0]
    kept, gain = columns[order], score[order]
    if not len(order):
        return np.zeros(0, np.int64)
    c, layer = np.nonzero(kept >= 0)
    nodes, row = np.unique(kept[c, layer] * 3 + layer, return_inverse=True)
    matrix = csr_array((np.ones(len(c)), (row, c)), shape=(len(nodes), len(kept)))
    solved = milp(
        -gain,
        constraints=LinearConstraint(matrix, ub=1.0),
        integrality=np.ones(len(kept), int),
        bounds=Bounds(0, 1),
        options={"mip_rel_gap": 0.0},
    )
    if solved.x is None:
        raise RuntimeError(f"HiGHS found no choice of {len(kept)} columns: {solved.message}")
    return np.sort(order[solved.x > 0.5])


def _checked(
    columns: Int[np.ndarray, "C 3"], score: Float[np.ndarray, "C"]
) -> tuple[Int[np.ndarray, "C 3"], Float[np.ndarray, "C"]]:
    columns, score = np.asarray(columns), np.asarray(score, float)
    if columns.ndim != 2 or columns.shape[1] != 3 or score.shape != columns.shape[:1]:
        raise InputError(
            f"columns need (C, 3) indices and (C,) scores; got {columns.shape} and {score.shape}. "
            "Give one score a column."
        )
    if len(columns) and not np.issubdtype(columns.dtype, np.integer):
        raise InputError(f"columns need integer indices; got {columns.dtype}. Convert them, with -1 for none.")
    if len(columns) and (columns.min() < -1 or columns.max(axis=1).min() < 0):
        raise InputError("columns need a node of some layer, -1 for none; got an index below -1 or a column of none.")
    if np.isnan(score).any() or np.isposinf(score).any():
        raise InputError("columns need scores below infinity; got NaN or +inf. Forbid a column with -inf.")
    return columns.astype(np.int64), score
