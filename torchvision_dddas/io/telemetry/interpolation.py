"""What the telemetry says at a moment, and whether it says anything about a clip."""

import math

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Flight, Telemetry

_TURN = 2 * math.pi


def at(telemetry: Telemetry, time_s: float, tolerance_s: float = 1.0) -> Flight | None:
    """The flight at a time, linear between samples, angles and longitudes the short way round.

    What either sample beside it does not say is NaN. Up to tolerance_s outside the span the nearest sample holds;
    beyond it nothing is known: None.
    """
    times, time_s = telemetry.time_s, float(time_s)
    count = len(times)
    if count == 0 or not times.item(0) - tolerance_s <= time_s <= times.item(count - 1) + tolerance_s:
        return None
    after = min(int(times.searchsorted(time_s)), count - 1)
    end_s = times.item(after)
    before, share = after, 0.0
    if after > 0 and time_s < end_s:  # else outside the span, or on a sample, which then counts alone
        before = after - 1
        share = (time_s - times.item(before)) / (end_s - times.item(before))

    def between(values: np.ndarray, full: float = math.inf) -> float:
        low = values.item(before)
        return low + share * _way(low, values.item(after), full)

    first, second = telemetry.place[before].tolist(), telemetry.place[after].tolist()
    around = 360.0 if telemetry.geographic else math.inf
    east = first[0] + share * _way(first[0], second[0], around)
    roll = between(telemetry.roll_rad, _TURN)
    return Flight(
        between(telemetry.altitude_m),
        between(telemetry.speed_m_s),
        (_wrapped(east, around), first[1] + share * (second[1] - first[1])),
        between(telemetry.above_sea_m),
        between(telemetry.heading_rad, _TURN) % _TURN,
        between(telemetry.pitch_rad),
        _wrapped(roll, _TURN),
        between(telemetry.hfov_rad),
        between(telemetry.vehicle_heading_rad, _TURN) % _TURN,
    )


def _way(low: float, high: float, full: float) -> float:
    """From one value to another; on a circle the short way round."""
    way = high - low
    return way if abs(way) <= full / 2 or full == math.inf else (way + full / 2) % full - full / 2


def _wrapped(value: float, full: float) -> float:
    """A value on a circle, from minus half of it to half."""
    return value if abs(value) <= full / 2 or full == math.inf else (value + full / 2) % full - full / 2


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
