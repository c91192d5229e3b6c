"""Locate people in one picture of a camera on the ground (appendix A, IV-C, eq. 13-15), with covariances.

A person stands upright on the plane from which the camera's height is measured. Consider a level frame at the camera
that looks along its heading. The ray through a pixel falls by `slope` metres per metre ahead. With the slopes of the
feet and of the head, the distance ahead is
    body height / (feet - head)      for any camera height, and
    camera height / feet             for any body height.
With a level camera the first is the source's D = f H / h. Inverse distances, 1 / ahead, are linear in the pixels, so
the two are averaged there, weighted by the inverse of their covariance. They share the foot row, the pitch and the
focal length, so the covariance includes these correlations. If the two differ more than chance allows, for example for
a child or a half hidden body, it is unknown which is right, so the covariance is extended towards the other.

Difference to the source: D is the depth along the optical axis, and the distance over the ground is D / cos(alpha).
`paper` uses D as the distance, as printed.
"""

import numpy as np

from torchvision_dddas.config import GroundParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import normalize
from torchvision_dddas.types import Bool, Camera, Float, Poses, Sightings

# Smallest standard deviation of a box's edges, in pixels.
_PIXEL_SIGMA = 0.5
# Standard deviation of the middle of a box cut at its side, in box heights.
_SIDE_SIGMA = 0.15
# A box touches the picture's border if its edge is at most this far from it.
_BORDER_PX = 1.0
# Largest relative standard deviation of a distance; above it the linearization is not valid.
_COARSEST = 0.5

# Columns of derivatives: one for each error, multiplied by the error's standard deviation.
_FEET, _TALL, _SIDE, _DISPUTE, _BODY, _EAST, _NORTH, _HEADING, _PITCH, _HEIGHT, _FOCAL = range(11)
_OWN, _CAMERA = slice(_FEET, _BODY), slice(_EAST, _FOCAL + 1)


def range_people(
    box_px: Float[np.ndarray, "N 4"],
    cut: Bool[np.ndarray, "N"],
    camera: Camera,
    poses: Poses,
    east_north_m: Float[np.ndarray, "N 2"],
    parameters: GroundParameters,
) -> Sightings:
    """Return distance, bearing and place of people, one row a box.

    cut: the picture's border cuts the body, so its height is unknown; the foot row can still be used if it is visible.
    poses: directions of the camera, one row a box; its place is given by east_north_m in local metres.
    Raise InputError if parameters.use needs the foot row and the camera's height is unknown.
    """
    box = np.asarray(box_px, float).reshape(-1, 4)
    if parameters.mode == "paper":
        return _as_printed(box, camera, poses, east_north_m, parameters)
    if parameters.use == "feet" and not np.isfinite(camera.height_m):
        raise InputError(
            f"{camera.name} has no height_m; ground.use = feet needs the camera's height above the ground. "
            "Add it, or set ground.use = height"
        )
    slopes, by_error = _rays(box, cut, camera, poses, parameters)
    feet_shown = ~cut | (box[:, 1] + box[:, 3] < camera.size_px[1] - _BORDER_PX)
    inverse, by_distance, by = _inverse_distance(slopes, by_error, cut, feet_shown, camera, parameters)
    aside, by_aside = slopes[2], by_error[2]
    sine, cosine = np.sin(poses.heading_rad), np.cos(poses.heading_rad)
    along, across = np.stack([sine, cosine], axis=1), np.stack([cosine, -sine], axis=1)
    way = along + aside[:, None] * across  # over the ground, per metre ahead
    ahead = 1 / inverse
    offset = ahead[:, None] * way
    deviation = -(ahead**2)[:, None, None] * way[:, :, None] * by_distance[:, None, :]
    deviation += ahead[:, None, None] * across[:, :, None] * by_aside[:, None, :]
    deviation[:, :, _HEADING] += camera.heading_sigma_rad * np.stack([offset[:, 1], -offset[:, 0]], axis=1)
    deviation[:, 0, _EAST] += camera.position_sigma_m
    deviation[:, 1, _NORTH] += camera.position_sigma_m
    own = deviation[:, :, _OWN]
    return Sightings(
        east_north_m + offset,
        np.hypot(offset[:, 0], offset[:, 1]),
        np.mod(poses.heading_rad + np.arctan(aside), 2 * np.pi),
        by,
        own @ own.swapaxes(1, 2),
        deviation[:, :, _BODY],
        deviation[:, :, _CAMERA],
    )


def touches_border(box_px: Float[np.ndarray, "N 4"], size_px: tuple[int, int]) -> Bool[np.ndarray, "N"]:
    """Return whether the picture's border may cut each body, for tables that do not say so."""
    box = np.asarray(box_px, float).reshape(-1, 4)
    low, high = box[:, :2], box[:, :2] + box[:, 2:]
    return (low <= _BORDER_PX).any(axis=1) | (high >= np.array(size_px) - _BORDER_PX).any(axis=1)


