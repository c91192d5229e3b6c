"""Make one record of a flight from the samples of any log: check them, and resample them at common times."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torchvision_dddas.errors import InputError, printable
from torchvision_dddas.geometry import DEGREE_M
from torchvision_dddas.io.telemetry.fields import HEIGHTS, POSSIBLE
from torchvision_dddas.types import COLUMNS_OF_TELEMETRY, Telemetry

KINDS = (
    "a CSV, DJI .SRT, MAVLink .tlog, PX4 .ulg, ArduPilot .bin or .log, MPEG-TS with MISB ST 0601, NMEA 0183, or a JPEG "
    "or TIFF"
)

OWN = "table"
"""The kind of this package's own tables, which may lack a place."""

# Clocks before this date and in the future are rejected. A GPS receiver after a week rollover is 1024 weeks early.
_FIRST_CLOCK_S, _DAY_S = 1_230_768_000.0, 86_400.0  # 2009-01-01
# A barometer's zero drifts by metres in a flight. An altitude below this does not count from the ground.
_DEEP_M = -5.0
# Samples this close have the same time: a split between them would coincide with one of them.
_SAME_S = 1e-6
# A larger distance between two samples separates two flights.
JUMP_M, SPLIT_S, _STRAY = 200.0, 1e-3, 2
# Two heights are the same if they differ by less than this throughout.
_ALIKE_M = 0.5
PAUSES = ("without samples", "the place is unknown")
"""Words of the notes on pauses in a log."""

# A pause of this many median sample intervals, and of this many seconds, is a gap with unknown values.
_GAP_SHARE, _GAP_S = 10.0, 5.0
# A log that has only these quantities is refused.
_NOT_ALONE = {"speed_m_s", "hfov_rad", "vehicle_heading_rad", "position_sigma_m"}
# Angles with a full circle of values, and the lower end of their range.
_TURNING = {"heading_rad": 0.0, "roll_rad": -np.pi, "vehicle_heading_rad": 0.0}
_FULL = {"longitude_deg": 360.0} | dict.fromkeys(_TURNING, 2 * np.pi)
# Half the time span over which a line is fitted to the places: smallest and largest value.
_LEAST_S, _MOST_S = 1.0, 10.0
# Places are rounded. The span is long enough that a step of the last digit changes the speed by at most this.
_STEP_M_S = 0.5
# A receiver's places drift by this even if more digits are written.
_WANDER_M = 0.1


