"""Heights of the ground from a GeoTIFF, on a grid of local metres so that a look-up costs nothing."""

from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.elevation.raster import area, laid, lie, opened
from torchvision_dddas.types import Elevation

LOWEST_M, HIGHEST_M = -500.0, 9000.0
"""A height beyond is no ground's on Earth: a hole that the raster does not declare."""

MOST_CELLS = 2000
"""Heights along a side of the grid; a finer raster is averaged down to it."""


def read_elevation(
    path: str | Path, places: np.ndarray, origin_deg: tuple[float, float] | None, margin_m: float = 500.0
) -> Elevation:
    """Heights about places (N, 2), relative to that at east = north = 0.

    places: local metres; margin_m: how far around them. origin_deg: (longitude, latitude) of the local metres; None
    where there is none: then they are taken for the raster's own coordinates.
    Where the raster does not cover the origin, up = 0 is the mean height at those places that it does cover.
    Raises InputError where rasterio is missing, the file is no raster, of several bands, without CRS, not in metres, or
    covers none of the places.
    """
    where = np.asarray(places, float).reshape(-1, 2)
    where = where[np.isfinite(where).all(axis=1)]
    if not len(where):
        raise InputError(f"elevation {path}: no place is known to look it up at; give landmarks with places")
    with opened(path, "elevation", origin_deg is not None) as raster:
        if raster.count != 1:
            raise InputError(f"elevation {path} has {raster.count} bands; wanted one, of heights in metres")
        unit = (raster.units[0] or "m").lower()
        if unit not in ("m", "metre", "meter", "metres", "meters"):
            raise InputError(f"elevation {path} has heights in {unit}; wanted metres")
        grid = laid(raster, 1, where, origin_deg, margin_m, MOST_CELLS, (LOWEST_M, HIGHEST_M))
        covers = area(raster, origin_deg is not None)
    heights = grid.values
    cells = np.rint((np.vstack([np.zeros((1, 2)), where]) - grid.corner_m) / grid.step_m).astype(int)
    inside = ((cells >= 0) & (cells < heights.shape[::-1])).all(axis=1)
    known = np.full(len(cells), np.nan)
    known[inside] = heights[cells[inside, 1], cells[inside, 0]]
    if not np.isfinite(known[1:]).any():
        raise InputError(
            f"elevation {path} covers {covers}, the landmarks lie at {lie(where, origin_deg)}; it has no height there"
        )
    base = float(known[0] if np.isfinite(known[0]) else np.nanmean(known[1:]))
    return Elevation(heights - base, grid.corner_m, grid.step_m, base)
