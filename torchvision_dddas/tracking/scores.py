"""Association scores: how well a detection continues a track, as log-odds, 0 where the evidence is balanced.

Scores add up, and a target without a link scores 0. So no dummy has to be tuned, and dummies do not win by their number
(appendix C gives dummies an affinity of their own, and its optimum is then to link nothing).
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.config import TrackParameters
from torchvision_dddas.geometry import namespace
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.kalman import HEIGHT, PP, SEEN, SS, USUAL_SPEED, VX, VY, WIDTH, X, Y

_LARGEST_SIZE_PENALTY = 8.0
_MISSED_FRAMES = 5.0  # scale on which the penalty of a gap grows
_LEAST_DETECTIONS = 30  # before the birth rate is estimated
_NO_BIRTHS = 10  # detections without a birth, times the interval, that the rate starts from
_USUAL_BIRTH_RATE = 0.002  # per detection and frame
_LARGEST_BIRTH_PENALTY = 6.0  # a target that reappears at once on the spot is not new, however many targets appear
_LEAVING_FRAMES = 15  # for which a target is predicted to go on; later it may have stopped or turned
_STEPS, _PRIOR_STEPS, _LEAST_STEPS = 60, 10, 5  # steps remembered, what the prior is worth, before steps count
_LEAST_SPEED = 0.01  # heights a frame


@dataclass(frozen=True)
class SceneState:
    """What the scores depend on, beside tracks and detections.

    frame: its number. interval: frames from one sampled frame to the next. speed: of the speed prior, heights a frame.
    birth_rate: targets that begin inside the picture, per detection and frame. doubt: share of detections that are not
    certain. size: (width, height) of the picture, None if unknown.
    """

    frame: int
    interval: int
    speed: float
    birth_rate: float = 0.0
    doubt: float = 0.0
    size: tuple[float, float] | None = None

    def agility(self, parameters: TrackParameters) -> float:
        """Sd of the change of velocity in a frame, heights a frame: fast targets turn fast."""
        return parameters.agility * self.speed / USUAL_SPEED


def birth_rate(births: int, seen: int, doubt: float, interval: int) -> float:
    """Targets that begin inside the picture per detection and frame, from counts of both.

    A doubtful detector loses tracks and begins new ones for them: such births are no sign of new targets.
    """
    return births / ((seen + _NO_BIRTHS * interval) * interval * (1 + 2 * doubt)) if seen > _LEAST_DETECTIONS else 0.0


def is_near_border(box_px: np.ndarray, size: tuple[float, float] | None) -> np.ndarray:
    """(N,) whether boxes (N, 4) are so close to the picture's border that a target may come or go there."""
    x, y, width, height = (box_px[..., side] for side in range(4))
    if size is None:
        return namespace(box_px).zeros_like(x, dtype=bool)
    margin = 0.15 * height
    return (x < margin) | (y < margin) | (x + width > size[0] - margin) | (y + height > size[1] - margin)


def association_scores(
    state: np.ndarray, left_at_border: np.ndarray, box_px: np.ndarray, scene: SceneState, parameters: TrackParameters
) -> np.ndarray:
    """(N, M) scores of tracks and the detections of a frame, without appearance.

    state: (N, kalman.COLUMNS) as last seen. left_at_border: (N,) whether last seen at the border. box_px: (M, 4).
    Arrays, or tensors with a gradient in the parameters.
    """
    functions = namespace(state)
    later = kalman.predict(state, scene.frame, scene.agility(parameters))
    centre, height = box_px[..., :2] + box_px[..., 2:] / 2, functions.log(box_px[..., 3])
    score = _position_score(later, later[..., PP] + parameters.scatter**2, centre, parameters)
    score = score - _size_penalty(later, height, scene.doubt, parameters.size_scatter)
    gap = scene.frame - state[..., SEEN]
    missed = gap > scene.interval
    if not missed.any():
        return score
    # A lost target may have stood still behind an obstacle: then its last place is a better prediction.
    rest = _position_score(state, parameters.scatter**2 + parameters.rest_drift**2 * gap, centre, parameters)
    rest = rest - _size_penalty(state, height, scene.doubt, parameters.size_scatter)
    lost = functions.maximum(score, rest - parameters.rest_price)
    late = functions.clip(gap - scene.interval, 0, None)
    lost = lost - (parameters.missed + 0.5 * functions.log1p(late / _MISSED_FRAMES))[..., None]
    # A target seen at the border after a gap is more likely another one.
    lost = lost - (
        parameters.border * is_near_border(box_px, scene.size)[..., None, :]
        + parameters.left * left_at_border[..., None]
    )
    # Where targets keep appearing inside the picture, this is rather a new one than a lost one.
    excess = functions.log(functions.clip(scene.birth_rate / _USUAL_BIRTH_RATE, 1.0, None))
    lost = lost - functions.clip(parameters.births * excess, None, _LARGEST_BIRTH_PENALTY)
    return functions.where(missed[..., None], lost, score)


