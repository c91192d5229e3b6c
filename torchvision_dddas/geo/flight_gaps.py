"""Fill the parts of the camera's pose that a log lacks, from the camera's file, the vehicle's nose or its course."""

import math
from dataclasses import replace

import numpy as np

from torchvision_dddas.config import AerialParameters
from torchvision_dddas.types import Camera, Float, Telemetry

COURSE, NOSE = "the course over ground", "the vehicle's nose"
"""Sources of a heading if the log does not give that of the camera."""

# Half the time spans over which a line is fitted to the places. The shortest span with a known course is used.
_HALF_SPANS_S = (1.0, 2.0, 5.0, 10.0)
# Ignore the course of a slower vehicle, which may fly sideways; ignore courses with a larger standard deviation, and
# courses that turn by more within their span.
_LEAST_M_S, _SURE_RAD, _STRAIGHT_RAD = 2.0, math.radians(5.0), math.radians(10.0)


def fill_gaps(
    telemetry: Telemetry,
    camera: Camera | None,
    parameters: AerialParameters,
    has_ground: bool = False,
    has_landmarks: bool = False,
) -> tuple[Telemetry, list[str]]:
    """Fill quantities that the telemetry never gives, and return notes for the user.

    telemetry: in local metres. camera: the camera's file; its heading_rad, pitch_rad, roll_rad and height_m apply at
    all times, and takeoff_above_sea_m turns heights above the sea into heights above ground. has_ground: whether the
    heights of the ground are known; heights above the sea then count from it. has_landmarks: whether landmarks
    determine the heading better than the nose or the course of the vehicle.
    """
    notes = list[str]()
    if camera is not None:
        telemetry, used = _take_from_camera(telemetry, camera, has_ground)
        if used:
            words = "it is taken" if len(used) == 1 else "they are taken"
            notes.append(f"the log does not say {', '.join(used)}: {words} from camera {camera.name}")
        is_alike = np.array_equal(telemetry.altitude_m, telemetry.above_sea_m, equal_nan=True)
        if "takeoff_above_sea_m" in used and telemetry.height_zero == "unknown" and is_alike:
            notes.append("the log's heights count from the take-off point: as heights above the sea they lie below it")
        reasons: dict[str, list[str]] = {}
        for key in (key for key in known_keys(camera) if key not in used):
            reasons.setdefault(_why_unused(key, telemetry), []).append(key)
        notes += [
            f"camera {camera.name}: {', '.join(keys)} not used for the camera's pose, because {why}"
            for why, keys in reasons.items()
        ]
        if any(camera.place):
            notes.append(f"the place of camera {camera.name} is not used: the vehicle's place is used")
        if camera.knows("elevation_m"):
            notes.append(f"elevation_m of camera {camera.name} is not used: it is for a camera on the ground")
    if _lacks(telemetry, "heading_rad") and not has_landmarks:
        telemetry, more = _take_heading(telemetry, parameters)
        notes += more
    return telemetry, notes


def _why_unused(key: str, telemetry: Telemetry) -> str:
    if key not in ("height_m", "takeoff_above_sea_m"):
        return "the log says it"
    if key == "takeoff_above_sea_m" and _lacks(telemetry, "above_sea_m"):
        return "the log gives no height above the sea"
    return "the height above ground is known without it"


def known_keys(camera: Camera) -> list[str]:
    """Return the keys of the camera's file that describe the pose of a camera in the air."""
    names = ("heading_rad", "pitch_rad", "roll_rad", "height_m", "takeoff_above_sea_m")
    return [name.replace("_rad", "_deg") for name in names if camera.knows(name)]


def _lacks(telemetry: Telemetry, name: str) -> bool:
    return not np.isfinite(getattr(telemetry, name)).any()


def _take_from_camera(telemetry: Telemetry, camera: Camera, has_ground: bool) -> tuple[Telemetry, list[str]]:
    """Return telemetry with values of the camera's file that the log lacks, and the keys that were used."""
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
            # If all heights would lie below the take-off point, the log counts them from that point.
            is_from_takeoff = is_open and not (altitude_m > 0).any()
            filled["altitude_m"] = telemetry.above_sea_m if is_from_takeoff else altitude_m
        elif "height_m" in known:
            give("height_m", "altitude_m", camera.height_m, "altitude_sigma_m", "height_sigma_m")
    return replace(telemetry, **filled), used  # type: ignore[arg-type]


def _take_heading(telemetry: Telemetry, parameters: AerialParameters) -> tuple[Telemetry, list[str]]:
    """Return telemetry with the heading of the vehicle's nose or of its course, and a note."""
    sigma_rad = math.radians(parameters.course_sigma_deg)
    with_sigma = f"with a sigma of {parameters.course_sigma_deg:g} degrees"
    if not _lacks(telemetry, "vehicle_heading_rad"):
        heading_rad, sigma, source = telemetry.vehicle_heading_rad, np.full(len(telemetry), sigma_rad), NOSE
        note = f"the heading of the vehicle's nose is used, {with_sigma} (aerial.course_sigma_deg)"
    else:
        heading_rad, fit_rad = course_over_ground(telemetry.time_s, telemetry.place)
        sigma, source, known = np.hypot(fit_rad, sigma_rad), COURSE, np.isfinite(heading_rad)
        if not known.any():
            return telemetry, []
        note = (
            f"the course over ground is used where it is straight, in {100 * known.mean():.0f} % of the samples, "
            f"{with_sigma} or more (aerial.course_sigma_deg)"
        )
    filled = replace(telemetry, heading_rad=heading_rad, heading_sigma_rad=sigma, heading_from=source)
    return filled, [f"the log does not say the camera's heading: {note}"]


def course_over_ground(
    time_s: Float[np.ndarray, "N"], place_m: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Return the course, rad clockwise from north, and the standard deviation of its fit; NaN where not straight.

    A line is fitted to the places around each time. The standard deviation follows from their scatter about the line
    and from their distances.
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
    """Return direction and standard deviation of a straight flight; None if it is slow, uncertain or turns."""
    apart = time - time.mean()
    spread = float(apart @ apart)
    velocity = apart @ (place - place.mean(axis=0)) / spread
    speed = float(np.hypot(*velocity))
    if speed < _LEAST_M_S:
        return None
    missing = place - place.mean(axis=0) - apart[:, None] * velocity
    # A turning vehicle deviates from its line to one side in the middle and to the other side at the ends.
    across = missing @ np.array([velocity[1], -velocity[0]]) / speed
    bend = apart**2 - spread / len(time)
    turn_rad_s = 2 * float(bend @ across) / float(bend @ bend) / speed
    scatter = float(across @ across) / max(len(time) - 2, 1)
    # Rounded places jump, and the path between two of them is unknown.
    jumps = np.linalg.norm(np.diff(place, axis=0), axis=1)
    length, jump = speed * float(np.ptp(time)), float(jumps.max())
    rounding = (jump / length) ** 1.5
    sigma = math.hypot(math.sqrt(scatter / spread) / speed, rounding)
    if sigma > _SURE_RAD or abs(turn_rad_s) * float(np.ptp(time)) > _STRAIGHT_RAD:
        return None
    return float(np.arctan2(velocity[0], velocity[1]) % (2 * math.pi)), sigma
