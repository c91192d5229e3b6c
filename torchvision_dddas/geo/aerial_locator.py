"""Map the pictures of an aerial camera to the ground frame by frame, and place the targets there."""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, check_settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.aerial_targets import (
    Targets,
    TargetSpeeds,
    point_sigma_px,
    reference_points,
    remove_shadow,
    seen_targets,
    shadow_m,
    sun_at,
    tracked_targets,
)
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.landmark_trajectories import LandmarkTrajectories, LandmarkUse, select_landmarks
from torchvision_dddas.geo.plane_homography import (
    LEAST,
    PlaneSolver,
    load_solver,
    locate_pixels,
    no_fix,
    relative_width,
)
from torchvision_dddas.geo.site import Site, build_site, complete_site, fit_lens, resolve_camera
from torchvision_dddas.geometry import ground_height, surface_of
from torchvision_dddas.types import (
    Adjustment,
    AerialLocations,
    Camera,
    DetectionTable,
    Elevation,
    Fix,
    Flight,
    LandmarkObservations,
    Landmarks,
    Positions,
    Telemetry,
    TrackedFrame,
    Tracks,
)

# A landmark or a target may lie this far beyond the picture's edge, as a share of the picture's side.
_OUTSIDE = 0.25
# A picture that repeats an earlier one for longer than this locates nothing, because the scene has moved on.
_FROZEN_S = 0.25
_UNKNOWN = np.full((3, 3), np.nan)
# By telemetry alone, a target is left out if the standard deviation of its distance exceeds this share of the distance.
_VAGUE = 0.2