def _position_score(
    place: np.ndarray, variance: np.ndarray, centre_px: np.ndarray, parameters: TrackParameters
) -> np.ndarray:
    """(N, M) log density of centres around predicted places, and the prior. variance: (N,) in squared heights."""
    functions = namespace(place)
    # Standing people move less up and down in the picture than across it.
    level = functions.ones_like(variance)
    upright = functions.where(place[..., HEIGHT] > place[..., WIDTH], parameters.upright * level, level)
    unit = (place[..., HEIGHT] ** 2 * variance)[..., None]
    across = centre_px[..., None, :, 0] - place[..., X : X + 1]
    along = (centre_px[..., None, :, 1] - place[..., Y : Y + 1]) / upright[..., None]
    away = (across * across + along * along) / unit
    peak = parameters.prior - functions.log(2 * math.pi * variance * upright)
    return peak[..., None] - (1 + parameters.tail / 2) * functions.log1p(away / parameters.tail)


def _size_penalty(state: np.ndarray, height: np.ndarray, doubt: float, scatter: float) -> np.ndarray:
    """(N, M) penalty for a height other than predicted. height: (M,) its logarithm."""
    functions = namespace(state)
    usual = scatter * (1 + 0.5 * doubt)
    variance = usual**2 + state[..., SS]
    change = height[..., None, :] - functions.log(state[..., HEIGHT : HEIGHT + 1])
    wrong = functions.clip(0.5 * change**2 / variance[..., None], None, _LARGEST_SIZE_PENALTY)
    return wrong + 0.5 * functions.log(variance / usual**2)[..., None]


def is_remembered(
    state: np.ndarray, frame: int, interval: int, size: tuple[float, float] | None, parameters: TrackParameters
) -> np.ndarray:
    """(N,) which tracks (N, kalman.COLUMNS) are kept after a frame; those that have left the picture go earlier.

    interval: frames from one sampled frame to the next. size: (width, height) of the picture, None if unknown. Arrays
    or tensors.
    """
    functions = namespace(state)
    age = frame - state[..., SEEN]
    keep = age <= parameters.memory_frames
    if size is None:
        return keep
    going = functions.clip(age, None, _LEAVING_FRAMES)
    x, y = state[..., X] + going * state[..., VX], state[..., Y] + going * state[..., VY]
    outside = (x < 0) | (x > size[0]) | (y < 0) | (y > size[1])
    return keep & (~outside | (age <= parameters.memory_outside_frames) | (age <= interval))


class SpeedPrior:
    """Estimates the usual speed of a scene's targets, in box heights a frame.

    A step is the distance between mutual nearest neighbours of successive frames. It needs no identities, so that a
    wrong estimate cannot confirm itself.
    """

    def __init__(self, speed: float) -> None:
        """speed: the prior."""
        self.start = self.speed = speed
        self.usual = speed  # of the steps that are remembered
        self.steps: deque[float] = deque(maxlen=_STEPS)

    def add(self, before_px: np.ndarray, now_px: np.ndarray, frames: int) -> None:
        """Learn from the boxes (N, 4), (M, 4) of two successive sampled frames, in the same coordinates."""
        if not len(before_px) or not len(now_px):
            return
        centre, other = before_px[:, :2] + before_px[:, 2:] / 2, now_px[:, :2] + now_px[:, 2:] / 2
        distance = np.hypot(centre[:, None, 0] - other[None, :, 0], centre[:, None, 1] - other[None, :, 1])
        nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
        mutual = np.flatnonzero(back[nearest] == np.arange(len(before_px)))
        self.steps.extend(distance[mutual, nearest[mutual]] / (before_px[mutual, 3] * frames))
        if (known := self.known) >= _LEAST_STEPS:
            self.usual = max(1.25 * sorted(self.steps)[(3 * known) // 4], _LEAST_SPEED)
            self.speed = blend_speed(self.start, self.usual, known)

    @property
    def known(self) -> int:
        """Steps remembered."""
        return len(self.steps)


def blend_speed(start: float, usual: float, known: int) -> float:
    """The speed by the prior `start` and by `known` steps of speed `usual`. Numbers or tensors."""
    share = known / (_PRIOR_STEPS + known) * (known >= _LEAST_STEPS)
    return start ** (1 - share) * usual**share
