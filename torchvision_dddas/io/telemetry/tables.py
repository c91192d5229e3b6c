"""Telemetry from CSV: own tables, `time_s,altitude_m,...`, and those of other programs, known by their column names."""

import math
import re
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from functools import cache
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.io.tables import Column, CsvText, Schema, read_csv, read_table
from torchvision_dddas.io.telemetry.record import KINDS, OWN, Log, build_record
from torchvision_dddas.types import Telemetry

PAIRS = (("longitude_deg", "latitude_deg"), ("east_m", "north_m"))
_ANY = (-math.inf, math.inf, "")
_COMPASS = (-360.0, 360.0, "clockwise from true north, -360 to 360")
_LOCAL = (-1e7, 1e7, "metres from the origin, -1e7 to 1e7")
_OPTIONAL = {
    "altitude_m": _ANY,
    "speed_m_s": (0.0, math.inf, "the speed over ground, 0 or more"),
    "longitude_deg": _ANY,
    "latitude_deg": _ANY,
    "east_m": _LOCAL,
    "north_m": _LOCAL,
    "above_sea_m": _ANY,
    "heading_deg": _COMPASS,
    # A gimbal that looks straight down reports 90.2 as well as 89.8.
    "pitch_deg": (-180.0, 180.0, "how far the camera looks below the horizon, -180 to 180"),
    "roll_deg": (-180.0, 180.0, "clockwise, -180 to 180"),
    "hfov_deg": (0.0, 180.0, "the width of the field of view, 0 to 180"),
    "vehicle_heading_deg": _COMPASS,
}
SCHEMA = Schema(
    "telemetry",
    Column("time_s", "g", -1e10, 1e10, wanted="seconds since the clip's first frame"),
    *(
        Column(name, "g", low, high, may_be_empty=True, wanted=wanted)
        for name, (low, high, wanted) in _OPTIONAL.items()
    ),
)


def read_telemetry_table(path: Path, clock_offset_s: float, clip: Path | None, zone: tzinfo | None = None) -> Telemetry:
    """Read an own table, which has a column time_s, or that of another program. zone: of dates that say none.

    Raises InputError with file and line: as read_table, no rows, half a place, a time before the one above it.
    """
    text = read_csv(path, "telemetry")
    plain = {name: _plain(name) for name in set(text.header)}
    names = {name for name, _ in plain.values()}
    if "time_s" in text.header or not (names & (_TIMES | {"frame"}) and names & set(QUANTITY)):
        return _read_own(path, text, clock_offset_s)
    columns = [plain[name] for name in text.header]
    return _read_program_table(Log(path, "flight log table"), text, columns, clock_offset_s, clip, zone)


def _read_own(path: Path, text: CsvText, clock_offset_s: float) -> Telemetry:
    known = [name for name in SCHEMA.names if name in text.header]
    if not known:
        raise InputError(
            f"telemetry {path} looks like no log: its first line names none of {', '.join(SCHEMA.names)}; wanted "
            f"{KINDS}, of which a CSV needs time_s and altitude_m, or a place"
        )
    is_placed = any(set(pair) & set(known) for pair in PAIRS)
    heights = () if is_placed or "above_sea_m" in known else ("altitude_m",)  # the camera's file may say the height
    table = read_table(path, SCHEMA, ("time_s", *heights), is_ragged=True, text=text)
    pairs = [pair for pair in PAIRS if set(pair) & set(known)]
    for pair in pairs:
        if missing := set(pair) - set(known):
            raise InputError(f"telemetry {path} lacks {missing.pop()}; wanted {' and '.join(pair)}")
    if len(pairs) > 1:
        raise InputError(f"telemetry {path} has places in degrees and in metres; wanted one kind, leave the other out")
    if not len(table):
        raise InputError(f"telemetry {path} has a header but no rows")
    time_s = table["time_s"]
    if (is_back := np.diff(time_s) < 0).any():
        row = int(np.argmax(is_back)) + 1
        raise table.error(f"time_s runs back from {time_s[row - 1]:g} to {time_s[row]:g}; sort it by time", row)
    log = Log(path, OWN, moments=np.column_stack([time_s, time_s, table.line]))
    for name in known[1:]:
        is_angle = name.endswith("_deg") and name not in PAIRS[0]
        values = {name.replace("_deg", "_rad"): np.radians(table[name])} if is_angle else {name: table[name]}
        log.add_all(time_s, table.line, values, known=True)
    return build_record(log, clock_offset_s)


# --------------------------------------------------------------------------------------------------------------------
# What makers call the same thing: from a key and its unit to a quantity of the record.

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
"""Quantity by key, without capitals, blanks, dashes and underscores; of several, the first is the best."""

