"""How the picture lies on the ground, frame by frame, and where that puts the targets."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import AerialParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.elevation import surface, up
from torchvision_dddas.geo.georeferencer import Registrar
from torchvision_dddas.geo.landmark_selection import LandmarkUse, chosen
from torchvision_dddas.geo.landmark_trajectories import Courses
from torchvision_dddas.geo.plane import absolute, ground_points
from torchvision_dddas.geo.site import Site
from torchvision_dddas.geo.solvers import PlaneSolver
from torchvision_dddas.geo.speeds import Movers
from torchvision_dddas.geo.sun import feet_below, shadow_m, sun_at
from torchvision_dddas.io.telemetry import at
from torchvision_dddas.types import Adjustment, AerialLocations, Camera, Fix, Flight, LandmarkObservations, Positions


@dataclass(frozen=True)
class Targets:
    """The boxes of one frame.

    target: (N,) int64, the identity, or the row in the frame from 1. lasting: (N,) bool, whether it is an identity.
    score: (N,) in [0, 1]. feet_px: (N, 2) u, v of the point between the feet, NaN where unknown; None: of none.
    bodies: whether a box's centre is the middle of a body. middle_px: (N, 2) u, v of what stands for it in place of the
    box's centre, NaN where it does; None: for all.
    """

    box_px: np.ndarray
    target: np.ndarray
    lasting: np.ndarray
    score: np.ndarray
    feet_px: np.ndarray | None = None
    bodies: bool = False
    middle_px: np.ndarray | None = None


@dataclass(frozen=True)
class Look:
    """How the picture of one frame lies on the ground, by which landmarks; adjustments and seconds as in Scene."""

    fix: Fix
    marks: LandmarkObservations
    adjustments: tuple[Adjustment, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


class Locator:
    """How the picture lies on the ground, frame by frame, and where that puts targets. Feed it frames in order."""

    def __init__(
        self, site: Site, camera: Camera, settings: Settings, solver: PlaneSolver, rate_hz: float, focal_known: bool
    ) -> None:
        """Raises InputError for aerial.mode = paper, which works in degrees, where the landmarks are in metres."""
        if settings.aerial.mode == "paper" and site.origin_deg is None:
            raise InputError(
                "aerial.mode = paper works in degrees of longitude and latitude, and the landmarks are in metres; give "
                "longitude_deg,latitude_deg, or take another mode"
            )
        self.site, self.camera, self.settings, self.rate_hz = site, camera, settings, rate_hz
        self.courses = Courses(site.landmarks, settings.landmarks, rate_hz)
        self._solver, self.focal_known = solver, focal_known
        self._registrar = Registrar(camera, settings, solver, focal_known, site.landmarks.names)
        self._movers = Movers()
        self._use = LandmarkUse()
        self._ground = surface(site.elevation) if site.elevation is not None else None

    def anew(self) -> "Locator":
        """The same, as before its first frame."""
        return Locator(self.site, self.camera, self.settings, self._solver, self.rate_hz, self.focal_known)

    def learn(self, site: Site) -> None:
        """What landmarks and vehicle have reported by now, in the metres of the site so far."""
        self.site = site
        self.courses = Courses(site.landmarks, self.settings.landmarks, self.rate_hz)

    def places(self, fix: Fix, pixels: np.ndarray) -> np.ndarray:
        """(N, 2) local metres of what pixels (N, 2) show of the ground; NaN where a ray meets none."""
        return ground_points(fix, self.camera, pixels, 0.0, np.zeros(len(pixels)), self._ground)[0]

    def radii(self, fix: Fix, box_px: np.ndarray) -> np.ndarray:
        """(N,) m, of circles as large as the ellipses within boxes (N, 4) on the ground; NaN where it is not known."""
        low, high = box_px[:, :2] - 0.5, box_px[:, :2] + box_px[:, 2:] - 0.5
        corners = low, np.c_[high[:, 0], low[:, 1]], np.c_[low[:, 0], high[:, 1]]
        start, right, below = np.split(self.places(fix, np.concatenate(corners)), 3)
        return np.asarray(np.sqrt(np.linalg.norm(right - start, axis=1) * np.linalg.norm(below - start, axis=1)) / 2)

    def feet(self, pixels: np.ndarray, fix: Fix, height_m: float) -> np.ndarray | None:
        """Pixels (N, 2) of the feet of bodies so high that are seen together with their shadows.

        None where shadows do not count, or it is not known how the camera stands or the sun.
        """
        sun = self._sun(self.time_s(fix.frame)) if self.settings.aerial.shadows else None
        if sun is None or fix.pose is None:
            return None
        near = self.places(fix, pixels)
        up_m = np.zeros(len(near)) if self._ground is None else self._ground(near)
        return feet_below(pixels, np.c_[near, up_m], fix.pose, self.camera, height_m, shadow_m(sun, height_m))

    def time_s(self, frame: int) -> float:
        """Of a frame, since the clip's first."""
        return (frame - 1) / self.rate_hz

    def marks(self, frame: int) -> LandmarkObservations:
        """The landmarks of a frame, on the ground: those whose place and height are known."""
        return self._standing(self.courses.at(frame))

    def look(self, frame: int, marks: LandmarkObservations) -> Look:
        """How the picture of a frame lies on the ground; marks: those of `marks`, with their places in the picture."""
        start = time.perf_counter()
        speeds = self.courses.speed_m_s(frame)[marks.landmark]
        rows, self._use, adjustments = chosen(frame, self._use, marks, speeds, self.settings.landmarks)
        used = chosen_rows(marks, rows)
        degrees = None
        if self.settings.aerial.mode == "paper" and self.site.origin_deg is not None:
            degrees = geometry.lonlat(used.east_north_m, self.site.origin_deg), self.site.origin_deg
        when = self.time_s(frame)
        fix = self._registrar.step(frame, when, self.flight(when), used, degrees)
        return Look(fix, used, adjustments, {"fix": time.perf_counter() - start})

    def flight(self, time_s: float) -> Flight | None:
        """What the telemetry says, its altitude counted from up = 0; unknown where that is below the ground."""
        flight = at(self.site.telemetry, time_s) if self.site.telemetry is not None else None
        if flight is None:
            return None
        below, base = 0.0, 0.0
        if self.site.elevation is not None:
            base = self.site.elevation.base_m
            below = float(up(self.site.elevation, np.array([flight.place]))[0])
        altitude = flight.altitude_m + below
        if not math.isfinite(altitude) and self.site.elevation is not None:
            altitude = flight.above_sea_m - base
        if not altitude > (below if math.isfinite(below) else 0.0):
            altitude = math.nan
        return replace(flight, altitude_m=altitude)

    def ground(
        self,
        look: Look,
        targets: Targets,
        adjustments: Sequence[Adjustment] = (),
        seconds: Mapping[str, float] | None = None,
    ) -> AerialLocations:
        """Where the targets of a frame stand by its fix; none that the fix cannot place. Feed it frames in order.

        adjustments, seconds: what happened to the frame before, for the record.
        """
        fix = look.fix
        start = time.perf_counter()
        place, relative, own = self._laid(fix, targets)
        rows = np.flatnonzero(np.isfinite(place).all(axis=1))
        place, relative, own = place[rows], relative[rows], own[rows]
        when, target = self.time_s(fix.frame), targets.target[rows]
        velocity = self._movers.step(when, np.where(targets.lasting[rows], target, -1), place, own)
        origin = self.site.origin_deg
        positions = Positions(
            np.full(len(rows), fix.frame),
            target,
            place,
            absolute(relative, self.settings.landmarks.common_sigma_m),
            targets.score[rows],
            origin,
            None if origin is None else geometry.lonlat(place, origin),
        )
        spent = {**(seconds or {}), **look.seconds, "ground": time.perf_counter() - start}
        moved = (*adjustments, *look.adjustments)
        return AerialLocations(
            fix.frame, when, positions, rows, relative, velocity, targets.box_px, fix, look.marks, moved, spent
        )

    def points(self, fix: Fix, targets: Targets) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (N, 2) that stand for targets under a fix, and how high above the ground those are (N,) m."""
        height = self.settings.aerial.target_height_m
        pixels, lift = points_of(targets, self.settings.aerial, fix.pose is not None)
        if targets.bodies and lift.any() and (feet := self.feet(pixels, fix, height)) is not None:
            return feet, np.zeros(len(feet))
        return pixels, lift

    def _laid(self, fix: Fix, targets: Targets) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places (N, 2), their covariance relative to the team (N, 2, 2), and the part of it that is each box's own."""
        parameters = self.settings.aerial
        pixels, lift = self.points(fix, targets)
        place, by_pixel = ground_points(fix, self.camera, pixels, 1.0, lift, self._ground)
        _, shared = ground_points(fix, self.camera, pixels, 0.0, lift, self._ground)
        variance = sigma_of(targets, parameters) ** 2
        own = (by_pixel - shared) * variance[:, None, None]
        return place, shared + own, own

    def _sun(self, time_s: float) -> tuple[float, float] | None:
        """Where the sun stands, azimuth and height, rad; None where nothing tells, and at night."""
        parameters, site = self.settings.aerial, self.site
        if parameters.sun_height_deg > 0:
            return math.radians(parameters.sun_azimuth_deg), math.radians(parameters.sun_height_deg)
        sun = site.sun_rad
        if sun is None and site.origin_deg is not None and site.telemetry is not None:
            start = site.telemetry.start_utc_s
            sun = sun_at(*site.origin_deg, start + time_s) if math.isfinite(start) else None
        return sun if sun is not None and sun[1] > 0 else None

    def _standing(self, marks: LandmarkObservations) -> LandmarkObservations:
        if self._ground is None or not len(marks):
            return marks
        marks = replace(marks, up_m=marks.up_m + self._ground(marks.east_north_m))
        # Where the raster has no height, a landmark would be put on a plane that is not the ground's.
        return chosen_rows(marks, np.isfinite(marks.up_m))


