"""Landmarks from a CSV: where ground vehicles of known place reported to be, and where pictures show them.

frame,landmark,longitude_deg,latitude_deg       # or time_s; or east_m,north_m; optional u_px,v_px, sigma_m, planned
1,rover,-110.95000,32.23000
"""

from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import great_circle_m
from torchvision_dddas.io.csv_text import Line, opened
from torchvision_dddas.io.tables import LAST_FRAME
from torchvision_dddas.types import Landmarks

PLACES = (("longitude_deg", "latitude_deg"), ("east_m", "north_m"))
IMAGE = ("u_px", "v_px")

LIMITS = {
    "frame": (1, LAST_FRAME),
    "time_s": (-1e10, 1e10),
    "longitude_deg": (-180, 180),
    "latitude_deg": (-90, 90),
    "east_m": (-1e7, 1e7),
    "north_m": (-1e7, 1e7),
    "u_px": (-1e6, 1e6),
    "v_px": (-1e6, 1e6),
    "sigma_m": (0, 1e5),
    "planned": (0, 1),
}
"""Every column that is a number, and what it may be."""

FARTHEST_M = 100_000.0
"""Landmarks of one table are no further apart: what lies beyond is a typing mistake."""

Columns = dict[str, np.ndarray]


def read_landmarks(path: str | Path, rate_hz: float | None = None, clock_offset_s: float = 0.0) -> Landmarks:
    """Read `frame` or `time_s`, `landmark` (a name or a number), a place; `u_px,v_px`, `sigma_m`, `planned` if there.

    Rows may come in any order; further columns are ignored. An empty place is a dropout, an empty u_px and v_px not
    seen. Times become frames, 1 + (time_s + clock_offset_s) rate_hz, whole ones where the row has a place in the
    picture; a table by frames has no use for rate and offset.
    Raises InputError with file and line: unreadable, a column missing or named twice, times without a rate, not a
    number, out of range, longitude and latitude swapped, degrees and metres mixed, half a place, a landmark twice in a
    frame, places further apart than FARTHEST_M.
    """
    with opened(path, "landmarks") as (header, lines):
        return _parse(header, list(lines), str(path), rate_hz, clock_offset_s)


def _parse(header: list[str], lines: list[Line], path: str, rate_hz: float | None, offset_s: float) -> Landmarks:
    _check_header(header, path, rate_hz)
    for number, cells in lines:
        if len(cells) != len(header):
            raise InputError(
                f"landmarks {path}, line {number}: {len(cells)} columns; the first line names {len(header)}"
            )
    if not lines:
        raise InputError(f"landmarks {path} has a header but no rows")
    numbers = np.array([line.number for line in lines], np.int64)
    text = dict(zip(header, zip(*(line.cells for line in lines), strict=True), strict=True))
    columns = {name: _column(text[name], name, path, numbers) for name in LIMITS if name in text}
    kind = _kind(columns, path, numbers)
    _check_ranges(columns, text, path, numbers)
    place, image = _pair(columns, kind, path, numbers), _pair(columns, IMAGE, path, numbers)
    planned = columns.get("planned", np.zeros(len(lines))) == 1
    seen = np.isfinite(image[:, 0])
    for wrong, why in (
        (planned & ~np.isfinite(place[:, 0]), "planned is 1 but there is no place; wanted the waypoint's"),
        (planned & seen, "planned is 1 and there is a u_px; a waypoint is not seen, leave u_px and v_px empty"),
    ):
        if wrong.any():
            raise InputError(f"landmarks {path}, line {numbers[wrong.argmax()]}: {why}")
    frame = columns.get("frame")
    if frame is None:
        frame = 1 + (columns["time_s"] + offset_s) * (rate_hz or 1.0)
        # A picture's time is written with three digits or so: what is seen is seen in a whole frame.
        frame = np.round(np.where(seen, np.round(frame), frame), 6)
    names, landmark = _names(text["landmark"], path, numbers)
    geographic = kind == PLACES[0]
    order = np.argsort(frame, kind="stable")
    found = Landmarks(
        names,
        frame[order],
        landmark[order],
        image[order],
        place[order],
        columns.get("sigma_m", np.full(len(lines), np.nan))[order],
        planned[order],
        numbers[order],
        geographic,
        path,
    )
    _check_twice(found)
    _check_far(found)
    return found


def _check_header(header: list[str], path: str, rate_hz: float | None) -> None:
    columns = ", ".join(header) or "none"
    if twice := [name for name in (*LIMITS, "landmark") if header.count(name) > 1]:
        raise InputError(f"landmarks {path}: column {twice[0]} is named twice; wanted each name once")
    missing = ["frame or time_s"] if not {"frame", "time_s"} & set(header) else []
    if "landmark" not in header:
        missing.append("landmark")
    halves = [name for pair in (*PLACES, IMAGE) if len(set(pair) & set(header)) == 1 for name in pair]
    missing += [name for name in halves if name not in header]
    if not halves and not any(set(kind) <= set(header) for kind in PLACES):
        missing.append("longitude_deg,latitude_deg (or east_m,north_m)")
    if missing:
        raise InputError(f"landmarks {path} lacks {', '.join(missing)}; its columns are {columns}")
    if {"frame", "time_s"} <= set(header):
        raise InputError(f"landmarks {path} has both frame and time_s; give one of them")
    if "time_s" in header and rate_hz is None:
        raise InputError(f"landmarks {path} are by time_s; say with --rate how many frames a second there are")


