"""Read CSV tables of places on the ground: landmarks, which are vehicles of known place, and located targets.

frame,landmark,longitude_deg,latitude_deg       # or time_s; or east_m,north_m; optional u_px,v_px, sigma_m, planned
1,rover,-110.95000,32.23000
"""

from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import great_circle_m
from torchvision_dddas.io.tables import (
    COVARIANCE,
    DEGREES,
    EAST_NORTH,
    FARTHEST,
    FRAME,
    PLACES,
    TARGET,
    Column,
    CsvTable,
    Schema,
    check_crowding,
    read_csv,
    read_table,
)
from torchvision_dddas.types import Landmarks, Positions

IMAGE = ("u_px", "v_px")
HEIGHT_M = -600.0, 9000.0
"""Lowest and highest ground, above the sea or above the ellipsoid."""
LANDMARKS = Schema(
    "landmarks",
    Column("frame", "d", 1, FRAME.high, True, wanted="a whole number from 1; between two pictures, give time_s"),
    Column("time_s", "g", -1e10, 1e10),
    Column("landmark"),
    *(Column(name, ".9f", may_be_empty=True, wanted="a number") for name in ("latitude_deg", "longitude_deg")),
    *(Column(name, ".4f", -1e7, 1e7, may_be_empty=True) for name in PLACES[1]),
    *(Column(name, ".3f", -1e6, 1e6, may_be_empty=True) for name in IMAGE),
    Column("sigma_m", ".6g", 0, 1e5, may_be_empty=True),
    Column("planned", "d", 0, 1, True, may_be_empty=True, wanted="0 or 1"),
    *(Column(name, ".3f", *HEIGHT_M, may_be_empty=True) for name in ("elevation_m", "above_ellipsoid_m")),
)
FARTHEST_M = 100_000.0
"""Largest distance between landmarks of one table; larger distances are typing mistakes."""


def read_landmarks(path: str | Path, *, rate_hz: float | None = None, clock_offset_s: float = 0.0) -> Landmarks:
    r"""Read `frame` or `time_s`, `landmark` (a name or a number), a place, and the other columns of LANDMARKS if given.

    Rows may come in any order; further columns are ignored. An empty place is a dropout, and empty u_px and v_px mean
    not seen; `nan` counts as empty. Times become frames, 1 + (time_s + clock_offset_s) rate_hz, rounded if the row has
    pixels; a table by frames ignores rate and offset.
    Raise InputError with file and line as read_table does, and for times without a rate, swapped degrees, degrees
    beside metres, half a place, a landmark twice in a frame, or places further apart than FARTHEST_M.

    >>> written = pathlib.Path("marks.csv").write_text("frame,landmark,east_m,north_m\n1,a,3.0,4.0\n1,b,7.0,4.0\n")
    >>> td.read_landmarks("marks.csv").names
    ('a', 'b')
    """
    text = read_csv(path, "landmarks")
    _check_header(text.header, path, rate_hz)
    names = text.header.index("landmark")
    rows = [["" if cell.lower() == "nan" and k != names else cell for k, cell in enumerate(row)] for row in text.rows]
    table = read_table(path, LANDMARKS, text=text._replace(rows=rows))
    table.require_rows()
    _check_degrees(table)
    place, is_geographic = _places(table)
    image = _pair(table, IMAGE)
    planned, is_seen = table["planned"] == 1, np.isfinite(image[:, 0])
    table.refuse(planned & np.isnan(place[:, 0]), "planned is 1 but there is no place; give the waypoint's place")
    table.refuse(
        planned & is_seen, "planned is 1 and there is a u_px; a waypoint is not seen, leave u_px and v_px empty"
    )
    frame = table["frame"]
    if "frame" not in table:
        frame = 1 + (table["time_s"] + clock_offset_s) * (rate_hz or 1.0)
        # A picture's time is written with about three digits, so a pixel belongs to a whole frame.
        frame = np.round(np.where(is_seen, np.round(frame), frame), 6)
    check_crowding(frame, f"landmarks {path}", "landmarks")
    index: dict[str, int] = {}
    landmark = np.array([index.setdefault(name, len(index)) for name in table.columns["landmark"]], np.int64)
    table.refuse(landmark == index.get("", -1), "landmark is empty; give its name or number")
    columns = (frame, landmark, image, place, table["sigma_m"], planned, table.line)
    heights = {name: table[name] for name in ("elevation_m", "above_ellipsoid_m")}
    found = Landmarks(tuple(index), *columns, is_geographic, str(path), **heights)[np.argsort(frame, kind="stable")]
    _check_once_a_frame(found)
    _check_far(found)
    return found


