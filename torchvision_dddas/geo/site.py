"""Bring landmarks, telemetry and camera into one system of local metres before the first frame."""

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, is_set
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.flight_gaps import fill_gaps, known_keys
from torchvision_dddas.geo.heights import (
    count_from_plane,
    describe_takeoff,
    geoid_of,
    median_of,
    plane_above_sea,
    settle_landmarks,
    settle_telemetry,
)
from torchvision_dddas.geometry import ground_height
from torchvision_dddas.types import Camera, Elevation, Landmarks, Telemetry

_Reports = TypeVar("_Reports", Landmarks, Telemetry)

# If the camera looks higher above the horizon than this, its angles probably have the wrong sign.
_HIGHEST_DEG = 20.0
# If the vehicle is further from the landmarks than this, the files are from different flights.
_FARTHEST_M = 100_000.0
# Focal lengths that differ by more than this share count as different.
_OTHER = 0.02

# A log whose first altitude is lower than this begins on the ground.
_ON_GROUND_M = 3.0
# The ground heights of log and elevation agree within _SAME_M. The geoid alone seldom separates them by _DATUMS_M.
_SAME_M, _DATUMS_M = 10.0, 60.0
# _UNITS: factors by which an elevation in another unit is too high. Such a unit is reported if it reduces the
# difference by the factor _NEARER. Heights below _LOW_M are not tested, because their ratio is not reliable.
_LOW_M = 20.0
_UNITS, _NEARER = {"feet": 1 / 0.3048, "decimetres": 10.0, "centimetres": 100.0, "millimetres": 1000.0}, 10.0


@dataclass(frozen=True)
class Site:
    """Landmarks and telemetry in the same local metres, east and north of origin_deg.

    origin_deg: (longitude, latitude); None if all input is in local metres. sun_rad: azimuth and height of the sun, if
    they are known from a source other than the telemetry's clock. geoid_m: height of the geoid above the ellipsoid.
    plane_above_sea_m: height above the sea of up = 0. Both are NaN if unknown.
    """

    landmarks: Landmarks
    telemetry: Telemetry | None
    origin_deg: tuple[float, float] | None
    elevation: Elevation | None = None
    sun_rad: tuple[float, float] | None = None
    geoid_m: float = math.nan
    plane_above_sea_m: float = math.nan

    @property
    def places(self) -> np.ndarray:
        """(N, 2) local metres of landmarks and vehicle."""
        return np.concatenate([_known(self.landmarks), _known(self.telemetry)])


def _known(reports: Landmarks | Telemetry | None) -> np.ndarray:
    """Return the (N, 2) places that are reported."""
    place = np.zeros((0, 2)) if reports is None else reports.place
    return place[np.isfinite(place).all(axis=1)]


