"""Where people stand, from one look of a camera on the ground (appendix A, IV-C, eq. 13-15), with covariances.

A person stands upright on the plane that the camera's height is measured from. A ray through a pixel, in a level frame
at the camera that looks along its heading, falls by `slope` metres a metre ahead. With the slopes of the feet and of
the head, the distance ahead is
    body height / (feet - head)      whatever the camera's height, and
    camera height / feet             whatever the person's.
With a level camera the first is the source's D = f H / h. Inverse distances, 1 / ahead, are linear in the pixels: so
there the two are weighed, by the inverse of their covariance. They share the foot row, the pitch and the focal length,
and those correlations count. Where the two disagree beyond chance, as for a child or a body half hidden, nobody knows
which is right: then the covariance grows towards the other.

What the source does not do: D is the depth along the optical axis, and the way over the ground D / cos(alpha).
`paper` takes D for it, as printed.
"""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.config import GroundParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.projection import normalize
from torchvision_dddas.types import Bool, Camera, Float, Poses, Sightings

# Least standard deviation of a box's edges, in pixels.
PIXEL_SIGMA = 0.5
# Standard deviation of the middle of a box cut at its side, in box heights.
SIDE_SIGMA = 0.15
# A box whose edge is this near the picture's border touches it.
BORDER_PX = 1.0
# Largest relative standard deviation of a distance: beyond it the first order does not hold.
COARSEST = 0.5


def range_people(
    box_px: Float[np.ndarray, "N 4"],
    cut: Bool[np.ndarray, "N"],
    camera: Camera,
    poses: Poses,
    east_north_m: Float[np.ndarray, "N 2"],
    parameters: GroundParameters,
) -> Sightings:
    """Distance, bearing and place of people, a row a box.

    cut: the picture's border cuts the body, so its height tells nothing; the foot row still does where it is inside.
    poses: where the camera looked, a row a box; its place is not read but given in local metres as east_north_m.
    Raises InputError where parameters.use asks for the foot row and the camera's height is not known.
    """
    if parameters.use == "feet" and parameters.mode == "default" and not np.isfinite(camera.height_m):
        raise InputError(
            f"{camera.name} has no height_m; ground.use = feet needs the camera's height above the ground. "
            "Add it, or set ground.use = height"
        )
    if parameters.mode == "paper":
        return _as_printed(box_px, camera, poses, east_north_m, parameters)
    rays = _rays(box_px, cut, camera, poses, parameters)
    inverse, share, by = _inverse_distance(rays, cut, camera, parameters)
    return _placed(rays, inverse, share, by, camera, poses, east_north_m)


# Errors: each is a column, scaled to one standard deviation.

FEET, TALL, SIDE, DISPUTE, BODY, EAST, NORTH, HEADING, PITCH, HEIGHT, FOCAL = range(11)
OWN, CAMERA = slice(FEET, BODY), slice(EAST, FOCAL + 1)
COLUMNS = 11


@dataclass(frozen=True)
class _Rays:
    """The slopes of the feet and of the head, and metres to the right a metre ahead.

    d_*: (N, 11) their derivatives by one sigma of each error. feet_inside: (N,) whether the picture holds the feet.
    """

    feet: np.ndarray
    head: np.ndarray
    aside: np.ndarray
    d_feet: np.ndarray
    d_head: np.ndarray
    d_aside: np.ndarray
    feet_inside: np.ndarray


