"""Heights of the ground from a GeoTIFF, laid on a grid of local metres so that a look-up costs nothing."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Elevation

LOWEST_M, HIGHEST_M = -500.0, 9000.0
"""A height beyond is no ground's on Earth: a hole that the raster does not declare."""

MOST_CELLS = 2000
"""Heights along a side of the grid; a finer raster is averaged down to it."""


def read_elevation(
    path: str | Path,
    places: np.ndarray,
    origin_deg: tuple[float, float] | None,
    margin_m: float = 500.0,
) -> Elevation:
    """Heights about places (N, 2), relative to that at east = north = 0.

    places: local metres; margin_m: how far around them. origin_deg: (longitude, latitude) of the local metres; None
    where there is none: then they are taken for the raster's own coordinates.
    Where the raster does not cover the origin, up = 0 is the mean height at those places that it does cover.
    Raises InputError where rasterio is missing, the file is no raster, of several bands, without CRS, not in metres, or
    covers none of the places.
    """
    try:
        import rasterio
        from rasterio.errors import RasterioError
    except ImportError:
        raise InputError(
            f"elevation {path} needs rasterio: pip install 'torchvision-dddas[elevation]', or leave --dem out"
        ) from None
    where = np.asarray(places, float).reshape(-1, 2)
    where = where[np.isfinite(where).all(axis=1)]
    if not len(where):
        raise InputError(f"elevation {path}: no place is known to look it up at; give landmarks with places")
    try:
        with rasterio.open(path) as raster:
            _check(raster, path, origin_deg is not None)
            up_m, corner, step = _laid(raster, where, origin_deg, margin_m)
            area = _area(raster, origin_deg is not None)
    except (RasterioError, OSError) as error:
        raise InputError(f"elevation {path} cannot be read as a raster: {' '.join(str(error).split())}") from None
    return _relative(Elevation(up_m, corner, step), where, path, area, origin_deg)


def _check(raster: Any, path: str | Path, geographic: bool) -> None:
    if raster.count != 1:
        raise InputError(f"elevation {path} has {raster.count} bands; wanted a raster of one band, heights in metres")
    if geographic and raster.crs is None:
        raise InputError(f"elevation {path} has no CRS: where it lies is not known; wanted a georeferenced GeoTIFF")
    if not geographic and raster.crs is not None and raster.crs.is_geographic:
        raise InputError(
            f"elevation {path} is in degrees, the landmarks in local metres; give landmarks in longitude_deg,"
            "latitude_deg, or a raster in the same metres"
        )
    unit = (raster.units[0] or "m").lower()
    if unit not in ("m", "metre", "meter", "metres", "meters"):
        raise InputError(f"elevation {path} has heights in {unit}; wanted metres")


def _laid(
    raster: Any, where: np.ndarray, origin_deg: tuple[float, float] | None, margin_m: float
) -> tuple[np.ndarray, tuple[float, float], float]:
    """The raster's heights on local metres: (R, C), its corner (east, north) and its step."""
    from rasterio.crs import CRS
    from rasterio.transform import from_origin
    from rasterio.warp import Resampling, reproject, transform_bounds

    low, high = where.min(axis=0) - margin_m, where.max(axis=0) + margin_m
    step = max(_resolution_m(raster), float((high - low).max()) / MOST_CELLS)
    # A place of the grid at the origin itself, so that its height is the raster's and not that nearby.
    low, high = np.floor(low / step) * step, np.ceil(high / step) * step
    columns, rows = (np.rint((high - low) / step).astype(int) + 1).tolist()
    laid = np.full((rows, columns), np.nan)
    # A raster without CRS lies in the same coordinates: any CRS does for both sides.
    own = raster.crs or CRS.from_epsg(3857)
    local, bounds = own, (*low, *high)
    if origin_deg is not None:
        # On the ellipsoid the orthographic projection is the tangent plane's east and north, as in targets.geodesy.
        local = CRS.from_proj4(f"+proj=ortho +lat_0={origin_deg[1]!r} +lon_0={origin_deg[0]!r} +datum=WGS84 +units=m")
        bounds = transform_bounds(local, own, *bounds)
    heights, transform = _heights(raster, bounds)
    if heights is not None:
        reproject(
            heights,
            laid,
            src_transform=transform,
            src_crs=own,
            src_nodata=np.nan,
            # Places stand at the centres of cells; rasters run from north to south.
            dst_transform=from_origin(low[0] - step / 2, high[1] + step / 2, step, step),
            dst_crs=local,
            dst_nodata=np.nan,
            resampling=Resampling.bilinear,
        )
    return laid[::-1], (float(low[0]), float(low[1])), step


