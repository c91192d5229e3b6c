"""Notice a camera that gives the same picture again and again, although it moved before."""

from collections import deque

import numpy as np

from torchvision_dddas.geometry import transfer
from torchvision_dddas.types import FrameResult

# A frozen picture that is encoded again shifts by less than _STILL_PX. So does the picture of a camera that stands
# still, but its noise changes: after the first _SETTLING pictures none repeats the one before, and of those of a frozen
# camera at least the share _REPEATED does.
_STILL_PX, _SETTLING, _REPEATED = 0.03, 15, 0.2
# A camera moves if its pictures shift by more than _MOVED_PX at least _MOVED times.
_MOVED_PX, _MOVED = 0.1, 25
# The picture must be the same for _FROZEN_S and in _FEWEST results more, without a pause of _PAUSE_S.
_FROZEN_S, _FEWEST, _PAUSE_S = 3.0, 10, 1.0


class FrozenCamera:
    """Judges the motions of the pictures of one camera. A camera that did not move before is not judged."""

    def __init__(self) -> None:
        self._moved = 0
        self._still: deque[tuple[float, bool]] = deque(maxlen=1000)  # times of still pictures, and whether they repeat

    def add(self, result: FrameResult) -> None:
        """Take the next result. A picture whose motion is unknown is not still."""
        if result.frame is None:
            return
        shift_px = 0.0 if result.repeats else _shift_px(result)
        self._moved += _MOVED_PX < shift_px < np.inf
        now_s = result.frame.time_s
        if not shift_px <= _STILL_PX or (self._still and not 0 <= now_s - self._still[-1][0] < _PAUSE_S):
            self._still.clear()
        self._still.append((now_s, bool(result.repeats)))

    def describe(self) -> str:
        """Return how long the picture has been the same, if it is frozen; else ""."""
        if self._moved < _MOVED or len(self._still) < _SETTLING + _FEWEST:
            return ""
        still_s = self._still[-1][0] - self._still[0][0]
        if still_s < _FROZEN_S or np.mean([repeats for _, repeats in self._still][_SETTLING:]) < _REPEATED:
            return ""
        return f"the camera has given the same picture for {still_s:.0f} s: it may be frozen"


def _shift_px(result: FrameResult) -> float:
    """Return the largest shift of a corner since the picture before; infinite if it is unknown."""
    motion = result.tracked.now_from_before
    if motion is None or result.frame is None:
        return float(np.inf)
    height, width = result.frame.image.shape[:2]
    corners = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    return float(np.abs(transfer(motion, corners) - corners).max())