@dataclass
class Log:
    """The samples of a log. path: its file. kind: its kind, for messages. where: the unit of places in the file.

    bridge_s: longest pause of a quantity that is interpolated; 0 if a missing value means unknown.
    jitter_s: how far time may run back; a larger step is another recording, or damage. is_nominal: as in Telemetry.
    height_zero: zero of altitude_m, as in Telemetry. splits: times at which another flight begins.
    latest_utc_s: latest possible time 0, in seconds since 1970, if the zone of the dates is unknown.
    start_local_s: as in Telemetry.
    samples: column of the record, or another quantity of `fields` -> rows (N, 3) of time, value (NaN if unknown) and
    place in the file. Positions are longitude_deg and latitude_deg, or east_m and north_m. moments: rows (N, 3) with
    any value, one for each row of a log whose rows hold all quantities, including empty rows.
    """

    path: Path
    kind: str
    where: str = "line"
    bridge_s: float = 0.0
    jitter_s: float = 1.0
    height_zero: Literal["ground", "takeoff", "unknown"] = "takeoff"
    is_nominal: bool = False
    start_local_s: float = float("nan")
    latest_utc_s: float = math.nan
    splits: list[float] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    samples: dict[str, Any] = field(default_factory=dict)
    moments: Any = field(default_factory=list)

    def add(self, quantity: str, time_s: float, value: float, where: int) -> None:
        """Add a sample."""
        self.samples.setdefault(quantity, []).append((time_s, value, where))

    def add_all(self, times: np.ndarray, where: np.ndarray, values: dict[str, np.ndarray], known: bool = False) -> None:
        """Set all samples of some quantities; arguments are (N,). known: leave out unknown values."""
        for quantity, column in values.items():
            rows = np.column_stack([times, column, where]).astype(float)
            self.samples[quantity] = rows[~np.isnan(rows[:, 1])] if known else rows

    def note(self, text: str) -> None:
        """Add a note for the user, once. It may contain text of the file."""
        text = printable(" ".join(text.split()))
        if text not in self.notes:
            self.notes.append(text)

    def latitude_first(self, pairs: np.ndarray, told: str, asked: str, what: str) -> bool:
        """Return whether the latitude is the first of two coordinates, (N, 2). Raise InputError if unknown.

        told: the order in the dialect. asked: the order that the user set. what: the field with the pair, in words.
        """
        is_beyond = (np.abs(pairs) > 90).any(axis=0)
        if asked == "auto" and is_beyond[0] != is_beyond[1]:
            return bool(is_beyond[1])
        order = told if asked == "auto" else asked
        if not order:
            raise self.refuse(f"{what} may be lat-lon or lon-lat; set aerial.order=lat-lon or aerial.order=lon-lat")
        if asked == "auto":
            self.note(f"{what} is read as {order}, as usual in this dialect; aerial.order sets another order")
        return order == "lat-lon"

    def refuse(self, text: str, where: float | None = None) -> InputError:
        """Return the InputError to raise, with the file and the place."""
        place = f", {self.where} {where:.0f}" if where is not None else ""
        return InputError(f"telemetry {self.path}{place}: {text}")


def is_clock(utc_s: Any) -> Any:
    """Return whether seconds since 1970, a number or an array, can be the time of a log."""
    return (utc_s >= _FIRST_CLOCK_S) & (utc_s <= max(time.time(), _FIRST_CLOCK_S) + _DAY_S)


def build_record(
    log: Log, clock_offset_s: float = 0.0, start_utc_s: float = float("nan"), from_first: bool = False
) -> Telemetry:
    """Return the record of a log: a row for each time of any sample, every column linear between its own samples.

    start_utc_s: seconds since 1970 at the log's own time 0. from_first: whether times count from the first sample.
    Raise InputError if neither altitude, place nor attitude is known, if a place is off the globe, or if time runs
    back.
    """
    samples = {name: _sort(log, np.array(rows, float).reshape(-1, 3)) for name, rows in log.samples.items()}
    moments = _sort(log, np.array(log.moments, float).reshape(-1, 3))
    start = min((rows[0, 0] for rows in (*samples.values(), moments) if len(rows)), default=0.0) if from_first else 0.0
    for rows in (*samples.values(), moments):
        rows[:, 0] -= start
    _drop_impossible(log, samples)
    _check_globe(log, samples)
    samples = {name: rows for name, rows in samples.items() if np.isfinite(rows[:, 1]).any()}
    _settle_heights(log, samples)
    if (accuracy := samples.pop("accuracy_m", None)) is not None:
        samples["position_sigma_m"] = accuracy * [1, math.sqrt(0.5), 1]
        middle_m = np.nanmedian(samples["position_sigma_m"][:, 1])
        log.note(f"the log states the error of its places: the median sigma is {middle_m:.2g} m, east and north")
    _split_flights(log, samples)
    if not set(samples) - _NOT_ALONE:
        names = "time_s, latitude_deg, longitude_deg, altitude_m, heading_deg, pitch_deg"
        wanted = f"; wanted some of the columns {names}" if log.kind.startswith("table of") else ""
        raise log.refuse(f"nothing in it ({log.kind}) holds a place, an altitude or the attitude of a camera{wanted}")
    _note_altitude(log, samples)
    _note_silence(log, samples)
    times = _with_gaps(log, np.unique(np.concatenate([rows[:, 0] for rows in (moments, *samples.values())])))
    columns = {name: _column(times, rows, log.bridge_s, _FULL.get(name)) for name, rows in samples.items()}
    for name, low in _TURNING.items():
        if name in columns:
            columns[name] = (columns[name] - low) % (2 * np.pi) + low
    unknown = np.full(len(times), np.nan)
    geographic = "longitude_deg" in samples or "east_m" not in samples
    pair = ("longitude_deg", "latitude_deg") if geographic else ("east_m", "north_m")
    place = np.stack([columns.get(name, unknown) for name in pair], axis=1)
    place[~np.isfinite(place).all(axis=1)] = np.nan
    if "speed_m_s" not in columns and np.isfinite(place).all(axis=1).sum() > 2:
        columns["speed_m_s"], span_s = _speed_from_places(times, place, geographic, log.splits)
        if np.isfinite(columns["speed_m_s"]).any():
            log.note(f"the speed is computed from the places over {span_s:.1f} s")
    clock_s = start_utc_s + start
    if np.isfinite(clock_s) and not is_clock(clock_s):
        date = np.datetime64(int(np.clip(clock_s, -1e11, 1e11)), "s")
        log.note(f"the log's clock says {date}, which cannot be right: the time of day is unknown")
        clock_s = np.nan
    columns = {"altitude_m": unknown, "speed_m_s": unknown, **columns, "place": place}
    known: dict[str, Any] = {name: columns[name] for name in COLUMNS_OF_TELEMETRY if name in columns}
    return Telemetry(
        times + clock_offset_s,
        **known,
        geographic=geographic,
        height_zero=log.height_zero,
        is_nominal=log.is_nominal,
        start_utc_s=float(clock_s - clock_offset_s),
        start_local_s=log.start_local_s + start - clock_offset_s,
        latest_utc_s=float(log.latest_utc_s - clock_offset_s),
        origin=f"{log.path.name} ({log.kind})",
        notes=tuple(log.notes),
    )


