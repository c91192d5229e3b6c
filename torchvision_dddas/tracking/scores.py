"""How well a detection continues a track: the score of a link, a logarithm of odds, 0 where nothing speaks either way.

Scores of links add up, and a target without a link scores 0: no dummy has to be tuned, and none wins by its number
(appendix C gives dummies an affinity of their own, and its optimum is then to link nothing).
"""

import math
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.config import TrackParameters
from torchvision_dddas.geometry import namespace
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.kalman import HEIGHT, PP, SEEN, SS, USUAL_SPEED, WIDTH, X, Y

_WORST_SIZE = 8.0
_MISSED_FRAMES = 5.0  # how the price of a gap grows
_ENOUGH = 30  # detections before the rate of births means anything
_NO_BIRTHS = 10  # detections without a birth, times the interval, that the rate starts from
_USUAL_BIRTHS = 0.002  # per detection and frame
_MOST_BIRTHS = 6.0  # their price at most: who comes back at once and on the spot is no newcomer, whatever else appears


@dataclass(frozen=True)
class Sight:
    """What is known of a look at the scene.

    frame: its number. interval: frames between looks. speed: of the pace, heights/frame. births: targets that begin
    inside the picture, per detection and frame. doubt: share of detections that are not certain. size: (width, height)
    of the picture, None if unknown.
    """

    frame: int
    interval: int
    speed: float
    births: float = 0.0
    doubt: float = 0.0
    size: tuple[float, float] | None = None

    def agility(self, parameters: TrackParameters) -> float:
        """Sd of the change of velocity in a frame, heights/frame: who is fast turns fast."""
        return parameters.agility * self.speed / USUAL_SPEED


def births_of(births: int, seen: int, doubt: float, interval: int) -> float:
    """Targets that begin inside the picture per detection and frame, from counts of both.

    Who misses targets loses tracks and begins new ones for them: such births are no sign of new targets.
    """
    return births / ((seen + _NO_BIRTHS * interval) * interval * (1 + 2 * doubt)) if seen > _ENOUGH else 0.0


def near_border(box_px: np.ndarray, size: tuple[float, float] | None) -> np.ndarray:
    """(N,) whether boxes (N, 4) are so close to the picture's border that a target may come or go there."""
    x, y, width, height = (box_px[..., side] for side in range(4))
    if size is None:
        return namespace(box_px).zeros_like(x, dtype=bool)
    margin = 0.15 * height
    return (x < margin) | (y < margin) | (x + width > size[0] - margin) | (y + height > size[1] - margin)


def link_scores(
    state: np.ndarray, left_at_border: np.ndarray, box_px: np.ndarray, sight: Sight, parameters: TrackParameters
) -> np.ndarray:
    """(N, M) scores of the links from tracks to the detections of a look, appearance left out.

    state: (N, kalman.COLUMNS) as last seen. left_at_border: (N,) whether they were seen at the border then. box_px:
    (M, 4). Arrays, or tensors with a gradient in the parameters.
    """
    functions = namespace(state)
    later = kalman.predicted(state, sight.frame, sight.agility(parameters))
    centre, height = box_px[..., :2] + box_px[..., 2:] / 2, functions.log(box_px[..., 3])
    score = _closeness(later, later[..., PP] + parameters.scatter**2, centre, parameters)
    score = score - _misfit(later, height, sight.doubt, parameters.size_scatter)
    gap = sight.frame - state[..., SEEN]
    missed = gap > sight.interval
    if not missed.any():
        return score
    # Who was lost may have stood still behind something: that tells where better than any velocity.
    rest = _closeness(state, parameters.scatter**2 + parameters.rest_drift**2 * gap, centre, parameters)
    rest = rest - _misfit(state, height, sight.doubt, parameters.size_scatter)
    lost = functions.maximum(score, rest - parameters.rest_price)
    late = functions.clip(gap - sight.interval, 0, None)
    lost = lost - (parameters.missed + 0.5 * functions.log1p(late / _MISSED_FRAMES))[..., None]
    # A target seen at the border after a gap is more likely another one.
    lost = lost - (
        parameters.border * near_border(box_px, sight.size)[..., None, :] + parameters.left * left_at_border[..., None]
    )
    # Where targets keep appearing out of nowhere, this is one more rather than one come back.
    crowding = functions.log(functions.clip(sight.births / _USUAL_BIRTHS, 1.0, None))
    lost = lost - functions.clip(parameters.births * crowding, None, _MOST_BIRTHS)
    return functions.where(missed[..., None], lost, score)


def _closeness(
    place: np.ndarray, variance: np.ndarray, centre_px: np.ndarray, parameters: TrackParameters
) -> np.ndarray:
    """(N, M) logarithm of the density of centres around places, and the prior. variance: (N,) in squared heights."""
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


def _misfit(state: np.ndarray, height: np.ndarray, doubt: float, scatter: float) -> np.ndarray:
    """(N, M) price of a height other than expected. height: (M,) its logarithm."""
    functions = namespace(state)
    usual = scatter * (1 + 0.5 * doubt)
    variance = usual**2 + state[..., SS]
    change = height[..., None, :] - functions.log(state[..., HEIGHT : HEIGHT + 1])
    wrong = functions.clip(0.5 * change**2 / variance[..., None], None, _WORST_SIZE)
    return wrong + 0.5 * functions.log(variance / usual**2)[..., None]
