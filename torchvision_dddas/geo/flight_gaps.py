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
    telemetry: Telemetry,
    camera: Camera | None,
    parameters: AerialParameters,
    has_ground: bool = False,
    has_landmarks: bool = False,
) -> tuple[Telemetry, list[str]]:
    """The telemetry, completed where it never says a quantity, and what the user should know of that.

    telemetry: in local metres. camera: as its file says; its heading_rad, pitch_rad, roll_rad and height_m stand for
    all times, and from takeoff_above_sea_m heights above the sea become heights above ground. has_ground: whether the
    ground's heights are known, which heights above the sea are counted from then. has_landmarks: these tell the heading
    better than the nose or the course of the vehicle.
    """
    notes = list[str]()
    if camera is not None:
        telemetry, used = _take_from_camera(telemetry, camera, has_ground)
        if used:
            words = "it is taken" if len(used) == 1 else "they are taken"
            notes.append(f"the log does not say {', '.join(used)}: {words} from camera {camera.name}")
        is_alike = np.array_equal(telemetry.altitude_m, telemetry.above_sea_m, equal_nan=True)
        if "takeoff_above_sea_m" in used and telemetry.height_zero == "unknown" and is_alike:
            notes.append("the heights of the log count from the take-off point: above the sea they would lie below it")
        reasons: dict[str, list[str]] = {}
        for key in (key for key in known_keys(camera) if key not in used):
            reasons.setdefault(_why_unused(key, telemetry), []).append(key)
        notes += [f"camera {camera.name}: {', '.join(keys)} not used, because {why}" for why, keys in reasons.items()]
        if any(camera.place):
            notes.append(f"the place of camera {camera.name} is not used: it is that of the vehicle")
    if _lacks(telemetry, "heading_rad") and not has_landmarks:
        telemetry, more = _take_heading(telemetry, parameters)
        notes += more
    return telemetry, notes


def _why_unused(key: str, telemetry: Telemetry) -> str:
    if key not in ("height_m", "takeoff_above_sea_m"):
        return "the log says it"
    if key == "takeoff_above_sea_m" and _lacks(telemetry, "above_sea_m"):
        return "the log says no height above the sea"
    return "the height above ground is known without it"


def known_keys(camera: Camera) -> list[str]:
    """What a camera's file says of the pose of a camera in the air, by its keys."""
    names = ("heading_rad", "pitch_rad", "roll_rad", "height_m", "takeoff_above_sea_m")
    return [name.replace("_rad", "_deg") for name in names if camera.knows(name)]


def _lacks(telemetry: Telemetry, name: str) -> bool:
    return not np.isfinite(getattr(telemetry, name)).any()


def _take_from_camera(telemetry: Telemetry, camera: Camera, has_ground: bool) -> tuple[Telemetry, list[str]]:
    """Telemetry with what the camera's file says and the log does not, and the keys that were used."""
    filled, used = dict[str, np.ndarray](), list[str]()
    count, known = len(telemetry), known_keys(camera)

    def give(key: str, name: str, value: float, sigma_name: str = "", sigma_from: str = "") -> None:
        used.append(key)
        filled[name] = np.full(count, value)
        if sigma_name:
            sigma = getattr(camera, sigma_from) if camera.knows(sigma_from) else math.nan
            filled[sigma_name] = np.full(count, sigma)

    if "heading_deg" in known and _lacks(telemetry, "heading_rad"):
        give("heading_deg", "heading_rad", camera.heading_rad, "heading_sigma_rad", "heading_sigma_rad")
    if "pitch_deg" in known and _lacks(telemetry, "pitch_rad"):
        give("pitch_deg", "pitch_rad", camera.pitch_rad, "tilt_sigma_rad", "pitch_sigma_rad")
    if "roll_deg" in known and _lacks(telemetry, "roll_rad"):
        give("roll_deg", "roll_rad", camera.roll_rad)
    above_sea = not _lacks(telemetry, "above_sea_m")
    is_open = telemetry.height_zero == "unknown" and "takeoff_above_sea_m" in known
    if _lacks(telemetry, "altitude_m") and (is_open or not (above_sea and has_ground)):
        if "takeoff_above_sea_m" in known and above_sea:
            used.append("takeoff_above_sea_m")
            altitude_m = telemetry.above_sea_m - camera.takeoff_above_sea_m
            # Heights that would be below the take-off point throughout are counted from it.
            is_from_takeoff = is_open and not (altitude_m > 0).any()
            filled["altitude_m"] = telemetry.above_sea_m if is_from_takeoff else altitude_m
        elif "height_m" in known:
            give("height_m", "altitude_m", camera.height_m, "altitude_sigma_m", "height_sigma_m")
    return replace(telemetry, **filled), used  # type: ignore[arg-type]


def _take_heading(telemetry: Telemetry, parameters: AerialParameters) -> tuple[Telemetry, list[str]]:
    """Telemetry with the heading of the vehicle's nose or of its course, and a note."""
    sigma_rad = math.radians(parameters.course_sigma_deg)
    with_sigma = f"with a sigma of {parameters.course_sigma_deg:g} degrees"
    if not _lacks(telemetry, "vehicle_heading_rad"):
        heading_rad, sigma, source = telemetry.vehicle_heading_rad, np.full(len(telemetry), sigma_rad), NOSE
        note = f"that of the vehicle's nose is taken, {with_sigma} (aerial.course_sigma_deg)"
    else:
        heading_rad, fit_rad = course_over_ground(telemetry.time_s, telemetry.place)
        sigma, source, known = np.hypot(fit_rad, sigma_rad), COURSE, np.isfinite(heading_rad)
        if not known.any():
            return telemetry, []
        note = (
            f"the course over ground is taken where it is straight, in {100 * known.mean():.0f} % of the samples, "
            f"{with_sigma} or more (aerial.course_sigma_deg)"
        )
    filled = replace(telemetry, heading_rad=heading_rad, heading_sigma_rad=sigma, heading_from=source)
    return filled, [f"the log does not say the camera's heading: {note}"]


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