def build_site(landmarks: Landmarks | None, telemetry: Telemetry | None) -> Site:
    """Convert landmarks and telemetry to the landmarks' local metres, or to metres east and north of their first place.

    Without landmarks, use the telemetry's local metres, or metres east and north of the vehicle's first place.
    Raise InputError if neither gives a place, degrees and metres are mixed, longitude and latitude look swapped, the
    vehicle is below the ground throughout, its camera looks into the sky, or it is far from the landmarks.
    """
    if telemetry is not None:
        _check_telemetry(telemetry)
    flown = _known(telemetry)
    if landmarks is None:
        if telemetry is None or not len(flown):
            raise InputError(describe_no_place(telemetry))
        places, rows = np.zeros((0, 2)), np.zeros(0)
        none = rows.astype(np.int64)
        landmarks = Landmarks((), rows, none, places, places, rows, rows.astype(bool), none, telemetry.geographic)
        first = flown[0]
    elif not len(_known(landmarks)):
        raise InputError(f"landmarks {landmarks.path}: no row has a place; give longitude_deg,latitude_deg or metres")
    else:
        first = _known(landmarks)[0]
        if telemetry is not None and len(flown) and telemetry.geographic != landmarks.geographic:
            kinds = ("longitude and latitude", "local metres")
            one, other = kinds if landmarks.geographic else kinds[::-1]
            raise InputError(f"the landmarks are in {one}, the telemetry in {other}; give both in the same kind")
        if landmarks.geographic and len(flown):
            longitude, latitude = np.median(flown, axis=0).tolist()
            if looks_swapped(landmarks, (longitude, latitude)):
                raise InputError(
                    f"landmarks {landmarks.path}: longitude and latitude look swapped; the vehicle is at longitude "
                    f"{longitude:.5f}, latitude {latitude:.5f}"
                )
    origin = None
    if landmarks.geographic:
        origin = float(first[0]), float(first[1])
        landmarks = to_local(landmarks, origin)
        telemetry = None if telemetry is None else to_local(telemetry, origin)
    flown = _known(telemetry)
    if len(flown) and len(landmarks):
        away = np.linalg.norm(flown - np.nanmedian(landmarks.place, axis=0), axis=1).min()
        if away > _FARTHEST_M:
            raise InputError(
                f"the vehicle is {away / 1000:.0f} km or more from the landmarks of {landmarks.path} throughout; the "
                f"limit is {_FARTHEST_M / 1000:g} km: give the telemetry of this flight, with places in the same "
                "system"
            )
    return Site(landmarks, telemetry, origin)


def describe_no_place(telemetry: Telemetry | None) -> str:
    """Return why nothing can be located without landmarks."""
    if telemetry is None:
        return "locating needs landmarks, or telemetry with the vehicle's place; got neither"
    named = f"the telemetry {telemetry.origin}".rstrip()
    columns = "add the columns longitude_deg,latitude_deg or east_m,north_m to a CSV of it"
    return f"{named} holds no place of the vehicle ({columns}), and there are no landmarks"


def has_places(telemetry: Telemetry | None) -> bool:
    """Return whether the telemetry gives the vehicle's place at any time."""
    return len(_known(telemetry)) > 0


def complete_site(site: Site, camera: Camera | None, settings: Settings) -> tuple[Site, list[str]]:
    """Fill gaps of the telemetry from the camera's file or from the course flown, and return the site and notes.

    Heights above the ellipsoid become heights above the sea, and the height of the site's plane is determined.
    Raise InputError if with the camera's file the camera looks into the sky or the vehicle flies below the ground.
    """
    geoid_m = geoid_of(site.places, site.origin_deg, settings.aerial.geoid)
    landmarks, notes = settle_landmarks(site.landmarks, geoid_m, settings.aerial.mode)
    site = replace(site, landmarks=landmarks, geoid_m=geoid_m)
    if settings.aerial.geoid and math.isnan(geoid_m):
        notes.append("aerial.geoid is not used: in local metres the geoid's height is unknown")
    if site.telemetry is not None:
        site, more = complete_telemetry(site, site.telemetry, camera, settings)
        notes += more
    elif camera is not None and (keys := known_keys(camera)):
        notes.append(f"{', '.join(keys)} of the camera are not used: give --telemetry")
    if site.elevation is not None:
        up_m = ground_height(site.elevation, landmarks.place) + site.elevation.base_m
        apart_m = median_of(landmarks.elevation_m - up_m)
        if abs(apart_m) > _SAME_M:
            notes.append(
                f"the landmarks' elevation_m is {apart_m:+.0f} m from the elevation's heights there, the geoid at "
                f"{geoid_m:+.0f} m: does one of them count from the ellipsoid?"
            )
    plane_m = plane_above_sea(site.elevation, site.landmarks, site.telemetry, camera)
    return replace(site, plane_above_sea_m=plane_m), notes


