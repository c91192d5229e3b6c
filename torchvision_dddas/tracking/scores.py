"""Association scores: log-odds that a detection continues a track, 0 if the evidence is balanced.

The score of a link is the sum of the logarithms of three terms:

- the density of the target's next position at the detection, divided by the density of new targets there;
- the likelihood of the detection's size;
- the odds that the target is still there and is detected.

A target without a link scores 0, so the score of a missing detection needs no tuning. (Appendix C gives an affinity to
the dummy that stands for a missing detection. The best solution is then to link nothing.)
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

_LEAST_SCORE = -4.0  # pairs that cannot score more because of their distance are skipped
_FEW = 4000  # up to this number, all pairs are compared without sorting
_LARGEST_SIZE_PENALTY = 8.0
_LARGEST_GONE = 0.95
# Variance of a position by detection errors, in units of `scatter` squared, and its limit as a share of all variance.
_NOISE_SHARE, _MOST_NOISE = 1.5, 0.95
_BORDER = 0.3  # a target this near to the border, in heights, may cross the border even at rest

# A target that was detected once moves like one of its neighbours, stands still, or moves with any velocity. Each pair
# is the weight of the case, and its standard deviation in usual steps.
_NEIGHBOURS, _FEWEST = 6, 3
_AS_NEIGHBOURS, _AT_REST, _ANYHOW = (0.5, 0.25), (0.2, 0.125), (0.3, 0.7)


def is_near_border(box_px: np.ndarray, size: tuple[float, float] | None) -> np.ndarray:
    """Return (N,) whether boxes (N, 4) are so near to the picture's border that targets may appear or leave there."""
    x, y, width, height = (box_px[..., side] for side in range(4))
    if size is None:
        return namespace(box_px).zeros_like(x, dtype=bool)
    margin = 0.15 * height
    return (x < margin) | (y < margin) | (x + width > size[0] - margin) | (y + height > size[1] - margin)


