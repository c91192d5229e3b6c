"""Times in flight logs: dates in any order, clocks of 12 and 24 hours, durations, numbers since a start or 1970."""

import math
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from functools import lru_cache
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.tables import parse_numbers
from torchvision_dddas.io.telemetry.fields import POSSIBLE, Known
from torchvision_dddas.io.telemetry.record import Log

UNKNOWN_ZONE = "the dates are in an unknown time zone, so the clock is not known; aerial.time_zone tells it"
"""The note on a log whose dates say no zone."""

_DAY_S = 86_400.0
_DAY_FORM = r"(\d{1,4})[./-](\d{1,2})[./-](\d{1,4})"
_CLOCK_FORM = (
    r"(\d{1,2}):(\d{1,2})(?::(\d{1,2}))?(?:[.,:](\d{1,9}))?(?:[.,:](\d{1,3}))?(?:[.,:]\d{1,3})*"
    r"(?: ?([AaPp])\.?[Mm]\.?)?(?: ?(Z|UTC|GMT|[+-]\d{2}:?\d{2}))?"
)
_DATE, _DAY = re.compile(f"{_DAY_FORM}[ T,]+{_CLOCK_FORM}"), re.compile(_DAY_FORM)
_CLOCK = re.compile(rf"(?=\d+:\d+:|.*[AaPp]){_CLOCK_FORM}")  # 12:05.3 are minutes and seconds
_SPAN = re.compile(
    r"(?:(\d{1,6}) ?h\w* ?)?(?:(\d{1,6}) ?m\w* ?)?(?:(\d{1,6}(?:[.,]\d{1,9})?) ?s\w*)?"
    r"|(?:(\d{1,6}):)?(\d{1,6}):(\d{1,6}(?:[.,]\d{1,9})?)"
)
# From 2001 to 2100: an earlier clock was never set.
_SINCE_1970 = (1e9, 4.1e9)
# A larger number is no time of a log, since its start or since 1970.
_LONGEST_S = 1e10
# How far the rows of a flight log may be apart.
_STEP_S = (0.002, 10.0)
_SCALES = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}


def parse_date(text: str, day_first: bool = False) -> tuple[float, bool] | None:
    """Seconds since 1970 of the first date with a time in a text, and whether it has a zone; else UTC is assumed.

    None without a date. Fractions come as `.123`, as `,123` or as milli- and microseconds, `,774,808`. day_first: in
    dates that end with the year; in those with dots the day always comes first.
    """
    found = _DATE.search(text)
    if found is None:
        return None
    *parts, zone = found.groups(default="")
    seconds = midnight_s(*parts[:3], day_first or "." in found[0][:3]) + _clock_s(*parts[3:])
    if zone[:1] in ("+", "-"):
        away = timedelta(hours=int(zone[1:3]), minutes=int(zone[-2:])).total_seconds()
        seconds -= math.copysign(away, float(zone[0] + "1"))
    return (seconds, bool(zone)) if math.isfinite(seconds) else None


@lru_cache(maxsize=100)
def midnight_s(first: str, second: str, third: str, day_first: bool = False) -> float:
    """Seconds from 1970 to a date, of which the year has four digits; NaN if it is none."""
    last = (third, second, first) if day_first else (third, first, second)
    year, month, day = (first, second, third) if len(first) == 4 else last
    try:
        return datetime(int(year), int(month), int(day), tzinfo=UTC).timestamp() if len(year) == 4 else math.nan
    except (ValueError, OverflowError):
        return math.nan


def _clock_s(hour: str, minute: str, second: str, fraction: str, micro: str, half: str) -> float:
    """Seconds since midnight, NaN if there are none such. half: a or p of a clock of 12 hours."""
    hours, minutes, seconds = int(hour), int(minute), int(second or 0)
    if hours > (12 if half else 23) or minutes > 59 or seconds > 60:
        return math.nan
    hours = hours % 12 + 12 * (half in "pP") if half else hours
    return hours * 3600 + minutes * 60 + seconds + float(f"0.{fraction}{micro if len(fraction) == 3 else ''}0")


def parse_time_zone(text: str) -> tzinfo | None:
    """The zone of a name, Europe/Berlin, or of hours from UTC, +02:00; None for "". Raises InputError otherwise."""
    text = text.strip()
    if not text:
        return None
    if found := re.fullmatch(r"([+-])(\d{1,2})(?::?([0-5]\d))?", text):
        away = timedelta(hours=int(found[2]), minutes=int(found[3] or 0))
        if away < timedelta(hours=24):
            return timezone(-away if found[1] == "-" else away)
    try:
        return ZoneInfo(text)
    except (KeyError, ValueError, OSError):
        raise InputError(
            f"aerial.time_zone '{text[:40]}' is not known; wanted a name such as Europe/Berlin, or hours from UTC such "
            "as +02:00"
        ) from None