_UNITS = {
    "ft": 0.3048, "feet": 0.3048, "km/h": 1 / 3.6, "kmh": 1 / 3.6, "kph": 1 / 3.6, "mph": 0.44704, "kn": 1852 / 3600,
    "knots": 1852 / 3600, "kt": 1852 / 3600, "kts": 1852 / 3600, "cm": 0.01, "mm": 0.001,
}  # fmt: skip
_DATE = re.compile(
    r"(\d{4})[./-](\d{1,2})[./-](\d{1,2})[ T]+(\d{1,2}):(\d{1,2}):(\d{1,2})"
    r"(?:[.,:](\d{1,9}))?(?:[.,:](\d{1,3}))?(?:[.,:]\d{1,3})*(Z|[+-]\d{2}:?\d{2})?"
)
UNKNOWN_ZONE = "the dates are in an unknown time zone, so the clock is not known; aerial.time_zone tells it"
"""The note on a log whose dates say no zone."""

_CLOCK = re.compile(r"(\d{1,9}):(\d{1,9}):(\d+(?:\.\d+)?)")
# Half the width of the picture whose focal length is given for one 36 mm wide.
_HALF_WIDTH_MM = 18.0


@cache
def quantity_of(key: str) -> str | None:
    """The quantity of a key, however it is written; None for any other key."""
    return QUANTITY.get(re.sub(r"[\s_-]", "", key.lower()))


def convert(key: str, value: float, unit: str = "") -> tuple[str, float] | None:
    """The quantity of a key and its value in the record's units and signs; None for any other key."""
    quantity = quantity_of(key)
    if quantity is None:
        return None
    unit = unit.lower()
    value *= _UNITS.get(unit, 1.0)
    if quantity.endswith("_rad") and unit not in ("rad", "radians"):
        value = math.radians(value)
    # A gimbal's pitch is counted up from the horizon, the record's down.
    return quantity, 0.0 - value if quantity == "pitch_rad" else value


def parse_date(text: str) -> tuple[float, bool] | None:
    """Seconds since 1970 of the first date with a time in a text, and whether it has a zone; else UTC is assumed.

    None without a date. Fractions come as `.123`, as `,123` or as milli- and microseconds, `,774,808`.
    """
    found = _DATE.search(text)
    if found is None:
        return None
    *whole, fraction, micro, zone = found.groups(default="")
    try:
        year, month, day, hour, minute, second = map(int, whole)
        moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    seconds = moment.timestamp() + float(f"0.{fraction}{micro if len(fraction) == 3 else ''}0")
    if zone not in ("", "Z"):
        away = timedelta(hours=int(zone[1:3]), minutes=int(zone[-2:])).total_seconds()
        seconds -= math.copysign(away, float(zone[0] + "1"))
    return seconds, bool(zone)


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


def hfov_of_focal(focal_text: str, fnum_text: str, zoom_text: str) -> float | None:
    """Width of the field of view, rad, from a focal length as that of a 36 mm wide picture; None if it is none.

    Some write both it and the aperture times ten and a hundred: 240 beside 280 is 24 mm at f/2.8.
    """
    focal, fnum, zoom = map(_to_float, (focal_text, fnum_text, zoom_text))
    if "." not in focal_text and focal >= 100 and not fnum < 100:
        focal /= 10
    focal *= zoom if 1 <= zoom <= 100 else 1.0
    return 2 * math.atan(_HALF_WIDTH_MM / focal) if 8 <= focal <= 2000 else None


def _to_float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


# --------------------------------------------------------------------------------------------------------------------
# Tables of other programs.

_TIMES = {"time", "timestamp", "datetime", "date", "utc", "t", "seconds", "flytime", "elapsed", "elapsedtime"}
_OPENING, _NOT_IN_NAMES = re.compile(r"[(\[]"), re.compile(r"[\s_-]|^osd\.|(?<=^gimbal)\.")
_PER_SECOND = {"s": 1.0, "seconds": 1.0, "ms": 1e3, "millisecond": 1e3, "milliseconds": 1e3, "us": 1e6}


def _plain(name: str) -> tuple[str, str]:
    """A column's name without blanks and capitals, and its unit: `Speed (mph)`, `OSD.height [ft]`, `GIMBAL.pitch`."""
    # The first bracket is looked for alone: an expression for all of it would try each one in a name full of them.
    opening, unit = _OPENING.search(name), ""
    if opening is not None and name.endswith((")", "]")):
        name, unit = name[: opening.start()].rstrip(), name[opening.end() : -1]
    return _NOT_IN_NAMES.sub("", name.lower()), unit.lower()