@dataclass(frozen=True)
class BoxLook:
    """The inputs for the scores of all links between N tracks and the M boxes of a look.

    state, later: (N, kalman.COLUMNS) at the last detection, and predicted for the look. missed: (N,) looks without a
    detection since then. x, y, log_height: (M,) centres and log heights of the boxes. arrival: (M,), and survival:
    (N,), parts of the scores. All are arrays, or tensors with gradients to the parameters.
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
    def of(cls, state: Any, missed: Any, box_px: Any, scene: SceneState, parameters: TrackParameters) -> "BoxLook":
        """Build the look for boxes (M, 4)."""
        later = kalman.predict(state, scene.time, parameters.wander * scene.step)
        survival = _survival(later, missed, scene, parameters)
        x, y, height = box_px[..., 0] + box_px[..., 2] / 2, box_px[..., 1] + box_px[..., 3] / 2, box_px[..., 3]
        # The negative logarithm of the density of new targets, per square pixel, at each detection.
        arrival = -namespace(x).log(scene.density * (scene.turnover + _crossing(x, y, height, scene, parameters)))
        return cls(state, missed, later, survival, x, y, namespace(x).log(height), arrival, scene)

    def of_tracks(self, which: np.ndarray) -> "BoxLook":
        """Return the same boxes with the tracks of the given indices (K,)."""
        names = ("state", "missed", "later", "survival")
        return replace(self, **{name: getattr(self, name).take(which, 0) for name in names})


def association_scores(look: BoxLook, parameters: TrackParameters) -> np.ndarray:
    """Return (N, M) scores of tracks with a known velocity and the detections of a look, without appearance.

    In arrays, pairs that are too far apart for a link have the score -inf.
    """
    later, functions = look.later, namespace(look.state)
    states, variance = later[None], (later[..., PP] + parameters.scatter**2)[None]
    if is_lost := (look.missed > 0).any():
        # A lost target may have stood still behind an obstacle. Then its last position is a better prediction.
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


def newborn_scores(look: BoxLook, parameters: TrackParameters, velocities: np.ndarray) -> np.ndarray:
    """Return (N, M) scores like `association_scores`, for tracks with a single detection.

    velocities: (W, N, 2) from `likely_velocities`.
    """
    state = look.state
    functions = namespace(state)
    gap = look.scene.time - state[..., SEEN]
    step, noise = look.scene.step * gap, 2 * parameters.scatter**2
    count = len(velocities) - 1
    share = _AS_NEIGHBOURS[0] * count / (count + 2)  # the weight is lower for few neighbours
    other = (1 - share) / (_AT_REST[0] + _ANYHOW[0])
    # A target stays at rest, moves with any velocity, or moves like one of its neighbours. Each case has a position and
    # a standard deviation.
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
    """Return (W, N, 2) likely velocities, px a look, of targets that were detected once.

    The first is the common velocity; the others are the nearest tracks' velocities. state: (N, kalman.COLUMNS). flow:
    (K, kalman.COLUMNS) other tracks with known velocities. common: (2,) their common velocity.
    """
    right, down = flow[:, X] - state[:, X : X + 1], flow[:, Y] - state[:, Y : Y + 1]
    if len(flow) > 8 * _NEIGHBOURS:  # find the nearest by a partition, and sort only these
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
    """Return the (2,) median velocity, px a look, of tracks (K, kalman.COLUMNS); 0 for too few tracks."""
    return medians(flow[:, VX : VY + 1]) if len(flow) >= _FEWEST else np.zeros(2)


@dataclass(frozen=True)
class _Near:
    """The P pairs of N tracks and M boxes that are near enough for a link, for arrays. row, column: (P,)."""

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
    """All pairs of tracks and boxes, for tensors, which may have leading axes."""

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
    state: Any, place_px: np.ndarray, variance: np.ndarray, look: BoxLook, parameters: TrackParameters
) -> _Near | _All:
    """Return the pairs whose scores are computed: boxes in a circle around all predicted positions of a target.

    place_px: (W, N, 2) positions. variance: (W, N) in squared heights.
    """
    if not isinstance(state, np.ndarray):
        return _All()
    unit = state[:, HEIGHT] ** 2 * variance
    # Radius at which the score falls to _LEAST_SCORE if the size fits perfectly.
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
    # For each track, take the boxes between its left and right limits, which are a slice of the boxes sorted by x.
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
    look: BoxLook,
    parameters: TrackParameters,
) -> np.ndarray:
    """Return the log density, per square pixel, of the boxes' centres around positions: Student's t in two dimensions.

    place_px: (..., N, 2). variance: (..., N) in squared heights of the tracks.
    """
    functions = namespace(state)
    width, height = state[..., WIDTH], state[..., HEIGHT]
    one = functions.ones_like(height)
    # Detection errors are proportional to the sides of a box, and motion to its height. Upright people move less up and
    # down in the picture than sideways.
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


def _size_penalty(pairs: _Near | _All, state: np.ndarray, look: BoxLook, scatter: Any) -> np.ndarray:
    """Return the penalty for a height that differs from the prediction."""
    functions = namespace(state)
    variance = scatter**2 + state[..., SS]
    change = pairs.of_boxes(look.log_height) - pairs.of_tracks(functions.log(state[..., HEIGHT]))
    wrong = (0.5 * change**2 / pairs.of_tracks(variance)).clip(max=_LARGEST_SIZE_PENALTY)
    return wrong + pairs.of_tracks(0.5 * functions.log(variance / scatter**2))


def _survival(later: np.ndarray, missed: np.ndarray, scene: SceneState, parameters: TrackParameters) -> np.ndarray:
    """Return the (N,) log-odds that a target is still there and detected. missed: (N,) looks without a detection."""
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
    """Return the (N,) share of targets at x, y (N,) that cross the picture's border between two looks."""
    functions = namespace(x)
    if scene.size is None:
        return functions.zeros_like(x)
    depth = functions.minimum(functions.minimum(x, y), functions.minimum(scene.size[0] - x, scene.size[1] - y))
    return parameters.crossing * functions.exp(-(depth.clip(0) / height_px) / (scene.step + _BORDER))
