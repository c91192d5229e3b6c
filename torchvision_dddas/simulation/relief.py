"""The shape of the ground: smooth hills, or those of an elevation raster, on one grid that spans the world."""

from dataclasses import replace

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Elevation

_COARSEST_M = 2.0  # step of the grid of heights
_MOST = 1000  # steps along a side
_HILLS_M = (60.0, 200.0)  # wavelengths of the synthetic relief


def make_hills(side_m: float, relief_m: float, above_sea_m: float, rng: np.random.Generator) -> Elevation:
    """Synthetic hills, relief_m from the lowest to the highest place, 0 at the origin.

    Waves of 60 to 200 m from all directions, none longer than the world; the longer, the higher.
    """
    steps, step = _grid(side_m)
    metres = np.linspace(-side_m / 2, side_m / 2, steps + 1)
    east, north = np.meshgrid(metres, metres)
    up = np.zeros_like(east)
    for length in np.geomspace(_HILLS_M[0], min(_HILLS_M[1], max(side_m, _HILLS_M[0])), 12):
        turn, phase = rng.uniform(0, 2 * np.pi, 2)
        up += length**1.5 * np.sin(2 * np.pi / length * (east * np.cos(turn) + north * np.sin(turn)) + phase)
    spread = float(np.ptp(up))
    made = _about_origin(up * (relief_m / spread), side_m, step, 0.0)
    return replace(made, base_m=above_sea_m)


def resample_raster(given: Elevation, side_m: float) -> Elevation:
    """Heights of an elevation raster on the world's grid, 0 at the origin.

    Raises InputError where it does not cover the whole world: says which part of it does.
    """
    steps, step = _grid(side_m)
    metres = np.linspace(-side_m / 2, side_m / 2, steps + 1)
    heights = np.asarray(given.up_m, np.float64)
    known = np.isfinite(heights)
    rows, columns = ((metres - given.corner_m[k]) / given.step_m for k in (1, 0))
    covered = _between(rows, heights.shape[0], 1) @ known @ _between(columns, heights.shape[1], 1).T > 1 - 1e-6
    if not covered.all():
        there = [np.flatnonzero(known.any(axis=k)) for k in (0, 1)]  # columns, rows
        low, high = ([given.corner_m[k] + given.step_m * there[k][end] for k in (0, 1)] for end in (0, -1))
        raise InputError(
            f"the elevation covers {np.floor(100 * covered.mean()):.0f} % of the world: it has heights from "
            f"{low[0]:.0f} m to {high[0]:.0f} m east and {low[1]:.0f} m to {high[1]:.0f} m north of world.origin_deg, "
            f"and the world needs {-side_m / 2:.0f} m to {side_m / 2:.0f} m without holes; "
            "set world.side_m or world.origin_deg, or give a larger raster"
        )
    base = float(np.median(heights[known]))
    filled = np.where(known, heights - base, 0.0)
    up_m = _between(rows, heights.shape[0], 3) @ filled @ _between(columns, heights.shape[1], 3).T
    return _about_origin(up_m, side_m, step, base + given.base_m)


def height_at(relief: Elevation, east_north_m: np.ndarray) -> np.ndarray:
    """(N,) metres of height at places (N, 2), bilinear; beyond the grid as if mirrored at its edges."""
    places = np.asarray(east_north_m, float).reshape(-1, 2)
    width = relief.up_m.shape[1]
    flat = relief.up_m.ravel()
    cells, shares = [], []
    for k in range(2):
        at = (places[:, k] - relief.corner_m[k]) / relief.step_m
        steps = relief.up_m.shape[1 - k] - 1
        if len(at) and not (at.min() >= 0 and at.max() <= steps):
            at = mirrored(at, steps)
        cells.append(np.minimum(at.astype(np.int64), steps - 1))
        shares.append(at - cells[-1])
    x, y = shares
    first = cells[1] * width + cells[0]
    low, high = (flat.take(node) + x * (flat.take(node + 1) - flat.take(node)) for node in (first, first + width))
    return np.asarray(low + y * (high - low))


def mirrored(at: np.ndarray, length: float) -> np.ndarray:
    """Coordinates folded into [0, length] as by mirrors at both ends."""
    return length - np.abs(np.mod(at, 2 * length) - length)


