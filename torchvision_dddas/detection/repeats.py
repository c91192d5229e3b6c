"""Find pictures that repeat the picture before, as in clips of 30 pictures a second that are stored at 60."""

from collections import deque

import cv2
import numpy as np

# Side of the cells over which differences are averaged. The smallest target still changes the mean of such a cell.
_CELL_PX = 8
# A repeated picture is encoded again: its cells differ by up to 11 grey levels if it is a key frame, else by up to 5.
# Successive different pictures differ by at least 34 in some cell for moving cameras, and by 37 for a fixed camera with
# walkers in view.
_MOST_LEVELS = 12.0
# A repeat differs by at most _SHARE of the largest difference among the _RECENT latest pictures. Pictures of a still
# scene by a fixed camera differ by noise only. The noise varies less, so these pictures do not count as repeats.
_SHARE, _RECENT = 0.25, 12
# If the mean difference of two pictures exceeds this, some cell differs by more than in any repeat.
_CHANGED_LEVELS = 2.5


class RepeatRule:
    """Compares each picture with the latest picture that is not a repeat, so that slow changes add up."""

    def __init__(self) -> None:
        self._before: np.ndarray | None = None
        self._differences: deque[float] = deque(maxlen=_RECENT)

    def is_repeat(self, grey: np.ndarray) -> bool:
        """Return whether the next picture, (H, W) uint8, repeats the picture before."""
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
    """Return the largest mean difference of a cell, grey levels; for clearly different pictures a large constant."""
    coarse = np.s_[:: _CELL_PX // 2, :: _CELL_PX // 2]
    if float(cv2.absdiff(before[coarse].copy(), after[coarse].copy()).mean()) > _CHANGED_LEVELS:
        return _MOST_LEVELS / _SHARE
    difference = cv2.absdiff(before, after)
    size = max(difference.shape[1] // _CELL_PX, 1), max(difference.shape[0] // _CELL_PX, 1)
    largest = float(cv2.resize(difference, size, interpolation=cv2.INTER_AREA).max())
    return max(largest, 0.5) if difference.any() else 0.0
