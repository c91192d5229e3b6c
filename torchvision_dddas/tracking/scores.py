"""Association scores: how well a detection continues a track, as log-odds, 0 where the evidence is balanced.

The score of a link is a sum of three logarithms:

- of the density of the target's next place where the detection is, over the density of new targets there;
- of the likelihood of the detection's size;
- of the odds that the target is still there and detected.

A target without a link scores 0. So no dummy has to be tuned, and dummies do not win by their number (appendix C gives
dummies an affinity of their own, and its optimum is then to link nothing).
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchvision_dddas.config import TrackParameters
from torchvision_dddas.geometry import namespace
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.box_motion import medians
from torchvision_dddas.tracking.kalman import HEIGHT, PP, SEEN, SS, VX, VY, WIDTH, X, Y
from torchvision_dddas.tracking.scene import SceneState

_LEAST_SCORE = -4.0  # of a pair that is near enough to be looked at
_FEW = 4000  # pairs that are compared with the reach without sorting
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


@dataclass(frozen=True)
class Look:
    """N tracks as last seen and at a look (later), and the M boxes there: what the scores of all links need.

    state, later: (N, kalman.COLUMNS). missed: (N,) looks without a detection since. x, y, log_height: (M,) of boxes.
    arrival: (M,), survival: (N,) parts of the scores. Arrays, or tensors with a gradient in the parameters.
    """

    state: np.ndarray
    missed: np.ndarray
    later: np.ndarray
    survival: np.ndarray
    x: np.ndarray
    y: np.ndarray
    log_height: np.ndarray
    arrival: np.ndarray
    scene: SceneState

    @classmethod
    def of(cls, state: Any, missed: Any, box_px: Any, scene: SceneState, parameters: TrackParameters) -> "Look":
        """The look of some boxes (M, 4)."""
        later = kalman.predict(state, scene.time, parameters.wander * scene.step)
        survival = _survival(later, missed, scene, parameters)
        x, y, height = box_px[..., 0] + box_px[..., 2] / 2, box_px[..., 1] + box_px[..., 3] / 2, box_px[..., 3]
        # Minus the logarithm of the density of new targets, a square pixel, at each detection.
        arrival = -namespace(x).log(scene.density * (scene.turnover + _crossing(x, y, height, scene, parameters)))
        return cls(state, missed, later, survival, x, y, namespace(x).log(height), arrival, scene)

    def of_tracks(self, which: np.ndarray) -> "Look":
        """The same boxes with some of the tracks (K,)."""
        names = ("state", "missed", "later", "survival")
        return replace(self, **{name: getattr(self, name).take(which, 0) for name in names})


def association_scores(look: Look, parameters: TrackParameters) -> np.ndarray:
    """(N, M) scores of tracks with a known velocity and the detections of a look, without appearance.

    In arrays, pairs that are too far apart for a link score -inf.
    """
    later, functions = look.later, namespace(look.state)
    states, variance = later[None], (later[..., PP] + parameters.scatter**2)[None]
    if is_lost := (look.missed > 0).any():
        # A lost target may have stood still behind an obstacle: then its last place is a better prediction.
        drift = parameters.rest_drift**2 * (look.scene.time - later[..., SEEN])
        states = functions.stack([later, look.state])
        variance = functions.stack([variance[0], parameters.scatter**2 + drift])
    pairs = _pairs(later, states[..., :2], variance, look, parameters)
    ways = _place_density(pairs, states, states[..., :2], variance, look, parameters)
    ways = ways - _size_penalty(pairs, states, look, parameters.size_scatter)
    score = ways[0]
    if is_lost:
        at_rest = functions.maximum(score, ways[1] - parameters.rest_price)
        score = functions.where(pairs.of_tracks(look.missed) > 0, at_rest, score)
    return pairs.matrix(score + pairs.of_boxes(look.arrival) + pairs.of_tracks(look.survival))


def newborn_scores(look: Look, parameters: TrackParameters, velocities: np.ndarray) -> np.ndarray:
    """(N, M) scores, as `association_scores`, of tracks with a single detection.

    velocities: (W, N, 2) from `likely_velocities`.
    """
    state = look.state
    functions = namespace(state)
    gap = look.scene.time - state[..., SEEN]
    step, noise = look.scene.step * gap, 2 * parameters.scatter**2
    count = len(velocities) - 1
    share = _AS_NEIGHBOURS[0] * count / (count + 2)  # few neighbours say little
    other = (1 - share) / (_AT_REST[0] + _ANYHOW[0])
    # A track stays at rest, moves at any velocity, or moves as one of its neighbours. Each case has a place and a
    # standard deviation, in steps.
    place = state[..., :2] + velocities[[0, *range(count + 1)]] * gap[..., None]
    spread = [_AT_REST[1] * step, _ANYHOW[1] * step, *[_AS_NEIGHBOURS[1] * step] * count]
    variance = noise + functions.stack(spread) ** 2
    pairs = _pairs(state, place, variance, look, parameters)
    density = functions.exp(_place_density(pairs, state, place, variance, look, parameters))
    score = other * (_AT_REST[0] * density[0] + _ANYHOW[0] * density[1])
    if count:
        score = score + share / count * density[2:].sum(0)
    score = functions.log(score)
    score = score - _size_penalty(pairs, look.later, look, parameters.size_scatter)
    return pairs.matrix(score + pairs.of_boxes(look.arrival) + pairs.of_tracks(look.survival))


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
    return medians(flow[:, VX : VY + 1]) if len(flow) >= _FEWEST else np.zeros(2)


@dataclass(frozen=True)
class _Near:
    """Those pairs of N tracks and M boxes that are near enough to be linked, for arrays. row, column: (P,)."""

    row: np.ndarray
    column: np.ndarray
    shape: tuple[int, int]

    def of_tracks(self, values: np.ndarray) -> np.ndarray:
        return values.take(self.row, -1)

    def of_boxes(self, values: np.ndarray) -> np.ndarray:
        return values.take(self.column, -1)

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
    state: Any, place_px: np.ndarray, variance: np.ndarray, look: Look, parameters: TrackParameters
) -> _Near | _All:
    """The pairs whose scores are computed: those in a circle around all places where a target may be.

    place_px: (W, N, 2), variance: (W, N) in squared heights.
    """
    if not isinstance(state, np.ndarray):
        return _All()
    unit = state[:, HEIGHT] ** 2 * variance
    # Where the density has fallen to what makes the score the least of interest if all else fits.
    least = _LEAST_SCORE - look.arrival.max(initial=-np.inf) - look.survival
    narrow = min(1.0, parameters.upright**2) * np.minimum(state[:, WIDTH] / state[:, HEIGHT], 1.0)
    fall = (-np.log(2 * math.pi * (unit * narrow)) - least) / (1 + parameters.tail / 2)
    reach = np.sqrt(parameters.tail * unit * np.expm1(fall.clip(0, 50))) * max(1.0, parameters.upright)
    x, y = place_px[..., 0], place_px[..., 1]
    radius = reach[0] if len(reach) == 1 else (reach + np.hypot(x - x[0], y - y[0])).max(axis=0)
    shape = len(state), len(look.x)
    if shape[0] * shape[1] <= _FEW:
        across, along = look.x - x[0][:, None], look.y - y[0][:, None]
        row, column = (across * across + along * along < (radius * radius)[:, None]).nonzero()
        return _Near(row, column, shape)
    # Of each track, the boxes between its left and its right reach: a run of those sorted by x.
    by_x = look.x.argsort(kind="stable")
    sorted_x = look.x[by_x]
    first = sorted_x.searchsorted(x[0] - radius)
    count = np.maximum(sorted_x.searchsorted(x[0] + radius, "right") - first, 0)
    row = np.arange(len(state)).repeat(count)
    column = by_x[np.arange(len(row)) + (first - count.cumsum() + count).repeat(count)]
    across, along = look.x[column] - x[0][row], look.y[column] - y[0][row]
    near = across * across + along * along < (radius * radius)[row]
    return _Near(row[near], column[near], shape)


def _place_density(
    pairs: _Near | _All,
    state: np.ndarray,
    place_px: np.ndarray,
    variance: np.ndarray,
    look: Look,
    parameters: TrackParameters,
) -> np.ndarray:
    """Log density, a square pixel, of the boxes' centres around places (..., N, 2): Student's t in two dimensions.

    variance: (..., N) in squared heights of the tracks.
    """
    functions = namespace(state)
    width, height = state[..., WIDTH], state[..., HEIGHT]
    one = functions.ones_like(height)
    # Errors of detection grow with the sides of a box. Motion goes with the height; standing people move less up and
    # down in the picture than across it.
    noise = functions.minimum(_NOISE_SHARE * parameters.scatter**2 * one, _MOST_NOISE * variance)
    motion = variance - noise
    upright = functions.where(height > width, parameters.upright * one, one)
    narrow = functions.minimum(width / height, one)
    unit_x, unit_y = height**2 * (motion + noise * narrow**2), height**2 * (motion * upright**2 + noise)
    peak = -0.5 * functions.log((2 * math.pi) ** 2 * unit_x * unit_y)
    across = pairs.of_boxes(look.x) - pairs.of_tracks(place_px[..., 0])
    along = pairs.of_boxes(look.y) - pairs.of_tracks(place_px[..., 1])
    away = across * across / pairs.of_tracks(unit_x) + along * along / pairs.of_tracks(unit_y)
    return pairs.of_tracks(peak) - (1 + parameters.tail / 2) * functions.log1p(away / parameters.tail)


def _size_penalty(pairs: _Near | _All, state: np.ndarray, look: Look, scatter: Any) -> np.ndarray:
    """Penalty for a height other than predicted."""
    functions = namespace(state)
    variance = scatter**2 + state[..., SS]
    change = pairs.of_boxes(look.log_height) - pairs.of_tracks(functions.log(state[..., HEIGHT]))
    wrong = (0.5 * change**2 / pairs.of_tracks(variance)).clip(max=_LARGEST_SIZE_PENALTY)
    return wrong + pairs.of_tracks(0.5 * functions.log(variance / scatter**2))


def _survival(later: np.ndarray, missed: np.ndarray, scene: SceneState, parameters: TrackParameters) -> np.ndarray:
    """(N,) log-odds that a target is still there and detected. missed: (N,) looks without a detection before."""
    functions = namespace(later)
    crossing = _crossing(later[..., 0], later[..., 1], later[..., HEIGHT], scene, parameters)
    gone = (scene.turnover + crossing).clip(max=_LARGEST_GONE)
    hidden = scene.missing * parameters.hiding ** (missed - 1.0)
    there = functions.where(missed > 0, hidden / (hidden + gone * missed), 1 - gone)
    seen = there * (1 - scene.missing)
    return functions.log(seen / (1 - seen))


def _crossing(
    x: np.ndarray, y: np.ndarray, height_px: np.ndarray, scene: SceneState, parameters: TrackParameters
) -> np.ndarray:
    """(N,) share of the targets at places x, y (N,) that come or go across the picture's border between looks."""
    functions = namespace(x)
    if scene.size is None:
        return functions.zeros_like(x)
    depth = functions.minimum(functions.minimum(x, y), functions.minimum(scene.size[0] - x, scene.size[1] - y))
    return parameters.crossing * functions.exp(-(depth.clip(0) / height_px) / (scene.step + _BORDER))
