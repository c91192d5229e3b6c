"""Where a target goes: position, velocity, size and growth of many targets at once, filtered at constant velocity.

The velocity is constant in the world, not in the picture: what comes nearer by a perspective camera grows, and moves
faster the larger it is. With a growth of γ a frame, after g frames a height h is h / (1 − γ g) and the displacement is
v g / (1 − γ g), exactly for a straight walk at constant speed towards a pinhole camera, or past a camera that drives.

A state is a (N, COLUMNS) float64 array, one row a target, in pixels and frames; but for the camera's motion a tensor
will do as well, with axes before N. Its variances are those of each of the two axes, which are alike and independent,
in squares of the target's height: near targets move as far in their own heights as distant ones. Those of the size are
of the logarithm of the height.
"""

import numpy as np

from torchvision_dddas.geometry import namespace

X, Y, VX, VY, WIDTH, HEIGHT, GROWTH, SEEN = range(8)
PP, PV, VV = 8, 9, 10  # position, velocity: variances and covariance
SS, SG, GG = 11, 12, 13  # logarithm of the height, growth
COLUMNS = 14

USUAL_SPEED = 0.07
"""Heights a frame at which the noise below is meant; it scales with the speed."""
SIZE_SCATTER = 0.1
"""Usual sd of a detection's logarithm of the height."""
_GROWTH = 0.03  # sd of the growth of a new target, per frame
_GROWTH_CHANGE = 0.01  # sd of its change in one frame
_WIDTH_GAIN = 0.5
_FARTHEST, _NEAREST = -1.0, 0.5  # bounds of γ g: nothing is predicted to come nearer than half its distance

