"""Apply homographies to points, chain them, and measure how far they move a picture."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np


def transfer(to_from: np.ndarray, points_px: np.ndarray) -> np.ndarray:
    """Apply a (3, 3) homography to (N, 2) points. A point on the horizon gives infinity and no error."""
    points = np.asarray(points_px, np.float64).reshape(-1, 2)
    homogeneous = np.ones((len(points), 3))
    homogeneous[:, :2] = points
    mapped = homogeneous @ to_from.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return mapped[:, :2] / mapped[:, 2:]


def chain(steps: Sequence[np.ndarray]) -> np.ndarray:
    """Chain the homographies of successive frames: return that from the first to the last frame, with [2, 2] = 1."""
    total = np.eye(3)
    for later_from_earlier in steps:
        total = later_from_earlier @ total
        total = total / total[2, 2]
    return total


def background_flow(later_from_earlier: np.ndarray, size: tuple[int, int], samples: int = 9) -> float:
    """Return the median displacement in pixels of a grid of points over a (width, height) image."""
    grid = _grid(size, samples)
    return float(np.median(np.linalg.norm(transfer(later_from_earlier, grid) - grid, axis=1)))


@lru_cache(maxsize=4)
def _grid(size: tuple[int, int], samples: int) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, samples), np.linspace(0, size[1] - 1, samples))
    return np.c_[u.ravel(), v.ravel()]


def corner_error(a: np.ndarray, b: np.ndarray, size: tuple[int, int]) -> float:
    """Return the largest difference of two homographies at the corners of a (width, height) image, in pixels."""
    corners = _grid(size, 2)
    return float(np.linalg.norm(transfer(a, corners) - transfer(b, corners), axis=1).max())
