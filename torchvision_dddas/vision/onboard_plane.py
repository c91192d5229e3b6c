"""Plane homographies on a small CPU: no torch."""

import numpy as np


class OnboardSolver:
    """Implements `PlaneSolver`."""

    name = "onboard"

    def solve(self, ground: np.ndarray, image: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weighted least squares in normalised coordinates."""
        ground, image, weight = (np.asarray(array, float) for array in (ground, image, weight))
        share = (weight / np.maximum(weight.sum(1, keepdims=True), 1e-300))[..., None]
        into, out = _scaling(ground, share), _scaling(image, share)
        rows, right = _rows(_moved(ground, into), _moved(image, out))
        root = np.sqrt(np.repeat(share, 2, axis=1))
        solution, valid = _solved(rows * root, right * root[..., 0])
        matrix = np.linalg.inv(out) @ solution @ into
        return matrix / matrix[:, 2:, 2:], valid & ((weight > 0).sum(1) >= 4)

    def solve_raw(self, ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The system of four points as it is, the normal equations of more."""
        rows, right = _rows(np.asarray(ground, float), np.asarray(image, float))
        if ground.shape[1] > 4:
            rows, right = rows.swapaxes(1, 2) @ rows, (rows.swapaxes(1, 2) @ right[..., None])[..., 0]
        return _solved(rows, right)


def _scaling(points: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(B, 3, 3) that takes points to mean 0 and root mean square distance sqrt 2."""
    mean = (points * share).sum(1)
    scale = np.sqrt(2 / np.maximum((((points - mean[:, None]) ** 2) * share).sum((1, 2)), 1e-300))
    matrix = np.zeros((len(points), 3, 3))
    matrix[:, 0, 0] = matrix[:, 1, 1] = scale
    matrix[:, :2, 2] = -mean * scale[:, None]
    matrix[:, 2, 2] = 1
    return matrix


def _moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return np.asarray(points @ matrix[:, :2, :2] + matrix[:, None, :2, 2])


def _rows(ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A (B, 2 n, 8) and k (B, 2 n)."""
    ones = np.concatenate([ground, np.ones_like(ground[..., :1])], -1)
    zero = np.zeros_like(ones)
    upper = np.concatenate([ones, zero, -image[..., :1] * ground], -1)
    lower = np.concatenate([zero, ones, -image[..., 1:] * ground], -1)
    rows = np.stack([upper, lower], 2)
    return rows.reshape(len(rows), -1, 8), image.reshape(len(image), -1)


def _solved(rows: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    matrix, valid = np.tile(np.eye(3), (len(rows), 1, 1)), np.zeros(len(rows), bool)
    for k in range(len(rows)):
        found, _, rank, _ = np.linalg.lstsq(rows[k], right[k], rcond=1e-9 if rows.shape[1] != 8 else None)
        matrix[k], valid[k] = np.append(found, 1).reshape(3, 3), rank == 8
    return matrix, valid
