"""Targets seen from the air: their reference pixels, their shadows, and their speeds over time."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.config import AerialParameters
from torchvision_dddas.geometry import project, transfer
from torchvision_dddas.types import Camera, CameraPose, Float, Int, TrackedFrame, Tracks

# Width of a person seen from straight above.
BODY_WIDTH_M = 0.5
# With the sun lower than this, shadows are too long and too weak to be used.
_LOWEST_SUN_RAD = math.radians(8.0)
_J2000_S = 946_728_000.0  # 2000-01-01 12:00 UTC, in seconds since 1970
# The velocity filter: acceleration of people and vehicles; standard deviation above which a velocity is unknown;
# standard deviation of a new target's velocity; and the gap after which a target starts again.
_ACCELERATION_M_S2, _KNOWN_M_S, _FASTEST_M_S, _FORGET_S = 0.5, 1.0, 10.0, 5.0


@dataclass(frozen=True)
class Targets:
    """The boxes of one frame.

    box_px: (N, 4). target: (N,) int64, the identity, or the row in the frame from 1. lasting: (N,) bool, whether
    target is an identity. score: (N,) in [0, 1]. feet_px: (N, 2) u, v of the point between the feet, NaN if unknown; or
    None. bodies: whether a box's centre is the middle of a body. middle_px: (N, 2) u, v to use instead of the box's
    centre; None, or NaN in a row: use the centre. classes: names and numbers (N,), as in Detections.
    """

    box_px: np.ndarray
    target: np.ndarray
    lasting: np.ndarray
    score: np.ndarray
    feet_px: np.ndarray | None = None
    bodies: bool = False
    middle_px: np.ndarray | None = None
    classes: tuple[np.ndarray, np.ndarray] | None = None


def seen_targets(tracks: Tracks, bodies: bool = False, middle_px: np.ndarray | None = None) -> Targets:
    """Return the targets of a frame that were seen. A box that bridges a gap has an identity, but no place.

    A detection without an identity is not a target and has no place either.

    middle_px: (M, 2) of the frame's detections.
    """
    seen = tracks.row >= 0
    middle = None if middle_px is None else middle_px[tracks.row[seen]]
    score = tracks.score[seen].clip(0, 1)
    box_px, identity, classes = tracks.box_px[seen], tracks.identity[seen], (tracks.label[seen], tracks.class_id[seen])
    return Targets(box_px, identity, seen[seen], score, None, bodies, middle, classes)


def tracked_targets(tracked: TrackedFrame, with_middles: bool) -> Targets:
    """Return `seen_targets` of a tracked frame. with_middles: place targets by the mean of their foreground."""
    return seen_targets(tracked.tracks, True, tracked.detections.middle_px if with_middles else None)


def reference_points(targets: Targets, parameters: AerialParameters, posed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (N, 2) that represent the targets, and their height above the ground (N,) m.

    posed: whether the camera's pose is known. Only then does the middle of a body lie at half its height.
    """
    points = targets.box_px[:, :2] + (targets.box_px[:, 2:] - 1) / 2
    by_feet = parameters.point == "auto" and targets.feet_px is not None
    for better in (targets.middle_px, targets.feet_px if by_feet else None):
        if better is not None:
            points = np.where(np.isfinite(better).all(axis=1)[:, None], better, points)
    raised = posed and not by_feet and (parameters.point == "foot" or (parameters.point == "auto" and targets.bodies))
    return points, np.full(len(points), parameters.target_height_m / 2 if raised else 0.0)


def point_sigma_px(targets: Targets, parameters: AerialParameters) -> np.ndarray:
    """Return (N,) standard deviations in pixels of the reference points, the same for u and v."""
    side = np.sqrt(np.maximum(targets.box_px[:, 2] * targets.box_px[:, 3], 0))
    return np.hypot(parameters.target_sigma_px, side * (parameters.own_sigma if targets.bodies else 0.0))


