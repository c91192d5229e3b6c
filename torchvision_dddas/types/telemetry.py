"""The reports of a vehicle about its flight."""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from torchvision_dddas.errors import InputError
from torchvision_dddas.types.record import Record
from torchvision_dddas.types.table import Table


@dataclass(frozen=True)
class Telemetry(Table):
    """Reports of a vehicle about its own flight, one row per sample, sorted by time; NaN if unknown. Arrays are (N,).

    time_s: since the clip's first frame. altitude_m: above height_zero: "ground" (below the vehicle) or "takeoff" (the
    take-off point). above_sea_m: with height_zero "unknown", the log does not say whether it counts from the sea or
    from the take-off point. above_ellipsoid_m: above WGS 84. speed_m_s: over the ground.
    place: (N, 2) longitude and latitude in degrees if geographic, else local metres east and north.
    heading_rad, pitch_rad, roll_rad: angles of the camera, as in Camera. If it looks straight down, the pitch is pi/2
    and the heading is the direction of the picture's upper edge. hfov_rad: horizontal field of view.
    vehicle_heading_rad: heading of the vehicle's nose. heading_sigma_rad, tilt_sigma_rad, altitude_sigma_m,
    position_sigma_m: standard deviations, the last for east and for north; NaN: the values of the group `aerial`.
    heading_from: source of heading_rad in words, if the log does not contain the camera's heading; else empty.
    is_nominal: hfov_rad follows from a 35 mm equivalent focal length, and is measured along the pictures' longer side.
    start_utc_s: seconds since 1970 at time_s = 0, NaN if unknown. start_local_s: the same by a clock of unknown zone.
    latest_utc_s: latest possible start_utc_s, if the dates lack a zone. origin: the file. notes: remarks for the user.
    Raise InputError for columns of other lengths and for decreasing times.

    >>> log = td.Telemetry([0.0, 1.0], altitude_m=[40.0, 42.0], speed_m_s=[5.0, 5.0])
    >>> log
    Telemetry(2 rows, time_s: 0 to 1, altitude_m: 40 to 42, speed_m_s: 5)
    >>> log.at(0.5).altitude_m
    41.0
    """

    time_s: np.ndarray
    altitude_m: np.ndarray
    speed_m_s: np.ndarray
    place: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    geographic: bool = True
    above_sea_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    heading_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    pitch_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    roll_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    hfov_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    vehicle_heading_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    heading_sigma_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    tilt_sigma_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    altitude_sigma_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    position_sigma_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    above_ellipsoid_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    height_zero: Literal["ground", "takeoff", "unknown"] = "ground"
    heading_from: str = ""
    is_nominal: bool = False
    start_utc_s: float = float("nan")
    latest_utc_s: float = float("nan")
    start_local_s: float = float("nan")
    origin: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        time_s = np.asarray(self.time_s, float)
        object.__setattr__(self, "time_s", time_s)
        if (np.diff(time_s) < 0).any():
            raise InputError("time_s of telemetry must not decrease; sort its rows by time")
        for name in COLUMNS_OF_TELEMETRY:
            given, wanted = np.asarray(getattr(self, name), float), (len(time_s), 2)[: 1 + (name == "place")]
            if len(given) == 0 < len(time_s):  # a column that was not given holds unknown values
                given = np.full(wanted, np.nan)
            if given.shape != wanted:
                raise InputError(f"{name} of telemetry must have the shape {wanted}, a row per time, got {given.shape}")
            object.__setattr__(self, name, given)

    def focal_px(self, size: tuple[int, int]) -> np.ndarray:
        """Return focal lengths in pixels from the field of view, (N,), NaN if unknown. size: (width, height)."""
        return (max(size) if self.is_nominal else size[0]) / 2 / np.tan(self.hfov_rad / 2)

    @property
    def hold_s(self) -> float:
        """Time for which the log still gives a place before its first and after its last sample: half an interval."""
        return min(0.5 * float(np.median(np.diff(self.time_s))) + 1e-6, 1.0) if len(self) > 1 else 1.0

    def at(self, time_s: float, *, tolerance_s: float = 1.0) -> "Flight | None":
        """Return the state at a time by linear interpolation; angles and longitudes turn the short way.

        A field is NaN if it is NaN in either neighbour. Up to tolerance_s before the first and after the last sample,
        the nearest sample is used; further away the result is None. Raise InputError for several times.
        """
        if np.ndim(time_s):
            got = np.shape(time_s)
            raise InputError(f"time_s must be one number, got an array {got}; ask for each: [log.at(t) for t in times]")
        times, time_s = self.time_s, float(time_s)
        count = len(times)
        if count == 0 or not times.item(0) - tolerance_s <= time_s <= times.item(count - 1) + tolerance_s:
            return None
        after = min(int(times.searchsorted(time_s)), count - 1)
        end_s = times.item(after)
        before, share = after, 0.0
        if after > 0 and time_s < end_s:  # else the time is outside, or on a sample, which needs no interpolation
            before = after - 1
            share = (time_s - times.item(before)) / (end_s - times.item(before))

        def between(values: np.ndarray, full: float = math.inf) -> float:
            low = values.item(before)
            return low + share * _wrap(values.item(after) - low, full)

        first, second = self.place[before].tolist(), self.place[after].tolist()
        around = 360.0 if self.geographic else math.inf
        east = first[0] + share * _wrap(second[0] - first[0], around)
        return Flight(
            between(self.altitude_m),
            between(self.speed_m_s),
            (_wrap(east, around), first[1] + share * (second[1] - first[1])),
            between(self.above_sea_m),
            between(self.heading_rad, _TURN) % _TURN,
            between(self.pitch_rad),
            _wrap(between(self.roll_rad, _TURN), _TURN),
            between(self.hfov_rad),
            between(self.vehicle_heading_rad, _TURN) % _TURN,
            between(self.heading_sigma_rad),
            between(self.tilt_sigma_rad),
            between(self.altitude_sigma_m),
            between(self.position_sigma_m),
            self.heading_from,
        )

    def check_overlap(self, last_s: float, *, first_s: float = 0.0, what: str = "clip") -> None:
        """Raise InputError, with both time ranges, if no sample lies near a clip or table from first_s to last_s."""
        if len(self) == 0:
            raise InputError(f"the telemetry has no samples; the {what} lasts from {first_s:.1f} to {last_s:.1f} s")
        from_s, to_s = float(self.time_s[0]), float(self.time_s[-1])
        if from_s - 1 > last_s or to_s + 1 < first_s:
            raise InputError(
                f"the telemetry covers {from_s:.1f} to {to_s:.1f} s, the {what} {first_s:.1f} to {last_s:.1f} s; "
                "they do not overlap: count time_s from the clip's first frame, or set aerial.clock_offset_s"
            )


