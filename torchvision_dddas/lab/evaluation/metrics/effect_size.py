"""The size of a change between two results relative to its spread over clips, and the number of clips that show it."""

import math

import numpy as np
from scipy.special import nctdtr, stdtrit

FEWEST_CLIPS = 3
"""Fewest clips from which the spread of the changes is estimated."""
MOST_CLIPS = 1_000_000


def paired_effect_size(before_after: np.ndarray) -> float:
    """Return Cohen's d_z of (N, 2) figures of the same clips: mean change over standard deviation of the changes.

    NaN for fewer than FEWEST_CLIPS known changes, or if all of them are equal.

    >>> round(paired_effect_size(np.array([[0.5, 0.6], [0.4, 0.7], [0.6, 0.8]])), 2)
    2.0

    Source: Cohen, 1988, Statistical Power Analysis, section 2.3.5.
    """
    changes = np.diff(before_after, axis=1).ravel()
    changes = changes[np.isfinite(changes)]
    spread = float(changes.std(ddof=1)) if len(changes) >= FEWEST_CLIPS else 0.0
    is_known = spread > 1e-9 * float(np.abs(changes).max(initial=0.0))
    return float(changes.mean()) / spread if is_known else math.nan


def count_needed(effect: float, level: float = 0.05, power: float = 0.8) -> int | None:
    """Return the fewest clips with which a two-sided paired t test at `level` shows an effect size with `power`.

    The power follows from the noncentral t distribution. None without an effect, or above MOST_CLIPS.

    >>> count_needed(0.5)
    34
    """
    if math.isnan(effect):
        return None

    def has_power(count: int) -> bool:
        limit = stdtrit(count - 1, 1 - level / 2)
        return bool(1 - nctdtr(count - 1, abs(effect) * math.sqrt(count), limit) >= power)

    low, high = 1, 2
    while not has_power(high):
        if high > MOST_CLIPS:
            return None
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if has_power(middle) else (middle, high)
    return high
