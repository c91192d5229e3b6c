"""Tables: our own `time_s,altitude_m,...`, and those of other programs, whose columns are known by their names."""

import math
import re
from collections.abc import Iterator
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.sources.csv_text import Line, opened
from torchvision_dddas.sources.telemetry.names import QUANTITY, dated, hfov_of_focal, understood
from torchvision_dddas.sources.telemetry.record import Log, assembled
from torchvision_dddas.types import Telemetry

COLUMNS = ("time_s", "altitude_m", "speed_m_s")
"""Those that every table of ours had; the speed may be left out, and the altitude where above_sea_m is there."""

FURTHER = (
    "longitude_deg",
    "latitude_deg",
    "east_m",
    "north_m",
    "above_sea_m",
    "heading_deg",
    "pitch_deg",
    "roll_deg",
    "hfov_deg",
    "vehicle_heading_deg",
)
LIMITS = {
    "pitch_deg": (-90.0, 90.0, "how far the camera looks below the horizon, -90 to 90"),
    "hfov_deg": (0.0, 180.0, "the width of the field of view, 0 to 180"),
    "speed_m_s": (0.0, math.inf, "the speed over ground, 0 or more"),
    "heading_deg": (-360.0, 360.0, "clockwise from true north, -360 to 360"),
    "vehicle_heading_deg": (-360.0, 360.0, "clockwise from true north, -360 to 360"),
    "roll_deg": (-180.0, 180.0, "clockwise, -180 to 180"),
}
PAIRS = (("longitude_deg", "latitude_deg"), ("east_m", "north_m"))


def read_table(path: Path, clock_offset_s: float, clip: Path | None) -> Telemetry:
    """Our own table where it has a column time_s, else another program's.

    Raises InputError with file and line: unreadable, a column missing, no rows, not a finite number, out of range,
    time running back.
    """
    with opened(path, "telemetry") as (header, lines):
        if "time_s" in header or not _understood(header):
            return _own(Log(path, "table"), header, lines, clock_offset_s)
        return _foreign(Log(path, "flight log table"), header, lines, clock_offset_s, clip)


def _own(log: Log, header: list[str], lines: Iterator[Line], clock_offset_s: float) -> Telemetry:
    columns = [name for name in (*COLUMNS, *FURTHER) if name in header]
    wanted = COLUMNS if not columns else ("time_s", "altitude_m" if "above_sea_m" not in columns else "above_sea_m")
    if missing := [name for name in wanted if name not in header]:
        raise InputError(
            f"telemetry {log.path} lacks {', '.join(missing)}; its columns are {', '.join(header) or 'none'}, "
            f"wanted {','.join(COLUMNS)}"
        )
    _check_pairs(log.path, columns)
    last = -math.inf
    for number, cells in lines:
        row = {name: _number(log, cells, header.index(name), name, number) for name in columns}
        time_s = row.pop("time_s")
        if math.isnan(time_s):
            raise log.refuse("time_s is ''; wanted a finite number", number)
        if time_s < last:
            raise log.refuse(f"time_s runs back from {last:g} to {time_s:g}; sort it by time", number)
        last = time_s
        log.moments.append((time_s, number))
        for name, value in row.items():
            if math.isfinite(value):
                turned = name.endswith("_deg") and name not in PAIRS[0]
                name, value = (name.replace("_deg", "_rad"), math.radians(value)) if turned else (name, value)
                log.say(name, time_s, value, number)
    if not log.moments:
        raise InputError(f"telemetry {log.path} has a header but no rows")
    return assembled(log, clock_offset_s)


def _check_pairs(path: Path, columns: list[str]) -> None:
    whole = [pair for pair in PAIRS if set(pair) & set(columns)]
    for pair in whole:
        if missing := set(pair) - set(columns):
            raise InputError(f"telemetry {path} lacks {missing.pop()}; wanted {' and '.join(pair)}")
    if len(whole) > 1:
        raise InputError(f"telemetry {path} has places in degrees and in metres; wanted one kind, leave the other out")


