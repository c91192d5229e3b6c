"""From what a log says here and there to one record on common times."""

import numpy as np

from torchvision_dddas.io.telemetry.checks import (
    in_order,
    longest_silence_s,
    note_lacks,
    note_silence,
    on_the_globe,
    sane,
)
from torchvision_dddas.io.telemetry.ground_speed import speed_from_places
from torchvision_dddas.io.telemetry.log import Log
from torchvision_dddas.types import Telemetry

# No sample for so many times the usual while, and for so long at least, is a gap: nothing is known within it.
_GAP_SHARE, _GAP_S = 10.0, 5.0
# With these alone nothing can be done.
_NOT_ALONE = {"speed_m_s", "hfov_rad", "vehicle_heading_rad"}
_TURNING = ("heading_rad", "roll_rad", "vehicle_heading_rad")
_FULL = {"longitude_deg": 360.0} | dict.fromkeys(_TURNING, 2 * np.pi)


def assembled(
    log: Log, clock_offset_s: float = 0.0, start_utc_s: float = float("nan"), from_first: bool = False
) -> Telemetry:
    """One row a moment at which anything was said; every column linear between what was said of it.

    start_utc_s: seconds since 1970 at the log's own time 0. from_first: whether the record's times are to begin with 0
    where the log's do not.
    Raises InputError where neither altitude, place nor attitude is known, where a place is off the globe, and where
    time runs back.
    """
    rows_of = {name: np.array(rows, float).reshape(-1, 3) for name, rows in log.said.items()} | log.columns
    said = {name: in_order(log, rows) for name, rows in rows_of.items()}
    moments = in_order(log, np.insert(np.array(log.moments, float).reshape(-1, 2), 1, 0.0, axis=1))
    start = min((rows[0, 0] for rows in (*said.values(), moments) if len(rows)), default=0.0) if from_first else 0.0
    for rows in (*said.values(), moments):
        rows[:, 0] -= start
    sane(log, said)
    on_the_globe(log, said)
    said = {name: rows for name, rows in said.items() if np.isfinite(rows[:, 1]).any()}
    if not set(said) - _NOT_ALONE:
        raise log.refuse(f"nothing in it ({log.kind}) tells a place, an altitude or how a camera looks")
    note_lacks(log, said)
    note_silence(log, said)
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
        start_utc_s=float(start_utc_s + start - clock_offset_s),
        origin=f"{log.path.name} ({log.kind})",
        notes=tuple(log.notes),
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
    most = longest_silence_s(known, bridge_s)
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
