"""Rotation vectors, rotation matrices and their derivatives, for the optimisation of poses."""

from math import atan2, cos, sin, sqrt

import numpy as np


def cross(vector: np.ndarray) -> np.ndarray:
    """Return the (..., 3, 3) matrices of the cross products with (..., 3) vectors."""
    matrices = np.zeros((*np.shape(vector), 3))
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    matrices[..., 2, 1], matrices[..., 0, 2], matrices[..., 1, 0] = x, y, z
    matrices[..., 1, 2], matrices[..., 2, 0], matrices[..., 0, 1] = -x, -y, -z
    return matrices


def _polynomial(vector: np.ndarray, first: float, second: float) -> np.ndarray:
    """Return I + first K + second K², where K is the matrix of the cross product with a vector."""
    x, y, z = vector.tolist()
    fx, fy, fz, sx, sy, sz = first * x, first * y, first * z, second * x, second * y, second * z
    return np.array(
        [
            [1 - sy * y - sz * z, sx * y - fz, sx * z + fy],
            [sx * y + fz, 1 - sx * x - sz * z, sy * z - fx],
            [sx * z - fy, sy * z + fx, 1 - sx * x - sy * y],
        ]
    )


def turned(vector: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation about a vector by its length in radians (Rodrigues)."""
    angle = sqrt(vector @ vector)
    if angle < 1e-6:
        return _polynomial(vector, 1.0, 0.5)
    return _polynomial(vector, sin(angle) / angle, (1 - cos(angle)) / angle**2)


def turn_of(rotation: np.ndarray) -> np.ndarray:
    """Return the (3,) rotation vector of a rotation matrix: the inverse of `turned`."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    x, y, z = h - f, c - g, d - b
    sine, cosine = sqrt(x * x + y * y + z * z) / 2, (a + e + i - 1) / 2
    angle = atan2(sine, cosine)
    if sine > 1e-7:
        return np.array([x, y, z]) * (angle / (2 * sine))
    if cosine > 0:
        return np.array([x, y, z]) / 2
    # For half a turn, the axis is any nonzero column of (R + I) / 2, and its sign is arbitrary.
    symmetric = (rotation + np.eye(3)) / 2
    axis = symmetric[:, int(np.argmax(np.diag(symmetric)))]
    return angle * axis / np.linalg.norm(axis)


def slope_of_turn(vector: np.ndarray) -> np.ndarray:
    """Return the (3, 3) derivative of `turn_of(turned(small) @ turned(vector))` by the small rotation."""
    angle = sqrt(vector @ vector)
    if angle < 1e-3:
        return _polynomial(vector, -0.5, 1 / 12)
    # Keep the sine away from 0, because the vector changes its sign at half a turn.
    return _polynomial(vector, -0.5, 1 / angle**2 - (1 + cos(angle)) / (2 * angle * max(sin(angle), 1e-6)))


def about_up(rotation: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation about the up axis in the decomposition rotation = tilt @ about_up."""
    angle = atan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
    return turned(np.array([0.0, 0.0, angle]))
