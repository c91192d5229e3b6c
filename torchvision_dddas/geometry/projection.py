"""A camera in the air and the ground below, in local metres: where a point shows, and where the ray of a pixel ends.

Camera axes are right, down and forward. With heading h, pitch p below the horizon and no roll they are
    right (cos h, -sin h, 0), down (-sin h sin p, -cos h sin p, -cos p), forward (sin h cos p, cos h cos p, -sin p)
in east, north and up: straight down (p = 90 deg), h is the heading of the picture's upper edge. Roll turns the camera
clockwise about forward. The lens distorts a radius r to r (1 + k1 r² + k2 r⁴), as in OpenCV.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from torchvision_dddas.geometry.rotations import cross
from torchvision_dddas.types import Camera, CameraPose, Elevation, Float

# A point whose depth is a smaller share of its distance is beside or behind the camera.
_NEAREST = 1e-6
# A slope is measured between two points that lie this far apart.
_SLOPE_M = 0.5
# A ray is searched this many times as deep as the ground lies below the camera, in so many steps, then halvings.
_REACH, _SAMPLES, _HALVINGS = 4.0, 96, 14

Surface = Callable[[np.ndarray], np.ndarray]
"""Height above the plane up = 0 of places (N, 2) in metres east and north; NaN where it is not known."""


def axes_of(
    heading_rad: float | np.ndarray, pitch_rad: float | np.ndarray, roll_rad: float | np.ndarray
) -> Float[np.ndarray, "*N 3 3"]:
    """The camera's right, down and forward, as columns, in east, north and up, of single angles or of arrays."""
    (sh, sp, sr), (ch, cp, cr) = (f(np.array([heading_rad, pitch_rad, roll_rad])) for f in (np.sin, np.cos))
    right, down = np.array([ch, -sh, 0 * ch]), np.array([-sh * sp, -ch * sp, -cp])
    forward = np.array([sh * cp, ch * cp, -sp])
    columns = np.array([cr * right + sr * down, cr * down - sr * right, forward])
    return np.moveaxis(columns, (1, 0), (-2, -1))


def project(points_m: Float[np.ndarray, "N 3"], pose: CameraPose, camera: Camera) -> Float[np.ndarray, "N 2"]:
    """Pixels (u, v) of points in east, north, up; NaN for a point behind the camera, or that the lens cannot show."""
    return project_with_slopes(points_m, pose, camera)[0]


