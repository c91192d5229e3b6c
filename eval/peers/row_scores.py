"""Identities scored on the boxes that a tracker was given, and intervals over sequences.

A true box that the detector missed does not count, nor does a box that a tracker fills in or moves: what is scored is
the identity of each given row.
"""

from dataclasses import dataclass

import numpy as np
from detectors import FALSE
from scipy.optimize import linear_sum_assignment


@dataclass(frozen=True)
class Score:
    """IDF1 in percent, switches, and processor milliseconds a look."""

    idf1: float
    switches: int
    ms: float = 0.0


def score_rows(true: np.ndarray, found: np.ndarray) -> tuple[float, int]:
    """IDF1 in percent, and switches, of rows in order of their frames.

    true: (N,) identities, FALSE for a false box. found: (N,) identities, 0 for none. IDF1 = 2 m / (true rows + rows
    with an identity, false boxes among them): m is the number of rows that the best one-to-one assignment of found to
    true identities explains. A switch is a row of a target whose identity differs from the last one it had.
    """
    both = (true != FALSE) & (found != 0)
    targets, target = np.unique(true[both], return_inverse=True)
    names, name = np.unique(found[both], return_inverse=True)
    shared = np.zeros((len(targets), len(names)), int)
    np.add.at(shared, (target, name), 1)
    explained = shared[linear_sum_assignment(shared, maximize=True)].sum()
    rows = np.count_nonzero(true != FALSE) + np.count_nonzero(found)
    by_target = np.argsort(target, kind="stable")
    same_target = np.diff(target[by_target]) == 0
    switches = np.count_nonzero(same_target & (np.diff(name[by_target]) != 0))
    return 200 * float(explained) / max(rows, 1), int(switches)


def bounds_of_mean(values: np.ndarray, draws: int = 10_000) -> tuple[float, float]:
    """The bounds that hold 95 % of the means of sequences drawn again, from (sequences,) values."""
    drawn = np.random.default_rng(0).integers(len(values), size=(draws, len(values)))
    low, high = np.percentile(values[drawn].mean(axis=1), [2.5, 97.5]).tolist()
    return low, high