@dataclass(frozen=True)
class FrameFix:
    """How one frame maps to the ground, and the landmarks that were used. adjustments and seconds are as in Scene.

    time_s: time of the frame, later than fix.time_s if its picture repeats an earlier picture.
    """

    fix: Fix
    marks: LandmarkObservations
    adjustments: tuple[Adjustment, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    time_s: float = math.nan

    def repeated(self, frame: int, time_s: float) -> "FrameFix":
        """Return this fix for a frame that repeats the picture; a picture that is too old locates nothing."""
        old_s, fix = time_s - self.fix.time_s, replace(self.fix, frame=frame, changes=())
        if old_s > _FROZEN_S:
            cause = f"the camera is frozen: the picture repeats frame {self.fix.frame}"
            fix = no_fix(frame, self.marks, cause)
        return FrameFix(replace(fix, time_s=self.fix.time_s), self.marks, time_s=time_s)


class AerialLocator:
    """Locate targets seen from the air by telemetry, landmarks of known place, or both. Call it with frames in order.

    >>> camera = td.Camera("uav", (640, 480), (600.0, 600.0), (319.5, 239.5))
    >>> none = {"heading_rad": np.zeros(2), "roll_rad": np.zeros(2), "place": np.zeros((2, 2)), "geographic": False}
    >>> log = td.Telemetry([0.0, 1.0], [50.0, 50.0], [5.0, 5.0], pitch_rad=np.full(2, np.pi / 2), **none)
    >>> locator = td.AerialLocator(camera, log)
    >>> locator.locate_pixels([[379.5, 179.5]]).east_north_m.round()
    array([[5., 5.]])
    """

    def __init__(
        self,
        camera: Camera | None,
        telemetry: Telemetry | None = None,
        landmarks: Landmarks | None = None,
        *,
        elevation: Elevation | None = None,
        settings: Settings | None = None,
        rate_hz: float = 10.0,
        backend: str = "auto",
        size_px: tuple[int, int] | None = None,
    ) -> None:
        """Take telemetry and landmarks, both in degrees or both in local metres.

        camera: None if the telemetry or the settings give the field of view; then size_px is needed. The heading,
        pitch, roll and heights of the camera are used where the telemetry never gives them.
        elevation: heights in metres about the first landmark, or about the vehicle's first place without landmarks.
        rate_hz: frames a second. backend: auto, onboard or torch.
        Raise InputError if neither telemetry nor landmarks are given, or if they contradict each other.
        """
        for value, kind in ((camera, Camera), (telemetry, Telemetry), (landmarks, Landmarks), (elevation, Elevation)):
            if value is not None and not isinstance(value, kind):
                raise InputError(f"AerialLocator expects a {kind.__name__}, got {type(value).__name__}")
        if not rate_hz > 0:
            raise InputError(f"rate_hz must be positive, got {rate_hz}")
        settings = check_settings(settings)
        site = replace(build_site(landmarks, telemetry), elevation=elevation)
        site, completed = complete_site(site, camera, settings)
        camera, focal_known, notes = resolve_camera(camera, size_px, site.telemetry, settings)
        self._begin(site, camera, settings, load_solver(backend), rate_hz, focal_known)
        self.notes += [*completed, *notes]

    @classmethod
    def from_site(
        cls, site: Site, camera: Camera, settings: Settings, solver: PlaneSolver, rate_hz: float, focal_known: bool
    ) -> "AerialLocator":
        """Make a locator from prepared parts. Raise InputError for aerial.mode = paper with landmarks in metres."""
        locator = cls.__new__(cls)
        locator._begin(site, camera, settings, solver, rate_hz, focal_known)
        return locator

    def _begin(
        self, site: Site, camera: Camera, settings: Settings, solver: PlaneSolver, rate_hz: float, focal_known: bool
    ) -> None:
        if settings.aerial.mode == "paper" and site.origin_deg is None:
            raise InputError(
                "aerial.mode = paper needs degrees of longitude and latitude, but the landmarks are in metres; give "
                "longitude_deg,latitude_deg, or use another mode"
            )
        self.camera, self.settings, self.rate_hz, self.focal_known = camera, settings, rate_hz, focal_known
        self.notes: list[str] = []
        self.assumes_rate = False
        self.set_site(site)
        self._solver = solver
        self._georeferencer = Georeferencer(camera, settings, solver, focal_known, site.landmarks.names)
        self._speeds, self._use = TargetSpeeds(), LandmarkUse()
        self._ground = surface_of(site.elevation)

    def restarted(self) -> "AerialLocator":
        """Return this locator in its state before the first frame."""
        again = self.from_site(self.site, self.camera, self.settings, self._solver, self.rate_hz, self.focal_known)
        again.assumes_rate = self.assumes_rate
        return again

    def set_site(self, site: Site) -> None:
        """Replace the site by one with the latest reports of landmarks and vehicle, in the same local metres."""
        if site.telemetry is not None:
            site = replace(site, telemetry=fit_lens(site.telemetry, self.camera))
        self.site = site
        self._trajectories = LandmarkTrajectories(site.landmarks, self.settings.landmarks, self.rate_hz)

    def locate(self, tracks: Tracks | TrackedFrame) -> AerialLocations:
        """Locate the targets of the next frame. Raise InputError for anything but Tracks or a TrackedFrame."""
        if isinstance(tracks, TrackedFrame):
            targets, frame = tracked_targets(tracks, bool(self.settings.crowds.join_m)), tracks.number
            time_s, motion = None if tracks.frame is None else tracks.frame.time_s, tracks.now_from_before
        elif isinstance(tracks, Tracks):
            targets, frame, time_s, motion = seen_targets(tracks), tracks.frame, None, None
        else:
            raise InputError(f"locate expects Tracks or a TrackedFrame, got {type(tracks).__name__}")
        return self.locate_targets(
            self.fix_frame(frame, self.landmarks_at(frame), time_s=time_s), targets, motion=motion
        )

    def locate_pixels(self, pixels: np.ndarray | Sequence[Sequence[float]], *, time_s: float = 0.0) -> Positions:
        """Locate the ground at pixels (N, 2), u and v, of the picture at a time since the clip's first frame.

        Return one position a pixel, NaN if its line of sight meets no ground, or meets it only near the horizon. The
        result does not depend on frames that were located before, and does not affect later frames.
        Raise InputError for pixels of another shape, and if telemetry and landmarks cannot place the picture.

        >>> places = locator.locate_pixels([[640, 360]], time_s=12.5)
        >>> places.lonlat_deg, places.covariance_m2
        """
        pixels = np.asarray(pixels, float)
        if pixels.ndim != 2 or pixels.shape[1] != 2 or not np.isfinite(pixels).all():
            raise InputError(f"pixels must be finite and of the shape (N, 2), u and v; got {pixels.shape}")
        settings = with_parameters(self.settings, {"aerial.point": "centre"})
        parts = self.camera, settings, self._solver, self.rate_hz, self.focal_known
        one, frame = self.from_site(self.site, *parts), 1 + round(time_s * self.rate_hz)
        fixed = one.fix_frame(frame, one.landmarks_at(frame), time_s=time_s)
        if not fixed.fix.by:
            raise InputError(f"nothing can be located at {time_s:g} s: {fixed.fix.cause}")
        count, nan = len(pixels), np.full((1, 2), np.nan)
        number = np.arange(1, count + 1)
        targets = Targets(np.c_[pixels, np.ones((count, 2))], number, np.zeros(count, bool), np.ones(count))
        located = one.locate_targets(fixed, targets)
        found, origin = located.positions, self.site.origin_deg
        degrees = None if origin is None else nan
        unknown = nan, nan[..., None] * nan[:, None], np.ones(1), origin, degrees
        nowhere = Positions(np.array([frame]), np.array([0]), *unknown)
        row = np.full(count, len(found))
        row[located.row] = np.arange(len(found))
        return replace(Positions.concat([found, nowhere])[row], target=number)

    def locate_table(
        self, table: DetectionTable, *, times_s: Mapping[int, float] | None = None
    ) -> Iterator[AerialLocations]:
        """Locate the targets of a table, in each of its frames and in the frames between that show landmarks.

        times_s: times of frames since the clip's first; needed if the frame rate is not constant.
        Boxes that bridge gaps and detections without a track get no place, as in `seen_targets`.
        """
        lasting = table.identity > 0 if table.identity is not None else np.zeros(len(table), bool)
        score = np.clip(table.score, 0, 1) if table.probable else np.ones(len(table))
        has_place = ~table.of_kind("bridge", "untracked")
        for frame in frames_to_locate(table, self.site.landmarks):
            rows = np.arange(len(table))[table.rows(frame)]
            rows = rows[has_place[rows]]
            feet = None if table.feet_px is None else table.feet_px[rows]
            places = table.box_px[rows], table.targets[rows], lasting[rows], score[rows], feet, table.ours
            targets = Targets(*places, classes=table.classes(rows))
            fixed = self.fix_frame(frame, self.landmarks_at(frame), time_s=(times_s or {}).get(frame))
            yield self.locate_targets(fixed, targets)

    @property
    def rate_warning(self) -> str:
        """The beginning of a message about the times of pictures; empty if their rate is known."""
        return "the frame rate is assumed, so first give --rate (rate_hz); " if self.assumes_rate else ""

    def time_s(self, frame: int) -> float:
        """Return the time of a frame since the clip's first, at the constant rate."""
        return (frame - 1) / self.rate_hz

    def time_of(self, fix: Fix) -> float:
        """Return when the picture of a fix was taken, in seconds since the clip's first frame."""
        return fix.time_s if math.isfinite(fix.time_s) else self.time_s(fix.frame)

    def landmarks_at(self, frame: int) -> LandmarkObservations:
        """Return the landmarks of a frame whose place and height are known."""
        marks = self._trajectories.at(frame)
        if not len(marks):
            return marks
        up_m = np.zeros(len(marks)) if self._ground is None else self._ground(marks.east_north_m)
        own_m = self._trajectories.elevation_m(frame)[marks.landmark] - self.site.plane_above_sea_m
        marks = replace(marks, up_m=marks.up_m + np.where(np.isfinite(own_m), own_m, up_m))
        # Without a height from the raster, a landmark would be put on a plane that is not the ground.
        return marks[np.isfinite(marks.up_m)]

    def telemetry_at(self, time_s: float) -> Flight | None:
        """Return the telemetry at a time, its altitude counted from up = 0; NaN if the altitude is below the ground."""
        telemetry = self.site.telemetry
        flight = telemetry.at(time_s, tolerance_s=telemetry.hold_s) if telemetry is not None else None
        if flight is None:
            return None
        below, altitude = 0.0, flight.altitude_m
        if (elevation := self.site.elevation) is not None:
            below = float(ground_height(elevation, np.array([flight.place]))[0])
            altitude += below
            if not math.isfinite(altitude):
                altitude = flight.above_sea_m - elevation.base_m
        if not altitude > (below if math.isfinite(below) else 0.0):
            altitude = math.nan
        # The offset does not apply to a heading derived from the course: it has no declination and no mounting error.
        offset_deg, lower_deg = self.settings.aerial.heading_offset_deg, self.settings.aerial.pitch_offset_deg
        heading_rad = flight.heading_rad + (0.0 if flight.heading_from else math.radians(offset_deg))
        pitch_rad = flight.pitch_rad + math.radians(lower_deg)
        return replace(flight, altitude_m=altitude, heading_rad=heading_rad, pitch_rad=pitch_rad)

    def fix_frame(self, frame: int, marks: LandmarkObservations, *, time_s: float | None = None) -> FrameFix:
        """Map a frame to the ground. marks: the result of `landmarks_at`, with the landmarks' pixels.

        time_s: time of the frame since the clip's first; None: computed from its number.
        """
        start = time.perf_counter()
        speeds = self._trajectories.speed_m_s(frame)[marks.landmark]
        rows, self._use, adjustments = select_landmarks(frame, self._use, marks, speeds, self.settings.landmarks)
        used = marks[rows]
        degrees = None
        if self.settings.aerial.mode == "paper" and self.site.origin_deg is not None:
            degrees = geometry.lonlat(used.east_north_m, self.site.origin_deg), self.site.origin_deg
        when = self.time_s(frame) if time_s is None else time_s
        flight = self.telemetry_at(when)
        fix = self._georeferencer.update(frame, when, flight, used, degrees)
        if flight is None and fix.cause:
            fix = replace(fix, cause=f"{self.rate_warning}{fix.cause}")
        seconds = {"fix": time.perf_counter() - start}
        return FrameFix(replace(fix, time_s=when), used, adjustments, seconds, when)

    def locate_targets(
        self,
        fixed: FrameFix,
        targets: Targets,
        *,
        adjustments: Sequence[Adjustment] = (),
        seconds: Mapping[str, float] | None = None,
        motion: np.ndarray | None = None,
    ) -> AerialLocations:
        """Locate the targets of a frame, and leave out those that the fix cannot place.

        adjustments, seconds: adjustments and times of the earlier stages, for the record. motion: (3, 3) pixel
        homography from the frame located before, None if unknown. By telemetry alone, velocities are relative to the
        ground as the pictures show it, because log errors that change between frames move standing targets too.
        """
        start, fix, origin = time.perf_counter(), fixed.fix, self.site.origin_deg
        # The covariance relative to the team is the sum of a part of each box alone and a part that all boxes share.
        pixels, lift = self.target_points(fix, targets)
        place, by_pixel = locate_pixels(fix, self.camera, pixels, 1.0, lift, self._ground)
        shared = locate_pixels(fix, self.camera, pixels, 0.0, lift, self._ground)[1]
        known = np.isfinite(place).all(axis=1)
        if fix.by == "telemetry":
            known &= ~_is_near_horizon(fix, place, shared)
        rows = np.flatnonzero(known)
        place = place[rows]
        own = (by_pixel - shared)[rows] * (point_sigma_px(targets, self.settings.aerial)[rows] ** 2)[:, None, None]
        relative = shared[rows] + own
        up_m = np.zeros(len(rows)) if self._ground is None else self._ground(place)
        if fix.pose is not None and (sigma_m := self.settings.aerial.terrain_sigma_m):
            # For ground one metre higher, the line of sight meets the ground this much nearer to the camera.
            nearer = (place - fix.pose.place_m[:2]) / (fix.pose.place_m[2] - up_m)[:, None]
            relative = relative + sigma_m**2 * nearer[:, :, None] * nearer[:, None, :]
        above_sea_m = self.site.plane_above_sea_m + up_m
        when, target = self.time_of(fix), targets.target[rows]
        carried, level = motion if motion is not None and fix.by == "telemetry" else _UNKNOWN, self._ground is None
        self._speeds.carry(carried, lambda px, up: locate_pixels(fix, self.camera, px, 0.0, up, self._ground)[0], level)
        lasting, seen = np.where(targets.lasting[rows], target, -1), np.c_[pixels, lift][rows]
        velocity = self._speeds.update(when, lasting, place, own, seen)
        positions = Positions(
            np.full(len(rows), fix.frame),
            target,
            place,
            relative + self.settings.landmarks.common_sigma_m**2 * np.eye(2),
            targets.score[rows],
            origin,
            None if origin is None else geometry.lonlat(place, origin),
            *(() if targets.classes is None else (column[rows] for column in targets.classes)),
        )
        positions = replace(positions, above_sea_m=above_sea_m, above_ellipsoid_m=above_sea_m + self.site.geoid_m)
        spent = {**(seconds or {}), **fixed.seconds, "ground": time.perf_counter() - start}
        made = (*adjustments, *fixed.adjustments)
        at_s = fixed.time_s if math.isfinite(fixed.time_s) else when
        return AerialLocations(
            *(fix.frame, at_s, positions, rows, relative, velocity, targets.box_px, fix, fixed.marks, made, spent),
            self._speeds.covariance_of(lasting),
        )

    def ground_places(self, fix: Fix, pixels: np.ndarray) -> np.ndarray:
        """Return the (N, 2) local metres of the ground at pixels (N, 2); NaN if a ray does not meet the ground."""
        return locate_pixels(fix, self.camera, pixels, 0.0, 0.0, self._ground)[0]

    def ground_radii(self, fix: Fix, box_px: np.ndarray) -> np.ndarray:
        """Return (N,) m, radii of circles with the ground area of the ellipse in each box (N, 4); NaN if unknown."""
        low, high = box_px[:, :2] - 0.5, box_px[:, :2] + box_px[:, 2:] - 0.5
        corners = low, np.c_[high[:, 0], low[:, 1]], np.c_[low[:, 0], high[:, 1]]
        start, right, below = np.split(self.ground_places(fix, np.concatenate(corners)), 3)
        return np.asarray(np.sqrt(np.linalg.norm(right - start, axis=1) * np.linalg.norm(below - start, axis=1)) / 2)

    def feet_px(self, fix: Fix, pixels: np.ndarray, height_m: float) -> np.ndarray | None:
        """Return the foot pixels (N, 2) of bodies of the given height whose foreground includes their shadows.

        Return None if shadows are not used, or if the camera's pose or the sun is unknown.
        """
        sun = self._sun(self.time_of(fix)) if self.settings.aerial.shadows else None
        if sun is None or fix.pose is None:
            return None
        near = self.ground_places(fix, pixels)
        up_m = np.zeros(len(near)) if self._ground is None else self._ground(near)
        return remove_shadow(pixels, np.c_[near, up_m], fix.pose, self.camera, height_m, shadow_m(sun, height_m))

    def target_points(self, fix: Fix, targets: Targets) -> tuple[np.ndarray, np.ndarray]:
        """Return the reference pixels (N, 2) of targets under a fix, and their height above the ground (N,) m."""
        pixels, lift = reference_points(targets, self.settings.aerial, fix.pose is not None)
        if targets.bodies and lift.any():
            feet = self.feet_px(fix, pixels, self.settings.aerial.target_height_m)
            if feet is not None:
                return feet, np.zeros(len(feet))
        return pixels, lift

    def _sun(self, time_s: float) -> tuple[float, float] | None:
        """Return azimuth and height of the sun, rad; None if unknown or at night."""
        parameters, site = self.settings.aerial, self.site
        if parameters.sun_height_deg > 0:
            return math.radians(parameters.sun_azimuth_deg), math.radians(parameters.sun_height_deg)
        sun = site.sun_rad
        if sun is None and site.origin_deg is not None and site.telemetry is not None:
            start = site.telemetry.start_utc_s
            sun = sun_at(*site.origin_deg, start + time_s) if math.isfinite(start) else None
        return sun if sun is not None and sun[1] > 0 else None


def _is_near_horizon(fix: Fix, place: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return (N,) bool, whether the sigma of a place's distance from the camera exceeds a fifth of that distance.

    The error of the camera's own place does not count.
    """
    if fix.pose is None or fix.covariance is None:
        return np.zeros(len(place), bool)
    away = place - fix.pose.place_m[:2]
    far = np.linalg.norm(away, axis=1)
    along = away / np.maximum(far, 1e-9)[:, None]
    variance = np.einsum("ni,nij,nj->n", along, covariance - fix.covariance[3:5, 3:5], along)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    vague: np.ndarray = sigma > _VAGUE * np.hypot(far, fix.pose.place_m[2])
    return vague


def frames_to_locate(table: DetectionTable, landmarks: Landmarks) -> list[int]:
    """Return the frames of a table, and those between its first and last with landmarks in the picture."""
    seen = landmarks.frame[np.isfinite(landmarks.image_px).all(axis=1)]
    between = seen[(seen >= table.first) & (seen <= table.last)]
    return np.unique(np.concatenate([table.frame, np.round(between).astype(np.int64)])).tolist()


def check_table(table: DetectionTable, locator: AerialLocator) -> None:
    """Raise InputError if the landmarks cannot place any frame of the table, and say what is missing.

    Causes are: no landmark has a pixel, a pixel is far outside the picture, or no frame is in common. Without
    telemetry, causes are also fewer than four landmarks in every frame, or all landmarks on one line.
    """
    landmarks, parameters = locator.site.landmarks, locator.settings.aerial
    if not landmarks.names:
        return
    seen = np.isfinite(landmarks.image_px).all(axis=1)
    if not seen.any():
        raise InputError(
            f"landmarks {landmarks.path} say no places in pictures; wanted columns u_px,v_px beside the places"
        )
    away = is_outside(locator, landmarks.image_px)
    if away.any():
        k = int(np.where(away, landmarks.line, np.iinfo(np.int64).max).argmin())
        (u, v), (columns, rows) = landmarks.image_px[k].tolist(), locator.camera.size_px
        raise InputError(
            f"landmarks {landmarks.path}, line {landmarks.line[k]}: u_px,v_px are {u:g}, {v:g}, far outside the "
            f"camera's pictures of {columns} x {rows} px; give pixels, and the camera's file for this size"
        )
    if not len(table):
        return
    frames = np.unique(table.frame).tolist()
    marks = [m[np.isfinite(m.image_px).all(axis=1)] for m in map(locator.landmarks_at, frames)]
    counts = np.array([len(m) for m in marks])
    if not counts.any():
        first, last = np.round(landmarks.frame[seen][[0, -1]]).astype(int).tolist()
        raise InputError(
            f"the table has frames {table.first} to {table.last}, the landmarks are seen in {first} to {last}: no "
            "common frame has a landmark of known place; is the clip's first frame number 1 in both?"
        )
    if locator.site.telemetry is not None and parameters.mode == "pose":
        return
    if counts.max() < LEAST:
        best = int(counts.argmax())
        missing = LEAST - int(counts[best])
        raise InputError(
            f"locate needs {LEAST} landmarks not on one line; frame {frames[best]} has {counts[best]}, the most: "
            f"{missing} missing. Give --telemetry, or {missing} landmark{'s' * (missing > 1)} more"
        )
    enough = np.flatnonzero(counts >= LEAST).tolist()
    if all(relative_width(marks[k]) < parameters.least_spread for k in enough):
        raise InputError(
            f"the {counts[enough[0]]} landmarks of frame {frames[enough[0]]} lie on one line, as in all others; "
            "give --telemetry, or a landmark away from it"
        )


def is_outside(locator: AerialLocator, pixels: np.ndarray) -> np.ndarray:
    """Return (N,) bool: whether pixels (N, 2) lie far beyond the picture's edges. False if its size is unknown."""
    if locator.settings.aerial.mode != "pose":
        return np.zeros(len(pixels), bool)
    size = np.array(locator.camera.size_px, float)
    beyond: np.ndarray = (pixels < -_OUTSIDE * size) | (pixels > (1 + _OUTSIDE) * size)
    return np.any(beyond, axis=1)
