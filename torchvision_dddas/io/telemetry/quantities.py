"""What makers call the same thing: from a key and its unit to a quantity of the record."""

import math
import re
from datetime import UTC, datetime, timedelta
from functools import cache

_KEYS = {
    "latitude_deg": "latitude lat gpslatitude gpslat",
    "longitude_deg": "longitude longtitude lon lng long gpslongitude gpslon",
    "altitude_m": "relalt relativealtitude relativeheight heightabovetakeoff altitudeagl heightagl altagl agl "
    "altitudem height barometer baro hb h",
    "above_sea_m": "absalt absolutealtitude altitudeabovesealevel abovesea amsl altitudemsl altmsl msl gpsaltitude "
    "gpsalt altitude alt",
    "speed_m_s": "h.s speed groundspeed hspeed horizontalspeed velocity",
    "heading_rad": "gbyaw gimbalyaw gimbalheading",
    "pitch_rad": "gbpitch gimbalpitch",
    "roll_rad": "gbroll gimbalroll",
    "vehicle_heading_rad": "heading yaw compassheading flightyaw uavyaw",
    "hfov_rad": "hfov horizontalfov",
}
QUANTITY = {key: quantity for quantity, keys in _KEYS.items() for key in keys.split()}
"""Quantity by key, without capitals, blanks, dashes and underscores; of several, what stands first tells it best."""

_UNITS = {
    "m": 1.0, "meters": 1.0, "metres": 1.0, "ft": 0.3048, "feet": 0.3048, "m/s": 1.0, "mps": 1.0, "km/h": 1 / 3.6,
    "kmh": 1 / 3.6, "kph": 1 / 3.6, "mph": 0.44704, "kn": 1852 / 3600, "knots": 1852 / 3600, "kt": 1852 / 3600,
    "kts": 1852 / 3600, "cm": 0.01, "mm": 0.001, "°": 1.0, "deg": 1.0, "degrees": 1.0,
}  # fmt: skip
_RADIANS = {"rad", "radians"}
_DATE = re.compile(
    r"(\d{4})[./-](\d{1,2})[./-](\d{1,2})[ T]+(\d{1,2}):(\d{1,2}):(\d{1,2})"
    r"(?:[.,:](\d{1,9}))?(?:[.,:](\d{1,3}))?(?:[.,:]\d{1,3})*(Z|[+-]\d{2}:?\d{2})?"
)
# Half the width of the picture whose focal length is said as that of a 36 mm wide one.
_HALF_WIDTH_MM = 18.0


@cache
def quantity_of(key: str) -> str | None:
    """What a key tells, however it is written; None for one that tells nothing of the flight."""
    return QUANTITY.get(re.sub(r"[\s_-]", "", key.lower()))


def understood(key: str, value: float, unit: str = "") -> tuple[str, float] | None:
    """The quantity and its value in the record's units and signs; None for a key that tells none."""
    quantity = quantity_of(key)
    if quantity is None:
        return None
    unit = unit.lower()
    value *= _UNITS.get(unit, 1.0)
    if quantity.endswith("_rad"):
        value = value if unit in _RADIANS else math.radians(value)
        # A gimbal's pitch is counted up from the horizon, the record's down.
        value = 0.0 - value if quantity == "pitch_rad" else value
    return quantity, value


def dated(text: str) -> tuple[float, bool] | None:
    """Seconds since 1970 of the first date with a time in a text, and whether its zone is told; else it is as if UTC.

    None without a date. Fractions come as `.123`, as `,123` or as milli- and microseconds, `,774,808`.
    """
    found = _DATE.search(text)
    if found is None:
        return None
    *whole, fraction, more, zone = found.groups()
    try:
        year, month, day, hour, minute, second = map(int, whole)
        moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    digits = (fraction or "") + (more or "" if len(fraction or "") == 3 else "")
    seconds = moment.timestamp() + (float(f"0.{digits}") if digits else 0.0)
    if zone and zone != "Z":
        away = timedelta(hours=int(zone[1:3]), minutes=int(zone[-2:])).total_seconds()
        seconds -= math.copysign(away, float(zone[0] + "1"))
    return seconds, zone is not None


def hfov_of_focal(text: str, fnum: float, zoom: float) -> float | None:
    """Width of the field of view, rad, from a focal length as that of a 36 mm wide picture; None if it is none.

    Some write both it and the aperture times ten and a hundred: 240 beside 280 is 24 mm at f/2.8.
    """
    focal = float(text.replace(",", "."))
    if "." not in text and focal >= 100 and not fnum < 100:
        focal /= 10
    focal *= zoom if 1 <= zoom <= 100 else 1.0
    return 2 * math.atan(_HALF_WIDTH_MM / focal) if 8 <= focal <= 2000 else None