def chosen_rows(marks: LandmarkObservations, rows: np.ndarray) -> LandmarkObservations:
    """Some of the landmarks."""
    return LandmarkObservations(
        marks.landmark[rows],
        marks.image_px[rows],
        marks.east_north_m[rows],
        marks.sigma_m[rows],
        marks.pixel_sigma[rows],
        marks.up_m[rows],
    )


def sigma_of(targets: Targets, parameters: AerialParameters) -> np.ndarray:
    """(N,) standard deviation in pixels, of u and of v each, of the points that stand for the targets."""
    side = np.sqrt(np.maximum(targets.box_px[:, 2] * targets.box_px[:, 3], 0))
    return np.hypot(parameters.target_sigma_px, side * (parameters.own_sigma if targets.bodies else 0.0))


def points_of(targets: Targets, parameters: AerialParameters, posed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) that stand for the targets, and how high above the ground those are (N,) m.

    A body's foot is where its middle, half its height up, has its place: that takes a pose of the camera (posed).
    """
    centre = targets.box_px[:, :2] + (targets.box_px[:, 2:] - 1) / 2
    if targets.middle_px is not None:
        centre = np.where(np.isfinite(targets.middle_px).all(axis=1)[:, None], targets.middle_px, centre)
    lift = np.zeros(len(centre))
    if parameters.point == "auto" and targets.feet_px is not None:
        named = np.isfinite(targets.feet_px).all(axis=1)
        return np.where(named[:, None], targets.feet_px, centre), lift
    if posed and (parameters.point == "foot" or (parameters.point == "auto" and targets.bodies)):
        lift += parameters.target_height_m / 2
    return centre, lift