def complete_telemetry(
    site: Site, telemetry: Telemetry, camera: Camera | None, settings: Settings
) -> tuple[Site, list[str]]:
    """Return the site with this telemetry, its gaps filled as in `complete_site`, and notes.

    site: with its geoid and settled landmarks. telemetry: in the site's local metres. Raise InputError as that does.
    """
    has_level = bool(np.isfinite(site.landmarks.elevation_m).any()) and settings.aerial.mode == "pose"
    has_takeoff = camera is not None and camera.knows("takeoff_above_sea_m")
    has_ground, has_landmarks = site.elevation is not None, len(site.landmarks) > 0
    can_use = has_ground or has_level or has_takeoff
    telemetry, notes = settle_telemetry(telemetry, site.geoid_m, can_use, bool(settings.aerial.geoid))
    notes += describe_takeoff(telemetry, camera)
    if has_level and not has_ground:
        telemetry, more = count_from_plane(telemetry, plane_above_sea(None, site.landmarks, None, None), camera)
        notes += more
    telemetry, more = fill_gaps(telemetry, camera, settings.aerial, has_ground, has_landmarks)
    notes += more
    if site.elevation is not None:
        telemetry, more = _match_ground(telemetry, site.elevation, camera, site.geoid_m)
        notes += more
    _check_altitude(telemetry, "the altitude by the camera's takeoff_above_sea_m", "correct that height")
    _check_pitch(telemetry, "camera file")
    return replace(site, telemetry=telemetry), notes


def _match_ground(
    telemetry: Telemetry, elevation: Elevation, camera: Camera | None, geoid_m: float
) -> tuple[Telemetry, list[str]]:
    """Return telemetry whose altitude counts from the ground below, and notes if log and elevation disagree.

    Raise InputError if the elevation has the log's heights in another unit.
    """
    notes, altitude, up_m = list[str](), telemetry.altitude_m, ground_height(elevation, telemetry.place)
    takeoff_m = math.nan if camera is None else camera.takeoff_above_sea_m
    by_log, where = telemetry.above_sea_m - altitude, "below the vehicle"
    risen = altitude if np.isfinite(altitude).any() else telemetry.above_sea_m - takeoff_m
    known = np.isfinite(up_m + risen)
    if known.any() and (telemetry.height_zero == "takeoff" or risen is not altitude):
        first, where = int(known.argmax()), "where it took off"
        by_log = by_log if math.isnan(takeoff_m) else np.full(len(risen), takeoff_m)
        start_m = float(up_m[first])
        known &= (np.arange(len(known)) == first) & (risen <= _ON_GROUND_M)
        if not known.any() and math.isfinite(takeoff_m):
            start_m = takeoff_m - elevation.base_m
        elif not known.any():
            notes.append("the log begins in the air: its altitude is counted from the ground below its first place")
        telemetry = replace(telemetry, altitude_m=altitude + start_m - up_m, height_zero="ground")
    known &= np.isfinite(by_log)
    if telemetry.height_zero == "unknown" or not known.any():
        return telemetry, notes
    logged, raster = float(np.median(by_log[known])), float(np.median(up_m[known])) + elevation.base_m
    apart = abs(raster - logged)
    found = f"the ground {where} is {logged:.0f} m above the sea by the log and {raster:.0f} m by the elevation"
    whose, more, less = ("elevation", raster, logged) if raster > logged else ("log", logged, raster)
    off, unit = min((abs(more / factor - less), unit) for unit, factor in _UNITS.items())
    if _NEARER * off < apart > _DATUMS_M and less > _LOW_M:
        found += f", {raster / logged:.3g} times as much"
        raise InputError(f"{found}: is the {whose} in {unit}, {_UNITS[unit]:.3g} to the metre? Give both in metres")
    if apart > _SAME_M:
        geoid = f", where the geoid lies at {geoid_m:.0f} m" if math.isfinite(geoid_m) else ""
        notes.append(f"{found}, {apart:.0f} m apart: does one of them count from the ellipsoid{geoid}?")
    return telemetry, notes


