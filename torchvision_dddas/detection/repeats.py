"""Pictures that repeat the one before, as of 30 pictures a second stored at 60, or of 24 stored at 30."""

from collections import deque

import cv2
import numpy as np

# Side of the cells over which a difference is averaged: the least target is not lost in them.
_CELL_PX = 8
# A repeated picture is coded again: its cells differ by up to 11 grey levels where a key frame falls on it, else by 5.
# Successive pictures of moving cameras differ by 34 and more in some cell, of standing ones before walkers by 37.
_MOST_LEVELS = 12.0
# Beside the largest difference of the latest pictures that of a repeated one is small. A standing camera before a still
# scene shows noise alone, which does not vary so much.
_SHARE, _RECENT = 0.25, 12
# Pictures that differ so much on average differ by more than a repeated one in some cell.
_CHANGED_LEVELS = 2.5


class RepeatRule:
    """Compares each picture with the latest one that is no repeat, so that slow changes add up until they show."""

    def __init__(self) -> None:
        self._before: np.ndarray | None = None
        self._differences: deque[float] = deque(maxlen=_RECENT)

    def is_repeat(self, grey: np.ndarray) -> bool:
        """Whether the next picture, uint8 (H, W), repeats the one before."""
        before, self._before = self._before, grey
        if before is None or before.shape != grey.shape:
            return False
        difference = _largest_difference(before, grey)
        likely = difference <= min(_MOST_LEVELS, _SHARE * max(self._differences, default=0.0))
        self._differences.append(difference)
        if difference and not likely:
            return False
        self._before = before
        return True


def _largest_difference(before: np.ndarray, after: np.ndarray) -> float:
    """Largest mean difference of a cell, grey levels; 0 where the pictures are equal. Limited for a quick answer."""
    coarse = np.s_[:: _CELL_PX // 2, :: _CELL_PX // 2]
    if float(cv2.absdiff(before[coarse].copy(), after[coarse].copy()).mean()) > _CHANGED_LEVELS:
        return _MOST_LEVELS / _SHARE
    difference = cv2.absdiff(before, after)
    size = max(difference.shape[1] // _CELL_PX, 1), max(difference.shape[0] // _CELL_PX, 1)
    largest = float(cv2.resize(difference, size, interpolation=cv2.INTER_AREA).max())
    return max(largest, 0.5) if difference.any() else 0.0