def _read_program_table(
    log: Log,
    text: CsvText,
    columns: list[tuple[str, str]],
    clock_offset_s: float,
    clip: Path | None,
    zone: tzinfo | None,
) -> Telemetry:
    """Rows at dates, times of day, numbers of seconds, or frames of a clip. columns: as `_plain` gives them.

    Raises InputError with the line for a time that is none, and where frames are counted and no clip is given.
    """
    names, units = zip(*columns, strict=True)
    is_timed = not _TIMES.isdisjoint(names)
    clock = next(i for i, name in enumerate(names) if name in (_TIMES if is_timed else ("frame",)))
    rate_hz = math.nan
    if not is_timed:
        if clip is None:
            raise InputError(f"telemetry {log.path} has frames and no times; give its clip, or a column time_s")
        rate_hz = open_source(clip).rate_hz
    # For each quantity the column with the best of its names.
    ranks = {key: rank for rank, key in enumerate(QUANTITY)}
    best: dict[str, tuple[int, int]] = {}
    for i, name in enumerate(names):
        if name in QUANTITY:
            best[QUANTITY[name]] = min(best.get(QUANTITY[name], (len(ranks), i)), (ranks[name], i))
    used = sorted(i for _, i in best.values())
    if {names[i] for i in used} & {"altitude", "alt"}:
        log.note("the file does not say where the altitude is zero; above the sea is assumed")
    optics = [names.index(key) if key in names else None for key in ("focallen", "fnum", "dzoomratio")]
    films = names.index("isvideo") if "isvideo" in names else clock  # whether the camera records at the time
    wanted = {clock, films, *used, *(i for i in optics if i is not None)}
    first = begin = filmed = math.nan
    is_zoned = False
    for number, row in zip(text.line, text.rows, strict=True):
        cells = {i: row[i] if i < len(row) else "" for i in wanted}
        if is_timed:
            moment, has_zone = _moment(cells[clock], units[clock])
            is_zoned = is_zoned or has_zone
        else:
            count = _to_float(cells[clock])
            begin = min(count, 1.0) if math.isnan(begin) else begin  # frames are counted from 0 or from 1
            moment = (count - begin) / rate_hz
        if not math.isfinite(moment):
            raise log.refuse(f"'{cells[clock]}' is no time; wanted a date with a time, or seconds", number)
        first = (moment if is_timed else 0.0) if math.isnan(first) else first
        log.moments.append((moment - first, 0.0, number))
        if films != clock and math.isnan(filmed) and _to_float(cells[films]) == 1:
            filmed = moment - first
        for i in used:
            value = _to_float(cells[i])
            if math.isfinite(value) and (found := convert(names[i], value, units[i])):
                log.add(found[0], moment - first, found[1], number)
        hfov = hfov_of_focal(*("" if i is None else cells[i] for i in optics)) if optics[0] is not None else None
        if hfov is not None:
            log.add("hfov_rad", moment - first, hfov, number)
            log.is_nominal = True
            log.note("the field of view is that of a focal length as for a picture with a longer side of 36 mm")
    if not log.moments:
        raise InputError(f"telemetry {log.path} has a header but no rows")
    if filmed > 0 and not clock_offset_s:
        log.note(
            f"the log says that the camera began to film {filmed:.1f} s after its first row, and times count from that "
            f"row: aerial.clock_offset_s={-filmed:.1f} counts them from where the film begins"
        )
    if not is_zoned and parse_date(text.rows[0][clock]) is not None:
        if zone is None:
            log.note(UNKNOWN_ZONE)
        else:
            first, is_zoned = to_utc(first, zone), True
    return build_record(log, clock_offset_s, first if is_zoned else math.nan)


def _moment(text: str, unit: str) -> tuple[float, bool]:
    """Seconds of a date, a time of day or a number, and whether they are since 1970 in UTC."""
    if date := parse_date(text):
        return date[0], date[1] or unit == "utc"
    if clock := _CLOCK.fullmatch(text):
        return int(clock[1]) * 3600 + int(clock[2]) * 60 + float(clock[3]), False
    value = _to_float(text)
    is_since_1970 = value > 1e9
    # Without a unit the size decides: of times since 1970, 10 digits are seconds, 13 milli- and 16 microseconds.
    per_second = _PER_SECOND.get(unit, 1e6 if value > 1e14 else 1e3 if value > 1e11 else 1.0)
    value /= per_second
    return value, is_since_1970 and (unit not in _PER_SECOND or value > 1e9)
