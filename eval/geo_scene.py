"""Simulate many flights over landmarks at once: truth, measurements, and the attainable accuracy.

A scene is one frame. Landmarks stand in a disc of 25 m radius. Half of the targets are within 10 m of its middle, half
in the whole disc. The camera looks at the middle. Measurements are pixels and GPS of the landmarks, pixels of targets,
and telemetry, all with Gaussian errors. The picture's borders are ignored: from 50 m the disc is higher than the
picture. The geometry is not taken from the package, so that errors in the package cannot hide.

`pose_bound` and `homography_bound` are Cramér-Rao bounds: no unbiased estimate of a target's place from the same
measurements has a smaller covariance. The bound of the pose counts the priors as measurements.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ellipe

from torchvision_dddas.types import Camera

RADIUS_M, CROWD_M, MOST = 25.0, 10.0, 8
"""Radius of the landmarks' disc and of the crowd's disc, and the largest number of landmarks."""
SIZE_PX = (1920, 1080)
FOCAL_PX = SIZE_PX[0] / 2 / np.tan(np.radians(35))
CAMERA = Camera("aerial", SIZE_PX, (FOCAL_PX, FOCAL_PX), ((SIZE_PX[0] - 1) / 2, (SIZE_PX[1] - 1) / 2))
"""1080p, a lens of 70 degrees."""
SIGMA_OF = 1 / np.sqrt(-2 * np.log(0.05))
"""Standard deviation along each axis of a GPS error, as a share of its 95 % radius."""
FOCAL_SIGMA, TILT_SIGMA, HEADING_SIGMA = 0.01, np.radians(1.0), np.radians(5.0)
ALTITUDE_SIGMA, POSITION_SIGMA_M = 0.02, 3.5 * SIGMA_OF
"""Standard deviations of the telemetry."""
GPS = {
    "exact": 0.0,
    "2 cm RTK": 0.02,
    "1.5 m": 1.5 * SIGMA_OF,
    "3.5 m": 3.5 * SIGMA_OF,
    "two RTK": np.nan,
    "opposite RTK": np.nan,
}
"""Standard deviations of landmarks along each axis. RTK: two landmarks, any or opposite, have RTK; others 3.5 m."""
LAYOUTS = ("ring", "small ring", "disc", "row", "corner", "L")


@dataclass(frozen=True)
class Case:
    """Parameters of a batch of scenes. common_m: sigma along each axis of the error that all receivers share.

    grade: errors of telemetry and receivers relative to the usual errors. landmarks = 0: telemetry alone.
    """

    altitude_m: float = 50.0
    landmarks: int = 4
    layout: str = "ring"
    gps: str = "3.5 m"
    pixel_sigma: float = 1.0
    tilt_deg: float = 0.0
    common_m: float = 0.0
    grade: float = 1.0


@dataclass(frozen=True)
class Scenes:
    """A batch of S scenes with n landmarks and T targets. Estimates must not use the fields true_*.

    true_axes: (S, 3, 3) camera's right, down, forward. true_place: (S, 3). true_focal: (S,) relative to the camera's.
    axes, place: by telemetry. true_marks, marks: (S, n, 2) east, north. sigma_m: (S, n). common_m: (S, 2) error that
    all reported places share. marks_px, targets_px: (S, n or T, 2). true_targets: (S, T, 2).
    """

    case: Case
    true_axes: np.ndarray
    true_place: np.ndarray
    true_focal: np.ndarray
    true_marks: np.ndarray
    true_targets: np.ndarray
    axes: np.ndarray
    place: np.ndarray
    marks: np.ndarray
    sigma_m: np.ndarray
    common_m: np.ndarray
    marks_px: np.ndarray
    targets_px: np.ndarray

    def __len__(self) -> int:
        return len(self.true_focal)


def scenes(case: Case, count: int, targets: int = 20, seed: int = 0) -> Scenes:
    """Draw a batch of scenes. Batches with the same seed share camera, telemetry, targets and their pixels."""
    flight, crowd, team = (np.random.default_rng([seed, n]) for n in range(3))
    heading = flight.uniform(-np.pi, np.pi, count)
    tilt = np.radians(case.tilt_deg)
    nominal = looking(heading, np.full(count, np.pi / 2 - tilt), np.zeros(count))
    # A gimbal is not exact: the tilt is off by a degree, and the view misses the middle by some metres.
    true_axes = turned(flight.normal(0, TILT_SIGMA, (count, 3)) * (1, 1, 0)) @ nominal
    back = case.altitude_m * np.tan(tilt) * np.stack([np.sin(heading), np.cos(heading)], axis=1)
    true_place = np.concatenate([flight.normal(0, 2, (count, 2)) - back, np.full((count, 1), case.altitude_m)], axis=1)
    true_focal = np.exp(case.grade * flight.normal(0, FOCAL_SIGMA, count))
    away = case.grade * flight.normal(0, (TILT_SIGMA, TILT_SIGMA, HEADING_SIGMA), (count, 3))
    axes = turned(away) @ true_axes
    shift = (POSITION_SIGMA_M, POSITION_SIGMA_M, ALTITUDE_SIGMA * case.altitude_m)
    # All receivers, including the aircraft's, share an error.
    common = flight.normal(0, 1, (count, 2)) * case.common_m
    place = true_place + case.grade * flight.normal(0, shift, (count, 3)) + np.pad(common, ((0, 0), (0, 1)))

    inner = targets // 2
    true_targets = np.concatenate([disc(crowd, (count, inner), CROWD_M), disc(crowd, (count, targets - inner))], axis=1)
    noise = crowd.normal(0, case.pixel_sigma, (count, targets, 2))
    targets_px = pixels(true_targets, true_axes, true_place, true_focal) + noise

    # Draw errors for the most landmarks, so that scenes with fewer landmarks have the same first errors.
    n, shape = case.landmarks, (count, MOST, 2)
    place_noise, pixel_noise = team.normal(0, 1, shape)[:, :n], team.normal(0, case.pixel_sigma, shape)[:, :n]
    true_marks = np.stack([layout(case.layout, n, np.random.default_rng([seed, 3, s])) for s in range(count)])
    sigma_m = np.full((count, n), case.grade * GPS[case.gps])
    if case.gps in ("two RTK", "opposite RTK"):
        sigma_m[:] = GPS["3.5 m"]
        sigma_m[:, [0, n // 2 if case.gps == "opposite RTK" else 1]] = GPS["2 cm RTK"]
        if case.gps == "two RTK":
            sigma_m = team.permuted(sigma_m, axis=1)
    marks = true_marks + place_noise * sigma_m[..., None] + common[:, None]
    marks_px = pixels(true_marks, true_axes, true_place, true_focal) + pixel_noise
    return Scenes(
        case, true_axes, true_place, true_focal, true_marks, true_targets, axes, place, marks, sigma_m, common,
        marks_px, targets_px,
    )  # fmt: skip


def disc(rng: np.random.Generator, shape: tuple[int, ...], radius_m: float = RADIUS_M) -> np.ndarray:
    """Return points in a disc, (*shape, 2)."""
    far, turn = radius_m * np.sqrt(rng.uniform(0, 1, shape)), rng.uniform(-np.pi, np.pi, shape)
    return np.stack([far * np.cos(turn), far * np.sin(turn)], axis=-1)


def layout(name: str, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return places (n, 2) of landmarks, turned at random.

    ring: evenly spaced on the disc's rim, each up to 10 degrees off. small ring: at half the radius. disc: anywhere.
    row: along a diameter, with a width of 2 to 4 % of the length. corner: within 6 m near the rim. L: evenly spaced
    along two legs of 25 m.
    """
    turn = rng.uniform(-np.pi, np.pi)
    if name in ("ring", "small ring"):
        angle = turn + 2 * np.pi * np.arange(n) / n + np.radians(rng.uniform(-10, 10, MOST)[:n])
        return RADIUS_M / (1 + (name != "ring")) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if name == "disc":
        return disc(rng, (MOST,))[:n]
    if name == "row":
        along = np.linspace(-RADIUS_M, RADIUS_M, n)
        shares = rng.uniform(0, 1, MOST)[:n]  # stretched below to both edges of the row
        aside = 2 * RADIUS_M * rng.uniform(0.02, 0.04) * ((shares - shares.min()) / np.ptp(shares) - 0.5)
        points = np.stack([along, aside], axis=1)
    elif name == "corner":
        points = disc(rng, (MOST,), 6.0)[:n] + np.array([18.0, 0.0])
    else:
        leg = 25.0 * np.linspace(-1, 1, n)
        points = (
            np.stack([np.maximum(leg, 0), np.maximum(-leg, 0)], axis=1) - 25 / 3 + rng.normal(0, 0.5, (MOST, 2))[:n]
        )
    c, s = np.cos(turn), np.sin(turn)
    return points @ np.array([[c, s], [-s, c]])


