"""Kalman filter of many targets at once: position, velocity, size and growth, with constant velocity.

The velocity is constant in the world and not in the picture: a target that comes nearer grows, and moves faster as it
grows. With a growth of γ a look, after g looks a height h is h / (1 − γ g) and the displacement is v g / (1 − γ g).
This is exact for a straight walk at constant speed towards a pinhole camera, or past a moving camera.

States are (N, COLUMNS) float64 arrays with one row for each target, in pixels and looks, or tensors with leading axes.
The variances of position and velocity are per axis, for two independent axes, in squared target heights, because near
and distant targets move by the same number of their own heights. The variances of size belong to the log height.
"""

from typing import Any

import numpy as np

from torchvision_dddas.geometry import namespace

X, Y, VX, VY, WIDTH, HEIGHT, GROWTH, SEEN = range(8)
PP, PV, VV = 8, 9, 10  # position, velocity: variances and covariance
SS, SG, GG = 11, 12, 13  # log height, growth: variances and covariance
COLUMNS = 14

SIZE_SCATTER = 0.1
"""Default standard deviation of the log height of a detection."""
_GROWTH = 0.15  # standard deviation of a new target's growth in a look, as a share of the usual step
_GROWTH_CHANGE = 0.4  # standard deviation of the change of growth, as a share of the velocity change's deviation
_WIDTH_GAIN = 0.5
_FARTHEST, _NEAREST = -1.0, 0.5  # bounds of γ g: the predicted distance is at least half of the current one

Variances = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Variance of a value, covariance with its rate, and variance of the rate: (N,) each."""


def start(
    box_px: np.ndarray, time: float, scatter: float, speed: float, size_scatter: float = SIZE_SCATTER
) -> np.ndarray:
    """Return the states of new targets at rest.

    box_px: (N, 4) x, y, width, height. scatter, speed, size_scatter: standard deviations of the centre in heights, of
    the velocity in heights a look, and of the log height.
    """
    nothing = 0 * box_px[..., 0]
    return _table(
        box_px[..., :2] + box_px[..., 2:] / 2,
        0 * box_px[..., :2],
        box_px[..., 2:],
        nothing,
        nothing + time,
        (nothing + scatter**2, nothing, nothing + speed**2),
        (nothing + size_scatter**2, nothing, nothing + (_GROWTH * speed) ** 2),
    )


def predict(state: np.ndarray, time: float, wander: float) -> np.ndarray:
    """Predict states at a later time. wander: standard deviation of a look's change of velocity, heights a look."""
    gap = time - state[..., SEEN]
    stretch = 1 / (1 - (gap * state[..., GROWTH]).clip(_FARTHEST, _NEAREST))
    return _table(
        state[..., X : Y + 1] + (gap * stretch)[..., None] * state[..., VX : VY + 1],
        state[..., VX : VY + 1] * (stretch**2)[..., None],
        state[..., WIDTH : HEIGHT + 1] * stretch[..., None],
        state[..., GROWTH] * stretch,
        state[..., SEEN],
        _spread(state, PP, gap, wander**2),
        _spread(state, SS, gap, (_GROWTH_CHANGE * wander) ** 2),
    )


def _spread(state: np.ndarray, first: int, gap: np.ndarray, power: float) -> Variances:
    """Return the variances after a gap (N,) of looks. The rate is a random walk with variance `power` a look."""
    place, both, rate = state[..., first], state[..., first + 1], state[..., first + 2]
    return (
        place + gap * (2 * both + gap * (rate + power / 3 * gap)),
        both + gap * (rate + power / 2 * gap),
        rate + power * gap,
    )


