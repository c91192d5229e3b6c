"""Attitudes: rotations of vehicles and of the cameras on them.

A turned body has the axes forward, right and down, given in north, east and down. Its angles are heading (clockwise
from north), pitch (positive below the horizon, as in the record) and roll (clockwise, seen from behind), in this order.
"""

import numpy as np

from torchvision_dddas.types import Float


def axes(
    heading_rad: Float[np.ndarray, "N"], pitch_rad: Float[np.ndarray, "N"], roll_rad: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N 3 3"]:
    """Return the axes of turned bodies, as columns."""
    cos_h, sin_h = np.cos(heading_rad), np.sin(heading_rad)
    cos_p, sin_p = np.cos(pitch_rad), np.sin(pitch_rad)
    cos_r, sin_r = np.cos(roll_rad)[..., None], np.sin(roll_rad)[..., None]
    forward = np.stack([cos_h * cos_p, sin_h * cos_p, sin_p], axis=-1)
    level_right = np.stack([-sin_h, cos_h, np.zeros_like(cos_h)], axis=-1)
    level_down = np.stack([-cos_h * sin_p, -sin_h * sin_p, cos_p], axis=-1)
    right, down = cos_r * level_right + sin_r * level_down, cos_r * level_down - sin_r * level_right
    return np.stack([forward, right, down], axis=-1)


def angles(turned: Float[np.ndarray, "N 3 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return heading, pitch and roll. Looking straight down, the heading is that of the upper edge, and roll is 0."""
    forward, right, down = np.moveaxis(turned, -1, 0)
    steep = np.hypot(forward[..., 0], forward[..., 1]) < 1e-6
    upwards = -np.sign(forward[..., 2])
    edge = np.arctan2(upwards * down[..., 1], upwards * down[..., 0])
    heading = np.where(steep, edge, np.arctan2(forward[..., 1], forward[..., 0]))
    roll = np.where(steep, 0.0, np.arctan2(right[..., 2], down[..., 2]))
    return heading, np.arcsin(np.clip(forward[..., 2], -1, 1)), roll


def axes_of_quaternion(wxyz: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 3 3"]:
    """Return the axes of a body from a quaternion to north, east, down; NaN if the quaternion's length is not 1."""
    length = np.linalg.norm(wxyz, axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        w, x, y, z = np.moveaxis(wxyz / np.where(np.abs(length - 1) < 0.1, length, np.nan), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def heading_at(time_s: np.ndarray, known_s: np.ndarray, heading_rad: np.ndarray, most_s: float = 1.0) -> np.ndarray:
    """Interpolate a heading the short way round; NaN if the nearest known heading is more than most_s away."""
    if len(known_s) == 0:
        return np.full(len(time_s), np.nan)
    after = np.searchsorted(known_s, time_s).clip(0, len(known_s) - 1)
    away_s = np.minimum(np.abs(known_s[after] - time_s), np.abs(known_s[(after - 1).clip(0)] - time_s))
    return np.where(away_s <= most_s, np.interp(time_s, known_s, np.unwrap(heading_rad)), np.nan)
