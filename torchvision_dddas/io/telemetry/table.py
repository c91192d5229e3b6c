"""Our own tables, `time_s,altitude_m,...`."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.csv_text import Line, opened
from torchvision_dddas.io.telemetry.log import OWN, Log
from torchvision_dddas.io.telemetry.program_table import is_program_table, read_program_table
from torchvision_dddas.io.telemetry.record import assembled
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
    "time_s": (-1e10, 1e10, "seconds since the clip's first frame"),
    # A gimbal that looks straight down reports 90.2 as well as 89.8.
    "pitch_deg": (-180.0, 180.0, "how far the camera looks below the horizon, -180 to 180"),
    "east_m": (-1e7, 1e7, "metres from the origin, -1e7 to 1e7"),
    "north_m": (-1e7, 1e7, "metres from the origin, -1e7 to 1e7"),
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
        if "time_s" in header or not is_program_table(header):
            return _own(Log(path, OWN), header, lines, clock_offset_s)
        return read_program_table(Log(path, "flight log table"), header, lines, clock_offset_s, clip)


def _own(log: Log, header: list[str], lines: Iterator[Line], clock_offset_s: float) -> Telemetry:
    columns = [name for name in (*COLUMNS, *FURTHER) if name in header]
    wanted = COLUMNS if not columns else ("time_s", "altitude_m" if "above_sea_m" not in columns else "above_sea_m")
    if missing := [name for name in wanted if name not in header]:
        raise InputError(
            f"telemetry {log.path} lacks {', '.join(missing)}; its columns are {', '.join(header) or 'none'}, "
            f"wanted {','.join(COLUMNS)}"
        )
    _check_pairs(log.path, columns)
    rows = list(lines)
    if not rows:
        raise InputError(f"telemetry {log.path} has a header but no rows")
    number = np.array([line for line, _ in rows], float)
    table = _numbers(log, rows, [header.index(name) for name in columns], columns)
    time_s = table.pop("time_s")
    back = np.diff(time_s)
    if (back < 0).any():
        i = int(np.argmax(back < 0))
        raise log.refuse(f"time_s runs back from {time_s[i]:g} to {time_s[i + 1]:g}; sort it by time", rows[i + 1][0])
    log.moments += zip(time_s.tolist(), number.tolist(), strict=True)
    for name, values in table.items():
        known = np.isfinite(values)
        turned = name.endswith("_deg") and name not in PAIRS[0]
        values = np.radians(values) if turned else values
        quantity = name.replace("_deg", "_rad") if turned else name
        log.say_all(quantity, time_s[known], values[known], number[known])
    return assembled(log, clock_offset_s)


def _numbers(log: Log, rows: list[Line], places: list[int], names: list[str]) -> dict[str, np.ndarray]:
    """(N,) a column, NaN where a cell is empty.

    Raises InputError for the first line with a cell that is missing, no finite number or out of its range.
    """
    try:
        cells = [[float(row[place] or "nan") for place in places] for _, row in rows]
    except (ValueError, IndexError):
        cells = [[]]
    table = np.array(cells)
    if table.shape == (len(rows), len(places)):
        empty = np.array([[row[place] == "" for place in places] for _, row in rows])
        good = np.isfinite(table) | (empty & (np.array(names) != "time_s"))
        for i, name in enumerate(names):
            least, most, _ = LIMITS.get(name, (-math.inf, math.inf, ""))
            good[:, i] &= empty[:, i] | ((table[:, i] >= least) & (table[:, i] <= most))
        if good.all():
            return dict(zip(names, table.T, strict=True))
    for number, row in rows:
        for place, name in zip(places, names, strict=True):
            _check(log, row, place, name, number)
    raise AssertionError("a cell that could not be taken passed every check")


def _check_pairs(path: Path, columns: list[str]) -> None:
    whole = [pair for pair in PAIRS if set(pair) & set(columns)]
    for pair in whole:
        if missing := set(pair) - set(columns):
            raise InputError(f"telemetry {path} lacks {missing.pop()}; wanted {' and '.join(pair)}")
    if len(whole) > 1:
        raise InputError(f"telemetry {path} has places in degrees and in metres; wanted one kind, leave the other out")


def _check(log: Log, row: list[str], place: int, name: str, line: int) -> None:
    """Raises InputError for a cell that is no number; an empty one is unknown, but a row that ends early is cut off."""
    if place < len(row) and row[place] == "" and name != "time_s":
        return
    text = row[place] if place < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        short = "; the line ends before it" if place >= len(row) else ""
        raise log.refuse(f"{name} is '{text}'; wanted a finite number{short}", line)
    least, most, words = LIMITS.get(name, (-math.inf, math.inf, ""))
    if not least <= value <= most:
        raise log.refuse(f"{name} is '{text}'; wanted {words}", line)