def to_utc(local_s: float, zone: tzinfo) -> float:
    """Seconds since 1970 of a date in a time zone that `parse_date` has taken for UTC."""
    moment = datetime.fromtimestamp(local_s, UTC).replace(tzinfo=zone)
    return local_s - (moment.utcoffset() or timedelta()).total_seconds()


# --------------------------------------------------------------------------------------------------------------------
# Columns of times.


class TimeColumn(NamedTuple):
    """A column of times. values: (N,), NaN where there is none. scale: to seconds, NaN if it is not known.

    kind: "number" or "span"; "date" for what counts from 1970, "day" without a time, "clock" without a day. is_utc:
    whether it is in UTC. is_sure: whether the order of day and month, or the unit, is known. remark: what is assumed.
    """

    title: str
    values: np.ndarray
    kind: str
    scale: float = 1.0
    is_utc: bool = False
    is_sure: bool = True
    remark: str = ""


def read_times(title: str, cells: Sequence[str], known: Known) -> TimeColumn:
    """Read a column of times. known: what its name means."""
    numbers = parse_numbers(cells)
    is_number = np.isfinite(numbers)
    if is_number.any() and 2 * is_number.sum() >= len(cells) - cells.count(""):
        return TimeColumn(title, np.where(is_number, numbers, np.nan), "number", known.scale)
    day_first, is_sure = _day_order({found[0] for cell in cells if (found := _DAY.match(cell))})
    forms = {"date": _DATE.search, "day": _DAY.fullmatch, "clock": _CLOCK.fullmatch, "span": _SPAN.fullmatch}
    kinds = (kind for cell in cells if cell for kind, parse in forms.items() if parse(cell))
    kind = next(kinds, "span")
    values, is_utc = np.full(len(cells), np.nan), known.is_utc
    for place, cell in enumerate(cells):
        if kind == "date":
            if (date := parse_date(cell, day_first)) is not None:
                values[place], is_utc = date[0], is_utc or date[1]
        elif cell and (found := forms[kind](cell)) is not None:
            if kind == "day":
                values[place] = midnight_s(*found.groups(), day_first or "." in cell)
            elif kind == "clock":
                values[place] = _clock_s(*found.groups(default="")[:6])
            else:
                parts = zip(found.groups(default="0"), (3600.0, 60.0, 1.0) * 2, strict=True)
                values[place] = sum(float(part.replace(",", ".")) * each_s for part, each_s in parts)
    return TimeColumn(title, values, kind, 1.0, is_utc, is_sure)


def _day_order(dates: Iterable[str]) -> tuple[bool, bool]:
    """Whether the day comes first in dates that end with the year, and whether that is known."""
    parts = [part for date in dates if len((part := re.split(r"[./-]", date))[0]) != 4 and "." not in date]
    first, second = ({int(part[place]) for part in parts} for place in (0, 1))
    if max([*first, *second], default=0) > 12:
        return max(first) > 12, True
    # Within a flight the day changes and not the month.
    return len(first) > len(second), len(first) != len(second) or first == second


def settle_times(
    log: Log, columns: Sequence[TimeColumn], step_m: float, zone: tzinfo | None
) -> tuple[np.ndarray, float, list[str]]:
    """Seconds since the first time, (N,), NaN where there is none; when that was since 1970; the columns that tell it.

    The finest times that do not run back tell the seconds, dates the clock. step_m: how far the vehicle goes in a row.
    zone: of dates that say none. Raises InputError where the unit of all times is unknown.
    """
    day = next((one for one in columns if one.kind == "day"), None)
    whole = [one for one in columns if one.kind != "day"]
    if day is not None:
        for place, one in enumerate(whole):
            if one.kind == "clock":
                values, is_utc = day.values + one.values, day.is_utc or one.is_utc
                whole[place] = one._replace(values=values, kind="date", is_utc=is_utc, is_sure=day.is_sure)
    dated = (one.values[np.isfinite(one.values)] for one in whole if one.kind == "date")
    span_s = max((float(np.ptp(known)) for known in dated if len(known)), default=0.0)
    settled = [_in_seconds(one, step_m, span_s) for one in whole]
    chosen = min(settled, key=_rank) if settled else columns[0]._replace(values=columns[0].values * math.nan)
    known = np.flatnonzero(np.isfinite(chosen.values))
    if not len(known):
        return chosen.values, math.nan, []
    if chosen.kind == "number" and not chosen.is_sure:
        raise log.refuse(chosen.remark)
    if chosen.remark:
        log.note(chosen.remark)
    if 2 * len(np.unique(chosen.values[known])) < len(known):
        log.note(f"of the rows with the same '{chosen.title}' only the last counts")
    time_s = chosen.values - chosen.values[known[0]]
    clocks = [one for one in settled if one.kind == "date" and np.isfinite(one.values + time_s).any()]
    if not clocks:
        return time_s, math.nan, [chosen.title]
    clock = min(clocks, key=lambda one: (not one.is_utc, not one.is_sure, one is not chosen))
    titles = [chosen.title, clock.title, *([] if day is None else [day.title])]
    return time_s, _start_s(log, clock, time_s, zone), titles


