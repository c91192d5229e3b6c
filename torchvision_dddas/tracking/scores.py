"""Association scores: how well a detection continues a track, as log-odds, 0 where the evidence is balanced.

The score of a link is a sum of three logarithms:

- of the density of the target's next place where the detection is, over the density of new targets there;
- of the likelihood of the detection's size;
- of the odds that the target is still there and detected.

A target without a link scores 0. So no dummy has to be tuned, and dummies do not win by their number (appendix C gives
dummies an affinity of their own, and its optimum is then to link nothing).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchvision_dddas.config import TrackParameters
from torchvision_dddas.geometry import namespace
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.kalman import HEIGHT, PP, SEEN, SS, VX, VY, WIDTH, X, Y
from torchvision_dddas.tracking.scene import SceneState

_LEAST_SCORE = -4.0  # of a pair that is near enough to be looked at
_LARGEST_SIZE_PENALTY = 8.0
_LARGEST_GONE = 0.95
_NOISE_SHARE, _MOST_NOISE = 1.5, 0.95  # variance of places from errors, in `scatter` squared, and its largest share
_BORDER = 0.3  # heights: a target this near to the border may cross it even at rest

# A target that was detected once moves as one of its neighbours does, or stands still, or moves anyhow: the weights,
# and the standard deviations in usual steps.
_NEIGHBOURS, _FEWEST = 6, 3
_AS_NEIGHBOURS, _AT_REST, _ANYHOW = (0.5, 0.25), (0.2, 0.125), (0.3, 0.7)


def is_near_border(box_px: np.ndarray, size: tuple[float, float] | None) -> np.ndarray:
    """(N,) whether boxes (N, 4) are so close to the picture's border that a target may come or go there."""
    x, y, width, height = (box_px[..., side] for side in range(4))
    if size is None:
        return namespace(box_px).zeros_like(x, dtype=bool)
    margin = 0.15 * height
    return (x < margin) | (y < margin) | (x + width > size[0] - margin) | (y + height > size[1] - margin)


def association_scores(
    state: np.ndarray, missed: np.ndarray, box_px: np.ndarray, scene: SceneState, parameters: TrackParameters
) -> np.ndarray:
    """(N, M) scores of tracks with a known velocity and the detections of a look, without appearance.

    state: (N, kalman.COLUMNS) as last seen. missed: (N,) looks without a detection since. box_px: (M, 4). Arrays, or
    tensors with a gradient in the parameters. In arrays, pairs that are too far apart for a link score -inf.
    """
    functions = namespace(state)
    later = kalman.predict(state, scene.time, parameters.wander * scene.step)
    place, variance = later[None, ..., :2], (later[..., PP] + parameters.scatter**2)[None]
    if is_lost := (missed > 0).any():
        # A lost target may have stood still behind an obstacle: then its last place is a better prediction.
        spread = parameters.scatter**2 + parameters.rest_drift**2 * (scene.time - state[..., SEEN])
        place = functions.stack([later[..., :2], state[..., :2]])
        variance = functions.stack([variance[0], spread])
    arrival, survival = _arrival(box_px, scene, parameters), _survival(later, missed, scene, parameters)
    pairs = _pairs(later, place, variance, box_px, arrival, survival, parameters)
    score = _place_density(pairs, later, place[0], variance[0], box_px, parameters)
    score = score - _size_penalty(pairs, later, box_px, parameters.size_scatter)
    if is_lost:
        rest = _place_density(pairs, state, place[1], variance[1], box_px, parameters)
        rest = rest - _size_penalty(pairs, state, box_px, parameters.size_scatter) - parameters.rest_price
        score = functions.where(pairs.of_tracks(missed) > 0, functions.maximum(score, rest), score)
    return pairs.matrix(score + pairs.of_boxes(arrival) + pairs.of_tracks(survival))


def newborn_scores(
    state: np.ndarray,
    missed: np.ndarray,
    box_px: np.ndarray,
    scene: SceneState,
    parameters: TrackParameters,
    velocities: np.ndarray,
) -> np.ndarray:
    """(N, M) scores, as `association_scores`, of tracks with a single detection.

    velocities: (W, N, 2) from `likely_velocities`.
    """
    functions = namespace(state)
    gap = scene.time - state[..., SEEN]
    step, noise = scene.step * gap, 2 * parameters.scatter**2
    count = len(velocities) - 1
    share = _AS_NEIGHBOURS[0] * count / (count + 2)  # few neighbours say little
    other = (1 - share) / (_AT_REST[0] + _ANYHOW[0])
    # Ways to move: weights, which velocities, and standard deviations in steps.
    ways = [(other * _AT_REST[0], 0, _AT_REST[1]), (other * _ANYHOW[0], 0, _ANYHOW[1])]
    ways += [(share / count, 1 + neighbour, _AS_NEIGHBOURS[1]) for neighbour in range(count)]
    weight = functions.stack([way[0] + 0 * gap for way in ways])
    place = state[..., :2] + velocities[[way[1] for way in ways]] * gap[..., None]
    variance = functions.stack([noise + (way[2] * step) ** 2 for way in ways])
    later = kalman.predict(state, scene.time, parameters.wander * scene.step)
    arrival, survival = _arrival(box_px, scene, parameters), _survival(later, missed, scene, parameters)
    pairs = _pairs(state, place, variance, box_px, arrival, survival, parameters)
    density = functions.exp(_place_density(pairs, state, place, variance, box_px, parameters))
    score = functions.log((pairs.of_tracks(weight) * density).sum(0))
    score = score - _size_penalty(pairs, later, box_px, parameters.size_scatter)
    return pairs.matrix(score + pairs.of_boxes(arrival) + pairs.of_tracks(survival))


