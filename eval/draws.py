"""How sure a mean gain is."""

from collections.abc import Sequence

import numpy as np

DRAWS = 10_000


def told(gains: Sequence[float] | np.ndarray, digits: int = 2) -> str:
    """The mean, and between which ends 95 % of draws of its parts (sequences, scenes) would have put it."""
    drawn = np.random.default_rng(0).choice(gains, (DRAWS, len(gains))).mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return f"{np.mean(gains):+.{digits}f} ({low:+.{digits}f} to {high:+.{digits}f})"