def _rank(one: TimeColumn) -> tuple[bool, int]:
    """The lowest is best: whole columns of times that do not run back, then the most different ones."""
    known = one.values[np.isfinite(one.values)]
    back = int((known < np.maximum.accumulate(known) - 1.0).sum()) if len(known) else 0
    is_open = one.kind == "number" and not one.is_sure
    return is_open or 2 * len(known) < len(one.values) or back > 2 + len(known) // 100, -len(np.unique(known))


def _in_seconds(one: TimeColumn, step_m: float, span_s: float) -> TimeColumn:
    """A column in seconds. span_s: that of the dates of the same rows, 0 where there are none."""
    known = one.values[np.isfinite(one.values)]
    if one.kind == "clock":  # time goes on over midnight
        return one._replace(values=one.values + _DAY_S * np.cumsum(np.diff(one.values, prepend=math.nan) < -_DAY_S / 2))
    if one.kind != "number" or not len(known):
        return one
    steps = np.diff(known)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else math.nan
    scale, length, middle = one.scale, float(np.ptp(known)), float(np.median(known))
    # A step of hours or of microseconds shows that the values have another unit than the name.
    if math.isnan(scale) or step * scale > 3600 or step * scale < 1e-5:
        since = [n for n, s in _SCALES.items() if _SINCE_1970[0] < middle * s < _SINCE_1970[1]]
        near = [n for n, s in _SCALES.items() if span_s > 2 and abs(length * s - span_s) < max(1.5, 0.1 * span_s)]
        low, high = max(_STEP_S[0], step_m / POSSIBLE["speed_m_s"][1] if step_m > 0 else 0.0), _STEP_S[1]
        fit = [n for n, s in _SCALES.items() if low <= step * s <= high]
        names = near or [name for name in fit if name in since] or fit or since or ["seconds"]
        name = "seconds" if "seconds" in names else names[0]
        scale = _SCALES[name]
        if len(names) > 1 and name != "seconds":
            what = f"'{one.title}' steps by {step:g}, which may be {' or '.join(names)}"
            one = one._replace(is_sure=False, remark=f"{what}; wanted a name with the unit, as time_ms")
        elif len(names) > 1 or (name != "seconds" and name not in since):
            one = one._replace(remark=f"'{one.title}' is taken to be in {name}, by its steps of {step:g}")
    is_date = bool(_SINCE_1970[0] < middle * scale < _SINCE_1970[1])
    values = np.where(np.abs(one.values * scale) < _LONGEST_S, one.values * scale, math.nan)
    return one._replace(values=values, kind="date" if is_date else "number", is_utc=is_date)


def _start_s(log: Log, clock: TimeColumn, time_s: np.ndarray, zone: tzinfo | None) -> float:
    """Seconds since 1970 at time 0, NaN with a note if it is not known."""
    apart = (clock.values - time_s)[np.isfinite(clock.values + time_s)]
    is_whole = bool((clock.values[np.isfinite(clock.values)] % 1 == 0).all())  # rounded down
    start_s = float(apart[:100].max() if is_whole else np.median(apart[:100]))
    drift_s = float(apart[-1]) - start_s
    if abs(drift_s) > 2.0 + 0.02 * float(np.nanmax(time_s)):
        log.note(f"the dates of '{clock.title}' and the seconds of the log part by {drift_s:+.1f} s until its end")
    if not clock.is_sure:
        log.note(f"'{clock.title}' does not show whether day or month comes first, so the clock is not known")
    elif not _SINCE_1970[0] < start_s < _SINCE_1970[1]:
        log.note(f"'{clock.title}' is a clock of the year {1970 + start_s / 31_556_952:.0f}, which cannot be: not used")
    elif clock.is_utc or zone is not None:
        return start_s if clock.is_utc or zone is None else to_utc(start_s, zone)
    else:
        log.start_local_s = start_s
        log.note(UNKNOWN_ZONE)
    return math.nan
