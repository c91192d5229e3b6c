"""What a log lacks of the camera's pose: from the camera's file, else the vehicle's nose or the course it flew."""

import math
from dataclasses import replace

import numpy as np

from torchvision_dddas.config import AerialParameters
from torchvision_dddas.types import Camera, Float, Telemetry

COURSE, NOSE = "the course over ground", "the vehicle's nose"
"""What a heading is from where the log does not say that of the camera."""

# Half the time spans over which a line is fitted to the places: the shortest that is sure enough counts.
_HALF_SPANS_S = (1.0, 2.0, 5.0, 10.0)
# A slower vehicle may fly sideways; a course less sure than this, or one that turns by more within its span, is none.
_LEAST_M_S, _SURE_RAD, _STRAIGHT_RAD = 2.0, math.radians(5.0), math.radians(10.0)


def fill_gaps(
    telemetry: Telemetry, camera: Camera | None, parameters: AerialParameters, has_ground: bool = False
) -> tuple[Telemetry, list[str]]:
    """The telemetry, completed where it never says a quantity, and what the user should know of that.

    telemetry: in local metres. camera: as its file says; its heading_rad, pitch_rad, roll_rad and height_m stand for
    all times, and from takeoff_above_sea_m heights above the sea become heights above ground. has_ground: whether the
    ground's heights are known, which heights above the sea are counted from then.
    """
    filled, notes, unused = dict[str, object](), list[str](), list[str]()
    count = len(telemetry)

    def lacks(name: str) -> bool:
        return not np.isfinite(getattr(telemetry, name)).any()

    def give(name: str, value: float, sigma_name: str = "", sigma: float = math.nan) -> None:
        filled[name] = np.full(count, value)
        if sigma_name:
            filled[sigma_name] = np.full(count, sigma)

    def sigma_of(camera: Camera, name: str) -> float:
        return float(getattr(camera, name)) if camera.knows(name) else math.nan

    above_sea = not lacks("above_sea_m")
    for name, sigma_name, to in (
        ("heading_rad", "heading_sigma_rad", "heading_sigma_rad"),
        ("pitch_rad", "pitch_sigma_rad", "tilt_sigma_rad"),
        ("roll_rad", "", ""),
    ):
        if camera is None or not camera.knows(name):
            continue
        key = name.replace("_rad", "_deg")
        if not lacks(name):
            unused.append(key)
            continue
        give(name, getattr(camera, name), to, sigma_of(camera, sigma_name) if to else math.nan)
        notes.append(f"the log does not say {key}: it is that of camera {camera.name}, {_degrees(camera, name):g}")
    if camera is not None and camera.knows("takeoff_above_sea_m"):
        if lacks("altitude_m") and above_sea and not has_ground:
            filled["altitude_m"] = telemetry.above_sea_m - camera.takeoff_above_sea_m
            notes.append(f"the altitude is that above the take-off, {camera.takeoff_above_sea_m:g} m above the sea")
        else:
            unused.append("takeoff_above_sea_m")
    if camera is not None and camera.knows("height_m"):
        if lacks("altitude_m") and "altitude_m" not in filled and not (above_sea and has_ground):
            give("altitude_m", camera.height_m, "altitude_sigma_m", sigma_of(camera, "height_sigma_m"))
            notes.append(f"the log does not say the altitude: it is height_m of camera {camera.name}")
        else:
            unused.append("height_m")
    if camera is not None and unused:
        notes.append(f"camera {camera.name}: {', '.join(unused)} not used, because the log says it")
    if lacks("heading_rad") and "heading_rad" not in filled:
        sigma_rad = math.radians(parameters.course_sigma_deg)
        if not lacks("vehicle_heading_rad"):
            filled |= {"heading_rad": telemetry.vehicle_heading_rad, "heading_from": NOSE}
            filled["heading_sigma_rad"] = np.full(count, sigma_rad)
            notes.append(
                "the log does not say the camera's heading: that of the vehicle's nose is taken, with a sigma of "
                f"{parameters.course_sigma_deg:g} degrees (aerial.course_sigma_deg)"
            )
        else:
            course_rad, fit_rad = course_over_ground(telemetry.time_s, telemetry.place)
            if (known := np.isfinite(course_rad)).any():
                filled |= {"heading_rad": course_rad, "heading_from": COURSE}
                filled["heading_sigma_rad"] = np.hypot(fit_rad, sigma_rad)
                notes.append(
                    "the log does not say the heading: it is the course over ground where that is straight, in "
                    f"{100 * known.mean():.0f} % of the samples, with a sigma of {parameters.course_sigma_deg:g} "
                    "degrees or more (aerial.course_sigma_deg)"
                )
    return replace(telemetry, **filled), notes  # type: ignore[arg-type]


def _degrees(camera: Camera, name: str) -> float:
    return round(math.degrees(getattr(camera, name)), 3)


def course_over_ground(
    time_s: Float[np.ndarray, "N"], place_m: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """The direction flown, rad clockwise from north, and the standard deviation of its fit; NaN where not straight.

    A line is fitted to the places about each time; their scatter about it, and how far apart they are, say how sure its
    direction is.
    """
    course, sigma = np.full((2, len(time_s)), np.nan)
    rows = np.flatnonzero(np.isfinite(place_m).all(axis=1))
    time, place = time_s[rows], place_m[rows]
    for half_s in _HALF_SPANS_S:
        for k in np.flatnonzero(np.isnan(course[rows])).tolist():
            low, high = np.searchsorted(time, (time[k] - half_s - 1e-6, time[k] + half_s + 1e-6))
            if high - low < 4 or time[high - 1] - time[low] < half_s:
                continue
            found = _fit_course(time[low:high], place[low:high])
            if found is not None:
                course[rows[k]], sigma[rows[k]] = found
    return course, sigma


def _fit_course(time: np.ndarray, place: np.ndarray) -> tuple[float, float] | None:
    """Direction and standard deviation of a straight flight; None where it is slow, unsure or turns."""
    apart = time - time.mean()
    spread = float(apart @ apart)
    velocity = apart @ (place - place.mean(axis=0)) / spread
    speed = float(np.hypot(*velocity))
    if speed < _LEAST_M_S:
        return None
    missing = place - place.mean(axis=0) - apart[:, None] * velocity
    # A vehicle that turns leaves its line on one side in the middle and on the other at the ends.
    across = missing @ np.array([velocity[1], -velocity[0]]) / speed
    bend = apart**2 - spread / len(time)
    turn_rad_s = 2 * float(bend @ across) / float(bend @ bend) / speed
    scatter = float(across @ across) / max(len(time) - 2, 1)
    # Rounded places jump: how the vehicle went between two of them is not known.
    jumps = np.linalg.norm(np.diff(place, axis=0), axis=1)
    length, jump = speed * float(np.ptp(time)), float(jumps.max())
    rounding = (jump / length) ** 1.5
    sigma = math.hypot(math.sqrt(scatter / spread) / speed, rounding)
    if sigma > _SURE_RAD or abs(turn_rad_s) * float(np.ptp(time)) > _STRAIGHT_RAD:
        return None
    return float(np.arctan2(velocity[0], velocity[1]) % (2 * math.pi)), sigma
