"""Association scores: how well a detection continues a track, as log-odds, 0 where the evidence is balanced.

The score of a link is a sum of three logarithms:

- of the density of the target's next place where the detection is, over the density of new targets there;
- of the likelihood of the detection's size;
- of the odds that the target is still there and detected.

A target without a link scores 0. So no dummy has to be tuned, and dummies do not win by their number (appendix C gives
dummies an affinity of their own, and its optimum is then to link nothing).
"""

import math
from typing import Any

import numpy as np

from torchvision_dddas.config import TrackParameters
from torchvision_dddas.geometry import namespace
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.kalman import HEIGHT, PP, SEEN, SS, VX, VY, WIDTH, X, Y
from torchvision_dddas.tracking.scene import SceneState

_LARGEST_SIZE_PENALTY = 8.0
_LARGEST_GONE = 0.95
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
    tensors with a gradient in the parameters.
    """
    functions = namespace(state)
    later = kalman.predict(state, scene.time, parameters.wander * scene.step)
    score = _place_density(later, later[..., :2], later[..., PP] + parameters.scatter**2, box_px, parameters)
    score = score - _size_penalty(later, box_px, parameters.size_scatter)
    if (missed > 0).any():
        # A lost target may have stood still behind an obstacle: then its last place is a better prediction.
        gap = scene.time - state[..., SEEN]
        spread = parameters.scatter**2 + parameters.rest_drift**2 * gap
        rest = _place_density(state, state[..., :2], spread, box_px, parameters)
        rest = rest - _size_penalty(state, box_px, parameters.size_scatter) - parameters.rest_price
        score = functions.where((missed > 0)[..., None], functions.maximum(score, rest), score)
    return score + _arrival(box_px, scene, parameters) + _survival(later, missed, scene, parameters)[..., None]


def newborn_scores(
    state: np.ndarray,
    missed: np.ndarray,
    box_px: np.ndarray,
    scene: SceneState,
    parameters: TrackParameters,
    flow: np.ndarray,
) -> np.ndarray:
    """(N, M) scores, as `association_scores`, of tracks with a single detection.

    flow: (K, kalman.COLUMNS) other tracks, which show how targets move here; with tensors, none (0, kalman.COLUMNS).
    """
    functions = namespace(state)
    gap = scene.time - state[..., SEEN]
    step, noise = scene.step * gap, 2 * parameters.scatter**2
    common = common_velocity(flow)
    count = min(_NEIGHBOURS, len(flow))
    share = _AS_NEIGHBOURS[0] * count / (count + 2)  # few neighbours say little
    other = (1 - share) / (_AT_REST[0] + _ANYHOW[0])
    # Ways to move: weights, velocities, and standard deviations in steps.
    ways = [(other * _AT_REST[0], common, _AT_REST[1]), (other * _ANYHOW[0], common, _ANYHOW[1])]
    if count:
        away = np.hypot(flow[:, X] - state[:, X : X + 1], flow[:, Y] - state[:, Y : Y + 1])
        nearest = np.argsort(away, axis=1, kind="stable")[:, :count]
        ways += [(share / count, flow[neighbour, VX : VY + 1], _AS_NEIGHBOURS[1]) for neighbour in nearest.T]
    place = functions.concatenate([state[..., :2] + velocity * gap[..., None] for _, velocity, _ in ways], -2)
    variance = functions.concatenate([noise + (deviation * step) ** 2 for *_, deviation in ways], -1)
    repeated = functions.concatenate([state] * len(ways), -2)
    density = _place_density(repeated, place, variance, box_px, parameters)
    rows = state.shape[-2]
    score = math.log(ways[0][0]) + density[..., :rows, :]
    for way in range(1, len(ways)):
        part = math.log(ways[way][0]) + density[..., way * rows : (way + 1) * rows, :]
        score = functions.logaddexp(score, part)
    later = kalman.predict(state, scene.time, parameters.wander * scene.step)
    score = score - _size_penalty(later, box_px, parameters.size_scatter)
    return score + _arrival(box_px, scene, parameters) + _survival(later, missed, scene, parameters)[..., None]


def common_velocity(flow: np.ndarray) -> np.ndarray:
    """(2,) the velocity, in pixels a look, that tracks (K, kalman.COLUMNS) have in common; 0 of too few."""
    velocity: np.ndarray = flow[:, VX : VY + 1]
    return np.median(velocity, axis=0) if len(flow) >= _FEWEST else velocity[:0].sum(0)


def _place_density(
    state: np.ndarray, place_px: np.ndarray, variance: np.ndarray, box_px: np.ndarray, parameters: TrackParameters
) -> np.ndarray:
    """(N, M) log density, a square pixel, of the boxes' centres around places (N, 2): Student's t in two dimensions.

    variance: (N,) in squared heights of the tracks.
    """
    functions = namespace(state)
    # Standing people move less up and down in the picture than across it.
    level = functions.ones_like(variance)
    upright = functions.where(state[..., HEIGHT] > state[..., WIDTH], parameters.upright * level, level)
    unit = state[..., HEIGHT] ** 2 * variance
    centre = box_px[..., :2] + box_px[..., 2:] / 2
    across = centre[..., None, :, 0] - place_px[..., :1]
    along = (centre[..., None, :, 1] - place_px[..., 1:]) / upright[..., None]
    away = (across * across + along * along) / unit[..., None]
    peak = -functions.log(2 * math.pi * unit * upright)
    return peak[..., None] - (1 + parameters.tail / 2) * functions.log1p(away / parameters.tail)


def _size_penalty(state: np.ndarray, box_px: np.ndarray, scatter: Any) -> np.ndarray:
    """(N, M) penalty for a height other than predicted."""
    functions = namespace(state)
    variance = scatter**2 + state[..., SS]
    change = functions.log(box_px[..., 3])[..., None, :] - functions.log(state[..., HEIGHT : HEIGHT + 1])
    wrong = functions.clip(0.5 * change**2 / variance[..., None], None, _LARGEST_SIZE_PENALTY)
    return wrong + 0.5 * functions.log(variance / scatter**2)[..., None]


def _arrival(box_px: np.ndarray, scene: SceneState, parameters: TrackParameters) -> np.ndarray:
    """(1, M) minus the logarithm of the density of new targets, a square pixel, at each detection."""
    functions = namespace(box_px)
    centre = box_px[..., :2] + box_px[..., 2:] / 2
    crossing = _crossing(centre, box_px[..., 3], scene, parameters)
    density = scene.density * functions.ones_like(crossing)
    return -functions.log(density * (scene.turnover + crossing))[..., None, :]


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
