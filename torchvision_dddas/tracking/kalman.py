"""Kalman filter of many targets at once: position, velocity, size and growth, at constant velocity.

The velocity is constant in the world, not in the picture: a target that comes nearer grows, and moves faster the larger
it is. With a growth of γ a look, after g looks a height h is h / (1 − γ g) and the displacement is v g / (1 − γ g),
exactly for a straight walk at constant speed towards a pinhole camera, or past a camera that drives.

States are (N, COLUMNS) float64 arrays, one row a target, in pixels and looks, or tensors with axes before N. The
position's variances hold for each of the two axes, which are independent, in squares of the target's height: near
targets move as far in their own heights as distant ones. The size's are of the logarithm of the height.
"""

from typing import Any

import numpy as np

from torchvision_dddas.geometry import namespace

X, Y, VX, VY, WIDTH, HEIGHT, GROWTH, SEEN = range(8)
PP, PV, VV = 8, 9, 10  # position, velocity: variances and covariance
SS, SG, GG = 11, 12, 13  # logarithm of the height, growth
COLUMNS = 14

SIZE_SCATTER = 0.1
"""Default sd of the logarithm of a detection's height."""
_GROWTH = 0.15  # sd of the growth of a new target from look to look, as a share of its usual step
_GROWTH_CHANGE = 0.4  # sd of the growth's change, as a share of the velocity's
_WIDTH_GAIN = 0.5
_FARTHEST, _NEAREST = -1.0, 0.5  # bounds of γ g: no target is predicted nearer than half its distance

Variances = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Variance of a value, its covariance with its rate, variance of the rate: (N,) each."""


def start(
    box_px: np.ndarray, time: float, scatter: float, speed: float, size_scatter: float = SIZE_SCATTER
) -> np.ndarray:
    """States of new targets, at rest.

    box_px: (N, 4) x, y, width, height. scatter: sd of the centre, in heights. speed: sd of the velocity, in heights a
    look. size_scatter: sd of the logarithm of the height.
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
    """States at a later time. wander: sd of the change of velocity in one look, heights a look."""
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
    """Variances after a gap (N,) of looks, the rate being a random walk of this power."""
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
    """Predicted states corrected by their boxes (N, 4).

    The velocity's gain is at most two over the gap: one innovation after a long gap says little of the present speed.
    is_cut: (N,) whether the picture's border may cut the box. As such a target crosses the border it grows or shrinks
    in the picture, but comes no nearer: it keeps no growth.
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
    """Gains (N,) of a value and its rate, and the variances after the update. most: bound of the second gain."""
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
    """States (N, COLUMNS) of their parts: (N, 2) the first three, (N,) the others."""
    rest = (growth, seen, *place_variances, *size_variances)
    if isinstance(centre, np.ndarray):  # much faster than joining
        state = np.empty((*centre.shape[:-1], COLUMNS))
        state[..., X : Y + 1], state[..., VX : VY + 1], state[..., WIDTH : HEIGHT + 1] = centre, velocity, size
        for column, values in enumerate(rest, GROWTH):
            state[..., column] = values
        return state
    functions = namespace(centre)
    return functions.concatenate([centre, velocity, size, functions.stack(rest, -1)], -1)


def transform(state: np.ndarray, now_from_before: np.ndarray) -> np.ndarray:
    """States after the camera has moved. now_from_before: (3, 3) pixel homography.

    Velocities turn and stretch with the picture around each target, and sizes with its scale there.
    """
    place, derivative = _map_points(state[..., : Y + 1], now_from_before)
    velocity = namespace(state).einsum("...nij,...nj->...ni", derivative, state[..., VX : VY + 1])
    size = state[..., WIDTH : HEIGHT + 1] * _scale(derivative)
    return namespace(state).concatenate([place, velocity, size, state[..., GROWTH:]], -1)


def transform_boxes(box_px: np.ndarray, now_from_before: np.ndarray) -> np.ndarray:
    """Boxes (N, 4) after the camera has moved: centres move, sides stretch by the scale there and stay upright."""
    centre, derivative = _map_points(box_px[:, :2] + box_px[:, 2:] / 2, now_from_before)
    size = box_px[:, 2:] * _scale(derivative)
    return np.concatenate([centre - size / 2, size], axis=1)


def _map_points(point: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) under a homography, and its derivative there, (N, 2, 2)."""
    straight = namespace(point).swapaxes(h[..., :2], -1, -2)
    depth = point @ straight[..., 2:] + h[..., 2:, 2:]
    place = (point @ straight[..., :2] + h[..., None, :2, 2]) / depth
    return place, (h[..., None, :2, :2] - place[..., None] * h[..., None, 2:, :2]) / depth[..., None]


def _scale(derivative: np.ndarray) -> np.ndarray:
    area = derivative[..., 0, 0] * derivative[..., 1, 1] - derivative[..., 0, 1] * derivative[..., 1, 0]
    return namespace(derivative).sqrt(abs(area))[..., None]
