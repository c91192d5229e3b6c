"""Read times of flight logs: dates in any order, 12- and 24-hour clocks, durations, seconds since a start or 1970."""

import math
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.tables import parse_numbers
from torchvision_dddas.io.telemetry.fields import POSSIBLE, UNITS, Known
from torchvision_dddas.io.telemetry.record import SPLIT_S, Log, is_clock

UNKNOWN_ZONE = "the dates are in an unknown time zone, so the clock is not known; set aerial.time_zone"
"""The note on a log whose dates have no zone."""

_DAY_S = 86_400.0
_DAY_FORM = r"(\d{1,4})[./-](\d{1,2})[./-](\d{1,4})"
_CLOCK_FORM = (
    r"(\d{1,2}):(\d{1,2})(?::(\d{1,2}))?(?:[.,:](\d{1,9}))?(?:[.,:](\d{1,3}))?(?:[.,:]\d{1,3})*"
    r"(?: ?([AaPp])\.?[Mm]\.?)?(?: ?((?:Z|UTC|GMT)?[+-]\d{1,2}(?::?\d{2})?(?![\d.,:°])|[A-Z]{1,5}(?![A-Za-z])))?"
)
_DATE, _DAY = re.compile(f"{_DAY_FORM}[ T,]+{_CLOCK_FORM}"), re.compile(_DAY_FORM)
_CLOCK = re.compile(rf"(?=\d+:\d+:|.*[AaPp]){_CLOCK_FORM}")  # 12:05.3 are minutes and seconds
_SPAN = re.compile(r"(?:(\d{1,6}):)?(\d{1,6}):(\d{1,6}(?:[.,]\d{1,9})?)")
_UNIT_SPAN = re.compile(r"([-+]?\d{1,9}(?:[.,]\d{1,9})?) ?([a-zµ'\"]{1,12})[ ,]{0,3}")
_SPAN_UNITS = UNITS["time"] | {"m": 60.0, "'": 60.0, "d": 86_400.0, "day": 86_400.0, "days": 86_400.0, '"': 1.0}
# Hours from UTC of unambiguous zone names; CST, IST and BST are ambiguous.
_NAMED = "PST-8 PDT-7 MST-7 MDT-6 EST-5 EDT-4 Z+0 UTC+0 GMT+0 CET+1 CEST+2 EET+2 EEST+3 MSK+3 JST+9 KST+9 AEST+10"
_ZONES = {re.sub(r"[-+].*", "", zone): int(re.sub(r"[A-Z]", "", zone)) for zone in _NAMED.split()}
# Other forms of dates: as in EXIF, without separators, or with the name of the month.
_MONTHS = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
_MONTH = rf"({'|'.join(_MONTHS)})[a-z]{{0,6}}\.?"
_ODD_DATE = re.compile(
    r"(?<![\d:.])(?:(\d{4}):(\d\d):(\d\d)(?=[ T]\d)"
    r"|(20\d\d)([01]\d)([0-3]\d)(?=$|\.0*$|[ T_-]?[0-2]\d:?\d)"
    r"(?:[ T_-]?([0-2]\d):?([0-5]\d):?([0-6]\d)\.?(\d{0,9})(?!\d))?"
    rf"|(\d{{1,2}})[ .-]?{_MONTH}[ ,.-]{{1,2}}(\d{{4}}|\d\d)(?!\d)"
    rf"|{_MONTH} +(\d{{1,2}}),? +(?:(\d{{1,2}}:[\d:.]{{2,15}}) +)?(\d{{4}})(?!\d))",
    re.IGNORECASE,
)
_DIGITS = re.compile(r"([01]?\d|2[0-3])([0-5]\d)([0-5]\d)(?:\.?(\d*))")  # hours, minutes and seconds in one number
# From 2001 to 2100: an earlier value comes from a clock that was never set.
_SINCE_1970 = (1e9, 4.1e9)
# A larger number is not a time of a log, neither since its start nor since 1970.
_LONGEST_S = 1e10
# Limits for a flight log: step between rows in seconds, and number of days.
_STEP_S, _DAYS = (0.002, 10.0), 2
_SCALES = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9, "days": _DAY_S}
# The beginning of 1970 in days: of spreadsheets, MATLAB, Julian days and modified Julian days.
_EPOCHS = (25_569.0, 719_529.0, 2_440_587.5, 40_587.0, 0.0)
DATE_JUMP_S, _MOST_FLIGHTS = 10.0, 50  # a larger difference of dates and times marks another flight
# Rows are spread if at least this share repeats the time above, and times are multiples of at least this step.
_MORE, _TICK_S = 0.1, 0.1