def _heights(raster: Any, bounds: tuple[float, ...]) -> tuple[np.ndarray | None, Any]:
    """The part of the band within bounds, NaN where it has no height, and its transform; None where they are apart."""
    from rasterio.enums import Resampling
    from rasterio.transform import Affine
    from rasterio.windows import Window, from_bounds

    asked = from_bounds(*bounds, transform=raster.transform)
    first = max(math.floor(asked.col_off) - 2, 0), max(math.floor(asked.row_off) - 2, 0)
    last = (
        min(math.ceil(asked.col_off + asked.width) + 2, raster.width),
        min(math.ceil(asked.row_off + asked.height) + 2, raster.height),
    )
    width, height = last[0] - first[0], last[1] - first[1]
    if width <= 0 or height <= 0:
        return None, None
    window = Window(*first, width, height)
    shape = min(height, 2 * MOST_CELLS), min(width, 2 * MOST_CELLS)
    heights = raster.read(1, window=window, out_shape=shape, masked=True, resampling=Resampling.average)
    heights = heights.astype(np.float64).filled(np.nan)
    with np.errstate(invalid="ignore"):
        heights[(heights < LOWEST_M) | (heights > HIGHEST_M)] = np.nan
    return heights, raster.window_transform(window) * Affine.scale(width / shape[1], height / shape[0])


def _resolution_m(raster: Any) -> float:
    """Side of a cell, in metres; of a raster in degrees along its meridian."""
    sides = abs(raster.transform.a), abs(raster.transform.e)
    if raster.crs is not None and raster.crs.is_geographic:
        middle = (raster.bounds.bottom + raster.bounds.top) / 2
        return min(sides[0] * max(math.cos(math.radians(middle)), 0.01), sides[1]) * 111_320.0
    return float(min(sides))


def _area(raster: Any, geographic: bool) -> str:
    """Where the raster lies, in words."""
    if not geographic or raster.crs is None:
        west, south, east, north = raster.bounds
        return f"east {west:.0f} to {east:.0f} m, north {south:.0f} to {north:.0f} m"
    from rasterio.warp import transform_bounds

    west, south, east, north = transform_bounds(raster.crs, "EPSG:4326", *raster.bounds)
    return f"longitude {west:.5f} to {east:.5f}, latitude {south:.5f} to {north:.5f}"


def _relative(
    elevation: Elevation,
    where: np.ndarray,
    path: str | Path,
    area: str,
    origin_deg: tuple[float, float] | None,
) -> Elevation:
    """With up = 0 at the origin."""
    cells = np.rint((np.vstack([np.zeros((1, 2)), where]) - elevation.corner_m) / elevation.step_m).astype(int)
    rows, columns = elevation.up_m.shape
    inside = ((cells >= 0) & (cells < (columns, rows))).all(axis=1)
    heights = np.full(len(cells), np.nan)
    heights[inside] = elevation.up_m[cells[inside, 1], cells[inside, 0]]
    if not np.isfinite(heights[1:]).any():
        low, high = where.min(axis=0), where.max(axis=0)
        lie = f"east {low[0]:.0f} to {high[0]:.0f} m, north {low[1]:.0f} to {high[1]:.0f} m"
        if origin_deg is not None:
            lie += f" of longitude {origin_deg[0]:.5f}, latitude {origin_deg[1]:.5f}"
        raise InputError(f"elevation {path} covers {area}, the landmarks lie at {lie}; it has no height there")
    base = float(heights[0] if np.isfinite(heights[0]) else np.nanmean(heights[1:]))
    return Elevation(elevation.up_m - base, elevation.corner_m, elevation.step_m, base)