def _between(at: np.ndarray, count: int, order: int) -> np.ndarray:
    """(N, count) weights of the nodes 0, 1, .. for places between them: linear (1), or cubic (3) through the nodes.

    Rows of places beyond the nodes are 0.
    """
    slack = 1e-6
    inside = (at >= -slack) & (at <= count - 1 + slack)
    at = np.clip(at, 0, count - 1)
    first = np.minimum(at.astype(int), max(count - 2, 0))
    t = at - first
    weights = np.zeros((len(at), count))
    row = np.arange(len(at))
    if order == 1:
        parts = {0: 1 - t, 1: t}
    else:
        # Catmull and Rom's cubic: the slope at a node is that between its neighbours.
        parts = {
            -1: -t / 2 + t**2 - t**3 / 2,
            0: 1 - 5 / 2 * t**2 + 3 / 2 * t**3,
            1: t / 2 + 2 * t**2 - 3 / 2 * t**3,
            2: -(t**2) / 2 + t**3 / 2,
        }
    for offset, share in parts.items():
        np.add.at(weights, (row, np.clip(first + offset, 0, count - 1)), share)
    return weights * inside[:, None]


def _grid(side_m: float) -> tuple[int, float]:
    """Steps along a side, even so that the origin lies on the grid, and their length."""
    steps = 2 * int(np.ceil(min(side_m / _COARSEST_M, _MOST) / 2))
    return steps, side_m / steps


def _about_origin(up_m: np.ndarray, side_m: float, step_m: float, base_m: float) -> Elevation:
    middle = up_m.shape[0] // 2
    at_origin = float(up_m[middle, middle])
    return Elevation(up_m - at_origin, (-side_m / 2, -side_m / 2), step_m, base_m + at_origin)


# How the sun lies on the world: slopes towards it and away from it, and the shadows of all that stands.


SHADE_BGR = np.array([0.46, 0.39, 0.35], np.float32)  # what is left of a colour where only the blue sky lights it


def sun_direction(azimuth_deg: float, height_deg: float) -> np.ndarray:
    """(3,) unit vector to the sun, east, north, up; the azimuth clockwise from north."""
    azimuth, height = np.radians([azimuth_deg, height_deg])
    return np.array([np.sin(azimuth) * np.cos(height), np.cos(azimuth) * np.cos(height), np.sin(height)])


def light_on_slopes(up_m: np.ndarray, step_m: float, to_sun: np.ndarray) -> np.ndarray:
    """(R, C) light of heights whose rows go north, as a share of that on level ground."""
    north, east = np.gradient(up_m, step_m)
    facing = (to_sun[2] - east * to_sun[0] - north * to_sun[1]) / np.sqrt(1 + east**2 + north**2)
    direct = 1 - float(SHADE_BGR.mean())
    return np.asarray(1 - direct + direct * np.clip(facing / to_sun[2], 0, 2), np.float32)


def shadow_above_ground(heights_m: np.ndarray, texel_m: float, to_sun: np.ndarray) -> np.ndarray:
    """(H, W) float32: by how many metres the edge of the shadow passes above the surface; below 0 it is in the sun.

    heights_m: (H, W) of the surface, row 0 the north edge. The picture is turned so that the sun stands above its first
    row; then the shadow sinks from row to row and each row is a maximum.
    """
    rows, columns = heights_m.shape
    level = float(np.hypot(*to_sun[:2]))
    if level < 1e-3:
        return np.full(heights_m.shape, -1, np.float32)
    sink = texel_m * to_sun[2] / level
    # Rows of the turned picture go away from the sun: (column, row) of the world per turned column and row.
    away = np.array([-to_sun[0], to_sun[1]]) / level
    aside = np.array([away[1], -away[0]])
    size = int(np.ceil(np.hypot(rows, columns))) + 2
    centre = np.array([(columns - 1) / 2, (rows - 1) / 2])
    matrix = np.c_[aside, away, centre - (size - 1) / 2 * (aside + away)]
    turned = cv2.warpAffine(
        heights_m.astype(np.float32), matrix, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    edge = turned[0].copy()
    for row in range(size):
        height = turned[row].copy()
        turned[row] = np.clip(edge - height, -1, None)
        edge = np.maximum(edge, height) - np.float32(sink)
    back = cv2.invertAffineTransform(matrix)
    return cv2.warpAffine(turned, back, (columns, rows), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=-1)
