"""Where a target goes: position and velocity of many targets at once, filtered with constant velocity.

A state is a (N, COLUMNS) float64 array, one row a target, in pixels and frames. Its covariance is that of each of the
two axes, which are alike and independent, in squares of the target's height: near targets move as far in their own
heights as distant ones.
"""

import numpy as np

X, Y, VX, VY, WIDTH, HEIGHT, PP, PV, VV, SEEN, GROWTH, SS, SG, GG = range(14)
COLUMNS = 14
_LOOSE = 0.1  # sd of the logarithm of a height
_GROW0 = 0.03
_GROWQ = 0.01
_NEAR = 0.5
_POW = 2


def started(box_px: np.ndarray, frame: int, scatter: float, speed: float) -> np.ndarray:
    """States of targets seen for the first time, at rest. box_px: (N, 4). scatter, speed: sd in heights, heights/frame."""
    state = np.zeros((len(box_px), COLUMNS))
    state[:, X] = box_px[:, 0] + box_px[:, 2] / 2
    state[:, Y] = box_px[:, 1] + box_px[:, 3] / 2
    state[:, WIDTH : HEIGHT + 1] = box_px[:, 2:]
    state[:, PP], state[:, VV], state[:, SEEN] = scatter**2, speed**2, frame
    state[:, SS], state[:, GG] = _LOOSE**2, (_GROW0*speed/.07)**2
    return state


def predicted(state: np.ndarray, frame: int, agility: float) -> np.ndarray:
    """The states at a later frame. agility: sd of the change of velocity in one frame, heights/frame."""
    gap, power = frame - state[:, SEEN], agility**2
    later = state.copy()
    stretch = 1 / (1 - np.clip(gap * state[:, GROWTH], -1, _NEAR))
    later[:, X] += gap * state[:, VX] * stretch
    later[:, Y] += gap * state[:, VY] * stretch
    later[:, VX : VY + 1] *= (stretch**_POW)[:, None]
    later[:, GROWTH] *= stretch
    later[:, PP] += gap * (2 * state[:, PV] + gap * (state[:, VV] + power * gap / 3))
    later[:, PV] += gap * (state[:, VV] + power * gap / 2)
    later[:, VV] += power * gap
    later[:, WIDTH] *= stretch
    later[:, HEIGHT] *= stretch
    power = (_GROWQ*agility/.009)**2
    later[:, SS] += gap * (2 * state[:, SG] + gap * (state[:, GG] + power * gap / 3))
    later[:, SG] += gap * (state[:, GG] + power * gap / 2)
    later[:, GG] += power * gap
    return later


def updated(later: np.ndarray, box_px: np.ndarray, frame: int, scatter: float, size_gain: float) -> np.ndarray:
    """Predicted states corrected by their boxes (N, 4).

    The velocity's gain is held to two over the gap: one surprise after a long absence tells little of the speed now.
    """
    gap = np.maximum(frame - later[:, SEEN], 1)
    gain = later[:, PP] / (later[:, PP] + scatter**2)
    turn = np.minimum(later[:, PV] / (later[:, PP] + scatter**2), 2 / gap)
    miss = box_px[:, :2] + box_px[:, 2:] / 2 - later[:, :2]
    new = later.copy()
    new[:, :2] += gain[:, None] * miss
    new[:, VX : VY + 1] += turn[:, None] * miss
    sgain = later[:, SS] / (later[:, SS] + _LOOSE**2)
    sturn = later[:, SG] / (later[:, SS] + _LOOSE**2)
    off = np.log(box_px[:, 3] / later[:, HEIGHT])
    new[:, HEIGHT] *= np.exp(sgain * off)
    new[:, WIDTH] += size_gain * (box_px[:, 2] - later[:, WIDTH])
    new[:, GROWTH] += sturn * off
    new[:, GG] -= sturn * later[:, SG]
    new[:, SG] *= 1 - sgain
    new[:, SS] *= 1 - sgain
    new[:, VV] -= turn * later[:, PV]
    new[:, PV] *= 1 - gain
    new[:, PP] *= 1 - gain
    new[:, SEEN] = frame
    return new


def carried(state: np.ndarray, now_from_before: np.ndarray) -> np.ndarray:
    """The states after the camera has moved. now_from_before: (3, 3) homography on pixels.

    Velocities turn and stretch with the picture around each target, and sizes with its scale there.
    """
    h = now_from_before
    point = state[:, :2] @ h[:2, :2].T + h[:2, 2]
    depth = (state[:, :2] @ h[2, :2] + h[2, 2])[:, None]
    place = point / depth
    # The derivative of the homography at each target.
    turn = (h[None, :2, :2] - place[:, :, None] * h[2, :2]) / depth[:, :, None]
    new = state.copy()
    new[:, :2] = place
    new[:, VX : VY + 1] = np.einsum("nij,nj->ni", turn, state[:, VX : VY + 1])
    new[:, WIDTH : HEIGHT + 1] *= np.sqrt(np.abs(np.linalg.det(turn)))[:, None]
    return new
