"""Camera geometry: a pinhole view, and a rolling shutter that reads its rows one after the other in flight."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from torchvision_dddas.lab.simulation.agents import Moment
from torchvision_dddas.lab.simulation.uav import cross_matrix
from torchvision_dddas.types import Camera, CameraPose

LEAST_PX = 0.7  # shorter motion during the exposure is hidden by the lens's own blur
_MOST = 40  # most pictures that are averaged for a blurred picture
_LOWEST = 0.004  # least sink of a ray per metre along the axis, so that rays above the horizon end far away
_FURTHEST_M = 20_000.0
_LANDINGS = 8
_CLOSE_M = 0.004
_VIBRATION_HZ = 120.0  # rotors with two blades that turn 60 times a second


@dataclass(frozen=True)
class PinholeView:
    """A pinhole view. image_from_world: (3, 4) projection. position_m: (3,) camera centre."""

    image_from_world: np.ndarray
    position_m: np.ndarray

    def homogeneous(self, points_m: np.ndarray) -> np.ndarray:
        """Return (..., 3) for world points (..., 3): pixels times depth, and depth."""
        return points_m @ self.image_from_world[:, :3].T + self.image_from_world[:, 3]

    def project(self, points_m: np.ndarray) -> np.ndarray:
        """Return pixels (..., 2) of world points (..., 3)."""
        seen = self.homogeneous(points_m)
        return seen[..., :2] / seen[..., 2:]

    @property
    def scale_px(self) -> float:
        """Norm of the projection's first row, sqrt(f^2 + cx^2): about 1.13 times the focal length at 56 degrees."""
        return float(np.linalg.norm(self.image_from_world[0, :3]))


def camera_axes(heading_rad: float, pitch_rad: float, roll_rad: float) -> np.ndarray:
    """Return (3, 3): a camera's right, down and forward directions as columns, in east, north, up.

    The angles are those of types.Camera. In a view straight down, the picture's upper edge points to the heading.
    """
    level, sunk = np.cos(pitch_rad), np.sin(pitch_rad)
    ahead = np.array([np.sin(heading_rad) * level, np.cos(heading_rad) * level, -sunk])
    right = np.array([np.cos(heading_rad), -np.sin(heading_rad), 0.0])
    down = np.cross(ahead, right)
    turned = right * np.cos(roll_rad) + down * np.sin(roll_rad), down * np.cos(roll_rad) - right * np.sin(roll_rad)
    return np.stack([*turned, ahead], axis=1)


def view_from_pose(pose: CameraPose, camera: Camera) -> PinholeView:
    """Return the view of a camera without distortion from a pose in local metres."""
    focal = np.array(camera.focal_px) * pose.focal
    inner = np.array([[focal[0], 0, camera.centre_px[0]], [0, focal[1], camera.centre_px[1]], [0, 0, 1.0]])
    rotation = pose.axes.T
    return PinholeView(inner @ np.c_[rotation, -rotation @ pose.place_m], pose.place_m)


