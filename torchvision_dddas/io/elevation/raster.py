"""A georeferenced raster laid on a grid of local metres."""

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError


@dataclass(frozen=True)
class Laid:
    """values: (R, C) or (B, R, C), rows to the north, NaN where the raster has none. corner_m: of the first; step_m."""

    values: np.ndarray
    corner_m: tuple[float, float]
    step_m: float


@contextmanager
def opened(path: str | Path, what: str, geographic: bool) -> Iterator[Any]:
    """An open raster. geographic: whether local metres have a geographic origin, so that a CRS is needed.

    Raises InputError where rasterio is missing, the file is no raster, or its CRS does not fit.
    """
    try:
        import rasterio
        from rasterio.errors import NotGeoreferencedWarning, RasterioError
    except ImportError:
        raise InputError(
            f"{what} {path} needs rasterio: pip install 'torchvision-dddas[elevation]', or leave it out"
        ) from None
    try:
        with warnings.catch_warnings():
            # What it warns of is refused below, in one line.
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            raster = rasterio.open(path)
        with raster:
            if raster.crs is None and raster.transform.is_identity:
                raise InputError(f"{what} {path} does not say where it lies; wanted a georeferenced GeoTIFF")
            t = raster.transform
            if not (np.isfinite([*t]).all() and 0 < abs(t.a * t.e - t.b * t.d) < math.inf):
                raise InputError(f"{what} {path} is damaged: its cells have no size")
            if geographic and raster.crs is None:
                raise InputError(
                    f"{what} {path} has no CRS: where it lies is not known; wanted a georeferenced GeoTIFF"
                )
            if not geographic and raster.crs is not None and raster.crs.is_geographic:
                raise InputError(
                    f"{what} {path} is in degrees, the landmarks in local metres; give landmarks in longitude_deg,"
                    "latitude_deg, or a raster in the same metres"
                )
            yield raster
    except (RasterioError, OSError) as error:
        raise InputError(f"{what} {path} cannot be read as a raster: {' '.join(str(error).split())}") from None


def laid(
    raster: Any,
    bands: int | list[int],
    where: np.ndarray,
    origin_deg: tuple[float, float] | None,
    margin_m: float,
    most_cells: int,
    within: tuple[float, float] = (-math.inf, math.inf),
) -> Laid:
    """Bands of a raster about places (N, 2) in local metres; a finer one is averaged down to most_cells a side.

    within: values beyond are holes that the raster does not declare. origin_deg: (longitude, latitude) of the local
    metres; None: they are the raster's own coordinates.
    """
    from rasterio.crs import CRS
    from rasterio.transform import from_origin
    from rasterio.warp import Resampling, reproject, transform_bounds

    low, high = where.min(axis=0) - margin_m, where.max(axis=0) + margin_m
    step = max(_resolution_m(raster), float((high - low).max()) / most_cells)
    # A place of the grid at the origin itself, so that its value is the raster's and not that nearby.
    low, high = np.floor(low / step) * step, np.ceil(high / step) * step
    columns, rows = (np.rint((high - low) / step).astype(int) + 1).tolist()
    # A raster without CRS lies in the same coordinates: any CRS does for both sides.
    own = raster.crs or CRS.from_epsg(3857)
    local, bounds = own, (*low, *high)
    if origin_deg is not None:
        # On the ellipsoid the orthographic projection is the tangent plane's east and north, as in targets.geodesy.
        local = CRS.from_proj4(f"+proj=ortho +lat_0={origin_deg[1]!r} +lon_0={origin_deg[0]!r} +datum=WGS84 +units=m")
        bounds = transform_bounds(local, own, *bounds)
    shape = (rows, columns) if isinstance(bands, int) else (len(bands), rows, columns)
    values = np.full(shape, np.nan)
    source, transform = _part(raster, bands, bounds, 2 * most_cells)
    if source is not None:
        # Before they are mixed with their neighbours.
        source[~((source >= within[0]) & (source <= within[1]))] = np.nan
        reproject(
            source,
            values,
            src_transform=transform,
            src_crs=own,
            src_nodata=np.nan,
            # Places stand at the centres of cells; rasters run from north to south.
            dst_transform=from_origin(low[0] - step / 2, high[1] + step / 2, step, step),
            dst_crs=local,
            dst_nodata=np.nan,
            resampling=Resampling.bilinear,
        )
    return Laid(values[..., ::-1, :], (float(low[0]), float(low[1])), step)


