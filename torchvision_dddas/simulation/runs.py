"""Rows that are alike, done at once."""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np


def runs(values: np.ndarray) -> Iterable[tuple[int, int]]:
    """The first row of each run of equal values (N,), and the one after its last."""
    return pairwise([0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)])