def parse_dates(texts: Sequence[str]) -> tuple[list[tuple[float, bool] | None], bool, str]:
    """Return the first date with a time in each text: seconds since 1970, and whether its zone is given (else UTC).

    A text without a date gives None. Also return whether the order of day and month is known, and the assumption about
    years. Fractions have the form `.123`, `,123`, or milli- and microseconds, `,774,808`. In dates with dots, the day
    comes before the month.
    """
    if any(map(_ODD_DATE.search, texts[:5])):
        texts = [_ODD_DATE.sub(_usual_date, text) for text in texts]
    found = [_DATE.search(text) for text in texts]
    days = {one[0] for one in (one and _DAY.match(one[0]) for one in found) if one}
    day_first, is_sure = _day_order(days)
    dates: list[tuple[float, bool] | None] = []
    for one in found:
        *parts, zone = one.groups(default="") if one else [""] * 10
        seconds = midnight_s(*parts[:3], day_first or "." in one[0][:3]) + _clock_s(*parts[3:]) if one else math.nan
        away_s = _zone_s(zone) if zone else None
        dates.append((seconds - (away_s or 0.0), away_s is not None) if math.isfinite(seconds) else None)
    is_short = any(re.fullmatch(r"\d\d?\D\d\d?\D\d\d", day) for day in days)
    return dates, is_sure, "years of two digits are assumed to come last" * is_short


def _usual_date(found: re.Match[str]) -> str:
    """Return a match of `_ODD_DATE` in the form 2022-08-26 18:12:57."""
    part = found.groups(default="")
    forms = ([part[k] for k in places] for places in ((0, 1, 2), (3, 4, 5), (12, 11, 10), (16, 13, 14)))
    year, month, day = next(filter(all, forms))
    month = f"{_MONTHS.index(month.lower()) + 1}" if month.lower() in _MONTHS else month
    clock = f"{part[6]}:{part[7]}:{part[8]}.{part[9]}0" if part[6] else part[15]
    return f"{'20' * (len(year) == 2)}{year}-{month}-{day} {clock}".rstrip()


def _zone_s(zone: str) -> float | None:
    """Return the seconds from UTC of `+02:00`, `UTC+2` or `CEST`; None for an unknown or empty name."""
    if found := re.fullmatch(r"(?:Z|UTC|GMT)?([+-])([01]?\d)(?::?([0-5]\d))?", zone):
        return float(f"{found[1]}{int(found[2]) * 3600 + int(found[3] or 0) * 60}")
    return 3600.0 * _ZONES[zone] if zone in _ZONES else None


@lru_cache(maxsize=100)
def midnight_s(first: str, second: str, third: str, day_first: bool = False) -> float:
    """Return the seconds from 1970 to a date, NaN if invalid. A two-digit year comes last, in this century."""
    last = (third, second, first) if day_first else (third, first, second)
    year, month, day = (first, second, third) if len(first) == 4 else last
    try:
        year = "20" + year if len(year) == 2 else year
        return datetime(int(year), int(month), int(day), tzinfo=UTC).timestamp() if len(year) == 4 else math.nan
    except (ValueError, OverflowError):
        return math.nan


def _clock_s(hour: str, minute: str, second: str, fraction: str, micro: str, half: str) -> float:
    """Return the seconds since midnight, NaN if invalid. half: a or p of a 12-hour clock."""
    hours, minutes, seconds = int(hour), int(minute), int(second or 0)
    if hours > (12 if half else 23) or minutes > 59 or seconds > 60:
        return math.nan
    hours = hours % 12 + 12 * (half in "pP") if half else hours
    return hours * 3600 + minutes * 60 + seconds + float(f"0.{fraction}{micro if len(fraction) == 3 else ''}0")