def _column(cells: tuple[str, ...], name: str, path: str, numbers: np.ndarray) -> np.ndarray:
    """(N,) float64, NaN for an empty cell."""
    try:
        values = np.array([cell or "nan" for cell in cells]).astype(float)
    except ValueError:
        values = np.array([_value(cell) for cell in cells])
    wrong = np.isinf(values)  # what is no number has become infinite
    if name in ("frame", "time_s"):
        wrong |= np.isnan(values)
    if name == "frame":
        wrong |= np.isfinite(values) & (values != np.round(values))
    if wrong.any():
        k = int(wrong.argmax())
        wanted = "a whole number, from 1; between two pictures, give time_s" if name == "frame" else "a number"
        raise InputError(f"landmarks {path}, line {numbers[k]}: {name} is '{cells[k]}'; wanted {wanted}")
    return values


def _value(cell: str) -> float:
    try:
        return float(cell or "nan")
    except ValueError:
        return np.inf


def _kind(columns: Columns, path: str, numbers: np.ndarray) -> tuple[str, str]:
    """The kind of place that the rows have."""
    given = [[name for name in kind if name in columns] for kind in PLACES]
    if not all(given):
        return PLACES[0] if given[0] else PLACES[1]
    used = [np.isfinite([columns[name] for name in kind]).any(axis=0) for kind in PLACES]
    if (both := used[0] & used[1]).any():
        raise InputError(
            f"landmarks {path}, line {numbers[both.argmax()]}: a place in degrees and in metres; give one kind in all "
            "rows and leave the columns of the other out"
        )
    if used[0].any() and used[1].any():
        raise InputError(
            f"landmarks {path}: line {numbers[used[0].argmax()]} has its place in degrees, line "
            f"{numbers[used[1].argmax()]} in metres; give one kind in all rows"
        )
    return PLACES[1] if used[1].any() else PLACES[0]


def _check_ranges(columns: Columns, text: dict[str, tuple[str, ...]], path: str, numbers: np.ndarray) -> None:
    for name in ("latitude_deg", *columns):  # a latitude tells more of a mistake than a longitude
        if name not in columns:
            continue
        low, high = LIMITS[name]
        wrong = (columns[name] < low) | (columns[name] > high)
        if name == "planned":
            wrong |= (columns[name] > 0) & (columns[name] < 1)
        if not wrong.any():
            continue
        k = int(wrong.argmax())
        wanted = "0 or 1" if name == "planned" else f"{low:g} to {high:g}"
        hint = ""
        if name in PLACES[0]:
            longitude, latitude = (columns[axis][k] for axis in PLACES[0])
            if abs(latitude) <= 180 and abs(longitude) <= 90:
                hint = "; longitude and latitude look swapped"
            elif abs(columns[name][k]) > 180:
                hint = "; if these are metres, name the columns east_m,north_m"
        raise InputError(f"landmarks {path}, line {numbers[k]}: {name} is '{text[name][k]}'; wanted {wanted}{hint}")


def _pair(columns: Columns, names: tuple[str, str], path: str, numbers: np.ndarray) -> np.ndarray:
    """(N, 2), NaN where a row has neither."""
    if names[0] not in columns:
        return np.full((len(numbers), 2), np.nan)
    pair = np.stack([columns[name] for name in names], axis=1)
    half = np.isnan(pair).sum(axis=1) == 1
    if half.any():
        k = int(half.argmax())
        here = names[int(np.isnan(pair[k, 0]))]
        raise InputError(f"landmarks {path}, line {numbers[k]}: {here} alone; wanted {' and '.join(names)}, or neither")
    return pair


def _names(cells: tuple[str, ...], path: str, numbers: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
    """The landmarks' names as they first appear, and (N,) which each row is of."""
    index: dict[str, int] = {}
    landmark = np.array([index.setdefault(cell, len(index)) for cell in cells], np.int64)
    if "" in index:
        k = int((landmark == index[""]).argmax())
        raise InputError(f"landmarks {path}, line {numbers[k]}: landmark is empty; wanted its name or number")
    return tuple(index), landmark


def _check_twice(found: Landmarks) -> None:
    order = np.lexsort((found.line, found.planned, found.landmark, found.frame))
    keys = np.stack([found.frame, found.landmark, found.planned])[:, order]
    same = (keys[:, 1:] == keys[:, :-1]).all(axis=0)
    if same.any():
        # The first in the file, whatever the order of frames.
        k = int(np.where(same, found.line[order][1:], np.iinfo(np.int64).max).argmin())
        first, again = (int(found.line[order[k + i]]) for i in (0, 1))
        raise InputError(
            f"landmarks {found.path}, line {again}: {found.names[found.landmark[order[k]]]} is in frame "
            f"{found.frame[order[k]]:g} already, by line {first}; wanted each landmark once in a frame"
        )


def _check_far(found: Landmarks) -> None:
    known = np.isfinite(found.place[:, 0])
    if not known.any():
        return
    start = found.place[known][0]
    from_start = found.place - start
    if found.geographic:
        from_start[:, 0] = (from_start[:, 0] + 180) % 360 - 180  # both sides of 180 degrees are near each other
    middle = start + np.median(from_start[known], axis=0)
    away = great_circle_m(found.place, middle) if found.geographic else np.linalg.norm(found.place - middle, axis=1)
    away = np.where(known, away, 0.0)
    k = int(away.argmax())
    if away[k] > FARTHEST_M:
        first, second = found.place[k]
        fix = "; a receiver without a fix says so: leave the place empty" if first == second == 0 else ""
        raise InputError(
            f"landmarks {found.path}, line {found.line[k]}: {first:g}, {second:g} lies {away[k] / 1000:.0f} km from "
            f"most others; wanted at most {FARTHEST_M / 1000:g} km{fix or ': check the digits'}"
        )
