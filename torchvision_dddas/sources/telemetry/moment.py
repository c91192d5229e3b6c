"""What the telemetry says at a moment, and whether it says anything about a clip."""

import math

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Flight, Telemetry

_TURN = 2 * math.pi


def at(telemetry: Telemetry, time_s: float, tolerance_s: float = 1.0) -> Flight | None:
    """The flight at a time, linear between samples, angles and longitudes the short way round.

    What either sample beside it does not say is NaN. Up to tolerance_s outside the span the nearest sample holds;
    beyond it nothing is known: None.
    """
    times = telemetry.time_s
    count = len(times)
    if count == 0 or not times[0] - tolerance_s <= time_s <= times[-1] + tolerance_s:
        return None
    after = int(times.searchsorted(time_s))
    if after in (0, count):  # outside the span, or on the first sample
        before = after = min(after, count - 1)
        share = 0.0
    else:
        before = after - 1
        # The sample that was asked for counts alone, whatever stands before it.
        share = float((time_s - times[before]) / (times[after] - times[before]))
        before = after if share == 1.0 else before

    def between(column: str) -> float:
        values = getattr(telemetry, column)
        low = float(values[before])
        return low + share * (float(values[after]) - low) if before != after else low

    def turned(column: str, full: float = _TURN) -> float:
        values = getattr(telemetry, column)
        return _turned(float(values[before]), float(values[after]), share, full)

    place = telemetry.place
    east, north = (float(place[before, 0]), float(place[after, 0])), (float(place[before, 1]), float(place[after, 1]))
    if telemetry.geographic:
        first = _turned(*east, share, 360.0)
        first = first if -180 <= first <= 180 else (first + 180) % 360 - 180
    else:
        first = east[0] + share * (east[1] - east[0])
    roll = turned("roll_rad")
    return Flight(
        between("altitude_m"),
        between("speed_m_s"),
        (first, north[0] + share * (north[1] - north[0])),
        between("above_sea_m"),
        turned("heading_rad") % _TURN,
        between("pitch_rad"),
        roll if -math.pi <= roll <= math.pi else (roll + math.pi) % _TURN - math.pi,
        between("hfov_rad"),
        turned("vehicle_heading_rad") % _TURN,
    )


def _turned(low: float, high: float, share: float, full: float) -> float:
    """Part of the way from one angle to another, the short way round."""
    way = (high - low + full / 2) % full - full / 2
    return low + share * way


def check_overlap(telemetry: Telemetry, last_s: float) -> None:
    """Raises InputError, with both spans, for telemetry that tells nothing about a clip from 0 to last_s."""
    if len(telemetry) == 0:
        raise InputError(f"the telemetry has no samples; the clip lasts from 0.0 to {last_s:.1f} s")
    from_s, to_s = float(telemetry.time_s[0]), float(telemetry.time_s[-1])
    if at(telemetry, 0.0) is None and at(telemetry, last_s) is None and not 0 <= from_s <= last_s:
        raise InputError(
            f"the telemetry covers {from_s:.1f} to {to_s:.1f} s, the clip 0.0 to {last_s:.1f} s; they do not overlap: "
            "count time_s from the clip's first frame"
        )