def _rays(box_px: np.ndarray, cut: np.ndarray, camera: Camera, poses: Poses, parameters: GroundParameters) -> _Rays:
    box = np.asarray(box_px, float).reshape(-1, 4)
    width, height = camera.size_px
    u = box[:, 0] + box[:, 2] / 2 - 0.5
    bottom = box[:, 1] + box[:, 3] - 0.5
    sine, cosine = np.sin(poses.pitch_rad), np.cos(poses.pitch_rad)
    x, y_feet = level(u, bottom, camera)
    _, y_head = level(u, box[:, 1] - 0.5, camera)

    def turned(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far a ray goes ahead, and its slope."""
        ahead = cosine - y * sine
        # A ray that goes straight up or down, or backward, has no slope of use.
        ahead = np.where(ahead > 1e-3, ahead, np.nan)
        return ahead, (sine + y * cosine) / ahead

    ahead_feet, feet = turned(y_feet)
    ahead_head, head = turned(y_head)
    aside = x / ahead_feet

    row = np.hypot(parameters.feet_sigma * box[:, 3], PIXEL_SIGMA) / camera.focal_px[1]
    tall = np.hypot(parameters.height_sigma * box[:, 3], PIXEL_SIGMA) / camera.focal_px[1]
    at_side = cut & ((box[:, 0] <= BORDER_PX) | (box[:, 0] + box[:, 2] >= width - BORDER_PX))
    side = np.hypot(np.where(at_side, SIDE_SIGMA, parameters.feet_sigma) * box[:, 3], PIXEL_SIGMA) / camera.focal_px[0]

    d_feet, d_head, d_aside = (np.zeros((len(box), COLUMNS)) for _ in range(3))
    d_feet[:, FEET], d_head[:, FEET] = row / ahead_feet**2, row / ahead_head**2
    d_head[:, TALL] = -tall / ahead_head**2
    d_feet[:, PITCH], d_head[:, PITCH] = (camera.pitch_sigma_rad * (1 + slope**2) for slope in (feet, head))
    d_feet[:, FOCAL], d_head[:, FOCAL] = (
        -camera.focal_sigma * y / ahead**2 for y, ahead in ((y_feet, ahead_feet), (y_head, ahead_head))
    )
    d_aside[:, SIDE] = side / ahead_feet
    d_aside[:, FEET] = row * x * sine / ahead_feet**2
    d_aside[:, PITCH] = camera.pitch_sigma_rad * aside * feet
    d_aside[:, FOCAL] = -camera.focal_sigma * (x / ahead_feet + x * y_feet * sine / ahead_feet**2)
    inside = ~cut | (box[:, 1] + box[:, 3] < height - BORDER_PX)
    return _Rays(feet, head, aside, d_feet, d_head, d_aside, inside)


def touches_border(box_px: Float[np.ndarray, "N 4"], size_px: tuple[int, int]) -> Bool[np.ndarray, "N"]:
    """Whether the picture's border may cut each body, for tables that do not say so."""
    box = np.asarray(box_px, float).reshape(-1, 4)
    low, high = box[:, :2], box[:, :2] + box[:, 2:]
    return (low <= BORDER_PX).any(axis=1) | (high >= np.array(size_px) - BORDER_PX).any(axis=1)


def level(u: np.ndarray, v: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixels to (right, down) per metre of depth, without distortion and roll; NaN where the lens has no such pixel."""
    right, down = normalize(np.stack([u, v], axis=1), camera).T
    sine, cosine = np.sin(camera.roll_rad), np.cos(camera.roll_rad)
    return right * cosine - down * sine, right * sine + down * cosine


def _inverse_distance(
    rays: _Rays, cut: np.ndarray, camera: Camera, parameters: GroundParameters
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """1 / ahead (N,), its (N, 11) derivatives, and what told it (N,)."""
    body, above = parameters.body_height_m, camera.height_m
    by_height, by_feet = (rays.feet - rays.head) / body, rays.feet / above
    can_height = (by_height > 0) & ~cut & (parameters.use != "feet")
    can_feet = (by_feet > 0) & rays.feet_inside & (parameters.use != "height")
    by = np.select([can_height & can_feet, can_height, can_feet], ["both", "height", "feet"], "bearing")

    d_height, d_feet = (rays.d_feet - rays.d_head) / body, rays.d_feet / above
    # Errors of the heights scale the inverse distance. They are taken at the weighed one: at its own, a distance that
    # came out too large would seem the surer.
    weighed = np.where(can_feet, by_feet, by_height)
    for _ in range(3):
        d_height[:, BODY] = -weighed * parameters.body_height_sigma_m / body
        d_feet[:, HEIGHT] = -weighed * camera.height_sigma_m / above
        gap = d_height - d_feet
        weight = -(gap * d_feet).sum(axis=1) / np.maximum((gap**2).sum(axis=1), 1e-300)
        weight = np.select([by == "both", by == "height"], [weight, 1.0], 0.0)
        ours = np.where(weight == 0, 0, weight * by_height) + np.where(weight == 1, 0, (1 - weight) * by_feet)
        weighed = np.where(by == "bearing", np.nan, ours)
    share = np.where((weight == 0)[:, None], 0, weight[:, None] * d_height)
    share = share + np.where((weight == 1)[:, None], 0, (1 - weight[:, None]) * d_feet)
    excess = np.abs(by_height - by_feet) - parameters.gate_sigmas * np.sqrt((gap**2).sum(axis=1))
    share[:, DISPUTE] = np.where(by == "both", np.maximum(excess, 0) / 2, 0)
    # NaN compares as false: such a distance is unknown.
    fine = (weighed > 0) & (np.sqrt((share**2).sum(axis=1)) < COARSEST * weighed)
    return np.where(fine, weighed, np.nan), share, np.where(fine, by, "bearing")


def _placed(
    rays: _Rays,
    inverse: np.ndarray,
    share: np.ndarray,
    by: np.ndarray,
    camera: Camera,
    poses: Poses,
    east_north_m: np.ndarray,
) -> Sightings:
    sine, cosine = np.sin(poses.heading_rad), np.cos(poses.heading_rad)
    ahead, along = 1 / inverse, np.stack([sine, cosine], axis=1)
    across = np.stack([cosine, -sine], axis=1)
    way = along + rays.aside[:, None] * across  # over the ground, a metre ahead
    offset = ahead[:, None] * way
    deviation = -(ahead**2)[:, None, None] * way[:, :, None] * share[:, None, :]
    deviation += ahead[:, None, None] * across[:, :, None] * rays.d_aside[:, None, :]
    deviation[:, :, HEADING] += camera.heading_sigma_rad * np.stack([offset[:, 1], -offset[:, 0]], axis=1)
    deviation[:, 0, EAST] += camera.position_sigma_m
    deviation[:, 1, NORTH] += camera.position_sigma_m
    own = deviation[:, :, OWN]
    return Sightings(
        east_north_m + offset,
        np.hypot(offset[:, 0], offset[:, 1]),
        np.mod(poses.heading_rad + np.arctan(rays.aside), 2 * np.pi),
        by,
        own @ own.swapaxes(1, 2),
        deviation[:, :, BODY],
        deviation[:, :, CAMERA],
    )


def _as_printed(
    box_px: np.ndarray, camera: Camera, poses: Poses, east_north_m: np.ndarray, parameters: GroundParameters
) -> Sightings:
    """Eq. (13) to (15): the height alone, whatever the pitch, whether cut or not; nothing is known of the errors."""
    box = np.asarray(box_px, float).reshape(-1, 4)
    distance = camera.focal_px[1] * parameters.body_height_m / box[:, 3]
    bearing = poses.heading_rad + np.arctan(
        (box[:, 0] + box[:, 2] / 2 - 0.5 - camera.centre_px[0]) / camera.focal_px[0]
    )
    offset = distance[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    n = len(box)
    unknown = np.full((n, 2, 6), np.nan)
    return Sightings(
        east_north_m + offset,
        distance,
        np.mod(bearing, 2 * np.pi),
        np.full(n, "height"),
        unknown[:, :, :2],
        unknown[:, :, 0],
        unknown,
    )
