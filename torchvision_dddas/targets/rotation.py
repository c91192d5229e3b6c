"""Rotations of a camera about the world's axes east, north and up, as vectors and as matrices."""

import numpy as np


def cross(vector: np.ndarray) -> np.ndarray:
    """(..., 3, 3) matrices that multiply like the cross product with (..., 3) vectors."""
    x, y, z = np.moveaxis(np.asarray(vector, float), -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*np.shape(x), 3, 3)


def turned(vector: np.ndarray) -> np.ndarray:
    """(3, 3) rotation about a vector by its length in radians (Rodrigues)."""
    angle = float(np.sqrt(vector @ vector))
    skew = cross(vector)
    if angle < 1e-8:
        return np.eye(3) + skew
    return np.eye(3) + np.sin(angle) / angle * skew + (1 - np.cos(angle)) / angle**2 * (skew @ skew)


def turn_of(rotation: np.ndarray) -> np.ndarray:
    """(3,) the vector about which a rotation turns, by its length in radians: the inverse of `turned`."""
    twice = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine, cosine = float(np.sqrt(twice @ twice)) / 2, (rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - 1) / 2
    angle = float(np.arctan2(sine, cosine))
    if sine > 1e-7:
        return twice * (angle / (2 * sine))
    if cosine > 0:
        return twice / 2
    # Half a turn: the axis is what the symmetric part leaves in place, its sign is free.
    symmetric = (rotation + np.eye(3)) / 2
    axis = symmetric[:, int(np.argmax(np.diag(symmetric)))]
    return angle * axis / np.linalg.norm(axis)


def slope_of_turn(vector: np.ndarray) -> np.ndarray:
    """(3, 3) how `turn_of(turned(small) @ turned(vector))` grows with the small rotation."""
    angle = float(np.sqrt(vector @ vector))
    skew = cross(vector)
    if angle < 1e-4:
        return np.eye(3) - skew / 2 + skew @ skew / 12
    # Bounded below half a turn, where the vector changes its sign.
    share = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * max(np.sin(angle), 1e-6))
    return np.eye(3) - skew / 2 + share * (skew @ skew)


def about_up(rotation: np.ndarray) -> np.ndarray:
    """(3, 3) the rotation about up that leaves, undone first, only a tilt: rotation = tilt @ about_up."""
    angle = np.arctan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
    return turned(np.array([0.0, 0.0, angle]))
