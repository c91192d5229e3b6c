"""Where the sun stands, and what that makes of what is seen to move: a body and the shadow that it casts.

From the air a walker's shadow is often larger than the walker. Where the sun stands is known wherever place and time
are, so what the shadow adds to a target's middle can be taken off it.
"""

import math

import numpy as np

from torchvision_dddas.geo.projection import project
from torchvision_dddas.types import Camera, CameraPose, Float

BODY_WIDTH_M = 0.5
"""Of a person from straight above, where no height shows."""

LOWEST_RAD = math.radians(8.0)
"""Below this height of the sun shadows are too long and too weak to count on."""

_J2000_S = 946_728_000.0  # 2000-01-01 12:00 UTC, in seconds since 1970


def sun_at(longitude_deg: float, latitude_deg: float, utc_s: float) -> tuple[float, float]:
    """Azimuth clockwise from north and height above the horizon, rad, without refraction; right to about 0.02 degrees.

    utc_s: seconds since 1970. Source: the low-precision formulas of the Astronomical Almanac, good from 1950 to 2050.
    """
    days = (utc_s - _J2000_S) / 86400
    mean_longitude = math.radians(280.460 + 0.9856474 * days)
    anomaly = math.radians(357.528 + 0.9856003 * days)
    ecliptic = mean_longitude + math.radians(1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly))
    tilt = math.radians(23.439 - 4e-7 * days)
    ascension = math.atan2(math.cos(tilt) * math.sin(ecliptic), math.cos(ecliptic))
    declination = math.asin(math.sin(tilt) * math.sin(ecliptic))
    sidereal = math.radians(280.46062 + 360.98564737 * days + longitude_deg)
    hour, latitude = sidereal - ascension, math.radians(latitude_deg)
    height = math.asin(
        math.sin(latitude) * math.sin(declination) + math.cos(latitude) * math.cos(declination) * math.cos(hour)
    )
    azimuth = math.atan2(
        -math.sin(hour) * math.cos(declination),
        math.sin(declination) * math.cos(latitude) - math.cos(declination) * math.sin(latitude) * math.cos(hour),
    )
    return azimuth % (2 * math.pi), height


def shadow_m(sun_rad: tuple[float, float], height_m: float) -> Float[np.ndarray, "2"]:
    """East and north from the foot of an upright body to the end of its shadow on level ground.

    sun_rad: azimuth and height. Zero for a sun so low that shadows tell nothing.
    """
    azimuth, up = sun_rad
    if up < LOWEST_RAD:
        return np.zeros(2)
    return -height_m / math.tan(up) * np.array([math.sin(azimuth), math.cos(azimuth)])


def feet_below(
    middle_px: Float[np.ndarray, "N 2"],
    foot_m: Float[np.ndarray, "N 3"],
    pose: CameraPose,
    camera: Camera,
    height_m: float,
    shadow: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "N 2"]:
    """Pixels of the feet of bodies whose foreground, body and shadow together, has its mean at middle_px.

    foot_m: about where the feet are. Both parts are strips of one width, so each weighs as its length in the picture;
    of a body seen from above at least its width shows.
    """
    foot = project(foot_m, pose, camera)

    def away(*step_m: float) -> np.ndarray:
        return project(foot_m + np.array(step_m), pose, camera) - foot

    head, tip, aside = away(0, 0, height_m), away(*shadow, 0), away(BODY_WIDTH_M, 0, 0)
    body, shade = np.hypot(np.linalg.norm(head, axis=1), np.linalg.norm(aside, axis=1)), np.linalg.norm(tip, axis=1)
    mean = (body[:, None] * head / 2 + shade[:, None] * tip / 2) / (body + shade)[:, None]
    return middle_px - mean