def likely_velocities(state: np.ndarray, flow: np.ndarray, common: np.ndarray) -> np.ndarray:
    """(W, N, 2) velocities, in pixels a look, of targets that were detected once: the common one; their neighbours'.

    state: (N, kalman.COLUMNS). flow: (K, kalman.COLUMNS) other tracks, which show how targets move here. common: (2,)
    their common velocity.
    """
    right, down = flow[:, X] - state[:, X : X + 1], flow[:, Y] - state[:, Y : Y + 1]
    if len(flow) > 8 * _NEIGHBOURS:  # sort those alone that are as near as the last of the nearest
        away = right * right
        away += down * down
        limit = np.partition(away, _NEIGHBOURS - 1, axis=1)[:, _NEIGHBOURS - 1 : _NEIGHBOURS]
        row, column = np.nonzero(away <= limit)
        order = np.lexsort((column, away[row, column], row))
        starts = np.searchsorted(row, np.arange(len(state)))
        nearest = column[order[starts[:, None] + np.arange(_NEIGHBOURS)]]
    else:
        nearest = np.argsort(np.hypot(right, down), axis=1, kind="stable")[:, :_NEIGHBOURS]
    found = np.empty((1 + nearest.shape[1], len(state), 2))
    found[0], found[1:] = common, np.swapaxes(flow[nearest, VX : VY + 1], 0, 1)
    return found


def common_velocity(flow: np.ndarray) -> np.ndarray:
    """(2,) the velocity, in pixels a look, that tracks (K, kalman.COLUMNS) have in common; 0 of too few."""
    return np.median(flow[:, VX : VY + 1], axis=0) if len(flow) >= _FEWEST else np.zeros(2)


@dataclass(frozen=True)
class _Near:
    """Those pairs of N tracks and M boxes that are near enough to be linked, for arrays. row, column: (P,)."""

    row: np.ndarray
    column: np.ndarray
    shape: tuple[int, int]

    def of_tracks(self, values: np.ndarray) -> np.ndarray:
        return values[..., self.row]

    def of_boxes(self, values: np.ndarray) -> np.ndarray:
        return values[..., self.column]

    def matrix(self, values: np.ndarray) -> np.ndarray:
        found = np.full(self.shape, -np.inf)
        found[self.row, self.column] = values
        return found


class _All:
    """All pairs, for tensors, which may have axes before those of the tracks and the boxes."""

    @staticmethod
    def of_tracks(values: Any) -> Any:
        return values[..., :, None]

    @staticmethod
    def of_boxes(values: Any) -> Any:
        return values[..., None, :]

    @staticmethod
    def matrix(values: Any) -> Any:
        return values


def _pairs(
    state: Any,
    place_px: np.ndarray,
    variance: np.ndarray,
    box_px: np.ndarray,
    arrival: np.ndarray,
    survival: np.ndarray,
    parameters: TrackParameters,
) -> _Near | _All:
    """The pairs whose scores are computed: those in a circle around all places where a target may be.

    place_px: (W, N, 2), variance: (W, N) in squared heights.
    """
    if not isinstance(state, np.ndarray):
        return _All()
    unit = state[:, HEIGHT] ** 2 * variance
    # Where the density has fallen to what makes the score the least of interest if all else fits.
    least = _LEAST_SCORE - arrival.max(initial=-np.inf) - survival
    least_unit = unit * min(1.0, parameters.upright**2) * np.minimum(state[:, WIDTH] / state[:, HEIGHT], 1.0)
    fall = (-np.log(2 * math.pi * least_unit) - least) / (1 + parameters.tail / 2)
    reach = np.sqrt(parameters.tail * unit * np.expm1(np.clip(fall, 0, 50))) * max(1.0, parameters.upright)
    x, y = place_px[..., 0], place_px[..., 1]
    radius = (reach + np.hypot(x - x[0], y - y[0])).max(axis=0)
    middle_x, middle_y = box_px[:, 0] + box_px[:, 2] / 2, box_px[:, 1] + box_px[:, 3] / 2
    # Of each track, the boxes between its left and its right reach: a run of those sorted by x.
    by_x = np.argsort(middle_x, kind="stable")
    first = np.searchsorted(middle_x[by_x], x[0] - radius)
    last = np.searchsorted(middle_x[by_x], x[0] + radius, "right")
    count = np.maximum(last - first, 0)
    row = np.repeat(np.arange(len(state)), count)
    column = by_x[np.arange(len(row)) - np.repeat(np.cumsum(count) - count - first, count)]
    across, along = middle_x[column] - x[0, row], middle_y[column] - y[0, row]
    near = across * across + along * along < (radius * radius)[row]
    return _Near(row[near], column[near], (len(state), len(box_px)))


