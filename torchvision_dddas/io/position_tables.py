"""Positions on the ground from a CSV, as `dddas locate` writes it."""

from pathlib import Path

import numpy as np

from torchvision_dddas.io.tables import (
    COVARIANCE,
    DEGREES,
    EAST_NORTH,
    FARTHEST,
    FRAME,
    TARGET,
    Column,
    Schema,
    read_table,
)
from torchvision_dddas.types import Positions

SCORE = Column("score", ".6g", -FARTHEST, FARTHEST, may_be_empty=True)
SCHEMA = Schema("positions", FRAME, TARGET, *EAST_NORTH, *COVARIANCE, *DEGREES, SCORE)
REQUIRED = ("frame", "target", "east_m", "north_m")


def read_positions(path: str | Path) -> Positions:
    """Read the REQUIRED columns, and the covariance, longitude_deg, latitude_deg and score where they are there.

    Rows may come in any order. An empty cell of a covariance or score is unknown. A table without rows is valid.
    Raises InputError with file and line: as read_table, variances that cannot be, a longitude and latitude that only
    some rows have.
    """
    table = read_table(path, SCHEMA, REQUIRED)
    east, both, north = (table[column.name] for column in COVARIANCE)
    # Unknown variances pass each comparison; a share above 1 allows for rounding.
    is_wrong = (east < 0) | (north < 0) | (both**2 > east * north * 1.01 + 1e-8)
    if is_wrong.any():
        row = int(is_wrong.argmax())
        raise table.error(
            f"{east[row]:g}, {both[row]:g}, {north[row]:g} are no variances of one place; wanted var_east_m2 and "
            "var_north_m2 of 0 or more, and cov_east_north_m2 squared below their product",
            row,
        )
    degrees = table.stack(*(column.name for column in DEGREES))
    is_known = np.isfinite(degrees).all(axis=1)
    if is_known.any():
        table.refuse(
            ~is_known,
            "no longitude_deg or latitude_deg, which other rows have; wanted both in all rows or in none",
        )
    order = np.argsort(table["frame"], kind="stable")
    return Positions(
        table["frame"][order].astype(np.int64),
        table["target"][order].astype(np.int64),
        table.stack("east_m", "north_m")[order],
        np.stack([east, both, both, north], axis=1).reshape(-1, 2, 2)[order],
        table["score"][order] if "score" in table else np.ones(len(table)),
        lonlat_deg=degrees[order] if "longitude_deg" in table and is_known.all() else None,
    )
