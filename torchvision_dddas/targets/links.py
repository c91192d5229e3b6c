"""How well a detection continues a track: the score of a link, a logarithm of odds, 0 where nothing speaks either way.

Scores of links add up, and a target without a link scores 0: no dummy has to be tuned, and none wins by its number
(appendix C gives dummies an affinity of their own, and its optimum is then to link nothing).
"""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.settings import TrackKnobs
from torchvision_dddas.targets import kalman
from torchvision_dddas.targets.kalman import HEIGHT, PP, SEEN, SS, USUAL_SPEED, WIDTH, X, Y

_PRIOR = 4.0  # what a detection that continues a track is worth before anything is compared
_TAIL = 4.0  # freedom of the distance's distribution: people turn and stop more than a normal law allows
_UPRIGHT = 0.6  # standing people move less up and down in the picture than across it
_WORST_SIZE = 8.0
_MISSED, _MISSED_FRAMES = 0.5, 5.0  # the price of a gap, and how it grows
_REST_DRIFT = 0.03  # heights per square root of a frame
_REST_PRICE = 1.0
_COME_BACK_AT_BORDER, _LEFT_AT_BORDER = 4.0, 2.0  # a target seen at the border after a gap is more likely another one
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

    def agility(self, knobs: TrackKnobs) -> float:
        """Sd of the change of velocity in a frame, heights/frame: who is fast turns fast."""
        return knobs.agility * self.speed / USUAL_SPEED


def near_border(box_px: np.ndarray, size: tuple[float, float] | None) -> np.ndarray:
    """(N,) whether boxes (N, 4) are so close to the picture's border that a target may come or go there."""
    if size is None:
        return np.zeros(len(box_px), bool)
    x, y, width, height = box_px.T
    margin = 0.15 * height
    return (x < margin) | (y < margin) | (x + width > size[0] - margin) | (y + height > size[1] - margin)


def link_scores(
    state: np.ndarray, left_at_border: np.ndarray, box_px: np.ndarray, sight: Sight, knobs: TrackKnobs
) -> np.ndarray:
    """(N, M) scores of the links from tracks to the detections of a look, appearance left out.

    state: (N, kalman.COLUMNS) as last seen. left_at_border: (N,) whether they were seen at the border then.
    """
    later = kalman.predicted(state, sight.frame, sight.agility(knobs))
    centre, height = box_px[:, :2] + box_px[:, 2:] / 2, np.log(box_px[:, 3])
    score = _closeness(later, later[:, PP] + knobs.scatter**2, centre)
    score -= _misfit(later, height, sight.doubt, knobs.size_scatter)
    missed = sight.frame - state[:, SEEN] > sight.interval
    if missed.any():
        was, gap = state[missed], sight.frame - state[missed, SEEN]
        # Who was lost may have stood still behind something: that tells where better than any velocity.
        rest = _closeness(was, knobs.scatter**2 + _REST_DRIFT**2 * gap, centre)
        rest -= _misfit(was, height, sight.doubt, knobs.size_scatter)
        lost = np.maximum(score[missed], rest - _REST_PRICE)
        lost -= (_MISSED + 0.5 * np.log1p((gap - sight.interval) / _MISSED_FRAMES))[:, None]
        lost -= _COME_BACK_AT_BORDER * near_border(box_px, sight.size) + _LEFT_AT_BORDER * left_at_border[missed, None]
        # Where targets keep appearing out of nowhere, this is one more rather than one come back.
        lost -= min(knobs.births * np.log(max(sight.births / _USUAL_BIRTHS, 1.0)), _MOST_BIRTHS)
        score[missed] = lost
    return score


def _closeness(place: np.ndarray, variance: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
    """(N, M) logarithm of the density of centres around places, and the prior. variance: (N,) in squared heights."""
    upright = np.where(place[:, HEIGHT] > place[:, WIDTH], _UPRIGHT, 1.0)
    unit = (place[:, HEIGHT] ** 2 * variance)[:, None]
    across = centre_px[:, 0] - place[:, X : X + 1]
    along = (centre_px[:, 1] - place[:, Y : Y + 1]) / upright[:, None]
    away = (across * across + along * along) / unit
    peak = _PRIOR - np.log(2 * np.pi * variance * upright)
    return peak[:, None] - (1 + _TAIL / 2) * np.log1p(away / _TAIL)


def _misfit(state: np.ndarray, height: np.ndarray, doubt: float, scatter: float) -> np.ndarray:
    """(N, M) price of a height other than expected. height: (M,) its logarithm."""
    usual = scatter * (1 + 0.5 * doubt)
    variance = usual**2 + state[:, SS]
    change = height - np.log(state[:, HEIGHT : HEIGHT + 1])
    return np.minimum(0.5 * change**2 / variance[:, None], _WORST_SIZE) + 0.5 * np.log(variance / usual**2)[:, None]
