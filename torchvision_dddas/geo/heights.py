"""Zero points of heights (ellipsoid, sea, take-off point, ground), and contradictions between the heights of a flight.

Height above the ellipsoid = height above the sea + height of the geoid.
"""

import math
from dataclasses import replace

import numpy as np

from torchvision_dddas.geometry import GEOID_SIGMA_M, geoid_height, lonlat
from torchvision_dddas.io.elevation import read_geoid
from torchvision_dddas.types import Camera, Elevation, Landmarks, Telemetry

# Heights of one thing with the same zero differ by less than _APART_M. Heights that differ by less than _ALIKE_M
# throughout are the same numbers. No drone that this program supports flies higher above the ground than _HIGH_M.
_APART_M, _ALIKE_M, _HIGH_M = 5.0, 0.5, 500.0


def geoid_of(places: np.ndarray, origin_deg: tuple[float, float] | None, file: str = "") -> float:
    """Return the height of the geoid above the ellipsoid amid places (N, 2), m; NaN without an origin in degrees.

    file: a raster of geoid heights; "" for the table of the package. Raise InputError as `read_geoid` does.
    """
    if origin_deg is None:
        return math.nan
    middle_deg = lonlat(np.median(places, axis=0)[None], origin_deg)
    return read_geoid(file, middle_deg[0].tolist()) if file else float(geoid_height(middle_deg)[0])


def settle_landmarks(landmarks: Landmarks, geoid_m: float, mode: str) -> tuple[Landmarks, list[str]]:
    """Return landmarks whose elevation counts from the sea, and notes on heights that cannot be used."""
    above_sea_m = landmarks.above_ellipsoid_m - geoid_m
    apart_m = np.abs(above_sea_m - landmarks.elevation_m)
    notes = []
    if (apart_m > _APART_M).any():
        notes.append(
            f"landmarks {landmarks.path}: elevation_m and above_ellipsoid_m less the geoid's {geoid_m:.1f} m are up to "
            f"{np.nanmax(apart_m):.0f} m apart; elevation_m is used"
        )
    if np.isfinite(landmarks.above_ellipsoid_m).any() and math.isnan(geoid_m):
        notes.append("above_ellipsoid_m of landmarks in local metres is not used: the geoid's height there is unknown")
    landmarks = replace(
        landmarks, elevation_m=np.where(np.isnan(landmarks.elevation_m), above_sea_m, landmarks.elevation_m)
    )
    if mode != "pose" and np.isfinite(landmarks.elevation_m).any():
        notes.append(f"heights of landmarks are not used: aerial.mode = {mode} assumes that all lie on a plane")
    return landmarks, notes


def settle_telemetry(
    telemetry: Telemetry, geoid_m: float, has_ground: bool, by_file: bool
) -> tuple[Telemetry, list[str]]:
    """Return telemetry whose heights above the ellipsoid became heights above the sea, and notes on contradictions.

    has_ground: whether the ground's height above the sea is known, so that heights above the sea can be used.
    """
    notes, sea, ellipsoid = list[str](), telemetry.above_sea_m, telemetry.above_ellipsoid_m
    altitude = telemetry.altitude_m
    apart_m = median_of(ellipsoid - sea)
    lacking = ~np.isfinite(sea) & np.isfinite(ellipsoid)
    if lacking.any() and math.isfinite(geoid_m):
        telemetry = replace(telemetry, above_sea_m=np.where(lacking, ellipsoid - geoid_m, sea))
        where = "" if lacking.sum() == np.isfinite(ellipsoid).sum() else f" in {lacking.sum()} rows that lack one"
        source = "by aerial.geoid" if by_file else f"EGM96 by a coarse table, sigma {GEOID_SIGMA_M:g} m"
        notes.append(
            f"heights above the sea{where} are those above the ellipsoid less the geoid's {geoid_m:.1f} m ({source})"
        )
    elif lacking.any():
        notes.append("heights above the ellipsoid are not used: in local metres the geoid's height is unknown")
    if abs(apart_m - geoid_m) > _APART_M:
        reason = "one of them counts from elsewhere"
        if abs(apart_m) < _APART_M:
            reason = "both count from the same zero"
        elif abs(apart_m + geoid_m) < _APART_M:
            reason = "the geoid was applied with the wrong sign"
        notes.append(
            f"the log's heights above the ellipsoid lie at {apart_m:+.1f} m from those above the sea, the geoid at "
            f"{geoid_m:+.1f} m from the ellipsoid: {reason}; those above the sea are used"
        )
    has_ground = has_ground and bool(np.isfinite(telemetry.above_sea_m).any())
    for other, what, column in ((sea, "the sea", "above_sea_m"), (ellipsoid, "the ellipsoid", "above_ellipsoid_m")):
        if telemetry.height_zero != "unknown" and _is_alike(altitude, other):
            use = "that altitude is not used" if has_ground else "is the ground there at 0 m? If not, omit altitude_m"
            notes.append(f"altitude_m is the same as {column} throughout, the height above {what}: {use}")
            if has_ground:
                telemetry = replace(telemetry, altitude_m=np.full(len(altitude), math.nan))
            return telemetry, notes
    if np.isfinite(altitude).any() and np.nanmin(altitude) > _HIGH_M:
        notes.append(
            f"the altitude above ground is {np.nanmin(altitude):.0f} m or more throughout: does it count from the sea "
            "or the ellipsoid? Then its column is above_sea_m or above_ellipsoid_m"
        )
    return telemetry, notes