def _with_gaps(log: Log, times: np.ndarray) -> np.ndarray:
    """Return the times. Add one time within each gap, at which values are unknown."""
    if len(times) < 6:
        return times
    steps = np.diff(times)
    most = max(_GAP_SHARE * float(np.median(steps)), _GAP_S, log.bridge_s)
    gaps = np.flatnonzero(steps > most)
    if len(gaps):
        log.note(
            f"{len(gaps)} gap{'s' * (len(gaps) > 1)} of more than {most:.1f} s {PAUSES[0]}: values are unknown "
            f"there. The first begins at {times[gaps[0]]:.1f} s and lasts {steps[gaps[0]]:.1f} s"
        )
    return np.sort(np.concatenate([times, (times[gaps] + times[gaps + 1]) / 2]))


def _column(times: np.ndarray, rows: np.ndarray, bridge_s: float, full: float | None) -> np.ndarray:
    """Return one quantity at all times: linear between neighbouring samples, otherwise NaN.

    A quantity that is sampled less often than others is interpolated, but not over a long pause. Outside its span a
    column keeps its value for bridge_s.
    """
    known, values = rows[:, 0], rows[:, 1]
    if np.array_equal(known, times):
        return values
    if len(known) == 1:
        return np.where(times == known[0], values[0], np.nan)
    after = np.searchsorted(known, times).clip(1, len(known) - 1)
    before = after - 1
    step_s = known[after] - known[before]
    share = (times - known[before]) / step_s
    way = values[after] - values[before]
    if full is not None:
        way = (way + full / 2) % full - full / 2
    column = np.where(share <= 0, values[before], np.where(share >= 1, values[after], values[before] + share * way))
    outside_s = np.maximum(known[0] - times, times - known[-1])
    is_in_pause = (share > 0) & (share < 1) & (step_s > _longest_silence_s(known, bridge_s))
    column[(outside_s > bridge_s) | is_in_pause] = np.nan
    return (column + 180) % 360 - 180 if full == 360.0 else column