def project_with_slopes(
    points_m: Float[np.ndarray, "N 3"], pose: CameraPose, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (N, 2), and their derivatives by the pose (N, 2, 7), in the order of Fix, and by the point (N, 2, 3)."""
    apart = np.asarray(points_m, float).reshape(-1, 3) - pose.place_m
    seen = apart @ pose.axes
    depth = seen[:, 2]
    ahead = depth > _NEAREST * np.abs(seen).sum(axis=1)
    depth = np.where(ahead, depth, np.nan)
    flat = seen[:, :2] / depth[:, None]
    scale = np.array(camera.focal_px) * pose.focal
    # Derivatives by the point in camera axes.
    by_seen = np.zeros((len(seen), 2, 3))
    by_seen[:, 0, 0] = by_seen[:, 1, 1] = 1 / depth
    by_seen[:, :, 2] = -flat / depth[:, None]
    if camera.k1 or camera.k2:
        flat, by_flat = _distort(flat, camera)
        by_seen = by_flat @ by_seen
    by_point = (scale[:, None] * by_seen) @ pose.axes.T
    by_pose = np.empty((len(seen), 2, 7))
    # A rotation w of the camera moves a point by -w x apart, seen from it: gradient . (apart x w).
    (gx, gy, gz), (x, y, z) = np.moveaxis(by_point, 2, 0), apart.T[:, :, None]
    by_pose[:, :, 0], by_pose[:, :, 1], by_pose[:, :, 2] = gy * z - gz * y, gz * x - gx * z, gx * y - gy * x
    by_pose[:, :, 3:6] = -by_point
    by_pose[:, :, 6] = scale * flat
    return flat * scale + camera.centre_px, by_pose, by_point


def rays(pixels: Float[np.ndarray, "N 2"], pose: CameraPose, camera: Camera) -> Float[np.ndarray, "N 3"]:
    """Directions in east, north, up through pixels, a metre of depth long; NaN where the lens has none."""
    flat = normalize(pixels, camera, pose.focal)
    return np.c_[flat, np.ones(len(flat))] @ pose.axes.T


def normalize(pixels: Float[np.ndarray, "N 2"], camera: Camera, focal: float = 1.0) -> Float[np.ndarray, "N 2"]:
    """Pixels to metres right and down per metre of depth, distortion undone; focal: as a share of the camera's.

    NaN where the lens shows no such pixel.
    """
    bent = (np.asarray(pixels, float).reshape(-1, 2) - camera.centre_px) / (np.array(camera.focal_px) * focal)
    if not (camera.k1 or camera.k2):
        return bent
    # Newton's steps on the radius; beyond that where the lens folds the picture back there is no solution.
    bent_radius = np.hypot(bent[:, 0], bent[:, 1])
    radius = bent_radius.copy()
    for _ in range(20):
        slope = 1 + 3 * camera.k1 * radius**2 + 5 * camera.k2 * radius**4
        missing = bent_radius - radius * (1 + camera.k1 * radius**2 + camera.k2 * radius**4)
        radius = np.where(slope > 0.05, radius + missing / np.maximum(slope, 0.05), np.nan)
    grown = 1 + camera.k1 * radius**2 + camera.k2 * radius**4
    reached = np.abs(radius * grown - bent_radius) < 1e-6
    return np.where(reached[:, None], bent / grown[:, None], np.nan)


def undistort_pixels(pixels: Float[np.ndarray, "N 2"], camera: Camera) -> Float[np.ndarray, "N 2"]:
    """Pixels of the same points for a lens without distortion."""
    return normalize(pixels, camera) * camera.focal_px + camera.centre_px


def distort_pixels(pixels: Float[np.ndarray, "N 2"], camera: Camera) -> Float[np.ndarray, "N 2"]:
    """Pixels as the lens shows them, from those of a lens without distortion; NaN where it shows none."""
    flat = (np.asarray(pixels, float).reshape(-1, 2) - camera.centre_px) / camera.focal_px
    return _distort(flat, camera)[0] * camera.focal_px + camera.centre_px


def _distort(flat: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(right, down) per metre of depth (N, 2) as the lens shows it; also the derivatives (N, 2, 2).

    NaN beyond the radius where the lens folds the picture back: 1 + 3 k1 r² + 5 k2 r⁴ falls to 0.05.
    """
    a, b, c = 5 * camera.k2, 3 * camera.k1, 0.95
    inside = b * b - 4 * a * c
    fold = np.inf
    if inside >= 0 and (a < 0 or b < 0):
        # The smaller positive root, in the form that holds for a = 0 too.
        fold = 2 * c / (-b + float(np.sqrt(inside)))
    square = (flat**2).sum(axis=1)
    grown = 1 + camera.k1 * square + camera.k2 * square**2
    slope = 2 * camera.k1 + 4 * camera.k2 * square
    grown = np.where((grown + slope * square > 0.05) & (square < fold), grown, np.nan)
    by_flat = slope[:, None, None] * flat[:, :, None] * flat[:, None, :] + grown[:, None, None] * np.eye(2)
    return flat * grown[:, None], by_flat


def inverse_2x2(matrices: Float[np.ndarray, "N 2 2"]) -> Float[np.ndarray, "N 2 2"]:
    """Inverses in closed form, which is faster for small matrices; infinite for a singular one."""
    (a, b), (c, d) = np.moveaxis(matrices, (1, 2), (0, 1))
    return np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), (0, 1), (1, 2))