def parse_time_zone(text: str) -> tzinfo | None:
    """Return the zone of a name, Europe/Berlin, or hours from UTC, +02:00; None for "". Raise InputError for others."""
    text = text.strip()
    if not text:
        return None
    if (away_s := _zone_s(text)) is not None:
        return timezone(timedelta(seconds=away_s))
    try:
        return ZoneInfo(text)
    except (KeyError, ValueError, OSError):
        raise InputError(
            f"aerial.time_zone '{text[:40]}' is not known; wanted a name such as Europe/Berlin, or hours from UTC such "
            "as +02:00"
        ) from None


def to_utc(local_s: float, zone: tzinfo) -> float:
    """Return the seconds since 1970 of a date in a time zone. local_s: the seconds of the same date in UTC."""
    moment = datetime.fromtimestamp(local_s, UTC).replace(tzinfo=zone)
    return local_s - (moment.utcoffset() or timedelta()).total_seconds()


# --------------------------------------------------------------------------------------------------------------------
# Columns of times.


class TimeColumn(NamedTuple):
    """A column of times. values: (N,), NaN if missing. scale: factor to seconds, NaN if unknown.

    kind: "number" or "span"; "date" for times since 1970, "day" without a time, "clock" without a day. is_utc: whether
    times are in UTC. is_sure: whether the order of day and month, or the unit, is known. remark: the assumption made.
    """

    title: str
    values: np.ndarray
    kind: str
    scale: float = 1.0
    is_utc: bool = False
    is_sure: bool = True
    remark: str = ""


def read_times(title: str, cells: Sequence[str], known: Known) -> TimeColumn:
    """Read a column of times. known: the meaning of its name."""
    numbers = parse_numbers(cells)
    is_number = np.isfinite(numbers)
    if is_number.any() and 2 * is_number.sum() >= len(cells) - cells.count(""):
        is_utc = known.is_utc or "utc" in title.lower()
        spelled = _spelled(cells, is_utc) if math.isnan(known.scale) else None
        if spelled is None:
            return TimeColumn(title, np.where(is_number, numbers, np.nan), "number", known.scale, known.is_utc)
        cells = spelled
    elif any(map(_ODD_DATE.search, cells[:5])):
        cells = [_ODD_DATE.sub(_usual_date, cell) for cell in cells]
    forms = {"date": _DATE.search, "day": _DAY.fullmatch, "clock": _CLOCK.fullmatch}
    kind = next((kind for cell in cells if cell for kind, parse in forms.items() if parse(cell)), "span")
    is_utc, is_sure, remark = known.is_utc, True, ""
    if kind in ("date", "day"):
        dates, is_sure, remark = parse_dates([f"{cell} 0:0" for cell in cells] if kind == "day" else cells)
        values = [math.nan if date is None else date[0] for date in dates]
        is_utc |= any(date is not None and date[1] for date in dates)
    elif kind == "clock":
        found = [_CLOCK.fullmatch(cell) for cell in cells]
        away_s = [_zone_s(one[7] or "") if one else None for one in found]
        clock_s = (_clock_s(*one.groups(default="")[:6]) if one else math.nan for one in found)
        values = [clock - (away or 0.0) for clock, away in zip(clock_s, away_s, strict=True)]
        is_utc |= {*away_s} != {None}
    else:
        values = [_span_s(cell) for cell in cells]
    return TimeColumn(title, np.array(values, float), kind, 1.0, is_utc, is_sure, remark)


def _span_s(text: str) -> float:
    """Return the seconds of `1:02:03.5`, `1h 2m 3.5s`, `500 ms` or `PT0.5S`; NaN for any other text."""
    if found := _SPAN.fullmatch(text):
        hours, minutes, seconds = (float((part or "0").replace(",", ".")) for part in found.groups())
        return hours * 3600 + minutes * 60 + seconds
    text = text.lower()
    text = text[1:].replace("t", " ").lstrip() if text[:1] == "p" else text
    place, total_s = 0, 0.0
    while found := _UNIT_SPAN.match(text, place):
        total_s += float(found[1].replace(",", ".")) * _SPAN_UNITS.get(found[2], math.nan)
        place = found.end()
    return total_s if place == len(text) > 0 else math.nan