def sun_at(longitude_deg: float, latitude_deg: float, utc_s: float) -> tuple[float, float]:
    """Return the sun's azimuth clockwise from north and its height above the horizon, rad, without refraction.

    utc_s: seconds since 1970. Accurate to about 0.02 degrees from 1950 to 2050.
    Source: the low-precision formulas of the Astronomical Almanac.
    """
    sin, cos, radians = math.sin, math.cos, math.radians
    days = (utc_s - _J2000_S) / 86400
    mean_longitude, anomaly = radians(280.460 + 0.9856474 * days), radians(357.528 + 0.9856003 * days)
    ecliptic = mean_longitude + radians(1.915 * sin(anomaly) + 0.020 * sin(2 * anomaly))
    tilt = radians(23.439 - 4e-7 * days)
    ascension = math.atan2(cos(tilt) * sin(ecliptic), cos(ecliptic))
    declination = math.asin(sin(tilt) * sin(ecliptic))
    hour = radians(280.46062 + 360.98564737 * days + longitude_deg) - ascension
    latitude = radians(latitude_deg)
    height = math.asin(sin(latitude) * sin(declination) + cos(latitude) * cos(declination) * cos(hour))
    north = sin(declination) * cos(latitude) - cos(declination) * sin(latitude) * cos(hour)
    return math.atan2(-sin(hour) * cos(declination), north) % (2 * math.pi), height


def shadow_m(sun_rad: tuple[float, float], height_m: float) -> Float[np.ndarray, "2"]:
    """Return the vector (east, north) from the foot of an upright body to the end of its shadow on level ground.

    sun_rad: azimuth and height. Return zeros if the sun is too low for shadows to be used.
    """
    azimuth, up = sun_rad
    if up < _LOWEST_SUN_RAD:
        return np.zeros(2)
    return -height_m / math.tan(up) * np.array([math.sin(azimuth), math.cos(azimuth)])


def remove_shadow(
    middle_px: Float[np.ndarray, "N 2"],
    foot_m: Float[np.ndarray, "N 3"],
    pose: CameraPose,
    camera: Camera,
    height_m: float,
    shadow: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "N 2"]:
    """Return the foot pixels of bodies from middle_px, the mean of the foreground of body and shadow together.

    From the air a walker's shadow is often larger than the walker. foot_m: rough places of the feet. Body and shadow
    are strips of equal width, so each is weighted by its length in the picture; seen from above, the body is at least
    BODY_WIDTH_M long.
    """
    foot = project(foot_m, pose, camera)
    steps_m = (0, 0, height_m), (*shadow, 0), (BODY_WIDTH_M, 0, 0)
    head, tip, aside = (project(foot_m + np.array(step), pose, camera) - foot for step in steps_m)
    body, shade = np.hypot(np.linalg.norm(head, axis=1), np.linalg.norm(aside, axis=1)), np.linalg.norm(tip, axis=1)
    mean = (body[:, None] * head / 2 + shade[:, None] * tip / 2) / (body + shade)[:, None]
    return middle_px - mean