def _check_header(header: list[str], path: str | Path, rate_hz: float | None) -> None:
    missing = ["frame or time_s"] if not {"frame", "time_s"} & set(header) else []
    missing += ["landmark"] if "landmark" not in header else []
    halves = [name for pair in (*PLACES, IMAGE) if len(set(pair) & set(header)) == 1 for name in pair]
    missing += [name for name in halves if name not in header]
    if not halves and not any(set(kind) <= set(header) for kind in PLACES):
        missing.append("longitude_deg,latitude_deg (or east_m,north_m)")
    if missing:
        columns = ", ".join(header) or "none"
        raise InputError(f"landmarks {path} lacks {', '.join(missing)}; its columns are {columns}")
    if {"frame", "time_s"} <= set(header):
        raise InputError(f"landmarks {path} has both frame and time_s; give one of them")
    if "time_s" in header and rate_hz is None:
        raise InputError(f"landmarks {path} has times (time_s); pass --rate, the number of frames a second")


def _check_degrees(table: CsvTable) -> None:
    """Check the ranges of degrees, latitudes first: they reveal swapped columns more often than longitudes."""
    for name, most in (("latitude_deg", 90), ("longitude_deg", 180)):
        is_wrong = np.abs(table[name]) > most
        if is_wrong.any():
            row = int(is_wrong.argmax())
            longitude, latitude = table.stack(*PLACES[0])[row]
            hint = ""
            if abs(latitude) <= 180 and abs(longitude) <= 90:
                hint = "; longitude and latitude look swapped"
            elif abs(table[name][row]) > 180:
                hint = "; if these are metres, name the columns east_m,north_m"
            raise table.error(f"{name} is '{table.cell(name, row)}'; wanted -{most} to {most}{hint}", row)


def _places(table: CsvTable) -> tuple[np.ndarray, bool]:
    """Return the places (N, 2), and whether they are longitudes and latitudes."""
    degrees, metres = (_pair(table, kind) for kind in PLACES)
    in_degrees, in_metres = np.isfinite(degrees[:, 0]), np.isfinite(metres[:, 0])
    table.refuse(
        in_degrees & in_metres,
        "the row has a place in degrees and in metres; give one kind in all rows and leave the other columns out",
    )
    if in_degrees.any() and in_metres.any():
        first, second = (table.line[known.argmax()] for known in (in_degrees, in_metres))
        raise table.error(f"line {first} has its place in degrees, line {second} in metres; give one kind in all rows")
    is_geographic = bool(in_degrees.any()) or ("longitude_deg" in table and not in_metres.any())
    return degrees if is_geographic else metres, is_geographic


def _pair(table: CsvTable, names: tuple[str, str]) -> np.ndarray:
    """Return two columns as (N, 2), NaN for a row with neither."""
    pair = table.stack(*names)
    is_half = np.isnan(pair).sum(axis=1) == 1
    if is_half.any():
        given = names[int(np.isnan(pair[is_half.argmax(), 0]))]
        table.refuse(is_half, f"{given} alone; wanted {' and '.join(names)}, or neither")
    return pair


