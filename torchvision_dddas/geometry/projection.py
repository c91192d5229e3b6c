"""Project points to pixels of a camera, and intersect the rays of pixels with the ground, in local metres.

The camera axes are right, down and forward. With heading h, pitch p below the horizon and no roll they are
    right (cos h, -sin h, 0), down (-sin h sin p, -cos h sin p, -cos p), forward (sin h cos p, cos h cos p, -sin p)
in east, north and up. For a camera that looks straight down (p = 90 deg), h is the heading of the picture's upper edge.
Roll turns the camera clockwise about forward. The lens distortion is OpenCV's: radial, from r to
r (1 + k1 r² + k2 r⁴ + k3 r⁶), and tangential by p1 and p2.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from torchvision_dddas.geometry.rotations import cross
from torchvision_dddas.types import Camera, CameraPose, Elevation, Float

# A point is beside or behind the camera if its depth is a smaller share of its distance.
_NEAREST = 1e-6
# The distortion folds the picture back where the derivative of the distorted radius is at most this.
_FOLDED = 0.05
# The slope of the ground is measured from this far before a point to this far after it.
_SLOPE_M = 0.5
# A ray is searched down to _REACH times the camera's height above the ground, in _SAMPLES steps. The interval found is
# then bisected _HALVINGS times.
_REACH, _SAMPLES, _HALVINGS = 4.0, 96, 14

Surface = Callable[[np.ndarray], np.ndarray]
"""Returns the heights above the plane up = 0 of positions (N, 2) in metres east and north; NaN where unknown."""


def axes_of(
    heading_rad: float | np.ndarray, pitch_rad: float | np.ndarray, roll_rad: float | np.ndarray
) -> Float[np.ndarray, "*N 3 3"]:
    """Return the camera's axes right, down, forward as columns, in east, north, up, for single angles or arrays."""
    (sh, sp, sr), (ch, cp, cr) = (f(np.array([heading_rad, pitch_rad, roll_rad])) for f in (np.sin, np.cos))
    right, down = np.array([ch, -sh, 0 * ch]), np.array([-sh * sp, -ch * sp, -cp])
    forward = np.array([sh * cp, ch * cp, -sp])
    columns = np.array([cr * right + sr * down, cr * down - sr * right, forward])
    return np.moveaxis(columns, (1, 0), (-2, -1))


def project(points_m: Float[np.ndarray, "N 3"], pose: CameraPose, camera: Camera) -> Float[np.ndarray, "N 2"]:
    """Return the pixels (u, v) of points in east, north, up; NaN behind the camera or outside the range of the lens."""
    return project_with_slopes(points_m, pose, camera)[0]


