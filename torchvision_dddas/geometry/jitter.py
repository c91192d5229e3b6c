"""Estimate the jitter of a target's measured positions around its path from the positions themselves."""

import math
from collections import deque

import numpy as np

_APART_S = (0.0, 0.5)  # measures errors from frame to frame, and slower errors; people turn little in 0.5 s
_LATEST = 10  # effective number of positions in the running mean


class Jitter:
    """Running estimate of the standard deviation of positions, per axis, around a constant velocity.

    Add the positions in order of time. A covariance describes the whole error of a position, mostly errors that all
    positions have in common, such as the error of the vehicle's position. The jitter is smaller. It is measured by the
    distance of each position from the extrapolation of the two positions before, once for successive positions and
    once for positions 0.5 s apart. The larger deviation is used.
    """

    def __init__(self) -> None:
        self._before: tuple[deque[tuple[float, np.ndarray]], ...] = (deque(maxlen=2), deque(maxlen=2))
        self._variance, self._count = [math.nan, math.nan], [0, 0]

    @property
    def sigma(self) -> float:
        """The standard deviation; NaN until there are three positions 0.5 s apart."""
        return math.nan if math.isnan(self._variance[1]) else math.sqrt(max(self._variance))

    def add(self, time_s: float, place: np.ndarray) -> None:
        """Add a position (2,)."""
        for k, (before, apart_s) in enumerate(zip(self._before, _APART_S, strict=True)):
            if before and time_s - before[-1][0] < max(apart_s, 1e-6):
                continue
            if len(before) == 2:
                (first_s, first), (second_s, second) = before
                share = (time_s - first_s) / (second_s - first_s)
                off = place - first - share * (second - first)
                variance = float(off @ off) / (2 * (1 + share**2 + (1 - share) ** 2))
                self._count[k] += 1
                weight = max(1 / self._count[k], 1 / _LATEST)
                kept = 0.0 if self._count[k] == 1 else (1 - weight) * self._variance[k]
                self._variance[k] = kept + weight * variance
            before.append((time_s, place))