# --------------------------------------------------------------------------------------------------------------------
# Checks.


def _sort(log: Log, rows: np.ndarray) -> np.ndarray:
    """Sort by time. Keep the last of several samples at the same time, and leave out single damaged times."""
    rows = rows[np.isfinite(rows[:, 0])]
    rows = rows[~_stray(rows[:, 0], log.jitter_s)]
    is_back = np.diff(rows[:, 0]) < -log.jitter_s
    if is_back.any():
        before, after = rows[int(is_back.argmax()) :][:2]
        raise log.refuse(
            f"time runs back from {before[0]:.3f} to {after[0]:.3f} s; are these two recordings in one file?", after[2]
        )
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return rows[np.append(np.diff(rows[:, 0]) > _SAME_S, True)] if len(rows) else rows


def _stray(times: np.ndarray, jitter_s: float) -> np.ndarray:
    """Return which times are out of order between ordered neighbours: damaged times, not another recording."""
    stray = np.zeros(len(times), bool)
    if len(times) < 3 or not np.isfinite(jitter_s):
        return stray
    before, middle, after = times[:-2], times[1:-1], times[2:]
    stray[1:-1] = (before <= after) & ((middle < before - jitter_s) | (middle > after + jitter_s))
    stray[0] = times[0] > times[1] + jitter_s and times[1] <= times[2]
    stray[-1] = times[-1] < times[-2] - jitter_s and times[-3] <= times[-2]
    # A last sample after a day without samples has a damaged time.
    stray[-1] |= times[-1] > times[-2] + 86_400
    return stray


def _drop_impossible(log: Log, samples: dict[str, np.ndarray]) -> None:
    """Set impossible values to NaN, except for places, which `_check_globe` checks."""
    for name, rows in samples.items():
        low, high = (-np.inf, np.inf) if "itude_deg" in name else POSSIBLE.get(name, (-np.inf, np.inf))
        wrong = np.isinf(rows[:, 1]) | (rows[:, 1] < low) | (rows[:, 1] > high)
        if wrong.any():
            _, value, where = rows[wrong.argmax()]
            value = math.degrees(value) if name.endswith("_rad") else value
            title = name.replace("_rad", "_deg")
            instead = ", aerial.position_sigma_m is used there" if name == "accuracy_m" else ""
            what = f"{title} is {value:g}, which is impossible; {wrong.sum()} left out{instead}"
            log.note(f"{log.where} {where:.0f}: {what}")
            rows[wrong, 1] = np.nan


def _check_globe(log: Log, samples: dict[str, np.ndarray]) -> None:
    """Raise InputError for degrees out of range; longitude and latitude 0 mean no fix."""
    for name, most in (("latitude_deg", 90.0), ("longitude_deg", 180.0)):
        rows = samples.get(name, np.zeros((0, 3)))
        wrong = np.abs(rows[:, 1]) > most
        if wrong.any():
            _, value, where = rows[wrong.argmax()]
            hint = "; are longitude and latitude swapped?" if name == "latitude_deg" and abs(value) <= 180 else ""
            raise log.refuse(f"{name} is {value:g}; wanted -{most:g} to {most:g}{hint}", where)
    longitude, latitude = (samples.get(name, np.zeros((0, 3))) for name in ("longitude_deg", "latitude_deg"))
    if len(longitude) == len(latitude):
        nowhere = (longitude[:, 1] == 0) & (latitude[:, 1] == 0)
        longitude[nowhere, 1] = latitude[nowhere, 1] = np.nan
        if nowhere.any():
            log.note(f"{nowhere.sum()} of {len(nowhere)} places are 0, 0: they have no fix and are unknown")