def looks_swapped(landmarks: Landmarks, near_lonlat: tuple[float, float]) -> bool:
    """Return whether longitude and latitude look swapped, judging by a near place in degrees (the vehicle's)."""
    known = _known(landmarks)
    if not landmarks.geographic or not len(known) or not np.isfinite(near_lonlat).all():
        return False
    near, middle = np.array(near_lonlat, float), np.median(known, axis=0)
    given, swapped = (float(geometry.great_circle_m(point[None], near)[0]) for point in (middle, middle[::-1]))
    # Swapping similar longitudes and latitudes moves a place only a little.
    return swapped < _FARTHEST_M and given > 10 * max(swapped, 300.0)


def to_local(reports: _Reports, origin_deg: tuple[float, float]) -> _Reports:
    """Convert reports in degrees to metres east and north of (longitude, latitude)."""
    return replace(reports, place=geometry.east_north(reports.place, origin_deg), geographic=False)


def _check_telemetry(telemetry: Telemetry) -> None:
    _check_altitude(telemetry, "the telemetry's altitude", "correct it, or leave --telemetry out")
    _check_pitch(telemetry, "telemetry")


def _check_altitude(telemetry: Telemetry, what: str, advice: str) -> None:
    altitude = telemetry.altitude_m[np.isfinite(telemetry.altitude_m)]
    if len(altitude) and (altitude <= 0).all():
        raise InputError(
            f"{what} is {altitude.min():g} to {altitude.max():g} m, at or below ground throughout; give metres above "
            f"ground: {advice}"
        )


def _check_pitch(telemetry: Telemetry, whose: str) -> None:
    pitch = np.degrees(telemetry.pitch_rad[np.isfinite(telemetry.pitch_rad)])
    if len(pitch) and np.median(pitch) < -_HIGHEST_DEG:
        raise InputError(
            f"by the {whose}'s pitch of {np.median(pitch):.0f} degrees the camera looks into the sky; give degrees "
            "below the horizon, 90 for straight down: change the sign of pitch_deg"
        )


def describe_unknown_heights(site: Site) -> list[str]:
    """Return notes on unknown heights of the vehicle, and of the ground below it or at landmarks."""
    telemetry, notes = site.telemetry, []
    if site.elevation is not None:
        for reports, what in (
            (site.landmarks, "at {} of {} places of landmarks: they are not used there"),
            (telemetry, "below the vehicle in {} of {} samples: its altitude is not used there"),
        ):
            places = _known(reports)
            if missing := int(np.isnan(ground_height(site.elevation, places)).sum()):
                notes.append("the elevation has no height " + what.format(missing, len(places)))
    elif telemetry is not None:
        if not np.isfinite(telemetry.altitude_m).any() and np.isfinite(telemetry.above_sea_m).any():
            notes.append(
                "the telemetry gives only heights above the sea; for heights above ground give --dem, or "
                "takeoff_above_sea_m or height_m in the camera's file"
            )
        low = telemetry.altitude_m <= 0
        if low.any():
            notes.append(
                f"the altitude is at or below ground in {low.sum()} of {len(low)} samples, the first at "
                f"{telemetry.time_s[low.argmax()]:.1f} s: it is not used there"
            )
    return notes


