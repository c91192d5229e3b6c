"""Telemetry from CSV: own tables, `time_s,altitude_m,...`, and those of other programs, known by their column names."""

import math
import re
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.io.tables import Column, CsvText, Schema, read_csv, read_table
from torchvision_dddas.io.telemetry.log import OWN, Log, assemble
from torchvision_dddas.io.telemetry.quantities import QUANTITY, dated, hfov_of_focal, understood
from torchvision_dddas.types import Telemetry

COLUMNS = ("time_s", "altitude_m", "speed_m_s")
"""The usual columns; the speed may be left out, and the altitude where above_sea_m is there."""

PAIRS = (("longitude_deg", "latitude_deg"), ("east_m", "north_m"))
_COMPASS = (-360.0, 360.0, "clockwise from true north, -360 to 360")
SCHEMA = Schema(
    "telemetry",
    Column("time_s", "g", -1e10, 1e10, wanted="seconds since the clip's first frame"),
    *(
        Column(name, "g", low, high, may_be_empty=True, wanted=wanted)
        for name, low, high, wanted in (
            ("altitude_m", -math.inf, math.inf, ""),
            ("speed_m_s", 0.0, math.inf, "the speed over ground, 0 or more"),
            ("longitude_deg", -math.inf, math.inf, ""),
            ("latitude_deg", -math.inf, math.inf, ""),
            ("east_m", -1e7, 1e7, "metres from the origin, -1e7 to 1e7"),
            ("north_m", -1e7, 1e7, "metres from the origin, -1e7 to 1e7"),
            ("above_sea_m", -math.inf, math.inf, ""),
            ("heading_deg", *_COMPASS),
            # A gimbal that looks straight down reports 90.2 as well as 89.8.
            ("pitch_deg", -180.0, 180.0, "how far the camera looks below the horizon, -180 to 180"),
            ("roll_deg", -180.0, 180.0, "clockwise, -180 to 180"),
            ("hfov_deg", 0.0, 180.0, "the width of the field of view, 0 to 180"),
            ("vehicle_heading_deg", *_COMPASS),
        )
    ),
)
_TIMES = {"time", "timestamp", "datetime", "date", "utc", "t", "seconds", "flytime", "elapsed", "elapsedtime"}
_PER_SECOND = {"s": 1.0, "seconds": 1.0, "ms": 1e3, "millisecond": 1e3, "milliseconds": 1e3, "us": 1e6}


def read_telemetry_table(path: Path, clock_offset_s: float, clip: Path | None) -> Telemetry:
    """Read an own table, which has a column time_s, or that of another program.

    Raises InputError with file and line: as read_table, no rows, half a place, a time before the one above it.
    """
    text = read_csv(path, "telemetry")
    if "time_s" in text.header or not _is_program_table(text.header):
        return _read_own(path, text, clock_offset_s)
    return _read_program_table(Log(path, "flight log table"), text, clock_offset_s, clip)


def _read_own(path: Path, text: CsvText, clock_offset_s: float) -> Telemetry:
    known = [name for name in SCHEMA.names if name in text.header]
    height = "above_sea_m" if "above_sea_m" in known else "altitude_m"
    table = read_table(path, SCHEMA, ("time_s", height) if known else COLUMNS, is_ragged=True, text=text)
    pairs = [pair for pair in PAIRS if set(pair) & set(known)]
    for pair in pairs:
        if missing := set(pair) - set(known):
            raise InputError(f"telemetry {path} lacks {missing.pop()}; wanted {' and '.join(pair)}")
    if len(pairs) > 1:
        raise InputError(f"telemetry {path} has places in degrees and in metres; wanted one kind, leave the other out")
    if not len(table):
        raise InputError(f"telemetry {path} has a header but no rows")
    time_s, number = table["time_s"], table.line.astype(float)
    if (is_back := np.diff(time_s) < 0).any():
        row = int(np.argmax(is_back)) + 1
        raise table.error(f"time_s runs back from {time_s[row - 1]:g} to {time_s[row]:g}; sort it by time", row)
    log = Log(path, OWN)
    log.moments += zip(time_s.tolist(), number.tolist(), strict=True)
    for name in known[1:]:
        values = table[name]
        is_known = np.isfinite(values)
        is_angle = name.endswith("_deg") and name not in PAIRS[0]
        quantity = name.replace("_deg", "_rad") if is_angle else name
        log.add_all(
            quantity, time_s[is_known], (np.radians(values) if is_angle else values)[is_known], number[is_known]
        )
    return assemble(log, clock_offset_s)


# --------------------------------------------------------------------------------------------------------------------
# Tables of other programs.