def _settle_heights(log: Log, samples: dict[str, np.ndarray]) -> None:
    """Make altitude_m and above_sea_m from the heights in a log; note assumptions about their zero."""
    unsaid = "the file does not say where the {} is zero; above the {} is assumed"
    takeoff, ground, height, bare, geoid = (samples.pop(name, None) for name in HEIGHTS)
    if takeoff is None and ground is None and height is not None:
        log.note(unsaid.format("height", "take-off point"))
        takeoff = height
    if ground is not None:
        samples["altitude_m"], log.height_zero = ground, "ground"
    if takeoff is not None:
        samples["altitude_m"], log.height_zero = takeoff, "takeoff"
    ellipsoid, lower = samples.get("above_ellipsoid_m"), samples.get("altitude_m")
    if ellipsoid is not None and geoid is not None and "above_sea_m" not in samples:
        up_m = np.interp(ellipsoid[:, 0], geoid[:, 0], geoid[:, 1])
        samples["above_sea_m"] = np.column_stack([ellipsoid[:, 0], ellipsoid[:, 1] - up_m, ellipsoid[:, 2]])
        log.note("heights above the sea are heights above the ellipsoid minus the log's own height of the geoid")
    if bare is None or "above_sea_m" in samples:
        return
    if lower is None:
        log.height_zero = "unknown"
        log.note(
            f"{unsaid.format('altitude', 'sea')}; for take-off heights set takeoff_above_sea_m = 0 in the camera's file"
        )
    else:
        apart_m = np.abs(np.interp(bare[:, 0], lower[:, 0], lower[:, 1]) - bare[:, 1])
        if len(known_m := apart_m[np.isfinite(apart_m)]) and known_m.max() < _ALIKE_M:
            return
        log.note(unsaid.format("altitude", "sea"))
    samples["above_sea_m"] = bare


def _split_flights(log: Log, samples: dict[str, np.ndarray]) -> None:
    """Split the log at jumps of its place: values between flights are unknown. Drop one or two stray places."""
    for pair, scale in ((("longitude_deg", "latitude_deg"), DEGREE_M), (("east_m", "north_m"), 1.0)):
        east, north = (samples.get(name, np.zeros((0, 3))) for name in pair)
        known = np.flatnonzero(np.isfinite(east[:, 1] + north[:, 1])) if len(east) == len(north) else np.zeros(0, int)
        if len(known) > 1:
            times, place = east[known, 0], np.stack([east[known, 1], north[known, 1]], axis=1) * scale
            if scale == DEGREE_M:
                place[:, 0] = np.unwrap(place[:, 0], period=360 * scale) * np.cos(np.radians(north[known[0], 1]))
            steps_s, away_m = np.diff(times), np.linalg.norm(np.diff(place, axis=0), axis=1)
            is_jump = away_m > np.maximum(JUMP_M, POSSIBLE["speed_m_s"][1] * steps_s)
            log.splits += (times[:-1] + np.minimum(steps_s / 2, SPLIT_S))[is_jump].tolist()
            flight = np.append(0, np.cumsum(is_jump))
            count = np.bincount(flight)[flight]
            east[known[(count <= _STRAY) & (count.max() > 2 * _STRAY)], 1] = np.nan
    if log.splits:
        times_s = ", ".join(f"{time_s:.1f}" for time_s in sorted(set(log.splits))[:5])
        log.note(
            f"the date or the place jumps after {times_s} s: these are several flights, and nothing is known between"
        )
        gaps = np.column_stack([log.splits, np.full((len(log.splits), 2), np.nan)])
        for name, rows in samples.items():
            rows = np.concatenate([rows, gaps])
            samples[name] = rows[np.unique(rows[:, 0], return_index=True)[1]]


def _note_altitude(log: Log, samples: dict[str, np.ndarray]) -> None:
    """Note a missing place or altitude, or an altitude below the ground."""
    if not {"latitude_deg", "east_m"} & set(samples) and log.kind != OWN:
        log.note("the log holds no place")
    if "altitude_m" not in samples:
        log.note("the log holds no altitude above ground")
        if "above_ellipsoid_m" in samples and "above_sea_m" not in samples:
            log.note("its heights count from the ellipsoid and do not give a height above ground")
        return
    deep = samples["altitude_m"][:, 1] < _DEEP_M
    if deep.any():
        _, value, where = samples["altitude_m"][deep.argmax()]
        log.note(
            f"{log.where} {where:.0f}: the altitude above ground is {value:g} m, below the ground; "
            f"{deep.sum()} of {len(deep)} are below {_DEEP_M:g} m; is its zero elsewhere?"
        )


