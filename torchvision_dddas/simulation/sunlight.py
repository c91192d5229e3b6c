"""How the sun lies on the world: slopes towards it and away from it, and the shadows of all that stands."""

import cv2
import numpy as np

SHADE_BGR = np.array([0.46, 0.39, 0.35], np.float32)
"""What is left of a colour where only the blue sky lights it."""


def towards(azimuth_deg: float, height_deg: float) -> np.ndarray:
    """(3,) unit vector to the sun, east, north, up; the azimuth clockwise from north."""
    azimuth, height = np.radians([azimuth_deg, height_deg])
    return np.array([np.sin(azimuth) * np.cos(height), np.cos(azimuth) * np.cos(height), np.sin(height)])


def on_slopes(up_m: np.ndarray, step_m: float, to_sun: np.ndarray) -> np.ndarray:
    """(R, C) light of heights whose rows go north, as a share of that on level ground."""
    north, east = np.gradient(up_m, step_m)
    facing = (to_sun[2] - east * to_sun[0] - north * to_sun[1]) / np.sqrt(1 + east**2 + north**2)
    direct = 1 - float(SHADE_BGR.mean())
    return np.asarray(1 - direct + direct * np.clip(facing / to_sun[2], 0, 2), np.float32)


def above_ground(heights_m: np.ndarray, texel_m: float, to_sun: np.ndarray) -> np.ndarray:
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
