"""Pixels laid on the ground by the rays of a camera of known pose, with the errors of the pose and of the pixels."""

import numpy as np

from torchvision_dddas.geo.projection import slopes_of_lift
from torchvision_dddas.geo.terrain_intersection import Surface, met_surface
from torchvision_dddas.geometry import cross
from torchvision_dddas.types import Camera, CameraPose, Float


def by_rays(
    pose: CameraPose,
    covariance: Float[np.ndarray, "7 7"],
    camera: Camera,
    pixels: Float[np.ndarray, "N 2"],
    sigma_px: float,
    up_m: float | Float[np.ndarray, "N"] = 0.0,
    surface: Surface | None = None,
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2 2"]]:
    """East and north of what pixels show, and their covariance; NaN where a ray meets no ground.

    covariance: of the pose, in the order of Fix. sigma_px: standard deviation of u and of v each. up_m: height of what
    is seen above the ground: the plane up = 0 or the surface.
    """
    place, by_pose, by_pixel = met_with_slopes(pose, camera, pixels, up_m, surface)
    spread_m2 = by_pose @ covariance @ by_pose.swapaxes(1, 2)
    spread_m2 += sigma_px**2 * by_pixel @ by_pixel.swapaxes(1, 2)
    return place, spread_m2


def met_with_slopes(
    pose: CameraPose,
    camera: Camera,
    pixels: Float[np.ndarray, "N 2"],
    up_m: float | Float[np.ndarray, "N"] = 0.0,
    surface: Surface | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """East and north of what pixels show (N, 2), and their derivatives by the pose (N, 2, 7) and the pixel (N, 2, 2).

    The pose in the order of Fix; up_m and surface as in `by_rays`.
    """
    flat, by_pixel, by_focal = slopes_of_lift(pixels, pose.focal, camera)
    way = np.c_[flat, np.ones(len(flat))] @ pose.axes.T
    far, normal = _met(pose.place_m, way, np.broadcast_to(np.asarray(up_m, float), len(way)), surface)
    offset = far[:, None] * way
    # A change of the ray or of its start moves the place where it meets the ground along the ground.
    steep = (way * normal).sum(axis=1)
    along = np.eye(3) - way[:, :, None] * normal[:, None, :] / steep[:, None, None]
    along = along[:, :2]
    by_lift = far[:, None, None] * along @ pose.axes[:, :2]
    by_pose = np.empty((len(way), 2, 7))
    by_pose[:, :, :3] = -along @ cross(offset)
    by_pose[:, :, 3:6] = along
    by_pose[:, :, 6] = (by_lift @ by_focal[:, :, None])[:, :, 0]
    return (pose.place_m + offset)[:, :2], by_pose, by_lift @ by_pixel


def _met(
    place_m: np.ndarray, way: np.ndarray, up_m: np.ndarray, surface: Surface | None
) -> tuple[np.ndarray, np.ndarray]:
    """How far along rays the ground is (N,), and its normal there (N, 3), upward; NaN where a ray meets none."""
    if surface is not None:
        return met_surface(place_m, way, up_m, surface)
    flat = np.broadcast_to(np.array([0.0, 0.0, 1.0]), way.shape)
    down = np.where(way[:, 2] < -1e-9 * np.linalg.norm(way, axis=1), way[:, 2], np.nan)
    far = (up_m - place_m[2]) / down
    return np.where(far > 0, far, np.nan), flat