def plane_above_sea(
    elevation: Elevation | None, landmarks: Landmarks, telemetry: Telemetry | None, camera: Camera | None
) -> float:
    """Return the height above the sea of up = 0, metres; NaN if unknown.

    Use the height of the elevation's origin; without it the landmarks' median; without it the difference of the log's
    heights above the sea and above ground; without it the take-off point.
    """
    if elevation is not None:
        return elevation.base_m
    if math.isfinite(of_landmarks := median_of(landmarks.elevation_m)):
        return of_landmarks
    takeoff_m = math.nan if camera is None else camera.takeoff_above_sea_m
    if telemetry is None:
        return takeoff_m
    between_m = math.nan
    if not _is_alike(telemetry.altitude_m, telemetry.above_sea_m):
        between_m = median_of(telemetry.above_sea_m - telemetry.altitude_m)
    is_from_takeoff = telemetry.height_zero != "ground" and math.isfinite(takeoff_m)
    return takeoff_m if is_from_takeoff or math.isnan(between_m) else between_m


def count_from_plane(telemetry: Telemetry, plane_m: float, camera: Camera | None) -> tuple[Telemetry, list[str]]:
    """Return telemetry whose altitude counts from the landmarks' height, if the log allows it; and a note."""
    takeoff_m = math.nan if camera is None else camera.takeoff_above_sea_m
    altitude = telemetry.altitude_m
    if not np.isfinite(altitude).any() and np.isfinite(telemetry.above_sea_m).any():
        altitude = telemetry.above_sea_m - plane_m
    elif telemetry.height_zero == "takeoff" and math.isfinite(takeoff_m):
        altitude = altitude + takeoff_m - plane_m
    else:
        return telemetry, []
    note = f"the altitude is counted from the landmarks, whose median is {plane_m:.1f} m above the sea"
    return replace(telemetry, altitude_m=altitude, height_zero="ground"), [note]


def describe_takeoff(telemetry: Telemetry, camera: Camera | None) -> list[str]:
    """Return a note if the take-off point lies above the whole flight."""
    takeoff_m = math.nan if camera is None else camera.takeoff_above_sea_m
    flown = telemetry.above_sea_m[np.isfinite(telemetry.above_sea_m)]
    if telemetry.height_zero == "unknown" or not len(flown) or not takeoff_m > flown.max() + _APART_M:
        return []
    flight = f"{flown.min():g} to {flown.max():g} m above the sea"
    return [f"takeoff_above_sea_m of the camera's file, {takeoff_m:g} m, lies above the whole flight, {flight}"]


def _is_alike(one: np.ndarray, other: np.ndarray) -> bool:
    apart = np.abs(one - other)
    return bool(np.isfinite(apart).any() and np.nanmax(apart) < _ALIKE_M)


def median_of(values: np.ndarray) -> float:
    """Return the median of the finite values, NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan
