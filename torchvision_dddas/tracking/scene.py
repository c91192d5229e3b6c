"""Estimate statistics of a scene: displacement between looks, density, turnover and missed detections of targets.

A look is a sampled frame. Times are in looks and not in seconds, so that nothing depends on the frame rate: targets
move by a share of their height from one look to the next, and that share is estimated.
"""

import math
from collections import deque
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

_STEPS, _PRIOR_STEPS, _LEAST_STEPS = 60, 10, 5  # steps kept, weight of the prior in steps, fewest steps for an estimate
_START_STEP, _LEAST_STEP = 0.3, 0.01  # prior and smallest step, heights a look
_NOISE = 1.23  # 75th percentile of steps that are pure noise, divided by the median change of the log height
_LEAST_SHARE = 0.25  # smallest share of the observed step that counts as motion
_LOOKS = 30  # number of looks over which targets are counted
_START_MISSING, _PRIOR_LINKS, _FADE = 0.03, 20, 0.99  # prior share of misses, its weight in links, decay per look
_SHORT = 3  # longer gaps, in looks, are hidden targets and not misses of the detector
_PRIOR_DETECTIONS = 30  # turnover = new tracks / (detections + this number)
_TURNOVER = (0.01, 0.2)  # bounds of the turnover


@dataclass(frozen=True)
class SceneState:
    """The scene statistics that the scores depend on. The values are numbers, or tensors in tuning.

    time: time of the look, in looks. step: usual displacement between looks, in heights. density: targets a square
    pixel. missing: share of looks in which a visible target is not detected. turnover: share of the targets that appear
    or disappear in a look far from the border. size: (width, height) of the picture in pixels, None if unknown.
    """

    time: Any
    step: Any
    density: Any
    missing: Any
    turnover: Any
    size: tuple[Any, Any] | None = None


class SceneStatistics:
    """Estimates the values of a `SceneState`."""

    def __init__(self, size: tuple[float, float] | None) -> None:
        self.size = size
        self.step = _START_STEP
        self._steps: deque[float] = deque(maxlen=_STEPS)
        self._changes: deque[float] = deque(maxlen=_STEPS)  # changes of the log height
        self._counts: deque[int] = deque(maxlen=_LOOKS)
        self._near, self._far = np.full(2, np.inf), np.full(2, -np.inf)  # corners of all boxes so far
        self._missed = self._links = 0.0
        self._births = self._seen = 0

    def copy(self) -> "SceneStatistics":
        """Return a copy that changes on its own."""
        other = copy(self)
        other._steps, other._changes, other._counts = copy(self._steps), copy(self._changes), copy(self._counts)
        return other

    def add_look(self, before_px: np.ndarray | None, now_px: np.ndarray, gap: float) -> None:
        """Add the boxes (N, 4) and (M, 4) of two successive looks, in the same coordinates, `gap` looks apart.

        A step is the distance between mutual nearest neighbours. It does not use identities, so that a wrong estimate
        cannot confirm itself.
        """
        self._counts.append(len(now_px))
        self._seen += len(now_px)
        if not len(now_px):
            return
        self._near = np.minimum(self._near, now_px[:, :2].min(axis=0))
        self._far = np.maximum(self._far, (now_px[:, :2] + now_px[:, 2:]).max(axis=0))
        if before_px is None or not len(before_px):
            return
        centre, other = before_px[:, :2] + before_px[:, 2:] / 2, now_px[:, :2] + now_px[:, 2:] / 2
        distance = np.hypot(centre[:, None, 0] - other[None, :, 0], centre[:, None, 1] - other[None, :, 1])
        nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
        mutual = np.flatnonzero(back[nearest] == np.arange(len(before_px)))
        partner = nearest[mutual]
        self._steps.extend((distance[mutual, partner] / (before_px[mutual, 3] * gap)).tolist())
        self._changes.extend(np.abs(np.log(now_px[partner, 3] / before_px[mutual, 3])).tolist())
        if (known := len(self._steps)) >= _LEAST_STEPS:
            # Inaccurate boxes change in size, and their centres move by about as much. Remove this noise from the step.
            seen, noise = sorted(self._steps)[(3 * known) // 4], _NOISE * sorted(self._changes)[known // 2]
            usual = max(1.25 * math.sqrt(max(seen**2 - noise**2, (_LEAST_SHARE * seen) ** 2)), _LEAST_STEP)
            share = known / (known + _PRIOR_STEPS)
            self.step = _START_STEP ** (1 - share) * usual**share

    def add_links(self, missed: np.ndarray, births: int) -> None:
        """Add the links of a look.

        missed: (K,) looks without a detection before each link. births: number of tracks begun far from the border.
        """
        missed = missed[missed <= _SHORT]
        self._links = _FADE * self._links + len(missed)
        self._missed = _FADE * self._missed + missed.sum()
        self._births += births

    def state(self, time: float) -> SceneState:
        """Return the state at a time, in looks."""
        width, height = self._far - self._near if self.size is None else self.size
        count = sum(self._counts) / len(self._counts) if self._counts else 1.0
        density = max(count, 0.5) / (width * height) if width > 0 and height > 0 else 1.0
        missing = (_START_MISSING * _PRIOR_LINKS + self._missed) / (_PRIOR_LINKS + self._missed + self._links)
        turnover = min(max(self._births / (self._seen + _PRIOR_DETECTIONS), _TURNOVER[0]), _TURNOVER[1])
        return SceneState(time, self.step, density, missing, turnover, self.size)