def _note_silence(log: Log, samples: dict[str, np.ndarray]) -> None:
    """Note long pauses between the samples of the place."""
    for name in {"latitude_deg", "east_m"} & set(samples):
        times, values, _ = samples[name].T
        known = times[np.isfinite(values)]
        steps = np.diff(known)
        gaps = np.flatnonzero(steps > _longest_silence_s(times, log.bridge_s))
        if len(gaps):
            longest = gaps[np.argmax(steps[gaps])]
            log.note(
                f"{PAUSES[1]} in {len(gaps)} pause{'s' * (len(gaps) > 1)}; the longest begins at "
                f"{known[longest]:.1f} s and lasts {steps[longest]:.1f} s"
            )


def _longest_silence_s(known: np.ndarray, bridge_s: float) -> float:
    """Return the longest pause between samples over which a quantity is interpolated."""
    return max(1.5 * float(np.median(np.diff(known))), bridge_s) if len(known) > 1 else bridge_s


# --------------------------------------------------------------------------------------------------------------------
# Speed over ground from places, if a log does not have it.


def _speed_from_places(
    time_s: np.ndarray, place: np.ndarray, geographic: bool, splits: Sequence[float]
) -> tuple[np.ndarray, float]:
    """Return the slope of a line fitted to the places around each time, m/s, and the time span of the fit, s.

    time_s: (N,) rising. place: (N, 2) degrees or metres, NaN if unknown. The speed is NaN at unknown places, and if the
    places span too short a time. splits: times over which no line is fitted.
    """
    known = np.isfinite(place).all(axis=1)
    speed = np.full(len(time_s), np.nan)
    flight = np.searchsorted(np.sort(splits), time_s[known])
    times = time_s[known] - time_s[known][0]
    metres = place[known] - place[known][0]
    if geographic:
        metres[:, 0] = (metres[:, 0] + 180) % 360 - 180
        metres *= DEGREE_M * np.array([np.cos(np.radians(place[known][0, 1])), 1.0])
    wanted_s = min(_step_m(place[known], geographic) / _STEP_M_S, _MOST_S)
    half_s = max(wanted_s, _LEAST_S, 2.0 * float(np.median(np.diff(times))))
    low = np.maximum(np.searchsorted(times, times - half_s - 1e-6), np.searchsorted(flight, flight))
    high = np.minimum(np.searchsorted(times, times + half_s + 1e-6), np.searchsorted(flight, flight, "right"))
    count, span_s = high - low, times[high - 1] - times[low]
    # Sums over each span are differences of running sums.
    terms = np.column_stack([times, times**2, metres, metres * times[:, None]])
    running = np.vstack([np.zeros((1, 6)), np.cumsum(terms, axis=0)])
    total, squares, east, north, t_east, t_north = (running[high] - running[low]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = squares - total**2 / count
        slope = np.stack([t_east - total * east / count, t_north - total * north / count]) / spread
    speed[known] = np.where((count > 2) & (span_s >= 0.9 * wanted_s) & (spread > 1e-6), np.hypot(*slope), np.nan)
    return speed, 2 * half_s


def _step_m(place: np.ndarray, geographic: bool) -> float:
    """Return the step of the last written digit of the places, m."""
    metres, least = (DEGREE_M, _WANDER_M) if geographic else (1.0, 0.0)
    for digits in range(8):
        shifted = place * 10.0**digits
        if np.allclose(shifted, np.round(shifted), rtol=0, atol=1e-4):
            return max(metres * 10.0**-digits, least)
    return least
