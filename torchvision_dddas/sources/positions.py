"""Positions on the ground from a CSV, as `dddas locate` writes it."""

import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Positions

COLUMNS = ("frame", "target", "east_m", "north_m")
COVARIANCE = ("var_east_m2", "cov_east_north_m2", "var_north_m2")
DEGREES = ("longitude_deg", "latitude_deg")


def read_positions(path: str | Path) -> Positions:
    """Read COLUMNS, and where they are there COVARIANCE, DEGREES and `score`; others are ignored.

    Rows may come in any order. An empty cell of a covariance is not known. A table without rows is valid.
    Raises InputError with file and line: unreadable, a column missing, not a finite number, a frame or target that is
    not whole and 1 or more.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            return _parse(file, str(path))
    except OSError as error:
        raise InputError(f"positions {path} cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"positions {path} is no CSV text: {error}") from None


def _parse(lines: Iterable[str], path: str) -> Positions:
    reader = csv.reader(lines, skipinitialspace=True)
    header = [name.strip() for name in next(reader, [])]
    if missing := [name for name in COLUMNS if name not in header]:
        raise InputError(
            f"positions {path} lacks {', '.join(missing)}; its columns are {', '.join(header) or 'none'}, "
            f"wanted {','.join(COLUMNS)}"
        )
    given = [name for name in (*COLUMNS, *COVARIANCE, *DEGREES, "score") if name in header]
    optional = {*COVARIANCE, *DEGREES, "score"}
    rows: list[list[float]] = []
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise InputError(
                f"positions {path}, line {reader.line_num}: {len(cells)} columns; the first line names {len(header)}"
            )
        row = [cells[header.index(name)].strip() for name in given]
        rows.append([_number(c, n, n in optional, path, reader.line_num) for c, n in zip(row, given, strict=True)])
    table = np.array(rows, float).reshape(-1, len(given))
    table = table[np.argsort(table[:, 0], kind="stable")]
    column = dict(zip(given, table.T, strict=True))
    n, unknown = len(table), np.full(len(table), np.nan)
    east, both, north = (column.get(name, unknown) for name in COVARIANCE)
    return Positions(
        column["frame"].astype(np.int64),
        column["target"].astype(np.int64),
        np.stack([column["east_m"], column["north_m"]], axis=1),
        np.stack([east, both, both, north], axis=1).reshape(n, 2, 2),
        column.get("score", np.ones(n)),
        lonlat_deg=np.stack([column[name] for name in DEGREES], axis=1) if set(DEGREES) <= column.keys() else None,
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
    if name in ("frame", "target") and not (value >= 1 and value == int(value)):
        raise InputError(f"positions {path}, line {line}: {name} is '{text}'; wanted a whole number, 1 or more")
    return value
