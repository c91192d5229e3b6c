"""Drawing in a pinhole view: the camera's projection, and a picture and a mask that are drawn on together."""

from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.types import Camera, CameraPose

SUBPIXEL_BITS = 4  # OpenCV draws with corners in sixteenths of a pixel

NEAR_M = 0.4  # what is nearer to a camera on the ground, in depth, is not drawn


@dataclass(frozen=True)
class View:
    """One pinhole view. image_from_world is the (3, 4) projection, position_m the (3,) camera centre."""

    image_from_world: np.ndarray
    position_m: np.ndarray

    def project(self, points_m: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of world points (N, 3)."""
        q = np.c_[points_m, np.ones(len(points_m))] @ self.image_from_world.T
        return q[:, :2] / q[:, 2:]


def camera_axes(heading_rad: float, pitch_rad: float, roll_rad: float) -> np.ndarray:
    """(3, 3), the columns a camera's right, down and forward in east, north, up; the angles as in types.Camera.

    Straight down the heading is that of the picture's upper edge.
    """
    level, sunk = np.cos(pitch_rad), np.sin(pitch_rad)
    ahead = np.array([np.sin(heading_rad) * level, np.cos(heading_rad) * level, -sunk])
    right = np.array([np.cos(heading_rad), -np.sin(heading_rad), 0.0])
    down = np.cross(ahead, right)
    turned = right * np.cos(roll_rad) + down * np.sin(roll_rad), down * np.cos(roll_rad) - right * np.sin(roll_rad)
    return np.stack([*turned, ahead], axis=1)


def view_from_pose(pose: CameraPose, camera: Camera) -> View:
    """The view of a camera without distortion from a pose in local metres."""
    focal = np.array(camera.focal_px) * pose.focal
    inner = np.array([[focal[0], 0, camera.centre_px[0]], [0, focal[1], camera.centre_px[1]], [0, 0, 1.0]])
    rotation = pose.axes.T
    return View(inner @ np.c_[rotation, -rotation @ pose.place_m], pose.place_m)


class Canvas:
    """A picture (H, W, 3) and a mask (H, W) that are drawn on together, so that the truth is what the eye sees."""

    def __init__(self, picture: np.ndarray) -> None:
        self.picture = picture
        self.mask = np.zeros(picture.shape[:2], np.uint16)

    def fill(self, points_px: np.ndarray, colour: np.ndarray, value: int) -> None:
        """Fill a convex outline (N, 2): smooth in the picture, whole pixels of `value` in the mask."""
        points = np.round(points_px * 2**SUBPIXEL_BITS).astype(np.int32)
        cv2.fillConvexPoly(self.picture, points, colour.tolist(), cv2.LINE_AA, SUBPIXEL_BITS)
        cv2.fillConvexPoly(self.mask, points, value, cv2.LINE_8, SUBPIXEL_BITS)


def fill_outline(points_m: np.ndarray, colour: np.ndarray, value: int, view: View, canvas: Canvas) -> None:
    """Fill a convex outline (N, 3) of which what is behind the camera is cut off."""
    matrix = view.image_from_world
    seen = points_m @ matrix[:, :3].T + matrix[:, 3]
    depth = seen[:, 2]
    if depth.min() < NEAR_M:
        kept = []
        for k in range(len(seen)):
            a, b = depth[k], depth[(k + 1) % len(seen)]
            if a >= NEAR_M:
                kept.append(seen[k])
            if (a >= NEAR_M) != (b >= NEAR_M):
                kept.append(seen[k] + (NEAR_M - a) / (b - a) * (seen[(k + 1) % len(seen)] - seen[k]))
        if len(kept) < 3:
            return
        seen = np.array(kept)
    px = seen[:, :2] / seen[:, 2:]
    low, high = px.min(axis=0), px.max(axis=0)
    height, width = canvas.picture.shape[:2]
    if (high > 0).all() and low[0] < width and low[1] < height:
        # OpenCV counts pixels in 16 bits where it counts them in sixteenths.
        canvas.fill(np.clip(px, -3e4, 3e4), colour, value)


def halved_levels(texture: np.ndarray, most: int) -> list[np.ndarray]:
    """A texture (H, W, ...) and its reductions, each half as large as the one before, `most` at most."""
    levels = [texture]
    while len(levels) < most and min(levels[-1].shape[:2]) >= 4:
        size = (levels[-1].shape[1] + 1) // 2, (levels[-1].shape[0] + 1) // 2
        levels.append(np.asarray(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA)))
    return levels
