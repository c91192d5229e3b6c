"""Where rays from the air first meet a ground that is not flat."""

from collections.abc import Callable

import numpy as np

from torchvision_dddas.types import Float

Surface = Callable[[np.ndarray], np.ndarray]
"""Height above the plane up = 0 of places (N, 2) in east and north; NaN where it is not known."""

_SLOPE_M = 0.5
"""How far aside heights are compared to tell a slope."""

_REACH, _SAMPLES, _HALVINGS = 4.0, 96, 14
"""A ray is followed so many times as deep as the ground below the camera lies, in so many steps, then halved."""


def met_surface(
    place_m: Float[np.ndarray, "3"], way: Float[np.ndarray, "N 3"], up_m: Float[np.ndarray, "N"], surface: Surface
) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """How far along rays, in their own lengths, the ground is, and its normal there, upward.

    up_m: height above the surface of what is seen. NaN where a ray meets none, or not where the surface is known.
    """
    normal = np.tile([0.0, 0.0, 1.0], (len(way), 1))
    down = np.where(way[:, 2] < -1e-9 * np.linalg.norm(way, axis=1), way[:, 2], np.nan)
    far = _first_met(place_m, way, up_m, surface, down)
    there = place_m[:2] + far[:, None] * way[:, :2]
    for axis in (0, 1):
        aside = np.zeros(2)
        aside[axis] = _SLOPE_M
        rise = (surface(there + aside) - surface(there - aside)) / (2 * _SLOPE_M)
        normal[:, axis] = -np.nan_to_num(rise)  # at the edge of what is known
    return far, normal


def _first_met(
    place_m: np.ndarray, way: np.ndarray, up_m: np.ndarray, surface: Surface, down: np.ndarray
) -> np.ndarray:
    """(N,) how far along each ray it first comes below the surface raised by up_m; NaN where that is not known."""
    below = float(surface(place_m[None, :2])[0])
    height = place_m[2] - (below if np.isfinite(below) else 0.0)
    if not height > 0 or not len(way):
        return np.full(len(way), np.nan)

    def above(far: np.ndarray) -> np.ndarray:
        """Metres above the ground (..., N)."""
        points = place_m + far[..., None] * way
        return points[..., 2] - up_m - surface(points[..., :2].reshape(-1, 2)).reshape(far.shape)

    steps = np.linspace(0, _REACH, _SAMPLES + 1)[:, None] * (-height / down)
    gap = above(steps)
    # Where the ground is not known a ray may have met it: only from above to below is it seen to.
    with np.errstate(invalid="ignore"):
        met = (gap[:-1] > 0) & (gap[1:] <= 0)
        hidden = np.cumsum(gap <= 0, axis=0)[:-1] > 0
    met &= ~hidden
    first, ray = met.argmax(axis=0), np.arange(len(way))
    low, high = steps[first, ray], steps[first + 1, ray]
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        with np.errstate(invalid="ignore"):
            over = above(middle) > 0
        low, high = np.where(over, middle, low), np.where(over, high, middle)
    at_low, at_high = above(low), above(high)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(at_low > at_high, at_low / (at_low - at_high), 0.5)
    return np.where(met.any(axis=0), low + share * (high - low), np.nan)