def ground_with_slopes(
    pose: CameraPose,
    camera: Camera,
    pixels: Float[np.ndarray, "N 2"],
    up_m: float | Float[np.ndarray, "N"] = 0.0,
    surface: Surface | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """East and north of what pixels show (N, 2), and their derivatives by the pose (N, 2, 7) and the pixel (N, 2, 2).

    The pose is in the order of Fix. up_m: height of what is seen above the ground, the plane up = 0 or the surface.
    NaN where a ray meets no ground.
    """
    scale = np.array(camera.focal_px) * pose.focal
    flat = normalize(pixels, camera, pose.focal)
    bent, by_flat = _distort(flat, camera)
    by_bent = inverse_2x2(by_flat)
    way = np.c_[flat, np.ones(len(flat))] @ pose.axes.T
    far, normal = _meet_ground(pose.place_m, way, np.broadcast_to(np.asarray(up_m, float), len(way)), surface)
    offset = far[:, None] * way
    # A change of the ray or of its start moves the place where it meets the ground along the ground.
    steep = np.where(np.isfinite(far), (way * normal).sum(axis=1), np.nan)
    along = (np.eye(3) - way[:, :, None] * normal[:, None, :] / steep[:, None, None])[:, :2]
    by_lift = far[:, None, None] * along @ pose.axes[:, :2]
    by_pose = np.empty((len(way), 2, 7))
    by_pose[:, :, :3] = -along @ cross(offset)
    by_pose[:, :, 3:6] = along
    by_pose[:, :, 6] = (by_lift @ -(by_bent @ bent[:, :, None]))[:, :, 0]
    return (pose.place_m + offset)[:, :2], by_pose, by_lift @ (by_bent / scale)


def _meet_ground(
    place_m: np.ndarray, way: np.ndarray, up_m: np.ndarray, surface: Surface | None
) -> tuple[np.ndarray, np.ndarray]:
    """How far along rays (N, 3), in their own lengths, they first meet the ground, and its upward normal there (N, 3).

    NaN where a ray meets no ground of known height.
    """
    normal = np.tile([0.0, 0.0, 1.0], (len(way), 1))
    down = np.where(way[:, 2] < -1e-9 * np.linalg.norm(way, axis=1), way[:, 2], np.nan)
    if surface is None:
        far = (up_m - place_m[2]) / down
        return np.where(far > 0, far, np.nan), normal
    with np.errstate(invalid="ignore", divide="ignore"):
        far = _search_surface(place_m, way, up_m, surface, down)
    there = place_m[:2] + far[:, None] * way[:, :2]
    for axis, aside in enumerate(_SLOPE_M * np.eye(2)):
        rise = (surface(there + aside) - surface(there - aside)) / (2 * _SLOPE_M)
        normal[:, axis] = -np.nan_to_num(rise)  # level at the edge of the known ground
    return far, normal


def _search_surface(
    place_m: np.ndarray, way: np.ndarray, up_m: np.ndarray, surface: Surface, down: np.ndarray
) -> np.ndarray:
    height = place_m[2] - float(np.nan_to_num(surface(place_m[None, :2])[0]))
    if not height > 0 or not len(way):
        return np.full(len(way), np.nan)

    def above(far: np.ndarray) -> np.ndarray:
        """Metres above the ground (..., N)."""
        points = place_m + far[..., None] * way
        return points[..., 2] - up_m - surface(points[..., :2].reshape(-1, 2)).reshape(far.shape)

    steps = np.linspace(0, _REACH, _SAMPLES + 1)[:, None] * (-height / down)
    gap = above(steps)
    # A ray may have met ground of unknown height: it counts only where it is seen to go from above to below.
    hidden = np.cumsum(gap <= 0, axis=0)[:-1] > 0
    met = (gap[:-1] > 0) & (gap[1:] <= 0) & ~hidden
    first, ray = met.argmax(axis=0), np.arange(len(way))
    low, high = steps[first, ray], steps[first + 1, ray]
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        over = above(middle) > 0
        low, high = np.where(over, middle, low), np.where(over, high, middle)
    at_low, at_high = above(low), above(high)
    share = np.where(at_low > at_high, at_low / (at_low - at_high), 0.5)
    return np.where(met.any(axis=0), low + share * (high - low), np.nan)


def ground_height(elevation: Elevation, east_north_m: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
    """Metres above the local plane, bilinear between the four nearest heights; NaN where one of them is unknown."""
    heights = elevation.up_m
    rows, columns = heights.shape
    place = (np.asarray(east_north_m, float).reshape(-1, 2) - elevation.corner_m) / elevation.step_m
    x, y = place[:, 0], place[:, 1]
    inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)  # False for NaN
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
