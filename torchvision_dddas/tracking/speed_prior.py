"""How fast the targets of a scene go, learned while it is watched."""

from collections import deque

import numpy as np

_STEPS = 60  # steps remembered
_PRIOR_STEPS = 10  # what the start is worth
_LEAST_STEPS = 5
_LEAST_SPEED = 0.01  # heights a frame


class Pace:
    """The speed scale, in box heights a frame.

    A step is the distance between mutual nearest neighbours of successive frames: no identity is needed, so that a
    wrong scale cannot confirm itself.
    """

    def __init__(self, speed: float) -> None:
        """speed: where nothing has been seen yet."""
        self.start = self.speed = speed
        self.usual = speed  # of the steps that are remembered
        self.steps: deque[float] = deque(maxlen=_STEPS)

    def add(self, before_px: np.ndarray, now_px: np.ndarray, frames: int) -> None:
        """Learn from the boxes (N, 4), (M, 4) of two successive looks, in the same coordinates."""
        if not len(before_px) or not len(now_px):
            return
        centre, other = before_px[:, :2] + before_px[:, 2:] / 2, now_px[:, :2] + now_px[:, 2:] / 2
        distance = np.hypot(centre[:, None, 0] - other[None, :, 0], centre[:, None, 1] - other[None, :, 1])
        nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
        mutual = np.flatnonzero(back[nearest] == np.arange(len(before_px)))
        self.steps.extend(distance[mutual, nearest[mutual]] / (before_px[mutual, 3] * frames))
        if (known := self.known) >= _LEAST_STEPS:
            self.usual = max(1.25 * sorted(self.steps)[(3 * known) // 4], _LEAST_SPEED)
            self.speed = speed_of(self.start, self.usual, known)

    @property
    def known(self) -> int:
        """Steps remembered."""
        return len(self.steps)


def speed_of(start: float, usual: float, known: int) -> float:
    """The speed where so many steps are known, and what they say; the start is worth some. Numbers, or tensors."""
    share = known / (_PRIOR_STEPS + known) * (known >= _LEAST_STEPS)
    return start ** (1 - share) * usual**share