def _spelled(cells: Sequence[str], is_utc: bool) -> list[str] | None:
    """Add separators to dates and times that are written as one number, 20220826181257 or 181257.5.

    Return None for other numbers: a part is too large, or the rows would be too far apart.
    """
    some = [cell for cell in cells if cell]
    if all(found is not None and len(found[0]) == len(cell) for cell in some for found in [_ODD_DATE.match(cell)]):
        dates = [_ODD_DATE.sub(_usual_date, cell) for cell in cells]
        return dates if any(":" in date for date in dates) or len(set(dates)) <= _DAYS else None
    parts = [found.groups() for cell in some if (found := _DIGITS.fullmatch(cell)) is not None]
    lengths = {len(cell.partition(".")[0]) for cell in some}
    if len(parts) < len(some) or not (lengths <= {5, 6} or lengths == {9}):
        return None
    clock_s = np.array([int(h) * 3600 + int(m) * 60 + float(f"{s}.{part}0") for h, m, s, part in parts])
    steps = np.abs(np.diff(clock_s)) % (_DAY_S - _STEP_S[1])
    # The numbers are also times if the minutes advanced and no seconds exceeded 59.
    is_told = is_utc or any(cell[0] == "0" for cell in some) or len({part[:2] for part in parts}) > 1
    is_near = bool((steps > 0).any()) and np.median(steps[steps > 0]) <= _STEP_S[1]
    return [_DIGITS.sub(r"\1:\2:\3.\g<4>0", cell) for cell in cells] if is_told and is_near else None


def _day_order(dates: Iterable[str]) -> tuple[bool, bool]:
    """Return whether the day comes first in dates that end with the year, and whether the order is certain."""
    parts = [part for date in dates if len((part := re.split(r"[./-]", date))[0]) != 4 and "." not in date]
    first, second = ({int(part[place]) for part in parts} for place in (0, 1))
    if max([*first, *second], default=0) > 12:
        return max(first) > 12, True
    # Within a flight the day may change, but hardly the month.
    return len(first) > len(second), len(first) != len(second) or first == second


def settle_times(
    log: Log, columns: Sequence[TimeColumn], step_m: float, is_far: np.ndarray, zone: tzinfo | None
) -> tuple[np.ndarray, float, list[str]]:
    """Return seconds since the first time, (N,), NaN if missing; that time since 1970; and the columns used.

    Seconds come from the finest times that do not run back, the clock from dates. step_m: distance of the vehicle
    between rows. is_far: (N,) whether it jumps before the row, as between flights. zone: time zone of dates that have
    no zone. Raise InputError if the unit of all times is unknown.
    """
    day = next((one for one in columns if one.kind == "day"), None)
    whole = [one for one in columns if one.kind != "day"]
    for place, one in enumerate(whole):
        if one.kind == "clock" and day is not None:
            values, is_utc = day.values + one.values, day.is_utc or one.is_utc
            whole[place] = TimeColumn(one.title, values, "date", 1.0, is_utc, day.is_sure, day.remark)
    parts, fractions = _with_fractions(whole)
    dated = (one.values[np.isfinite(one.values)] for one in parts if one.kind == "date")
    span_s = max((float(np.ptp(known)) for known in dated if len(known)), default=0.0)
    settled = [_in_seconds(one, step_m, span_s) for one in parts]
    clocks = [one for one in settled if one.kind == "date" and np.isfinite(one.values).any()]
    splits: dict[str, list[float]] = {}
    settled = [_continued(splits, one, min(clocks, key=_trust, default=None), is_far) for one in settled]
    chosen = min(settled, key=_rank) if settled else columns[0]._replace(values=columns[0].values * math.nan)
    known = np.flatnonzero(np.isfinite(chosen.values))
    if not len(known):
        return chosen.values, math.nan, []
    if chosen.kind == "number" and not chosen.is_sure:
        raise log.refuse(chosen.remark)
    if chosen.remark:
        log.note(chosen.remark)
    time_s = _spread(log, chosen.title, chosen.values - chosen.values[known[0]])
    log.splits += splits.get(chosen.title, [])
    sort_flights(log, time_s)
    clocks = [one for one in clocks if np.isfinite(one.values + time_s).any()]
    if not clocks:
        return time_s, math.nan, [chosen.title, *fractions]
    clock = min(clocks, key=lambda one: (_trust(one), one.title != chosen.title))
    titles = [chosen.title, clock.title, *fractions, *([] if day is None else [day.title])]
    return time_s, _start_s(log, clock, time_s, zone), titles