def resolve_camera(
    camera: Camera | None,
    size: tuple[int, int] | None,
    telemetry: Telemetry | None,
    settings: Settings,
    extent: tuple[float, float] | None = None,
) -> tuple[Camera, bool, list[str]]:
    """Return the aerial camera, whether its focal length is given, and notes for the user.

    camera: the camera of the camera file, None without a file. size: (width, height) of the pictures, used if the
    camera has no size. extent: (width, height) of all boxes, used as the size if nothing depends on the size, for
    example if landmarks alone map pictures to the ground. Raise InputError if the size is unknown, or if the camera's
    size is not that of the pictures.
    """
    parameters, notes = settings.aerial, list[str]()
    if camera is not None:
        if size is not None and tuple(camera.size_px) != tuple(size):
            raise InputError(
                f"camera {camera.name} has pictures of {camera.size_px[0]} x {camera.size_px[1]} px, the clip of "
                f"{size[0]} x {size[1]}; give the camera's file for this size"
            )
        if parameters.mode == "paper" and any(camera.distortion):
            notes.append(f"aerial.mode = paper ignores the lens distortion of camera {camera.name}")
        # A value set by hand overrides the file.
        if is_set(settings, "aerial.focal_sigma") or not math.isfinite(camera.focal_px[0]):
            camera = replace(camera, focal_sigma=parameters.focal_sigma)
        size = camera.size_px
    if size is None and parameters.mode != "pose":
        size = (math.ceil(extent[0]), math.ceil(extent[1])) if extent is not None else (1, 1)
    if size is None:
        raise InputError(
            "the size of the pictures is unknown, and so is the focal length; give --camera FILE or --clip CLIP, or "
            "--set aerial.mode=homography, which needs neither"
        )
    logged = np.zeros(0) if telemetry is None else telemetry.focal_px(size)[np.isfinite(telemetry.hfov_rad)]
    is_nominal = telemetry is not None and telemetry.is_nominal and len(logged) > 0
    if camera is not None and math.isfinite(camera.focal_px[0]):
        if is_nominal:
            zoom = f", times a zoom of up to {logged.max() / logged.min():.2f}" if _is_zoomed(logged) else ""
            notes.append(
                f"the focal length of camera {camera.name}, {camera.focal_px[0]:.0f} px{zoom}, is used, not the log's "
                f"nominal {logged.min():.0f} px"
            )
        elif any(abs(math.log(focal / camera.focal_px[0])) > _OTHER for focal in logged[:1]):
            notes.append(f"the focal length of camera {camera.name} is not used: the telemetry's field of view is used")
        return camera, True, notes
    # Unless the user says otherwise, an upright picture has the same field of view along its longer side.
    guessed_px = (size[0] if is_set(settings, "aerial.hfov_deg") else max(size)) / 2
    focal = float(np.median(logged)) if len(logged) else guessed_px / math.tan(math.radians(parameters.hfov_deg) / 2)
    middle = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    made = Camera("camera", size, (focal, focal), middle, focal_sigma=parameters.focal_sigma, given=frozenset())
    made = made if camera is None else replace(camera, focal_px=(focal, focal))
    if is_nominal:
        px = f"{logged.min():.0f} to {logged.max():.0f} px by its zoom" if _is_zoomed(logged) else f"{focal:.0f} px"
        notes.append(
            f"the log's nominal focal length, {px}, is applied to the pictures' longer side. A cropping video mode "
            "has a smaller field of view; the camera's file (focal_px) overrides it"
        )
    if len(logged) or parameters.mode != "pose":
        return made, bool(len(logged)), notes
    note = f"neither the camera file nor telemetry gives the field of view: using {parameters.hfov_deg:g} degrees"
    return made, False, [*notes, f"{note} (aerial.hfov_deg)"]


def _is_zoomed(focal_px: np.ndarray) -> bool:
    return bool(np.nanmax(focal_px) > (1 + _OTHER) * np.nanmin(focal_px))


def fit_lens(telemetry: Telemetry, camera: Camera) -> Telemetry:
    """Return the telemetry with the field of view along u of the camera's pictures.

    A nominal focal length applies to the longer side. If the camera's file gives the focal length, the log's nominal
    focal length only gives the zoom.
    """
    if not telemetry.is_nominal or not np.isfinite(telemetry.hfov_rad).any():
        return telemetry
    focal = telemetry.focal_px(camera.size_px)
    if camera.knows("focal_px"):
        focal = camera.focal_px[0] * focal / np.nanmin(focal) if _is_zoomed(focal) else np.full_like(focal, np.nan)
    return replace(telemetry, hfov_rad=2 * np.arctan(camera.size_px[0] / 2 / focal), is_nominal=False)