class TargetSpeeds:
    """Velocities of targets over the ground: one constant-velocity Kalman filter each, driven by white acceleration.

    The measurement noise is the pixel's error. The error of the camera's pose is common to all targets of a frame. If
    that error changes between frames, as it does when a log is late and the camera turns, `carry` removes the change.
    """

    def __init__(self) -> None:
        # By identity: time in seconds, state (4,) east, north and their velocities, and its covariance (4, 4).
        self._tracks: dict[int, tuple[float, np.ndarray, np.ndarray]] = {}
        # By identity: (3,) the ground pixel at which it was last seen and the height above ground, and (2,) its place.
        self._seen: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._latest: tuple[float, dict[int, np.ndarray]] = math.nan, {}  # time and velocities, by identity

    def carry(self, motion: np.ndarray, to_ground: Callable[[np.ndarray, np.ndarray], np.ndarray], level: bool) -> None:
        """Shift every target by the shift of the ground at its last pixel between its last frame and the next frame.

        motion: (3, 3) pixel homography from the frame before; NaN if unknown, then the targets stay. to_ground:
        function from pixels (N, 2) and heights (N,) to places (N, 2) in the next frame. level: the ground is a plane,
        as the registration assumes; if not, add the shift to the uncertainty of the places instead.
        """
        before = np.array([seen for seen, _ in self._seen.values()]).reshape(-1, 3)
        after = np.c_[transfer(motion, before[:, :2]), before[:, 2]]
        for name, seen, place in zip(list(self._seen), after, to_ground(after[:, :2], after[:, 2]), strict=True):
            shift = np.nan_to_num(place - self._seen[name][1])
            self._tracks[name][1][:2] += level * shift
            self._tracks[name][2][:2, :2] += (1 - level) * np.outer(shift, shift)
            self._seen[name] = seen, place

    def covariance_of(self, identity: Int[np.ndarray, " N"]) -> Float[np.ndarray, "N 2 2"]:
        """Return the covariances of the velocities that the latest `update` returned, m²/s²; NaN if unknown."""
        covariance = np.full((len(identity), 2, 2), np.nan)
        for row, name in enumerate(identity.tolist()):
            if name in self._tracks and np.isfinite(self._latest[1].get(name, math.nan)).all():
                covariance[row] = self._tracks[name][2][2:, 2:]
        return covariance

    def update(
        self,
        time_s: float,
        identity: Int[np.ndarray, " N"],
        east_north_m: Float[np.ndarray, "N 2"],
        covariance_m2: Float[np.ndarray, "N 2 2"],
        seen: Float[np.ndarray, "N 3"] | None = None,
    ) -> Float[np.ndarray, "N 2"]:
        """Return the velocities in the next frame, m/s east and north; NaN if unknown or without identity (below 1).

        covariance_m2: covariance of the errors that are new in every frame; if unknown, a sigma of 1 m. seen: pixels u,
        v of the places and their heights above the ground, for `carry`. A frame at the time of the frame before
        gets the same velocities.
        """
        if time_s == self._latest[0]:
            return np.array([self._latest[1].get(name, [math.nan] * 2) for name in identity.tolist()]).reshape(-1, 2)
        covariance_m2 = np.where(np.isfinite(covariance_m2), covariance_m2, np.eye(2))
        velocity = np.full((len(identity), 2), np.nan)
        for row, name in enumerate(identity.tolist()):
            if name < 1:
                continue
            place, noise = east_north_m[row], covariance_m2[row]
            lapse = time_s - self._tracks[name][0] if name in self._tracks else -1.0
            if not 0 <= lapse <= _FORGET_S:
                spread = np.diag([0.0, 0.0, _FASTEST_M_S**2, _FASTEST_M_S**2])
                spread[:2, :2] = noise
                self._tracks[name] = time_s, np.array([*place, 0.0, 0.0]), spread
                continue
            _, state, spread = self._tracks[name]
            if lapse > 0:  # otherwise the picture repeats the picture before
                state, spread = _corrected(state, spread, lapse, place, noise)
                self._tracks[name] = time_s, state, spread
            if spread.diagonal()[2:].max() < _KNOWN_M_S**2:
                velocity[row] = state[2:]
        if seen is not None:
            self._seen |= dict(zip(identity.tolist(), zip(seen, east_north_m, strict=True), strict=True))
        self._tracks = {name: track for name, track in self._tracks.items() if time_s - track[0] <= _FORGET_S}
        self._seen = {name: seen for name, seen in self._seen.items() if name in self._tracks}
        self._latest = time_s, dict(zip(identity.tolist(), velocity, strict=True))
        return velocity


def _corrected(
    state: np.ndarray, spread: np.ndarray, lapse: float, place: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a target's state and covariance after `lapse` seconds and an update with a measured place."""
    move = np.kron([[1.0, lapse], [0.0, 1.0]], np.eye(2))
    drive = np.kron([[lapse**3 / 3, lapse**2 / 2], [lapse**2 / 2, lapse]], np.eye(2)) * _ACCELERATION_M_S2**2
    state, spread = move @ state, move @ spread @ move.T + drive
    # The small term keeps the matrix invertible if a place is stated to be exact.
    gain = spread[:, :2] @ np.linalg.inv(spread[:2, :2] + noise + 1e-12 * np.eye(2))
    return state + gain @ (place - state[:2]), spread - gain @ spread[:2]