def project_with_slopes(
    points_m: Float[np.ndarray, "N 3"], pose: CameraPose, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels (N, 2), and derivatives by the pose (N, 2, 7), in the order of Fix, and by the point (N, 2, 3)."""
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
    if any(camera.distortion):
        flat, by_flat = _distort(flat, camera)
        by_seen = by_flat @ by_seen
    by_point = (scale[:, None] * by_seen) @ pose.axes.T
    by_pose = np.empty((len(seen), 2, 7))
    # A rotation w of the camera moves a point, as seen from the camera, by -w x apart: gradient . (apart x w).
    (gx, gy, gz), (x, y, z) = np.moveaxis(by_point, 2, 0), apart.T[:, :, None]
    by_pose[:, :, 0], by_pose[:, :, 1], by_pose[:, :, 2] = gy * z - gz * y, gz * x - gx * z, gx * y - gy * x
    by_pose[:, :, 3:6] = -by_point
    by_pose[:, :, 6] = scale * flat
    return flat * scale + camera.centre_px, by_pose, by_point


def rays(pixels: Float[np.ndarray, "N 2"], pose: CameraPose, camera: Camera) -> Float[np.ndarray, "N 3"]:
    """Return the rays of pixels in east, north, up, scaled to a depth of 1 m; NaN outside the range of the lens."""
    flat = normalize(pixels, camera, pose.focal)
    return np.c_[flat, np.ones(len(flat))] @ pose.axes.T


def normalize(pixels: Float[np.ndarray, "N 2"], camera: Camera, focal: float = 1.0) -> Float[np.ndarray, "N 2"]:
    """Convert pixels to metres right and down per metre of depth, without distortion.

    focal: focal length as a share of the camera's. Pixels outside the range of the lens give NaN.
    """
    bent = (np.asarray(pixels, float).reshape(-1, 2) - camera.centre_px) / (np.array(camera.focal_px) * focal)
    if not any(camera.distortion):
        return bent
    # Solve for the radius by Newton's method. Beyond the radius where the picture folds back there is no solution.
    k1, k2, p1, p2, k3 = camera.distortion
    bent_radius = np.hypot(bent[:, 0], bent[:, 1])
    radius = bent_radius.copy()
    for _ in range(20):
        slope = 1 + 3 * k1 * radius**2 + 5 * k2 * radius**4 + 7 * k3 * radius**6
        missing = bent_radius - radius * (1 + k1 * radius**2 + k2 * radius**4 + k3 * radius**6)
        radius = np.where(slope > 0.05, radius + missing / np.maximum(slope, 0.05), np.nan)
    grown = 1 + k1 * radius**2 + k2 * radius**4 + k3 * radius**6
    reached = np.abs(radius * grown - bent_radius) < 1e-6
    flat = np.where(reached[:, None], bent / grown[:, None], np.nan)
    if not (p1 or p2):
        return flat
    for _ in range(8):
        seen, by_flat = _distort(flat, camera)
        flat = flat + (inverse_2x2(by_flat) @ (bent - seen)[:, :, None])[:, :, 0]
    reached = np.abs(_distort(flat, camera)[0] - bent).max(axis=1) < 1e-6
    return np.where(reached[:, None], flat, np.nan)


def undistort_pixels(pixels: Float[np.ndarray, "N 2"], camera: Camera) -> Float[np.ndarray, "N 2"]:
    """Remove the lens distortion from pixels; NaN outside the range of the lens."""
    return normalize(pixels, camera) * camera.focal_px + camera.centre_px


def distort_pixels(pixels: Float[np.ndarray, "N 2"], camera: Camera) -> Float[np.ndarray, "N 2"]:
    """Add the lens distortion to pixels of a lens without distortion; NaN outside the range of the lens."""
    flat = (np.asarray(pixels, float).reshape(-1, 2) - camera.centre_px) / camera.focal_px
    return _distort(flat, camera)[0] * camera.focal_px + camera.centre_px


def _distort(flat: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Distort (right, down) per metre of depth (N, 2), and return also the derivatives (N, 2, 2).

    The results are NaN beyond the radius where the distortion folds the picture back.
    """
    k1, k2, p1, p2, k3 = camera.distortion
    square = (flat**2).sum(axis=1)
    grown = 1 + k1 * square + k2 * square**2 + k3 * square**3
    slope = 2 * k1 + 4 * k2 * square + 6 * k3 * square**2
    grown = np.where((grown + slope * square > _FOLDED) & (square < _fold_square(k1, k2, k3)), grown, np.nan)
    by_flat = slope[:, None, None] * flat[:, :, None] * flat[:, None, :] + grown[:, None, None] * np.eye(2)
    seen = flat * grown[:, None]
    if p1 or p2:
        x, y = flat.T
        seen = seen + np.stack(
            [2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y], 1
        )
        across = 2 * p1 * x + 2 * p2 * y
        aside = [[2 * p1 * y + 6 * p2 * x, across], [across, 6 * p1 * y + 2 * p2 * x]]
        by_flat = by_flat + np.moveaxis(np.array(aside), 2, 0)
    return seen, by_flat


@lru_cache(maxsize=32)
def _fold_square(k1: float, k2: float, k3: float) -> float:
    """Return the square of the radius where 1 + 3 k1 r² + 5 k2 r⁴ + 7 k3 r⁶ first falls to _FOLDED, else infinity."""
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1 - _FOLDED])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1)) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


