"""How well a detection continues a track: the score of a link, a logarithm of odds, 0 where nothing speaks either way."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.settings import TrackKnobs
from torchvision_dddas.targets import kalman
from torchvision_dddas.targets.kalman import HEIGHT, PP, SEEN, WIDTH, X, Y

_PRIOR = 4.0  # what a detection that continues a track is worth before anything is compared
_TAIL = 4.0  # freedom of the distance's distribution: people turn and stop more than a normal law allows
_UPRIGHT = 0.6  # people move less up and down in the picture than across it
_SIZE_SCATTER = 0.1  # of the logarithm of a height
_SIZE_CHANGE = 0.4  # heights change as far as targets come nearer
_WORST_SIZE = 8.0
_GROWK = 1.0
_REST_DRIFT = 0.03  # heights per square root of a frame
_REST_PRICE = 1.0


@dataclass(frozen=True)
class Sight:
    """What is known of a look at the scene. speed: of the pace, heights/frame. births: new tracks inside the picture
    per detection. size: (width, height) of the picture, None if unknown."""

    frame: int
    interval: int
    speed: float
    births: float
    size: tuple[float, float] | None


def near_border(box_px: np.ndarray, size: tuple[float, float] | None) -> np.ndarray:
    """(N,) whether boxes (N, 4) are so close to the picture's border that a target may come or go there."""
    if size is None or not len(box_px):
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
    later = kalman.predicted(state, sight.frame, knobs.agility * sight.speed / 0.07)
    gap = sight.frame - state[:, SEEN]
    missed = gap > sight.interval
    centre_x, centre_y = box_px[:, 0] + box_px[:, 2] / 2, box_px[:, 1] + box_px[:, 3] / 2
    score = _near(later, later[:, PP] + knobs.scatter**2, centre_x, centre_y)
    score -= _size(later, box_px, np.sqrt(_SIZE_SCATTER**2 + later[:, kalman.SS] * _GROWK))
    if missed.any():
        long = np.maximum(gap[missed] - sight.interval, 0)
        rest = _near(state[missed], knobs.scatter**2 + _REST_DRIFT**2 * gap[missed], centre_x, centre_y)
        rest -= _size(state[missed], box_px, np.sqrt(_SIZE_SCATTER**2 + state[missed, kalman.SS]*_GROWK)) + _REST_PRICE
        both = np.maximum(score[missed], rest)
        both -= (0.5 + 0.5 * np.log1p(long / 5))[:, None]
        both -= 4.0 * near_border(box_px, sight.size)[None] + 2.0 * left_at_border[missed, None]
        both -= 2 * max(np.log(max(sight.births, 1e-9) / 0.01), 0.0)
        score[missed] = both
    return score


def _near(place: np.ndarray, variance: np.ndarray, centre_x: np.ndarray, centre_y: np.ndarray) -> np.ndarray:
    """(N, M) logarithm of the density of centres around places with a variance (N,) in squared heights."""
    across = centre_x - place[:, X : X + 1]
    along = (centre_y - place[:, Y : Y + 1]) / _UPRIGHT
    distance = (across**2 + along**2) / (place[:, HEIGHT] ** 2 * variance)[:, None]
    return _PRIOR - (1 + _TAIL / 2) * np.log1p(distance / _TAIL) - np.log(2 * np.pi * variance * _UPRIGHT)[:, None]


def _size(state: np.ndarray, box_px: np.ndarray, scatter: np.ndarray) -> np.ndarray:
    """(N, M) price of a height other than expected. scatter: (N,) sd of its logarithm."""
    change = np.log(box_px[:, 3]) - np.log(state[:, HEIGHT : HEIGHT + 1])
    return np.minimum(0.5 * (change / scatter[:, None]) ** 2, _WORST_SIZE) + np.log(scatter / _SIZE_SCATTER)[:, None]


def likeness_scores(likeness: np.ndarray, visible: np.ndarray, knobs: TrackKnobs) -> np.ndarray:
    """(N, M) what the appearance adds. likeness: (N, M) Bhattacharyya coefficients. visible: (M,) shares of the boxes."""
    return knobs.appearance_weight * (likeness - knobs.appearance_offset) * np.sqrt(visible)[None]


def visible_share(box_px: np.ndarray) -> np.ndarray:
    """(N,) share of each box that no box nearer to the camera covers; nearer is what stands lower in the picture."""
    if not len(box_px):
        return np.zeros(0)
    low, high = box_px[:, :2], box_px[:, :2] + box_px[:, 2:]
    side = np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None])
    overlap = np.prod(np.maximum(side, 0), axis=2)
    nearer = high[None, :, 1] > high[:, None, 1]
    covered = (overlap * nearer).sum(axis=1) / np.prod(box_px[:, 2:], axis=1)
    return np.clip(1 - covered, 0.0, 1.0)