class Shutter:
    """A camera without distortion whose last row is read readout_s after its first.

    vibration_px: standard deviation along each axis of a row's shift by vibration. seed: seed of the vibration's phase.
    """

    def __init__(self, camera: Camera, readout_s: float, vibration_px: float, seed: int) -> None:
        self.camera, self._readout_s = camera, readout_s
        self._vibration_px, self._seed = vibration_px, seed

    def lag_s(self, v: np.ndarray) -> np.ndarray:
        """Return the time from reading the middle row to reading row v, seconds."""
        last = self.camera.size_px[1] - 1
        return (np.clip(v, 0, last) / last - 0.5) * self._readout_s

    def _aside_px(self, number: int, v: np.ndarray) -> np.ndarray | float:
        """Return (N, 2) shifts of rows (N,) of a picture by vibration, pixels."""
        if not self._vibration_px:
            return 0.0
        turns = 2 * np.pi * _VIBRATION_HZ * self.lag_s(v)[:, None]
        return np.sqrt(2) * self._vibration_px * np.sin(turns + _phases(self._seed, number))

    def rays(self, moment: Moment, image_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return starts and directions (N, 3) of rays through pixels (N, 2). Directions are 1 m long along the axis."""
        pose, row = moment.pose, image_px[:, 1]
        steady_px = image_px - self._aside_px(moment.number, row)
        flat = (steady_px - np.array(self.camera.centre_px)) / (np.array(self.camera.focal_px) * pose.focal)
        lag = self.lag_s(row)[:, None]
        way = _rotate(np.c_[flat, np.ones(len(flat))] @ pose.axes.T, moment.turn_rad_s, lag)
        return pose.place_m + lag * moment.velocity_m_s, way

    def ways(self, moment: Moment, places_m: np.ndarray, exposure_s: float) -> np.ndarray:
        """Return the motion (N, 2), pixels, of static points (N, 3) in the picture during an exposure."""
        ends = []
        for lag in (-exposure_s / 2, exposure_s / 2):
            axes = _rotate(moment.pose.axes.T, moment.turn_rad_s, np.full((3, 1), lag)).T
            pose = replace(moment.pose, place_m=moment.pose.place_m + lag * moment.velocity_m_s, axes=axes)
            ends.append(self.project(replace(moment, pose=pose), places_m)[0])
        return ends[1] - ends[0]

    def project(
        self, moment: Moment, points_m: np.ndarray, velocity_m_s: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels (N, 2) and depths (N,) along the axis of points (N, 3) that move at velocity_m_s."""
        pose, centre = moment.pose, np.array(self.camera.centre_px)
        focal = np.array(self.camera.focal_px) * pose.focal
        # The place relative to the camera is a polynomial of the lag. Compute its terms once.
        once = cross_matrix(-moment.turn_rad_s).T
        away, slide = points_m - pose.place_m, np.asarray(velocity_m_s - moment.velocity_m_s)
        terms = [away @ pose.axes]
        if self._readout_s > 0:
            terms += [away @ (once @ pose.axes) + slide @ pose.axes]
            terms += [away @ (once @ once @ pose.axes / 2) + slide @ (once @ pose.axes)]
        seen = terms[0]
        # The row gives the time and the time gives the row. Few iterations suffice, because the shutter is fast.
        row = np.zeros(0)
        for again in range(3 if self._readout_s > 0 else 1):
            if again:
                lag = self.lag_s(row)[:, None]
                seen = terms[0] + lag * (terms[1] + lag * terms[2])
            depth = seen[:, 2]
            over = 1 / np.where(np.abs(depth) < 1e-6, 1e-6, depth)
            row = seen[:, 1] * over * focal[1] + centre[1]
        column = seen[:, 0] * over * focal[0] + centre[0]
        return np.stack([column, row], axis=1) + self._aside_px(moment.number, row), depth


@lru_cache(maxsize=8)
def _phases(seed: int, number: int) -> np.ndarray:
    """Return (2,) phases of the vibration in a picture's middle row. They do not depend on the frame rate."""
    return np.random.default_rng([seed, 79, number]).uniform(0, 2 * np.pi, 2)


def _rotate(vectors: np.ndarray, turn_rad_s: np.ndarray, lag_s: np.ndarray) -> np.ndarray:
    """Turn vectors (N, 3) for lag_s (N, 1) by Rodrigues' formula to second order, for angles of milliradians."""
    if not np.any(lag_s) or not np.any(turn_rad_s):
        return vectors
    matrix = cross_matrix(turn_rad_s).T
    once = lag_s * (vectors @ matrix)
    return vectors + once + lag_s / 2 * (once @ matrix)


def meet_ground(
    start_m: np.ndarray, way: np.ndarray, up_m: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (N,) along rays (N, 3) to the ground, and the ground's heights (N,) there.

    up_m: returns the ground's heights at places (N, 2). Rays above the horizon get a large distance.
    """
    sink = np.maximum(-way[:, 2], _LOWEST)
    up = up_m(start_m[:, :2])
    far = np.clip((start_m[:, 2] - up) / sink, 0.0, _FURTHEST_M)
    before: tuple[np.ndarray, np.ndarray] | None = None
    for _ in range(_LANDINGS):
        up = up_m(start_m[:, :2] + far[:, None] * way[:, :2])
        over = start_m[:, 2] - far * sink - up
        if np.abs(over).max() < _CLOSE_M:
            break
        step = over / sink
        if before is not None:
            # Where the ground rises along the ray, secant steps converge faster than plain steps.
            change = over - before[1]
            slope = np.where(np.abs(change) > 1e-9, (far - before[0]) / np.where(change == 0, 1, change), -1 / sink)
            step = np.where((slope < 0) & (slope > -4 / sink), -over * slope, step)
        before = far, over
        far = np.clip(far + step, 0.0, _FURTHEST_M)
    return far, up


def motion_blur(picture: np.ndarray, way_px: np.ndarray) -> np.ndarray:
    """Blur a picture (H, W, C) uint8 by the motion of its parts during the exposure.

    way_px: (r, c, 2) float32 motion from start to end of the exposure, on a grid from corner to corner of the picture.
    """
    longest = float(np.linalg.norm(way_px, axis=-1).max())
    if longest < LEAST_PX:
        return picture
    if np.ptp(way_px.reshape(-1, 2), axis=0).max() < LEAST_PX:
        kernel = streak_kernel(way_px.mean(axis=(0, 1)))
        return np.asarray(cv2.filter2D(picture, -1, kernel, borderType=cv2.BORDER_REPLICATE))
    height, width = picture.shape[:2]
    rows, columns = way_px.shape[:2]
    # The first and the last grid point lie on the first and the last pixel.
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    across, down = u * np.float32((columns - 1) / (width - 1)), v * np.float32((rows - 1) / (height - 1))
    way = [cv2.remap(np.ascontiguousarray(way_px[..., k], np.float32), across, down, cv2.INTER_LINEAR) for k in (0, 1)]
    count = min(int(np.ceil(longest)) + 1, _MOST)
    total = np.zeros(picture.shape, np.float32)
    for share in ((np.arange(count, dtype=np.float32) + 0.5) / count - 0.5).astype(np.float32):
        at = u + share * way[0], v + share * way[1]
        cv2.accumulate(cv2.remap(picture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), total)
    return np.round(total / count).astype(np.uint8)


def streak_kernel(way_px: np.ndarray) -> np.ndarray:
    """Return a (K, K) float32 blur kernel along a motion (2,), centred, with sum 1."""
    reach = int(np.ceil(np.abs(way_px).max() / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    count = 4 * reach + 1
    for u, v in (((np.arange(count) + 0.5) / count - 0.5)[:, None] * way_px + reach).tolist():
        x, y = int(u), int(v)
        for column, wide in ((x, 1 - (u - x)), (x + 1, u - x)):
            for row, high in ((y, 1 - (v - y)), (y + 1, v - y)):
                if wide * high > 0:
                    kernel[row, column] += wide * high
    return kernel / kernel.sum()
