"""A moving camera over flat ground: where it is at each frame, and how it projects.

Ground frame: x to the right, y ahead, z up, metres. Image points are (u, v) pixels.
"""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.types import Camera, CameraPose


@dataclass(frozen=True)
class View:
    """One pinhole view. image_from_world is the (3, 4) projection, position_m the (3,) camera centre."""

    image_from_world: np.ndarray
    position_m: np.ndarray

    @property
    def image_from_ground(self) -> np.ndarray:
        """(3, 3) homography from ground points (x, y, 1) to pixels."""
        return self.image_from_world[:, [0, 1, 3]]

    def project(self, points_m: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of world points (N, 3)."""
        q = np.c_[points_m, np.ones(len(points_m))] @ self.image_from_world.T
        return q[:, :2] / q[:, 2:]

    def pixels_per_metre(self, point_m: np.ndarray) -> float:
        """Scale, across the line of sight, at a world point (3,)."""
        depth = float(self.image_from_world[2] @ np.append(point_m, 1.0))
        return float(np.linalg.norm(self.image_from_world[0, :3]) / depth)


def axes(heading_rad: float, pitch_rad: float, roll_rad: float) -> np.ndarray:
    """(3, 3), the columns a camera's right, down and forward in east, north, up; the angles as in types.Camera.

    Straight down the heading is that of the picture's upper edge.
    """
    level, sunk = np.cos(pitch_rad), np.sin(pitch_rad)
    ahead = np.array([np.sin(heading_rad) * level, np.cos(heading_rad) * level, -sunk])
    right = np.array([np.cos(heading_rad), -np.sin(heading_rad), 0.0])
    down = np.cross(ahead, right)
    turned = right * np.cos(roll_rad) + down * np.sin(roll_rad), down * np.cos(roll_rad) - right * np.sin(roll_rad)
    return np.stack([*turned, ahead], axis=1)


def view_of(pose: CameraPose, camera: Camera) -> View:
    """The view of a camera without distortion from a pose in local metres."""
    focal = np.array(camera.focal_px) * pose.focal
    inner = np.array([[focal[0], 0, camera.centre_px[0]], [0, focal[1], camera.centre_px[1]], [0, 0, 1.0]])
    rotation = pose.axes.T
    return View(inner @ np.c_[rotation, -rotation @ pose.place_m], pose.place_m)


def look(position_m: np.ndarray, yaw: float, pitch: float, roll: float, focal_px: float, size: tuple[int, int]) -> View:
    """The view from a place. Angles in radians: yaw clockwise from ahead, pitch below the horizon, roll clockwise."""
    rotation = axes(yaw, pitch, roll).T
    inner = np.array([[focal_px, 0, (size[0] - 1) / 2], [0, focal_px, (size[1] - 1) / 2], [0, 0, 1.0]])
    return View(inner @ np.c_[rotation, -rotation @ position_m], position_m)


def flight(seed: int, frames: int, size: tuple[int, int], rate_hz: float = 10.0) -> list[View]:
    """A drone that drifts sideways and pans after the traffic at 15 m: slow roll, gusts, and a zoom that breathes.

    size is (width, height); the field of view is the same for every size. The same seed gives the same flight.
    """
    rng = np.random.default_rng([seed, 1])
    phase = rng.uniform(0, 2 * np.pi, 6)
    shake = rng.normal(0, 1, (frames, 3)) * np.radians([0.05, 0.05, 0.04])
    views = []
    for k in range(frames):
        t = k / rate_hz
        position = np.array([-3 + 0.9 * t, 0.25 * t, 15 + 0.25 * np.sin(0.9 * t + phase[0])])
        yaw = np.radians(-4 + 1.3 * t + 0.8 * np.sin(1.1 * t + phase[1])) + shake[k, 0]
        pitch = np.radians(35 + 0.8 * np.sin(0.8 * t + phase[2])) + shake[k, 1]
        roll = np.radians(1.5 * np.sin(0.7 * t + phase[3])) + shake[k, 2]
        zoom = 1 + 0.015 * np.sin(0.9 * t + phase[4])
        views.append(look(position, yaw, pitch, roll, 1.125 * max(size[0], size[1] * 4 / 3) * zoom, size))
    return views