# -- geometry --------------------------------------------------------------------------------------------------------


def looking(heading: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Return axes (S, 3, 3) with columns right, down, forward in east, north, up."""
    zero = np.zeros_like(heading)
    right = np.stack([np.cos(heading), -np.sin(heading), zero], axis=-1)
    forward = np.stack([np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), -np.sin(pitch)], axis=-1)
    down = np.cross(forward, right)
    c, s = np.cos(roll)[..., None], np.sin(roll)[..., None]
    return np.stack([c * right + s * down, c * down - s * right, forward], axis=-1)


def turned(vector: np.ndarray) -> np.ndarray:
    """Return rotations (S, 3, 3) about vectors (S, 3) by their lengths in radians."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([np.stack(row, axis=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], axis=-2)
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * cross @ cross


def pixels(ground: np.ndarray, axes: np.ndarray, place: np.ndarray, focal: np.ndarray) -> np.ndarray:
    """Return pixels u, v (S, n, 2) of points (S, n, 2) on the ground plane."""
    away = np.concatenate([ground, np.zeros_like(ground[..., :1])], axis=-1) - place[:, None]
    seen = away @ axes
    return np.array(CAMERA.centre_px) + FOCAL_PX * focal[:, None, None] * seen[..., :2] / seen[..., 2:]


# -- bounds ----------------------------------------------------------------------------------------------------------


def pose_bound(batch: Scenes) -> np.ndarray:
    """Return the smallest covariance (S, T, 2, 2) of the targets' places by telemetry and landmarks together.

    The information about the pose comes from telemetry, and from each landmark's pixels and GPS. The error of a
    target's place comes from its own pixels and from the pose.
    """
    case = batch.case
    sigma = np.array(
        [TILT_SIGMA, TILT_SIGMA, HEADING_SIGMA, POSITION_SIGMA_M, POSITION_SIGMA_M,
         ALTITUDE_SIGMA * case.altitude_m, FOCAL_SIGMA]
    )  # fmt: skip
    by_pose, by_place = _slopes(batch, batch.true_marks)
    information = np.diag((case.grade * sigma) ** -2.0) + _gathered(by_pose, by_place, batch.sigma_m, case.pixel_sigma)
    by_pose, by_place = _slopes(batch, batch.true_targets)
    return _carried(by_pose, by_place, information, case.pixel_sigma)


def homography_bound(batch: Scenes) -> np.ndarray:
    """Return the bound (S, T, 2, 2) by landmarks alone, for the eight parameters of a homography."""
    case, turn = batch.case, np.swapaxes(batch.true_axes, 1, 2)
    matrix = np.concatenate([turn[..., :2], -turn @ batch.true_place[..., None]], axis=-1)
    matrix[:, :2] *= batch.true_focal[:, None, None]  # pixels from the middle, in focal lengths
    matrix = matrix @ np.diag([RADIUS_M, RADIUS_M, 1.0])
    matrix = matrix / matrix[:, 2:, 2:]

    def slopes(ground: np.ndarray) -> np.ndarray:
        """Return derivatives (S, n, 2, 8) of pixels by the elements in u = (a x + b y + r) / (p x + q y + 1)."""
        x, y = np.moveaxis(ground / RADIUS_M, -1, 0)
        one, zero = np.ones_like(x), np.zeros_like(x)
        point = np.stack([x, y, one], axis=-1) @ np.swapaxes(matrix, 1, 2)
        u, v, w = point[..., 0] / point[..., 2], point[..., 1] / point[..., 2], point[..., 2]
        rows = [[x, y, one, zero, zero, zero, -u * x, -u * y], [zero, zero, zero, x, y, one, -v * x, -v * y]]
        return FOCAL_PX * np.stack([np.stack(row, axis=-1) for row in rows], axis=-2) / w[..., None, None]

    information = _gathered(
        slopes(batch.true_marks), _slopes(batch, batch.true_marks)[1], batch.sigma_m, case.pixel_sigma
    )
    _, by_place = _slopes(batch, batch.true_targets)
    return _carried(slopes(batch.true_targets), by_place, information, case.pixel_sigma)


def mean_length(covariance: np.ndarray) -> np.ndarray:
    """Return the mean distance from the middle of plane normal distributions with covariances (..., 2, 2)."""
    small, large = np.moveaxis(np.linalg.eigvalsh(covariance), -1, 0)
    return np.sqrt(2 * large / np.pi) * ellipe(1 - small / large)


def _slopes(batch: Scenes, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return numerical derivatives of pixels, (S, n, 2, 7) by pose and log focal length, (S, n, 2, 2) by point."""
    axes, place, focal = batch.true_axes, batch.true_place, batch.true_focal
    count = len(focal)

    def moved(k: int, step: float) -> np.ndarray:
        d = np.zeros((count, 9))
        d[:, k] = step
        there = ground + d[:, None, 7:]
        return pixels(there, turned(d[:, :3]) @ axes, place + d[:, 3:6], focal * np.exp(d[:, 6]))

    steps = np.array([1e-5] * 3 + [1e-3] * 3 + [1e-5] + [1e-3] * 2)
    columns = [(moved(k, h) - moved(k, -h)) / (2 * h) for k, h in enumerate(steps)]
    both = np.stack(columns, axis=-1)
    return both[..., :7], both[..., 7:]


def _gathered(by_state: np.ndarray, by_place: np.ndarray, sigma_m: np.ndarray, pixel_sigma: float) -> np.ndarray:
    """Return the landmarks' information (S, k, k) about the state."""
    blur = pixel_sigma**2 * np.eye(2) + sigma_m[..., None, None] ** 2 * by_place @ np.swapaxes(by_place, -1, -2)
    return np.einsum("snia,snij,snjb->sab", by_state, np.linalg.inv(blur), by_state)


def _carried(by_state: np.ndarray, by_place: np.ndarray, information: np.ndarray, pixel_sigma: float) -> np.ndarray:
    """Return covariances (S, T, 2, 2) of places whose pixels depend on the state and on the place."""
    back = np.linalg.inv(by_place)
    scale = 1 / np.sqrt(np.einsum("saa->sa", information))
    covariance = np.linalg.inv(information * scale[:, :, None] * scale[:, None])
    slope = back @ by_state * scale[:, None, None]
    return pixel_sigma**2 * back @ np.swapaxes(back, -1, -2) + slope @ covariance[:, None] @ np.swapaxes(slope, -1, -2)


Bound = Callable[[Scenes], np.ndarray]
BOUNDS: dict[str, Bound] = {"pose": pose_bound, "homography": homography_bound}