def _check_once_a_frame(found: Landmarks) -> None:
    order = np.lexsort((found.line, found.planned, found.landmark, found.frame))
    keys = np.stack([found.frame, found.landmark, found.planned])[:, order]
    is_same = (keys[:, 1:] == keys[:, :-1]).all(axis=0)
    if is_same.any():
        # Report the first duplicate in the file, whatever the order of the frames is.
        k = int(np.where(is_same, found.line[order][1:], np.iinfo(np.int64).max).argmin())
        row, again = order[k : k + 2]
        raise InputError(
            f"landmarks {found.path}, line {found.line[again]}: {found.names[found.landmark[row]]} is in frame "
            f"{found.frame[row]:g} already, by line {found.line[row]}; give each landmark once in a frame"
        )


def _check_far(found: Landmarks) -> None:
    is_known = np.isfinite(found.place[:, 0])
    if not is_known.any():
        return
    start = found.place[is_known][0]
    from_start = found.place - start
    if found.geographic:
        from_start[:, 0] = (from_start[:, 0] + 180) % 360 - 180  # places on both sides of 180 degrees are neighbours
    middle = start + np.median(from_start[is_known], axis=0)
    away = great_circle_m(found.place, middle) if found.geographic else np.linalg.norm(found.place - middle, axis=1)
    k = int(np.where(is_known, away, 0.0).argmax())
    if away[k] > FARTHEST_M:
        first, second = found.place[k]
        fix = "a receiver without a fix reports 0, 0: leave it empty" if first == second == 0 else "check the digits"
        raise InputError(
            f"landmarks {found.path}, line {found.line[k]}: {first:g}, {second:g} lies {away[k] / 1000:.0f} km from "
            f"most others; wanted at most {FARTHEST_M / 1000:g} km: {fix}"
        )


# --------------------------------------------------------------------------------------------------------------------
# Tables of the positions of targets. `dddas locate` writes them.

SCORE = Column("score", ".6g", -FARTHEST, FARTHEST, may_be_empty=True)
POSITIONS = Schema("positions", FRAME, TARGET, *EAST_NORTH, *COVARIANCE, *DEGREES, SCORE)
POSITION_COLUMNS = ("frame", "target", "east_m", "north_m")


def read_positions(path: str | Path) -> Positions:
    r"""Read POSITION_COLUMNS, and the covariance, longitude_deg, latitude_deg and score if given.

    Rows may come in any order. An empty cell of a covariance or score is unknown. A table without rows is valid.
    Raise InputError with file and line as read_table does, and for impossible variances, or if only some rows have
    longitude and latitude.

    >>> written = pathlib.Path("places.csv").write_text("frame,target,east_m,north_m\n1,7,3.0,4.0\n")
    >>> td.read_positions("places.csv").east_north_m
    array([[3., 4.]])
    """
    table = read_table(path, POSITIONS, POSITION_COLUMNS)
    check_crowding(table["frame"], f"positions {path}", "places")
    east, both, north = (table[column.name] for column in COVARIANCE)
    # Unknown variances (NaN) pass these comparisons. Rounding may give a correlation slightly above 1.
    is_wrong = (east < 0) | (north < 0) | (both**2 > east * north * 1.01 + 1e-8)
    if is_wrong.any():
        row = int(is_wrong.argmax())
        raise table.error(
            f"{east[row]:g}, {both[row]:g}, {north[row]:g} are not the variances of a place; wanted var_east_m2 and "
            "var_north_m2 of 0 or more, and cov_east_north_m2 squared below their product",
            row,
        )
    degrees = table.stack(*PLACES[0])
    is_known = np.isfinite(degrees).all(axis=1)
    if is_known.any():
        table.refuse(
            ~is_known,
            "no longitude_deg or latitude_deg, which other rows have; give both in all rows or in none",
        )
    return Positions(
        table["frame"].astype(np.int64),
        table["target"].astype(np.int64),
        table.stack("east_m", "north_m"),
        np.stack([east, both, both, north], axis=1).reshape(-1, 2, 2),
        table["score"] if "score" in table else np.ones(len(table)),
        lonlat_deg=degrees if "longitude_deg" in table and is_known.all() else None,
    )[np.argsort(table["frame"], kind="stable")]