def level(u: np.ndarray, v: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels as (right, down) per metre of depth, without distortion and roll; NaN outside the lens model."""
    right, down = normalize(np.stack([u, v], axis=1), camera).T
    sine, cosine = np.sin(camera.roll_rad), np.cos(camera.roll_rad)
    return right * cosine - down * sine, right * sine + down * cosine


def _rays(
    box: np.ndarray, cut: np.ndarray, camera: Camera, poses: Poses, parameters: GroundParameters
) -> tuple[np.ndarray, np.ndarray]:
    """Return (3, N) slopes of feet and head, and metres right per metre ahead; and their (3, N, 11) derivatives."""
    u, tall = box[:, 0] + box[:, 2] / 2 - 0.5, box[:, 3]
    sine, cosine = np.sin(poses.pitch_rad), np.cos(poses.pitch_rad)
    x, y_feet = level(u, box[:, 1] + tall - 0.5, camera)
    _, y_head = level(u, box[:, 1] - 0.5, camera)
    y = np.stack([y_feet, y_head])
    # Distance ahead per ray length. A ray that goes straight up or down, or backward, has no usable slope.
    ahead = cosine - y * sine
    ahead = np.where(ahead > 1e-3, ahead, np.nan)
    slope = (sine + y * cosine) / ahead
    aside = x / ahead[0]
    row = np.hypot(parameters.feet_sigma * tall, _PIXEL_SIGMA) / camera.focal_px[1]
    top = np.hypot(parameters.height_sigma * tall, _PIXEL_SIGMA) / camera.focal_px[1]
    cut_aside = cut & ((box[:, 0] <= _BORDER_PX) | (box[:, 0] + box[:, 2] >= camera.size_px[0] - _BORDER_PX))
    side_sigma = np.where(cut_aside, _SIDE_SIGMA, parameters.feet_sigma)
    by_error = np.zeros((3, len(box), 11))
    by_error[:2, :, _FEET] = row / ahead**2
    by_error[1, :, _TALL] = -top / ahead[1] ** 2
    by_error[:2, :, _PITCH] = camera.pitch_sigma_rad * (1 + slope**2)
    by_error[:2, :, _FOCAL] = -camera.focal_sigma * y / ahead**2
    by_error[2, :, _SIDE] = np.hypot(side_sigma * tall, _PIXEL_SIGMA) / camera.focal_px[0] / ahead[0]
    by_error[2, :, _FEET] = row * x * sine / ahead[0] ** 2
    by_error[2, :, _PITCH] = camera.pitch_sigma_rad * aside * slope[0]
    by_error[2, :, _FOCAL] = -camera.focal_sigma * (x / ahead[0] + x * y_feet * sine / ahead[0] ** 2)
    return np.stack([*slope, aside]), by_error


def _inverse_distance(
    slopes: np.ndarray,
    by_error: np.ndarray,
    cut: np.ndarray,
    feet_shown: np.ndarray,
    camera: Camera,
    parameters: GroundParameters,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return 1 / ahead (N,), its (N, 11) derivatives, and the source of the distance (N,)."""
    body, above = parameters.body_height_m, camera.height_m
    (feet, head, _), (d_feet, d_head, _) = slopes, by_error
    by_height, by_feet = (feet - head) / body, feet / above
    can_height = (by_height > 0) & ~cut & (parameters.use != "feet")
    can_feet = (by_feet > 0) & feet_shown & (parameters.use != "height")
    by = np.select([can_height & can_feet, can_height, can_feet], ["both", "height", "feet"], "bearing")
    d_height, d_feet = (d_feet - d_head) / body, d_feet / above
    # Errors of the heights scale the inverse distance. They are evaluated at the weighted inverse distance: otherwise a
    # distance that came out too large would seem more certain.
    inverse = np.where(can_feet, by_feet, by_height)
    for _ in range(3):
        d_height[:, _BODY] = -inverse * parameters.body_height_sigma_m / body
        d_feet[:, _HEIGHT] = -inverse * camera.height_sigma_m / above
        gap = d_height - d_feet
        weight = -(gap * d_feet).sum(axis=1) / np.maximum((gap**2).sum(axis=1), 1e-300)
        weight = np.select([by == "both", by == "height"], [weight, 1.0], 0.0)
        ours = np.where(weight == 0, 0, weight * by_height) + np.where(weight == 1, 0, (1 - weight) * by_feet)
        inverse = np.where(by == "bearing", np.nan, ours)
    share = weight[:, None]
    derivative = np.where(share == 0, 0, share * d_height) + np.where(share == 1, 0, (1 - share) * d_feet)
    excess = np.abs(by_height - by_feet) - parameters.gate_sigmas * np.sqrt((gap**2).sum(axis=1))
    derivative[:, _DISPUTE] = np.where(by == "both", np.maximum(excess, 0) / 2, 0)
    # Comparisons with NaN are false, so such a distance is unknown.
    fine = (inverse > 0) & (np.sqrt((derivative**2).sum(axis=1)) < _COARSEST * inverse)
    return np.where(fine, inverse, np.nan), derivative, np.where(fine, by, "bearing")


def _as_printed(
    box: np.ndarray, camera: Camera, poses: Poses, east_north_m: np.ndarray, parameters: GroundParameters
) -> Sightings:
    """Apply eq. (13) to (15): use the box height alone, for any pitch and cut; the errors are unknown."""
    distance = camera.focal_px[1] * parameters.body_height_m / box[:, 3]
    right = (box[:, 0] + box[:, 2] / 2 - 0.5 - camera.centre_px[0]) / camera.focal_px[0]
    bearing = poses.heading_rad + np.arctan(right)
    place = east_north_m + distance[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    unknown = np.full((len(box), 2, 6), np.nan)
    by = np.full(len(box), "height")
    return Sightings(place, distance, np.mod(bearing, 2 * np.pi), by, unknown[:, :, :2], unknown[:, :, 0], unknown)