def area(raster: Any, geographic: bool) -> str:
    """Where a raster lies, in words."""
    if not geographic or raster.crs is None:
        west, south, east, north = raster.bounds
        return f"east {west:.0f} to {east:.0f} m, north {south:.0f} to {north:.0f} m"
    from rasterio.warp import transform_bounds

    west, south, east, north = transform_bounds(raster.crs, "EPSG:4326", *raster.bounds)
    return f"longitude {west:.5f} to {east:.5f}, latitude {south:.5f} to {north:.5f}"


def lie(where: np.ndarray, origin_deg: tuple[float, float] | None) -> str:
    """Where places lie, in words."""
    low, high = where.min(axis=0), where.max(axis=0)
    text = f"east {low[0]:.0f} to {high[0]:.0f} m, north {low[1]:.0f} to {high[1]:.0f} m"
    if origin_deg is None:
        return text
    return f"{text} of longitude {origin_deg[0]:.5f}, latitude {origin_deg[1]:.5f}"


def _part(raster: Any, bands: int | list[int], bounds: tuple[float, ...], most: int) -> tuple[np.ndarray | None, Any]:
    """What of the bands is within bounds, float64, NaN where there is none, and its transform; None if nothing is."""
    from rasterio.enums import Resampling
    from rasterio.transform import Affine
    from rasterio.windows import Window, from_bounds

    with np.errstate(all="ignore"):  # a damaged file may say that its cells are of no size
        asked = from_bounds(*bounds, transform=raster.transform)
    if not np.isfinite([asked.col_off, asked.row_off, asked.width, asked.height]).all():
        return None, None
    first = max(math.floor(asked.col_off) - 2, 0), max(math.floor(asked.row_off) - 2, 0)
    last = (
        min(math.ceil(asked.col_off + asked.width) + 2, raster.width),
        min(math.ceil(asked.row_off + asked.height) + 2, raster.height),
    )
    width, height = last[0] - first[0], last[1] - first[1]
    if width <= 0 or height <= 0:
        return None, None
    window = Window(*first, width, height)
    shape = min(height, most), min(width, most)
    out = shape if isinstance(bands, int) else (len(bands), *shape)
    values = raster.read(bands, window=window, out_shape=out, masked=True, resampling=Resampling.average)
    wide, high, t = width / shape[1], height / shape[0], raster.window_transform(window)
    scaled = Affine(t.a * wide, t.b * high, t.c, t.d * wide, t.e * high, t.f)
    holes = np.ma.getmaskarray(values)
    # Of a photo, a band that is white is no hole, though the file's value for holes be 255.
    holes = holes if values.ndim == 2 else np.broadcast_to(holes.all(axis=0), values.shape)
    with np.errstate(invalid="ignore"):  # where a raster is damaged a value may be any bits
        return np.where(holes, np.nan, values.data.astype(np.float64)), scaled


def _resolution_m(raster: Any) -> float:
    """Side of a cell, in metres; of a raster in degrees along its meridian."""
    sides = abs(raster.transform.a), abs(raster.transform.e)
    if raster.crs is not None and raster.crs.is_geographic:
        middle = (raster.bounds.bottom + raster.bounds.top) / 2
        return min(sides[0] * max(math.cos(math.radians(middle)), 0.01), sides[1]) * 111_320.0
    return float(min(sides))
