"""The cheapest one-to-one assignment: a small one at once, a large one by SciPy.

SciPy's `optimize` takes half a second and 45 MB to import, more than the rest of a run onboard: only crowds need it.
"""

from itertools import pairwise

import numpy as np

from torchvision_dddas.shapes import Float, Int

# Up to so many rows or columns are assigned here, in a millisecond at the most.
SMALL = 12


def cheapest(cost: Float[np.ndarray, "N M"]) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """Rows, ascending, and the column of each: min(N, M) pairs of the least sum of finite costs.

    Source: shortest augmenting paths, Jonker and Volgenant 1987.
    """
    cost = np.asarray(cost, float)
    if min(cost.shape) > SMALL:
        from scipy.optimize import linear_sum_assignment

        return linear_sum_assignment(cost)
    if cost.shape[0] <= cost.shape[1]:
        return np.arange(cost.shape[0]), _assigned(cost)
    rows = _assigned(cost.T)
    order = np.argsort(rows)
    return rows[order], order


def _assigned(cost: np.ndarray) -> np.ndarray:
    """The column of each row, rows no more than columns; one row more at a time, along the cheapest changes."""
    rows, columns = cost.shape
    of_column = np.full(columns, -1)
    row_price, column_price = np.zeros(rows), np.zeros(columns)
    for new in range(rows):
        length, before = np.full(columns, np.inf), np.full(columns, -1)
        closed = np.zeros(columns, bool)
        row, way, reached = new, 0.0, -1  # the path's last row, its length, its last column
        while True:
            through = way + cost[row] - row_price[row] - column_price
            shorter = ~closed & (through < length)
            length[shorter], before[shorter] = through[shorter], reached
            reached = int(np.where(closed, np.inf, length).argmin())
            way = float(length[reached])
            if of_column[reached] < 0:
                break
            closed[reached] = True
            row = int(of_column[reached])
        row_price[of_column[closed]] += way - length[closed]
        row_price[new] += way
        column_price[closed] -= way - length[closed]
        path = [reached]
        while before[path[-1]] >= 0:
            path.append(int(before[path[-1]]))
        for column, earlier in pairwise(path):
            of_column[column] = of_column[earlier]
        of_column[path[-1]] = new
    column_of = np.empty(rows, np.int64)
    column_of[of_column[of_column >= 0]] = np.flatnonzero(of_column >= 0)
    return column_of
