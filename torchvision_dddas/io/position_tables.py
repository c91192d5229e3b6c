"""Positions on the ground from a CSV, as `dddas locate` writes it."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.csv_text import Line, opened
from torchvision_dddas.io.detection_tables import LAST_FRAME
from torchvision_dddas.types import Positions

COLUMNS = ("frame", "target", "east_m", "north_m")
COVARIANCE = ("var_east_m2", "cov_east_north_m2", "var_north_m2")
DEGREES = ("longitude_deg", "latitude_deg")

LIMITS = {"longitude_deg": 180.0, "latitude_deg": 90.0}
"""How far from 0 they may be; any other number FARTHEST."""

FARTHEST = 1e9
"""No place, variance or score is larger."""


def read_positions(path: str | Path) -> Positions:
    """Read COLUMNS, and where they are there COVARIANCE, DEGREES and `score`; others are ignored.

    Rows may come in any order. An empty cell of a covariance or score is not known. A table without rows is valid.
    Raises InputError with file and line: unreadable, a column missing or named twice, not a finite number or out of
    range (see LIMITS), a frame or target that is not whole and 1 or more, variances that are none, a longitude and
    latitude that only some rows have.
    """
    with opened(path, "positions") as (header, lines):
        return _parse(header, lines, str(path))


def _parse(header: list[str], lines: Iterator[Line], path: str) -> Positions:
    if missing := [name for name in COLUMNS if name not in header]:
        raise InputError(
            f"positions {path} lacks {', '.join(missing)}; its columns are {', '.join(header) or 'none'}, "
            f"wanted {','.join(COLUMNS)}"
        )
    if twice := [name for name in header if name and header.count(name) > 1]:
        raise InputError(f"positions {path}: column {twice[0]} is named twice; wanted each name once")
    given = [name for name in (*COLUMNS, *COVARIANCE, *DEGREES, "score") if name in header]
    optional = {*COVARIANCE, *DEGREES, "score"}
    rows: list[list[float]] = []
    lines_of: list[int] = []
    for number, cells in lines:
        if len(cells) != len(header):
            raise InputError(
                f"positions {path}, line {number}: {len(cells)} columns; the first line names {len(header)}"
            )
        row = [cells[header.index(name)] for name in given]
        rows.append([_number(c, n, n in optional, path, number) for c, n in zip(row, given, strict=True)])
        lines_of.append(number)
    table = np.array(rows, float).reshape(-1, len(given))
    order = np.argsort(table[:, 0], kind="stable")
    table, at = table[order], np.array(lines_of, int)[order]
    column = dict(zip(given, table.T, strict=True))
    n, unknown = len(table), np.full(len(table), np.nan)
    east, both, north = (column.get(name, unknown) for name in COVARIANCE)
    # Compared so that what is not known passes; a share more than 1 is left to rounding.
    if (wrong := (east < 0) | (north < 0) | (both**2 > east * north * 1.01 + 1e-8)).any():
        k = int(wrong.argmax())
        raise InputError(
            f"positions {path}, line {at[k]}: {east[k]:g}, {both[k]:g}, {north[k]:g} are no variances of one place; "
            "wanted var_east_m2 and var_north_m2 of 0 or more, and cov_east_north_m2 squared below their product"
        )
    degrees = np.stack([column.get(name, unknown) for name in DEGREES], axis=1)
    known = np.isfinite(degrees).all(axis=1)
    if known.any() and not known.all():
        raise InputError(
            f"positions {path}, line {at[known.argmin()]}: no longitude_deg or latitude_deg, which other rows have; "
            "wanted both in all rows, or leave the columns out"
        )
    return Positions(
        column["frame"].astype(np.int64),
        column["target"].astype(np.int64),
        np.stack([column["east_m"], column["north_m"]], axis=1),
        np.stack([east, both, both, north], axis=1).reshape(n, 2, 2),
        column.get("score", np.ones(n)),
        lonlat_deg=degrees if set(DEGREES) <= column.keys() and known.all() else None,
    )


def _number(text: str, name: str, may_lack: bool, path: str, line: int) -> float:
    if may_lack and not text:
        return np.nan
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"positions {path}, line {line}: {name} is '{text}'; wanted a finite number")
    if name in ("frame", "target"):
        most = LAST_FRAME if name == "frame" else 2**53
        if not (1 <= value <= most and value == int(value)):
            raise InputError(f"positions {path}, line {line}: {name} is '{text}'; wanted a whole number, 1 to {most}")
    elif abs(value) > (limit := LIMITS.get(name, FARTHEST)):
        raise InputError(f"positions {path}, line {line}: {name} is '{text}'; wanted {-limit:g} to {limit:g}")
    return value