Variances = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Of a value, of it and its rate, of the rate: (N,) each."""


def started(
    box_px: np.ndarray, frame: int, scatter: float, speed: float, size_scatter: float = SIZE_SCATTER
) -> np.ndarray:
    """States of targets seen for the first time, at rest.

    box_px: (N, 4) x, y, width, height. scatter, speed: sd of the centre in heights, and of the velocity per frame.
    size_scatter: sd of the logarithm of the height.
    """
    nothing = 0 * box_px[..., 0]
    return _table(
        box_px[..., :2] + box_px[..., 2:] / 2,
        0 * box_px[..., :2],
        box_px[..., 2:],
        nothing,
        nothing + frame,
        (nothing + scatter**2, nothing, nothing + speed**2),
        (nothing + size_scatter**2, nothing, nothing + (_GROWTH * speed / USUAL_SPEED) ** 2),
    )


def predicted(state: np.ndarray, frame: int, agility: float) -> np.ndarray:
    """The states at a later frame. agility: sd of the change of velocity in one frame, heights/frame."""
    gap = frame - state[..., SEEN]
    stretch = 1 / (1 - namespace(state).clip(gap * state[..., GROWTH], _FARTHEST, _NEAREST))
    return _table(
        state[..., X : Y + 1] + (gap * stretch)[..., None] * state[..., VX : VY + 1],
        state[..., VX : VY + 1] * (stretch**2)[..., None],
        state[..., WIDTH : HEIGHT + 1] * stretch[..., None],
        state[..., GROWTH] * stretch,
        state[..., SEEN],
        _spread(state, PP, gap, agility**2),
        _spread(state, SS, gap, (_GROWTH_CHANGE / 0.009 * agility) ** 2),
    )


def _spread(state: np.ndarray, first: int, gap: np.ndarray, power: float) -> Variances:
    """The variances of a value and its rate after a gap (N,), the rate being a random walk of this power."""
    place, both, rate = state[..., first], state[..., first + 1], state[..., first + 2]
    return (
        place + gap * (2 * both + gap * (rate + power / 3 * gap)),
        both + gap * (rate + power / 2 * gap),
        rate + power * gap,
    )


def updated(
    later: np.ndarray, box_px: np.ndarray, frame: int, scatter: float, size_scatter: float = SIZE_SCATTER
) -> np.ndarray:
    """Predicted states corrected by their boxes (N, 4).

    The velocity's gain is held to two over the gap: one surprise after a long absence tells little of the speed now.
    """
    functions = namespace(later)
    gap = functions.clip(frame - later[..., SEEN], 1, None)
    (gain, turn), of_place = _gains(later, PP, scatter**2, 2 / gap)
    miss = box_px[..., :2] + box_px[..., 2:] / 2 - later[..., : Y + 1]
    (grow, growing), of_size = _gains(later, SS, size_scatter**2, None)
    grown = functions.log(box_px[..., 3] / later[..., HEIGHT])
    width = later[..., WIDTH] + _WIDTH_GAIN * (box_px[..., 2] - later[..., WIDTH])
    return _table(
        later[..., : Y + 1] + gain[..., None] * miss,
        later[..., VX : VY + 1] + turn[..., None] * miss,
        functions.stack([width, later[..., HEIGHT] * functions.exp(grow * grown)], -1),
        later[..., GROWTH] + growing * grown,
        0 * later[..., SEEN] + frame,
        of_place,
        of_size,
    )


def _gains(
    later: np.ndarray, first: int, noise: float, most: np.ndarray | None
) -> tuple[tuple[np.ndarray, np.ndarray], Variances]:
    """Gains (N,) of a value and its rate, and the variances that are left. most: bound of the second gain."""
    place, both, rate = later[..., first], later[..., first + 1], later[..., first + 2]
    certain = place + noise
    gain, turn = place / certain, both / certain
    if most is not None:
        turn = namespace(later).minimum(turn, most)
    return (gain, turn), (place * (1 - gain), both * (1 - gain), rate - turn * both)


def _table(
    centre: np.ndarray,
    velocity: np.ndarray,
    size: np.ndarray,
    growth: np.ndarray,
    seen: np.ndarray,
    of_place: Variances,
    of_size: Variances,
) -> np.ndarray:
    """States (N, COLUMNS) of their parts: (N, 2) the first three, (N,) the others."""
    functions = namespace(centre)
    rest = functions.stack([growth, seen, *of_place, *of_size], -1)
    return functions.concatenate([centre, velocity, size, rest], -1)


def carried(state: np.ndarray, now_from_before: np.ndarray) -> np.ndarray:
    """The states after the camera has moved. now_from_before: (3, 3) homography on pixels.

    Velocities turn and stretch with the picture around each target, and sizes with its scale there.
    """
    place, turn = _mapped(state[..., : Y + 1], now_from_before)
    velocity = namespace(state).einsum("...nij,...nj->...ni", turn, state[..., VX : VY + 1])
    size = state[..., WIDTH : HEIGHT + 1] * _scale(turn)
    return namespace(state).concatenate([place, velocity, size, state[..., GROWTH:]], -1)


def carried_boxes(box_px: np.ndarray, now_from_before: np.ndarray) -> np.ndarray:
    """The same for boxes (N, 4): the centre moves, the sides stretch by the scale there and stay upright."""
    centre, turn = _mapped(box_px[:, :2] + box_px[:, 2:] / 2, now_from_before)
    size = box_px[:, 2:] * _scale(turn)
    return np.concatenate([centre - size / 2, size], axis=1)


def _mapped(point: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) under a homography, and its derivative there, (N, 2, 2)."""
    straight = namespace(point).swapaxes(h[..., :2], -1, -2)
    depth = point @ straight[..., 2:] + h[..., 2:, 2:]
    place = (point @ straight[..., :2] + h[..., None, :2, 2]) / depth
    return place, (h[..., None, :2, :2] - place[..., None] * h[..., None, 2:, :2]) / depth[..., None]


def _scale(turn: np.ndarray) -> np.ndarray:
    area = turn[..., 0, 0] * turn[..., 1, 1] - turn[..., 0, 1] * turn[..., 1, 0]
    return namespace(turn).sqrt(abs(area))[..., None]