def _number(log: Log, row: list[str], place: int, name: str, line: int) -> float:
    """A cell; NaN where it is empty. A row that ends before it is cut off."""
    if place < len(row) and row[place] == "":
        return math.nan
    text = row[place] if place < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise log.refuse(f"{name} is '{text}'; wanted a finite number", line)
    least, most, words = LIMITS.get(name, (-math.inf, math.inf, ""))
    if not least <= value <= most:
        raise log.refuse(f"{name} is '{text}'; wanted {words}", line)
    return value


# -- other programs' ---------------------------------------------------------------------------------------------------

_TIMES = {"time", "timestamp", "datetime", "date", "utc", "t", "seconds"}
_PER_SECOND = {"s": 1.0, "seconds": 1.0, "ms": 1e3, "millisecond": 1e3, "milliseconds": 1e3, "us": 1e6, "": 1.0}


def _understood(header: list[str]) -> bool:
    names = {_plain(name)[0] for name in header}
    return bool(names & _TIMES or "frame" in names) and bool(names & set(QUANTITY))


def _plain(name: str) -> tuple[str, str]:
    """A column's name without blanks and capitals, and its unit: `Speed (mph)`, `height_above_takeoff(feet)`."""
    found = re.fullmatch(r"(.*?)\s*[(\[](.*?)[)\]]", name)
    name, unit = (found[1], found[2]) if found else (name, "")
    return re.sub(r"[\s_-]", "", name.lower()), unit.lower()


def _foreign(log: Log, header: list[str], lines: Iterator[Line], clock_offset_s: float, clip: Path | None) -> Telemetry:
    names = [_plain(name) for name in header]
    timed = next((i for i, (name, _) in enumerate(names) if name in _TIMES), None)
    focal, fnum, zoom = (_index(names, key) for key in ("focallen", "fnum", "dzoomratio"))
    if timed is None and clip is None:
        raise InputError(f"telemetry {log.path} counts frames and says no times; give its clip, or a column time_s")
    rate_hz = _rate(clip) if timed is None and clip is not None else math.nan
    first, epoch = math.nan, False
    for number, cells in lines:
        cells = cells + [""] * (len(header) - len(cells))
        if timed is None:
            moment = _float(cells[_index(names, "frame") or 0]) / rate_hz
        else:
            date = dated(cells[timed])
            moment = date[0] if date else _float(cells[timed]) / _PER_SECOND.get(names[timed][1], 1.0)
            epoch = epoch or bool(date and (date[1] or names[timed][1] == "utc"))
        if not math.isfinite(moment):
            text = cells[timed] if timed is not None else "frame"
            raise log.refuse(f"'{text}' is no time; wanted a date with a time, or seconds", number)
        first = moment if math.isnan(first) else first
        log.moments.append((moment - first, number))
        for (name, unit), cell in zip(names, cells, strict=False):
            value = _float(cell)
            if math.isfinite(value) and (said := understood(name, value, unit)):
                log.say(said[0], moment - first, said[1], number)
        if focal is not None and math.isfinite(_float(cells[focal])):
            numbers = [_float(cells[i]) if i is not None else math.nan for i in (fnum, zoom)]
            if (hfov := hfov_of_focal(cells[focal], *numbers)) is not None:
                log.say("hfov_rad", moment - first, hfov, number)
                log.note("the field of view is that of a focal length for a picture 36 mm wide")
    if not log.moments:
        raise InputError(f"telemetry {log.path} has a header but no rows")
    return assembled(log, clock_offset_s, first if epoch else math.nan)


def _index(names: list[tuple[str, str]], key: str) -> int | None:
    return next((i for i, (name, _) in enumerate(names) if name == key), None)


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _rate(clip: Path) -> float:
    from torchvision_dddas.sources import open_source

    return float(open_source(clip).rate_hz)
