"""Tables of other programs, whose columns are known by their names and the units in them."""

import math
import re
from collections.abc import Iterator
from pathlib import Path

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.csv_text import Line
from torchvision_dddas.io.telemetry.log import Log
from torchvision_dddas.io.telemetry.names import QUANTITY, dated, hfov_of_focal, understood
from torchvision_dddas.io.telemetry.record import assembled
from torchvision_dddas.types import Telemetry

_TIMES = {"time", "timestamp", "datetime", "date", "utc", "t", "seconds", "flytime", "elapsed", "elapsedtime"}
_PER_SECOND = {"s": 1.0, "seconds": 1.0, "ms": 1e3, "millisecond": 1e3, "milliseconds": 1e3, "us": 1e6}


def is_program_table(header: list[str]) -> bool:
    """Whether a header has a column of times or frames, and one that tells something of a flight."""
    names = {_plain(name)[0] for name in header}
    return bool(names & _TIMES or "frame" in names) and bool(names & set(QUANTITY))


def _plain(name: str) -> tuple[str, str]:
    """A column's name without blanks and capitals, and its unit: `Speed (mph)`, `OSD.height [ft]`, `GIMBAL.pitch`."""
    found = re.fullmatch(r"(.*?)\s*[(\[](.*?)[)\]]", name)
    name, unit = (found[1], found[2]) if found else (name, "")
    return re.sub(r"[\s_-]|^osd\.|(?<=^gimbal)\.", "", name.lower()), unit.lower()


def read_program_table(
    log: Log, header: list[str], lines: Iterator[Line], clock_offset_s: float, clip: Path | None
) -> Telemetry:
    """Rows at dates, times of day, numbers of seconds, or frames of a clip.

    Raises InputError with the line for a time that is none, and where frames are counted and no clip is given.
    """
    names = [_plain(name) for name in header]
    timed = next((i for i, (name, _) in enumerate(names) if name in _TIMES), None)
    focal, fnum, zoom, frame = (_index(names, key) for key in ("focallen", "fnum", "dzoomratio", "frame"))
    if timed is None and clip is None:
        raise InputError(f"telemetry {log.path} counts frames and says no times; give its clip, or a column time_s")
    rate_hz = _rate(clip) if timed is None and clip is not None else math.nan
    telling = _telling(names)
    if {names[i][0] for i in telling} & {"altitude", "alt"}:
        log.note("from where the altitude is counted is not told; it is taken as above the sea")
    first = begin = math.nan
    zoned = False
    for number, cells in lines:
        cells = cells + [""] * (len(header) - len(cells))
        if timed is not None:
            moment, told = _moment(cells[timed], names[timed][1])
            zoned = zoned or told
        else:
            count = _float(cells[frame or 0])
            begin = min(count, 1.0) if math.isnan(begin) else begin  # frames are counted from 0 or from 1
            moment = (count - begin) / rate_hz
        if not math.isfinite(moment):
            text = cells[timed] if timed is not None else cells[frame or 0]
            raise log.refuse(f"'{text}' is no time; wanted a date with a time, or seconds", number)
        first = (moment if timed is not None else 0.0) if math.isnan(first) else first
        log.moments.append((moment - first, number))
        for i in telling:
            value = _float(cells[i])
            if math.isfinite(value) and (said := understood(names[i][0], value, names[i][1])):
                log.say(said[0], moment - first, said[1], number)
        if focal is not None and math.isfinite(_float(cells[focal])):
            numbers = [_float(cells[i]) if i is not None else math.nan for i in (fnum, zoom)]
            if (hfov := hfov_of_focal(cells[focal], *numbers)) is not None:
                log.say("hfov_rad", moment - first, hfov, number)
                log.note("the field of view is that of a focal length for a picture 36 mm wide")
    if not log.moments:
        raise InputError(f"telemetry {log.path} has a header but no rows")
    return assembled(log, clock_offset_s, first if zoned else math.nan)


def _telling(names: list[tuple[str, str]]) -> list[int]:
    """Which columns tell something: for each quantity the one whose name tells it best."""
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


def _rate(clip: Path) -> float:
    from torchvision_dddas.io.sources import open_source

    return float(open_source(clip).rate_hz)