def inverse_2x2(matrices: Float[np.ndarray, "N 2 2"]) -> Float[np.ndarray, "N 2 2"]:
    """Invert matrices in closed form, which is faster for small matrices. A singular matrix gives infinite entries."""
    (a, b), (c, d) = np.moveaxis(matrices, (1, 2), (0, 1))
    return np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), (0, 1), (1, 2))


def ground_with_slopes(
    pose: CameraPose,
    camera: Camera,
    pixels: Float[np.ndarray, "N 2"],
    up_m: float | Float[np.ndarray, "N"] = 0.0,
    surface: Surface | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ground positions (N, 2) of pixels, with derivatives by the pose (N, 2, 7) and by the pixel (N, 2, 2).

    Positions are east and north in metres; they are NaN where a ray does not meet the ground. The pose is in the order
    of Fix. up_m: height of the seen point above the ground, which is the plane up = 0 or the surface.
    """
    scale = np.array(camera.focal_px) * pose.focal
    flat = normalize(pixels, camera, pose.focal)
    bent, by_flat = _distort(flat, camera)
    by_bent = inverse_2x2(by_flat)
    way = np.c_[flat, np.ones(len(flat))] @ pose.axes.T
    far, normal = _meet_ground(pose.place_m, way, np.broadcast_to(np.asarray(up_m, float), len(way)), surface)
    offset = far[:, None] * way
    # A change of the ray or of its start moves the intersection along the ground.
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
    """Return the distance along rays (N, 3) to the ground, in ray lengths, and the ground's upward normal there (N, 3).

    The distance ends at the first intersection. It is NaN where a ray does not meet ground of known height.
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
        normal[:, axis] = -np.nan_to_num(rise)  # the ground counts as level at the edge of the known area
    return far, normal


def _search_surface(
    place_m: np.ndarray, way: np.ndarray, up_m: np.ndarray, surface: Surface, down: np.ndarray
) -> np.ndarray:
    height = place_m[2] - float(np.nan_to_num(surface(place_m[None, :2])[0]))
    if not height > 0 or not len(way):
        return np.full(len(way), np.nan)

    def above(far: np.ndarray) -> np.ndarray:
        """Return the height (..., N) of points on the rays above the ground, in metres."""
        points = place_m + far[..., None] * way
        return points[..., 2] - up_m - surface(points[..., :2].reshape(-1, 2)).reshape(far.shape)

    steps = np.linspace(0, _REACH, _SAMPLES + 1)[:, None] * (-height / down)
    gap = above(steps)
    # An intersection counts only where two successive samples lie above and below known ground, because a ray may cross
    # ground of unknown height unseen.
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
    """Return heights above the local plane in metres, bilinear between four heights; NaN where one is unknown."""
    heights = elevation.up_m
    rows, columns = heights.shape
    place = (np.asarray(east_north_m, float).reshape(-1, 2) - elevation.corner_m) / elevation.step_m
    x, y = place[:, 0], place[:, 1]
    inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)  # False for NaN
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    # A position on the last row or column is interpolated in the cell before it.
    column, row = np.minimum(x.astype(int), columns - 2), np.minimum(y.astype(int), rows - 2)
    right, above = x - column, y - row
    low = heights[row, column] * (1 - right) + heights[row, column + 1] * right
    high = heights[row + 1, column] * (1 - right) + heights[row + 1, column + 1] * right
    return np.where(inside, low * (1 - above) + high * above, np.nan)


def surface_of(elevation: Elevation | None) -> Surface | None:
    """Return `ground_height` for an elevation model; None for level ground."""
    return None if elevation is None else lambda east_north_m: ground_height(elevation, east_north_m)


def shift_origin(elevation: Elevation, origin_m: np.ndarray) -> Elevation:
    """Shift an elevation model to an origin (2,) in its current metres, with heights relative to the ground there."""
    base = float(ground_height(elevation, np.asarray(origin_m, float)[None])[0])
    corner = elevation.corner_m[0] - float(origin_m[0]), elevation.corner_m[1] - float(origin_m[1])
    return replace(elevation, up_m=elevation.up_m - base, corner_m=corner, base_m=elevation.base_m + base)