_TURN = 2 * math.pi
_LEAST_SINE = 0.1  # smallest sine of the angle of the view below the horizon


def ground_distance(altitude_m: float, below_horizon_rad: ArrayLike) -> np.ndarray:
    """Return the distances, m, to level ground along lines of sight at angles (...) below the horizon.

    An angle of less than about 6 degrees counts as 6 degrees, because its ground is too far to tell.

    >>> types.ground_distance(50.0, np.radians([90, 30])).round(6).tolist()
    [50.0, 100.0]
    """
    return altitude_m / np.maximum(np.sin(below_horizon_rad), _LEAST_SINE)


def _wrap(value: float, full: float) -> float:
    """Return a value or difference on a circle of circumference `full`, from minus half of it to half."""
    return value if abs(value) <= full / 2 or full == math.inf else (value + full / 2) % full - full / 2


COLUMNS_OF_TELEMETRY = (
    "altitude_m",
    "speed_m_s",
    "place",
    "above_sea_m",
    "heading_rad",
    "pitch_rad",
    "roll_rad",
    "hfov_rad",
    "vehicle_heading_rad",
    "heading_sigma_rad",
    "tilt_sigma_rad",
    "altitude_sigma_m",
    "position_sigma_m",
    "above_ellipsoid_m",
)


@dataclass(frozen=True)
class Flight(Record):
    """Telemetry at one moment; fields as in Telemetry, NaN if unknown.

    >>> round(td.Flight(altitude_m=50.0, pitch_rad=np.radians(30)).distance_m, 6)
    100.0
    """

    altitude_m: float
    speed_m_s: float = float("nan")
    place: tuple[float, float] = (float("nan"), float("nan"))
    above_sea_m: float = float("nan")
    heading_rad: float = float("nan")
    pitch_rad: float = float("nan")
    roll_rad: float = float("nan")
    hfov_rad: float = float("nan")
    vehicle_heading_rad: float = float("nan")
    heading_sigma_rad: float = float("nan")
    tilt_sigma_rad: float = float("nan")
    altitude_sigma_m: float = float("nan")
    position_sigma_m: float = float("nan")
    heading_from: str = ""

    @property
    def distance_m(self) -> float:
        """Distance from the camera to level ground along the optical axis; the altitude if the pitch is unknown.

        See `ground_distance`.
        """
        if not math.isfinite(self.pitch_rad):
            return self.altitude_m
        return float(ground_distance(self.altitude_m, self.pitch_rad))
