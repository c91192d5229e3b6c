"""What the vehicle reports of itself, from a CSV of `time_s,altitude_m,speed_m_s`."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.sources.csv_text import Line, opened
from torchvision_dddas.types import Flight, Telemetry

COLUMNS = ("time_s", "altitude_m", "speed_m_s")


def read_telemetry(path: str | Path) -> Telemetry:
    """Read the three columns by name; further columns are ignored, blank lines skipped.

    Raises InputError with file and line: unreadable, a column missing, no rows, not a finite number, a
    negative speed, time running back.
    """
    with opened(path, "telemetry") as (header, lines):
        return _parse(header, lines, str(path))


def at(telemetry: Telemetry, time_s: float, tolerance_s: float = 1.0) -> Flight | None:
    """Altitude and speed at a time, linear between samples.

    Up to tolerance_s outside the span the nearest sample holds; beyond it nothing is known: None.
    """
    times = telemetry.time_s
    if len(times) == 0 or not times[0] - tolerance_s <= time_s <= times[-1] + tolerance_s:
        return None
    return Flight(
        float(np.interp(time_s, times, telemetry.altitude_m)), float(np.interp(time_s, times, telemetry.speed_m_s))
    )


def _parse(header: list[str], lines: Iterator[Line], path: str) -> Telemetry:
    if missing := [name for name in COLUMNS if name not in header]:
        raise InputError(
            f"telemetry {path} lacks {', '.join(missing)}; its columns are {', '.join(header) or 'none'}, "
            f"wanted {','.join(COLUMNS)}"
        )
    places = [header.index(name) for name in COLUMNS]
    rows: list[list[float]] = []
    for number, cells in lines:
        rows.append([_number(cells, place, header, path, number) for place in places])
        if len(rows) > 1 and rows[-1][0] < rows[-2][0]:
            raise InputError(
                f"telemetry {path}, line {number}: time_s runs back from {rows[-2][0]:g} to {rows[-1][0]:g}; "
                "sort it by time"
            )
    if not rows:
        raise InputError(f"telemetry {path} has a header but no rows")
    time_s, altitude_m, speed_m_s = np.array(rows, float).T
    return Telemetry(time_s, altitude_m, speed_m_s)


def _number(row: list[str], place: int, header: list[str], path: str, line: int) -> float:
    text = row[place] if place < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"telemetry {path}, line {line}: {header[place]} is '{text}'; wanted a finite number")
    if value < 0 and header[place] == "speed_m_s":
        raise InputError(
            f"telemetry {path}, line {line}: speed_m_s is '{text}'; wanted the speed over ground, 0 or more"
        )
    return value