def update(
    later: np.ndarray,
    box_px: np.ndarray,
    time: float,
    scatter: float,
    size_scatter: float = SIZE_SCATTER,
    is_cut: np.ndarray | bool = False,
) -> np.ndarray:
    """Correct predicted states by boxes (N, 4).

    The gain of the velocity is at most 2 / gap, because one innovation after a long gap tells little about the current
    speed. is_cut: (N,) whether the picture's border may cut the box. The growth of such a target is set to 0, because
    its box changes in size without a change of distance.
    """
    functions = namespace(later)
    gap = functions.clip(time - later[..., SEEN], 1e-3, None)
    (gain, rate_gain), place_variances = _gains(later, PP, scatter**2, 2 / gap)
    innovation = box_px[..., :2] + box_px[..., 2:] / 2 - later[..., : Y + 1]
    (size_gain, growth_gain), size_variances = _gains(later, SS, size_scatter**2, None)
    size_innovation = functions.log(box_px[..., 3] / later[..., HEIGHT])
    width = later[..., WIDTH] + _WIDTH_GAIN * (box_px[..., 2] - later[..., WIDTH])
    return _table(
        later[..., : Y + 1] + gain[..., None] * innovation,
        later[..., VX : VY + 1] + rate_gain[..., None] * innovation,
        functions.stack([width, later[..., HEIGHT] * functions.exp(size_gain * size_innovation)], -1),
        (later[..., GROWTH] + growth_gain * size_innovation) * (1.0 - 1.0 * is_cut),
        0 * later[..., SEEN] + time,
        place_variances,
        size_variances,
    )


def _gains(
    later: np.ndarray, first: int, noise: float, most: np.ndarray | None
) -> tuple[tuple[np.ndarray, np.ndarray], Variances]:
    """Return the gains (N,) of a value and of its rate, and the updated variances. most: bound of the rate's gain."""
    place, both, rate = later[..., first], later[..., first + 1], later[..., first + 2]
    total = place + noise
    gain, rate_gain = place / total, both / total
    if most is not None:
        rate_gain = namespace(later).minimum(rate_gain, most)
    return (gain, rate_gain), (place * (1 - gain), both * (1 - gain), rate - rate_gain * both)


def _table(
    centre: Any,
    velocity: np.ndarray,
    size: np.ndarray,
    growth: np.ndarray,
    seen: np.ndarray,
    place_variances: Variances,
    size_variances: Variances,
) -> np.ndarray:
    """Build states (N, COLUMNS) from their parts: the first three are (N, 2), the others (N,)."""
    rest = (growth, seen, *place_variances, *size_variances)
    if isinstance(centre, np.ndarray):  # filling an array is much faster than concatenation
        state = np.empty((*centre.shape[:-1], COLUMNS))
        state[..., X : Y + 1], state[..., VX : VY + 1], state[..., WIDTH : HEIGHT + 1] = centre, velocity, size
        for column, values in enumerate(rest, GROWTH):
            state[..., column] = values
        return state
    functions = namespace(centre)
    return functions.concatenate([centre, velocity, size, functions.stack(rest, -1)], -1)


def transform(state: np.ndarray, now_from_before: np.ndarray) -> np.ndarray:
    """Transform states by the camera's motion. now_from_before: (3, 3) pixel homography.

    Velocities are mapped by the derivative of the homography at each target, and sizes by its scale there.
    """
    place, derivative = _map_points(state[..., : Y + 1], now_from_before)
    velocity = namespace(state).einsum("...nij,...nj->...ni", derivative, state[..., VX : VY + 1])
    size = state[..., WIDTH : HEIGHT + 1] * _scale(derivative)
    return namespace(state).concatenate([place, velocity, size, state[..., GROWTH:]], -1)


def transform_boxes(box_px: np.ndarray, now_from_before: np.ndarray) -> np.ndarray:
    """Transform boxes (N, 4) by the camera's motion: centres by the homography, sides by its scale, not rotated."""
    centre, derivative = _map_points(box_px[:, :2] + box_px[:, 2:] / 2, now_from_before)
    size = box_px[:, 2:] * _scale(derivative)
    return np.concatenate([centre - size / 2, size], axis=1)


def _map_points(point: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Map points (N, 2) by a homography, and return also its derivatives there, (N, 2, 2)."""
    straight = namespace(point).swapaxes(h[..., :2], -1, -2)
    depth = point @ straight[..., 2:] + h[..., 2:, 2:]
    place = (point @ straight[..., :2] + h[..., None, :2, 2]) / depth
    return place, (h[..., None, :2, :2] - place[..., None] * h[..., None, 2:, :2]) / depth[..., None]


def _scale(derivative: np.ndarray) -> np.ndarray:
    area = derivative[..., 0, 0] * derivative[..., 1, 1] - derivative[..., 0, 1] * derivative[..., 1, 0]
    return namespace(derivative).sqrt(abs(area))[..., None]