def _with_fractions(columns: Sequence[TimeColumn]) -> tuple[Sequence[TimeColumn], list[str]]:
    """Add a column of fractions of a second to the columns of whole seconds; return the columns and its title."""
    for one in columns:
        known = one.values[np.isfinite(one.values)] * one.scale
        is_back = one.kind == "number" and one.scale < 1 and (np.diff(known) < -0.1).any()
        if is_back and 0 <= known.min() <= known.max() < 1:
            whole = (other for other in columns if not other.scale < 1 and (other.values % 1 == 0).all())
            seconds = [other for other in whole if len(np.unique(other.values)) < len(other.values)]
            sums = [other._replace(values=other.values + one.values * one.scale, scale=1.0) for other in seconds]
            return sums or columns, [one.title] * bool(sums)
    return columns, []


def _restarts(values: np.ndarray) -> list[int]:
    """Return rows in which a column of times restarts. A column with many restarts holds no times: return no rows."""
    known = np.flatnonzero(np.isfinite(values))
    back = known[1:][np.diff(values[known]) < -1.0]
    highest = np.fmax.accumulate(values)
    # After a single damaged time, the times continue.
    is_few = len(back) <= min(1 + len(known) // 20, _MOST_FLIGHTS)
    return [int(row) for row in back[: len(back) * is_few] if (values[row : row + 3] < highest[row - 1]).sum() == 3]


def sort_flights(log: Log, time_s: np.ndarray) -> None:
    """Let a log be sorted by time if a whole flight stands after a later flight."""
    if rows := _restarts(time_s):
        spans = sorted((np.nanmin(part), np.nanmax(part)) for part in np.split(time_s, rows))
        log.jitter_s = math.inf if all(before[1] < after[0] for before, after in pairwise(spans)) else log.jitter_s


def _continued(
    splits: dict[str, list[float]], one: TimeColumn, dated: TimeColumn | None, is_far: np.ndarray
) -> TimeColumn:
    """Continue a column of times that restarts with another flight: by the dates, or one second later without dates.

    is_far: (N,) whether the vehicle jumps before the row. Without dates and a jump, the times are unchanged.
    splits: title -> times that separate flights; extended here.
    """
    values = one.values.copy()
    for row in _restarts(one.values) if one.kind != "date" else ():
        before = np.flatnonzero(np.isfinite(values[:row]))[-1]
        jump_s = math.nan if dated is None else dated.values[row] - dated.values[before]
        if math.isfinite(jump_s) or is_far[row]:
            values[row:] += values[before] - values[row] + (jump_s if math.isfinite(jump_s) else 1.0)
            first = values[np.isfinite(values)][0]
            splits.setdefault(one.title, []).append(float(values[before] - first) + SPLIT_S)
    return one._replace(values=values)


def _spread(log: Log, title: str, time_s: np.ndarray) -> np.ndarray:
    """Spread rows with equal times evenly up to the next time, and add a note."""
    known = np.flatnonzero(np.isfinite(time_s))
    ticks, first, count = np.unique(time_s[known], return_index=True, return_counts=True)
    more = len(known) - len(ticks)
    step_s = float(np.diff(ticks).min()) if len(ticks) > 1 else 0.0
    is_coarse = step_s >= _TICK_S and np.allclose(ticks / step_s, np.round(ticks / step_s), atol=1e-3)
    if is_coarse and more >= _MORE * len(ticks) and (count > 1).sum() > 1 and (np.diff(time_s[known]) >= 0).all():
        usual = float(np.median(count))
        place = np.arange(len(known)) - np.repeat(first, count)
        place[: count[0]] += max(0, round(usual) - int(count[0]))  # the log begins within a step
        log.note(f"'{title}' steps by {step_s:g} s with {usual:g} rows in each step: they are spread evenly over it")
        time_s[known] += (place - place[0]) * step_s / np.repeat(np.maximum(count, usual), count)
    elif 50 * more > len(known):
        log.note(f"only the last of the rows with the same '{title}' counts")
    return time_s


def _trust(clock: TimeColumn) -> tuple[bool, bool]:
    return not clock.is_utc, not clock.is_sure


def _rank(one: TimeColumn) -> tuple[bool, int]:
    """Return a sorting key. Complete columns whose times do not run back come first, then columns with most values."""
    known = one.values[np.isfinite(one.values)]
    back = int((known < np.maximum.accumulate(known) - 1.0).sum()) if len(known) else 0
    is_open = one.kind == "number" and not one.is_sure
    return is_open or 2 * len(known) < len(one.values) or back > 2 + len(known) // 100, -len(np.unique(known))


def _in_seconds(one: TimeColumn, step_m: float, span_s: float) -> TimeColumn:
    """Convert a column to seconds. span_s: span of the dates in the same rows, 0 without dates."""
    known = one.values[np.isfinite(one.values)]
    if one.kind == "clock":  # a step back is midnight
        return one._replace(values=one.values + _DAY_S * np.cumsum(np.diff(one.values, prepend=math.nan) < -_DAY_S / 2))
    if one.kind != "number" or not len(known):
        return one
    steps = np.diff(known)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else math.nan
    scale, length, middle = one.scale, float(np.ptp(known)), float(np.median(known))
    # A step of hours or of microseconds shows that the values have another unit than the name suggests.
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
        elif len(names) > 1 or (name != "seconds" and name not in since) or name == "days":
            one = one._replace(remark=f"'{one.title}' is taken to be in {name}, by its steps of {step:g}")
    if scale == _DAY_S:
        days = next((day for day in _EPOCHS if is_clock((middle - day) * _DAY_S)), 0.0)
        values = (one.values - days) * _DAY_S
        return one._replace(values=values, kind="date" if is_clock((middle - days) * _DAY_S) else "number")
    is_date = bool(_SINCE_1970[0] < middle * scale < _SINCE_1970[1])
    values = np.where(np.abs(one.values * scale) < _LONGEST_S, one.values * scale, math.nan)
    return one._replace(values=values, kind="date" if is_date else "number", is_utc=is_date)


def _start_s(log: Log, clock: TimeColumn, time_s: np.ndarray, zone: tzinfo | None) -> float:
    """Return the seconds since 1970 at time 0; NaN with a note if they are unknown."""
    known = np.flatnonzero(np.isfinite(clock.values + time_s))
    apart = (clock.values - time_s)[known]
    # A flight begins where the dates jump and stay away.
    smooth = np.median([np.append(apart[:1], apart[:-1]), apart, np.append(apart[1:], apart[-1:])], axis=0)
    jumps_s = np.abs(np.diff(smooth, append=smooth[-1]))
    begins = np.flatnonzero(jumps_s > max(DATE_JUMP_S, 10 * float(np.median(jumps_s))))
    log.splits += [float(time_s[known[row]]) + SPLIT_S for row in begins]
    apart = apart[: [*begins, len(apart)][0] + 1]
    is_whole = bool((clock.values[np.isfinite(clock.values)] % 1 == 0).all())  # whole seconds are rounded down
    start_s = float(apart[:100].max() if is_whole else np.median(apart[:100]))
    drift_s = float(apart[-1]) - start_s
    if abs(drift_s) > 2.0 + 0.02 * float(time_s[known[len(apart) - 1]]):
        log.note(f"the dates of '{clock.title}' and the seconds of the log differ by {drift_s:+.1f} s at its end")
    return clock_at_start(log, start_s, clock.is_utc, clock.is_sure, zone, f"'{clock.title}'", clock.remark)


def clock_at_start(
    log: Log, start_s: float, is_utc: bool, is_sure: bool, zone: tzinfo | None, what: str, remark: str
) -> float:
    """Return the seconds since 1970 at time 0, or NaN with a note. start_s: the date at time 0, read as UTC."""
    if remark:
        log.note(remark)
    if math.isnan(start_s):
        return math.nan
    if not _SINCE_1970[0] < start_s < _SINCE_1970[1]:
        log.note(f"{what} shows the impossible year {1970 + start_s / 31_556_952:.0f}: it is not used")
        return math.nan
    if is_sure and (is_utc or zone is not None):
        return start_s if is_utc or zone is None else to_utc(start_s, zone)
    if is_sure:
        log.start_local_s = start_s
    # Another zone changes the time by at most half a day, another order of day and month by eleven months.
    log.latest_utc_s = start_s + (_DAY_S / 2 if is_sure else 340 * _DAY_S)
    unsure = f"{what} does not show whether day or month comes first, so the clock is not known"
    log.note(UNKNOWN_ZONE if is_sure else unsure)
    return math.nan