def _place_density(
    pairs: _Near | _All,
    state: np.ndarray,
    place_px: np.ndarray,
    variance: np.ndarray,
    box_px: np.ndarray,
    parameters: TrackParameters,
) -> np.ndarray:
    """Log density, a square pixel, of the boxes' centres around places (..., N, 2): Student's t in two dimensions.

    variance: (..., N) in squared heights of the tracks.
    """
    functions = namespace(state)
    width, height = state[..., WIDTH], state[..., HEIGHT]
    level = functions.ones_like(variance)
    # Errors of detection grow with the sides of a box. Motion goes with the height; standing people move less up and
    # down in the picture than across it.
    noise = functions.minimum(_NOISE_SHARE * parameters.scatter**2 * level, _MOST_NOISE * variance)
    motion = variance - noise
    upright = functions.where(height > width, parameters.upright * level, level)
    narrow = functions.minimum(width / height, level)
    unit_x, unit_y = height**2 * (motion + noise * narrow**2), height**2 * (motion * upright**2 + noise)
    peak = -0.5 * functions.log((2 * math.pi) ** 2 * unit_x * unit_y)
    across = pairs.of_boxes(box_px[..., 0] + box_px[..., 2] / 2) - pairs.of_tracks(place_px[..., 0])
    along = pairs.of_boxes(box_px[..., 1] + box_px[..., 3] / 2) - pairs.of_tracks(place_px[..., 1])
    away = across * across / pairs.of_tracks(unit_x) + along * along / pairs.of_tracks(unit_y)
    return pairs.of_tracks(peak) - (1 + parameters.tail / 2) * functions.log1p(away / parameters.tail)


def _size_penalty(pairs: _Near | _All, state: np.ndarray, box_px: np.ndarray, scatter: Any) -> np.ndarray:
    """Penalty for a height other than predicted."""
    functions = namespace(state)
    variance = scatter**2 + state[..., SS]
    change = pairs.of_boxes(functions.log(box_px[..., 3])) - pairs.of_tracks(functions.log(state[..., HEIGHT]))
    wrong = functions.clip(0.5 * change**2 / pairs.of_tracks(variance), None, _LARGEST_SIZE_PENALTY)
    return wrong + pairs.of_tracks(0.5 * functions.log(variance / scatter**2))


def _arrival(box_px: np.ndarray, scene: SceneState, parameters: TrackParameters) -> np.ndarray:
    """(M,) minus the logarithm of the density of new targets, a square pixel, at each detection."""
    centre = box_px[..., :2] + box_px[..., 2:] / 2
    crossing = _crossing(centre, box_px[..., 3], scene, parameters)
    return -namespace(box_px).log(scene.density * (scene.turnover + crossing))


def _survival(later: np.ndarray, missed: np.ndarray, scene: SceneState, parameters: TrackParameters) -> np.ndarray:
    """(N,) log-odds that a target is still there and detected. missed: (N,) looks without a detection before."""
    functions = namespace(later)
    gone = scene.turnover + _crossing(later[..., :2], later[..., HEIGHT], scene, parameters)
    gone = functions.clip(gone, None, _LARGEST_GONE)
    hidden = scene.missing * parameters.hiding ** (missed - 1.0)
    there = functions.where(missed > 0, hidden / (hidden + gone * missed), 1 - gone)
    seen = there * (1 - scene.missing)
    return functions.log(seen / (1 - seen))


def _crossing(
    place_px: np.ndarray, height_px: np.ndarray, scene: SceneState, parameters: TrackParameters
) -> np.ndarray:
    """(N,) share of the targets at places (N, 2) that come or go across the picture's border between looks."""
    functions = namespace(place_px)
    x, y = place_px[..., 0], place_px[..., 1]
    if scene.size is None:
        return functions.zeros_like(x)
    depth = functions.minimum(functions.minimum(x, y), functions.minimum(scene.size[0] - x, scene.size[1] - y))
    depth = functions.clip(depth, 0, None) / height_px
    return parameters.crossing * functions.exp(-depth / (scene.step + _BORDER))
