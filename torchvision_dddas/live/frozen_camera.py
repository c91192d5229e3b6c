"""Notice a camera that gives the same picture again and again, although it moved before."""

import numpy as np

from torchvision_dddas.types import FrameResult

# A moving camera, and the noise of a hovering one, shift most pictures by more than _MOVED_PX; a frozen picture is
# encoded again and again, and shifts by less than _STILL_PX. So many moved pictures make a camera a moving one.
_MOVED_PX, _STILL_PX, _MOVED = 0.1, 0.03, 25
_FROZEN_S = 3.0


class FrozenCamera:
    """Judges the motions of the pictures of one camera. A fixed camera, whose pictures never move, is not judged."""

    def __init__(self) -> None:
        self._moved, self._latest_s, self._now_s = 0, np.nan, np.nan

    def add(self, result: FrameResult) -> None:
        """Take the next result. An unknown motion counts as one."""
        if result.frame is None:
            return
        self._now_s = result.frame.time_s
        motion = result.tracked.now_from_before
        shift_px = 0.0 if result.repeats else np.inf
        if motion is not None and not result.repeats:
            height, width = result.frame.image.shape[:2]
            corners = np.array([[0, width, 0, width], [0, 0, height, height], [1, 1, 1, 1]])
            moved = motion @ corners
            shift_px = float(np.abs(moved[:2] / moved[2] - corners[:2]).max())
        self._moved += _MOVED_PX < shift_px < np.inf
        if shift_px > _STILL_PX or np.isnan(self._latest_s):
            self._latest_s = self._now_s

    def describe(self) -> str:
        """Return how long the picture has been the same, if it is frozen; else ""."""
        still_s = self._now_s - self._latest_s
        if self._moved < _MOVED or not still_s > _FROZEN_S:
            return ""
        return f"the camera has given the same picture for {still_s:.0f} s: it may be frozen"