def _is_program_table(header: list[str]) -> bool:
    """Whether a header has a column of times or frames, and one that tells something of a flight."""
    names = {_plain(name)[0] for name in header}
    return bool(names & _TIMES or "frame" in names) and bool(names & set(QUANTITY))


def _plain(name: str) -> tuple[str, str]:
    """A column's name without blanks and capitals, and its unit: `Speed (mph)`, `OSD.height [ft]`, `GIMBAL.pitch`."""
    found = re.fullmatch(r"(.*?)\s*[(\[](.*?)[)\]]", name)
    name, unit = (found[1], found[2]) if found else (name, "")
    return re.sub(r"[\s_-]|^osd\.|(?<=^gimbal)\.", "", name.lower()), unit.lower()


def _read_program_table(log: Log, text: CsvText, clock_offset_s: float, clip: Path | None) -> Telemetry:
    """Rows at dates, times of day, numbers of seconds, or frames of a clip.

    Raises InputError with the line for a time that is none, and where frames are counted and no clip is given.
    """
    names = [_plain(name) for name in text.header]
    timed = next((i for i, (name, _) in enumerate(names) if name in _TIMES), None)
    focal, fnum, zoom, frame = (_index(names, key) for key in ("focallen", "fnum", "dzoomratio", "frame"))
    rate_hz = math.nan
    if timed is None:
        if clip is None:
            raise InputError(f"telemetry {log.path} has frames and no times; give its clip, or a column time_s")
        rate_hz = open_source(clip).rate_hz
    used = _best_columns(names)
    if {names[i][0] for i in used} & {"altitude", "alt"}:
        log.note("the file does not say where the altitude is zero; above the sea is assumed")
    first = begin = math.nan
    zoned = False
    for number, row in zip(text.line, text.rows, strict=True):
        cells = row + [""] * (len(names) - len(row))
        if timed is not None:
            moment, told = _moment(cells[timed], names[timed][1])
            zoned = zoned or told
        else:
            count = _float(cells[frame or 0])
            begin = min(count, 1.0) if math.isnan(begin) else begin  # frames are counted from 0 or from 1
            moment = (count - begin) / rate_hz
        if not math.isfinite(moment):
            cell = cells[timed] if timed is not None else cells[frame or 0]
            raise log.refuse(f"'{cell}' is no time; wanted a date with a time, or seconds", number)
        first = (moment if timed is not None else 0.0) if math.isnan(first) else first
        log.moments.append((moment - first, number))
        for i in used:
            value = _float(cells[i])
            if math.isfinite(value) and (said := understood(names[i][0], value, names[i][1])):
                log.add(said[0], moment - first, said[1], number)
        if focal is not None and math.isfinite(_float(cells[focal])):
            numbers = [_float(cells[i]) if i is not None else math.nan for i in (fnum, zoom)]
            if (hfov := hfov_of_focal(cells[focal], *numbers)) is not None:
                log.add("hfov_rad", moment - first, hfov, number)
                log.note("the field of view is that of a focal length for a picture 36 mm wide")
    if not log.moments:
        raise InputError(f"telemetry {log.path} has a header but no rows")
    return assemble(log, clock_offset_s, first if zoned else math.nan)


def _best_columns(names: list[tuple[str, str]]) -> list[int]:
    """For each quantity the column with the best of its names."""
    best: dict[str, tuple[int, int]] = {}
    for i, (name, _) in enumerate(names):
        if name in QUANTITY:
            rank = (list(QUANTITY).index(name), i)
            best[QUANTITY[name]] = min(best.get(QUANTITY[name], rank), rank)
    return sorted(i for _, i in best.values())


def _moment(text: str, unit: str) -> tuple[float, bool]:
    """Seconds of a date, a time of day or a number, and whether they are since 1970 in UTC."""
    if date := dated(text):
        return date[0], date[1] or unit == "utc"
    if clock := re.fullmatch(r"(\d+):(\d+):(\d+(?:\.\d+)?)", text):
        return int(clock[1]) * 3600 + int(clock[2]) * 60 + float(clock[3]), False
    value = _float(text)
    since_1970 = value > 1e9
    if unit in _PER_SECOND:
        return value / _PER_SECOND[unit], since_1970 and value / _PER_SECOND[unit] > 1e9
    # Without a unit the size tells: of times since 1970, 10 digits are seconds, 13 milli- and 16 microseconds.
    return value / (1e6 if value > 1e14 else 1e3 if value > 1e11 else 1.0), since_1970


def _index(names: list[tuple[str, str]], key: str) -> int | None:
    return next((i for i, (name, _) in enumerate(names) if name == key), None)


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
