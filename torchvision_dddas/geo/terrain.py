"""Ground that is not level: heights from a grid, and where rays first meet it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from torchvision_dddas.types import Elevation, Float

Surface = Callable[[np.ndarray], np.ndarray]
"""Height above the plane up = 0 of places (N, 2) in metres east and north; NaN where it is not known."""

# Distance over which heights are compared for a slope.
_SLOPE_M = 0.5
# A ray is followed this many times as deep as the ground lies below the camera, in so many steps, then halvings.
_REACH, _SAMPLES, _HALVINGS = 4.0, 96, 14


def ground_height(elevation: Elevation, east_north_m: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
    """Metres above the local plane, bilinear between the four nearest heights; NaN where one of them is unknown."""
    heights = elevation.up_m
    rows, columns = heights.shape
    place = (np.asarray(east_north_m, float).reshape(-1, 2) - elevation.corner_m) / elevation.step_m
    x, y = place[:, 0], place[:, 1]
    with np.errstate(invalid="ignore"):
        inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    # The last row and column have no next one: they are its far side.
    column, row = np.minimum(x.astype(int), columns - 2), np.minimum(y.astype(int), rows - 2)
    right, above = x - column, y - row
    low = heights[row, column] * (1 - right) + heights[row, column + 1] * right
    high = heights[row + 1, column] * (1 - right) + heights[row + 1, column + 1] * right
    return np.where(inside, low * (1 - above) + high * above, np.nan)


def surface_of(elevation: Elevation | None) -> Surface | None:
    """`ground_height` of one elevation; None where the ground is level."""
    return None if elevation is None else lambda east_north_m: ground_height(elevation, east_north_m)


def shift_origin(elevation: Elevation, origin_m: np.ndarray) -> Elevation:
    """The same heights in metres about another origin, given as (2,) in the present metres, above the ground there."""
    base = float(ground_height(elevation, np.asarray(origin_m, float)[None])[0])
    corner = elevation.corner_m[0] - float(origin_m[0]), elevation.corner_m[1] - float(origin_m[1])
    return replace(elevation, up_m=elevation.up_m - base, corner_m=corner, base_m=elevation.base_m + base)


def intersect_surface(
    place_m: Float[np.ndarray, "3"], way: Float[np.ndarray, "N 3"], up_m: Float[np.ndarray, "N"], surface: Surface
) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """How far along rays, in their own lengths, they first meet the ground, and its upward normal there.

    up_m: height above the surface of what is seen. NaN where a ray meets no ground of known height.
    """
    normal = np.tile([0.0, 0.0, 1.0], (len(way), 1))
    down = np.where(way[:, 2] < -1e-9 * np.linalg.norm(way, axis=1), way[:, 2], np.nan)
    far = _first_met(place_m, way, up_m, surface, down)
    there = place_m[:2] + far[:, None] * way[:, :2]
    for axis in (0, 1):
        aside = np.zeros(2)
        aside[axis] = _SLOPE_M
        rise = (surface(there + aside) - surface(there - aside)) / (2 * _SLOPE_M)
        normal[:, axis] = -np.nan_to_num(rise)  # level at the edge of the known ground
    return far, normal


def _first_met(
    place_m: np.ndarray, way: np.ndarray, up_m: np.ndarray, surface: Surface, down: np.ndarray
) -> np.ndarray:
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
    # A ray may have met ground of unknown height: it counts only where it is seen to go from above to below.
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
