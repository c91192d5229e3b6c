"""How high the ground is at a place, from a grid of heights."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from torchvision_dddas.types import Elevation, Float


def up(elevation: Elevation, east_north_m: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
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


def surface(elevation: Elevation) -> Callable[[np.ndarray], np.ndarray]:
    """`up` of one elevation, for what asks a ground for its height: (N, 2) east and north -> (N,)."""
    return lambda east_north_m: up(elevation, east_north_m)


def about(elevation: Elevation, origin_m: np.ndarray) -> Elevation:
    """The same heights in metres about another origin, given as (2,) in those of now, above the ground there."""
    base = float(up(elevation, np.asarray(origin_m, float)[None])[0])
    corner = elevation.corner_m[0] - float(origin_m[0]), elevation.corner_m[1] - float(origin_m[1])
    return replace(elevation, up_m=elevation.up_m - base, corner_m=corner, base_m=elevation.base_m + base)
