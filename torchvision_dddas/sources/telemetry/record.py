"""From what a log says here and there to one record: in order, on common times, with notes of what is doubtful."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.sources.telemetry.pace import speed_from_places
from torchvision_dddas.types import Telemetry

QUANTITIES = (
    "altitude_m",
    "speed_m_s",
    "longitude_deg",
    "latitude_deg",
    "east_m",
    "north_m",
    "above_sea_m",
    "heading_rad",
    "pitch_rad",
    "roll_rad",
    "hfov_rad",
    "vehicle_heading_rad",
)
"""What a log may say; all but the place are columns of the record."""

OWN = "table"
"""The kind of our own tables, which may leave out what they like."""

# A barometer's zero drifts by metres in a flight; below this the altitude is none above ground.
_DEEP_M = -5.0
# What lies beyond these is damage, not flight.
_SANE = {"altitude_m": (-1e4, 1e5), "above_sea_m": (-1e4, 1e5), "speed_m_s": (0.0, 1e3), "hfov_rad": (1e-3, np.pi)}
# No sample for so many times the usual while, and for so long at least, is a gap: nothing is known within it.
_GAP_SHARE, _GAP_S = 10.0, 5.0
# With these alone nothing can be done.
_NOT_ALONE = {"speed_m_s", "hfov_rad", "vehicle_heading_rad"}
_TURNING = ("heading_rad", "roll_rad", "vehicle_heading_rad")
_FULL = {"longitude_deg": 360.0} | dict.fromkeys(_TURNING, 2 * np.pi)


@dataclass
class Log:
    """What was read so far. path: of the file. kind: in words, for messages. where: what samples are counted in.

    bridge_s: how long a column may be silent beside others and still be taken to go on; 0 where silence means unknown.
    jitter_s: how far time may run back; more is another recording, or damage.
    said: time, value and place in the file of what was said of each quantity. moments: time and place of the rows of
    a log that says everything at once, whether or not there was anything to say. columns: (N, 3), as in said.
    """

    path: Path
    kind: str
    where: str = "line"
    bridge_s: float = 0.0
    jitter_s: float = 1.0
    notes: list[str] = field(default_factory=list)
    said: dict[str, list[tuple[float, float, int]]] = field(default_factory=dict)
    moments: list[tuple[float, int]] = field(default_factory=list)
    columns: dict[str, np.ndarray] = field(default_factory=dict)

    def say(self, quantity: str, time_s: float, value: float, where: int) -> None:
        """One value at a time; NaN says that it is unknown from here on. where: the line, or what `where` names."""
        self.said.setdefault(quantity, []).append((time_s, value, where))

    def say_all(self, quantity: str, times: np.ndarray, values: np.ndarray, where: np.ndarray) -> None:
        """Many at once."""
        self.columns[quantity] = np.stack([times, values, where], axis=1).astype(float)

    def note(self, text: str) -> None:
        """What the user should know, once."""
        if text not in self.notes:
            self.notes.append(text)

    def refuse(self, text: str, where: int | None = None) -> InputError:
        """The error to raise, with the file and the place."""
        place = f", {self.where} {where}" if where is not None else ""
        return InputError(f"telemetry {self.path}{place}: {text}")


def assembled(log: Log, clock_offset_s: float = 0.0, start_utc_s: float = float("nan")) -> Telemetry:
    """One row a moment at which anything was said; every column linear between what was said of it.

    start_utc_s: seconds since 1970 at the log's own time 0.
    Raises InputError where neither altitude, place nor attitude is known, where a place is off the globe, and where
    time runs back.
    """
    rows_of = {name: np.array(rows, float).reshape(-1, 3) for name, rows in log.said.items()} | log.columns
    said = {name: _in_order(log, rows) for name, rows in rows_of.items()}
    moments = _in_order(log, np.insert(np.array(log.moments, float).reshape(-1, 2), 1, 0.0, axis=1))
    _sane(log, said)
    _on_the_globe(log, said)
    said = {name: rows for name, rows in said.items() if np.isfinite(rows[:, 1]).any()}
    if not set(said) - _NOT_ALONE:
        raise log.refuse(f"nothing in it ({log.kind}) tells a place, an altitude or how a camera looks")
    _note_lacks(log, said)
    _note_silence(log, said)
    times = _with_gaps(log, np.unique(np.concatenate([moments[:, 0], *(rows[:, 0] for rows in said.values())])))
    columns = {name: _column(times, rows, log.bridge_s, _FULL.get(name)) for name, rows in said.items()}
    for name in _TURNING:
        if name in columns:
            around = np.pi if name == "roll_rad" else 0.0
            columns[name] = (columns[name] + around) % (2 * np.pi) - around
    unknown = np.full(len(times), np.nan)
    geographic = "longitude_deg" in said or "east_m" not in said
    pair = ("longitude_deg", "latitude_deg") if geographic else ("east_m", "north_m")
    place = np.stack([columns.get(name, unknown) for name in pair], axis=1)
    place[~np.isfinite(place).all(axis=1)] = np.nan
    if "speed_m_s" not in columns and np.isfinite(place).all(axis=1).sum() > 2:
        columns["speed_m_s"], span_s = speed_from_places(times, place, geographic)
        if np.isfinite(columns["speed_m_s"]).any():
            log.note(f"the speed is that of the places, smoothed over {span_s:.1f} s")
    return Telemetry(
        times + clock_offset_s,
        columns.get("altitude_m", unknown),
        columns.get("speed_m_s", unknown),
        place,
        geographic,
        **{name: columns.get(name, unknown) for name in (*_TURNING, "above_sea_m", "pitch_rad", "hfov_rad")},
        start_utc_s=start_utc_s - clock_offset_s,
        origin=f"{log.path.name} ({log.kind})",
        notes=tuple(log.notes),
    )


def _in_order(log: Log, rows: np.ndarray) -> np.ndarray:
    """Sorted by time; of samples at the same time the last. A single time that no other goes with is left out."""
    rows = rows[np.isfinite(rows[:, 0])]
    rows = rows[~_stray(rows[:, 0], log.jitter_s)]
    back = np.diff(rows[:, 0])
    if len(back) and back.min() < -log.jitter_s:
        i = int(np.argmax(back < -log.jitter_s))
        raise log.refuse(
            f"time runs back from {rows[i, 0]:.3f} to {rows[i + 1, 0]:.3f} s; are these two recordings in one file?",
            int(rows[i + 1, 2]),
        )
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return rows[np.append(np.diff(rows[:, 0]) > 0, True)] if len(rows) else rows


def _stray(times: np.ndarray, jitter_s: float) -> np.ndarray:
    """Which times are out of order though those around them are not: a damaged one, not another recording."""
    stray = np.zeros(len(times), bool)
    if len(times) < 3 or not np.isfinite(jitter_s):
        return stray
    before, after = times[:-2], times[2:]
    around = (before <= after) & ((times[1:-1] < before - jitter_s) | (times[1:-1] > after + jitter_s))
    stray[1:-1] = around
    stray[0] = times[0] > times[1] + jitter_s and times[1] <= times[2]
    stray[-1] = times[-1] < times[-2] - jitter_s and times[-3] <= times[-2]
    # A day without a sample, then one: its time is damaged.
    stray[-1] |= times[-1] > times[-2] + 86_400
    return stray


def _sane(log: Log, said: dict[str, np.ndarray]) -> None:
    """What cannot be is unknown."""
    for name, (least, most) in _SANE.items():
        if name in said:
            rows = said[name]
            with np.errstate(invalid="ignore"):
                wrong = ~((rows[:, 1] >= least) & (rows[:, 1] <= most)) & ~np.isnan(rows[:, 1])
            if wrong.any():
                _, value, where = rows[np.argmax(wrong)]
                log.note(f"{log.where} {int(where)}: {name} is {value:g}, which cannot be; {wrong.sum()} left out")
                rows[wrong, 1] = np.nan


def _on_the_globe(log: Log, said: dict[str, np.ndarray]) -> None:
    """Raises InputError for degrees that are none; longitude and latitude 0 stand for no fix."""
    for name, most in (("latitude_deg", 90.0), ("longitude_deg", 180.0)):
        if name not in said:
            continue
        wrong = np.abs(said[name][:, 1]) > most
        if wrong.any():
            _, value, where = said[name][np.argmax(wrong)]
            hint = "; are longitude and latitude swapped?" if name == "latitude_deg" and abs(value) <= 180 else ""
            raise log.refuse(f"{name} is {value:g}; wanted -{most:g} to {most:g}{hint}", int(where))
    if {"longitude_deg", "latitude_deg"} <= set(said):
        longitude, latitude = said["longitude_deg"], said["latitude_deg"]
        if len(longitude) == len(latitude):
            nowhere = (longitude[:, 1] == 0) & (latitude[:, 1] == 0)
            longitude[nowhere, 1] = latitude[nowhere, 1] = np.nan
            if nowhere.any():
                log.note(f"{nowhere.sum()} of {len(nowhere)} places are 0, 0: no fix; unknown there")


def _note_lacks(log: Log, said: dict[str, np.ndarray]) -> None:
    if not {"latitude_deg", "east_m"} & set(said) and log.kind != OWN:
        log.note("no place is told anywhere")
    if "altitude_m" not in said:
        log.note("no altitude above ground is told anywhere")
        return
    deep = said["altitude_m"][:, 1] < _DEEP_M
    if deep.any():
        _, value, where = said["altitude_m"][np.argmax(deep)]
        log.note(
            f"{log.where} {int(where)}: the altitude above ground is {value:g} m, below the ground; "
            f"{deep.sum()} of {len(deep)} are below {_DEEP_M:g} m; is it counted from another place?"
        )


def _with_gaps(log: Log, times: np.ndarray) -> np.ndarray:
    """The times, and one more within each gap, where nothing is known."""
    if len(times) < 6:
        return times
    steps = np.diff(times)
    most = max(_GAP_SHARE * float(np.median(steps)), _GAP_S, log.bridge_s)
    gaps = np.flatnonzero(steps > most)
    if len(gaps):
        first = gaps[0]
        log.note(
            f"{len(gaps)} gap{'s' * (len(gaps) > 1)} of more than {most:.1f} s without samples, the first after "
            f"{times[first]:.1f} s for {steps[first]:.1f} s: nothing is known within"
        )
    return np.sort(np.concatenate([times, (times[gaps] + times[gaps + 1]) / 2]))


def _most_s(known: np.ndarray, bridge_s: float) -> float:
    """How long a quantity may be silent and still be taken to go on evenly."""
    return max(1.5 * float(np.median(np.diff(known))), bridge_s) if len(known) > 1 else bridge_s


def _note_silence(log: Log, said: dict[str, np.ndarray]) -> None:
    """Where the place is unknown for a while between its samples."""
    for name in ("latitude_deg", "east_m"):
        known = said[name][np.isfinite(said[name][:, 1]), 0] if name in said else np.zeros(0)
        steps = np.diff(known)
        gaps = np.flatnonzero(steps > _most_s(said[name][:, 0], log.bridge_s)) if len(steps) else steps
        if len(gaps):
            longest = gaps[np.argmax(steps[gaps])]
            log.note(
                f"the place is unknown for a while {len(gaps)} time{'s' * (len(gaps) > 1)}, the longest for "
                f"{steps[longest]:.1f} s after {known[longest]:.1f} s"
            )


def _column(times: np.ndarray, rows: np.ndarray, bridge_s: float, full: float | None) -> np.ndarray:
    """What was said of one quantity, at all times: linear between two samples that are near each other, else unknown.

    A column that is sampled more rarely than others goes on between its samples; one that falls silent does not.
    """
    known, values = rows[:, 0], rows[:, 1]
    if len(known) == len(times) and np.array_equal(known, times):
        return values
    steps = np.diff(known)
    if len(steps) == 0:
        return np.where(times == known[0], values[0], np.nan)
    most = _most_s(known, bridge_s)
    after = np.searchsorted(known, times).clip(1, len(known) - 1)
    before = after - 1
    share = (times - known[before]) / steps[before]
    way = values[after] - values[before]
    if full is not None:
        way = (way + full / 2) % full - full / 2
    found = values[before] + share * way
    # Outside its span a column holds for as long as it may be silent, and on a sample it is what was said there.
    found = np.where(share < 0, values[before], np.where(share > 1, values[after], found))
    outside = np.maximum(known[0] - times, times - known[-1])
    found[(outside > 0) & (outside > bridge_s)] = np.nan
    found[(outside <= 0) & (steps[before] > most) & (share > 0) & (share < 1)] = np.nan
    found = np.where(share == 0, values[before], np.where(share == 1, values[after], found))
    if full == 360.0:
        return (found + 180) % 360 - 180
    return found
