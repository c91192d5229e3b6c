"""Rasters of the ground, georeferenced: its heights, and photos of it from straight above, on grids of local metres."""

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import DEGREE_M
from torchvision_dddas.memory import check_memory
from torchvision_dddas.types import Elevation, Ortho

LOWEST_M, HIGHEST_M = -500.0, 9000.0
"""Heights outside do not exist on Earth: they are holes that the raster does not declare."""

MOST_CELLS = 2000
"""Highest number of heights along a side of the grid; a finer raster is averaged."""

MOST_PX = 1600
"""Highest number of pixels along a side; a finer photo is averaged."""

Degrees = tuple[float, float] | None
"""Longitude and latitude of the origin of local metres; None where these are a raster's own coordinates."""

_ALONE = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_PAM_ENABLED": "NO", "GDAL_CACHEMAX": 64}
"""GDAL's settings under which it opens nothing beside a raster: such files may name others, also in the network.

Its cache of blocks holds 64 MB; by default it is 5 % of the machine's memory.
"""

Grid = tuple[np.ndarray, np.ndarray, float]
"""Values (R, C) or (B, R, C), rows to the north, NaN where a raster has none; place of the first; metres a cell."""


def read_elevation(path: str | Path, places: np.ndarray, origin_deg: Degrees, margin_m: float = 500.0) -> Elevation:
    """Heights about places (N, 2), relative to that at east = north = 0.

    places: local metres; margin_m: how far around them.
    Where the raster does not cover the origin, up = 0 is the mean height at those places that it does cover.
    Raises InputError where rasterio is missing, the file is no raster, of several bands, without CRS, not in metres, or
    covers none of the places.
    """
    where = _known_places(places)
    if not len(where):
        raise InputError(f"elevation {path}: no place is known to look it up at; give landmarks with places")
    with _open_raster(path, "elevation", origin_deg) as raster:
        if raster.count != 1:
            raise InputError(f"elevation {path} has {raster.count} bands; wanted one, of heights in metres")
        unit = (raster.units[0] or "m").lower()
        if unit not in ("m", "metre", "meter", "metres", "meters"):
            raise InputError(f"elevation {path} has heights in {unit}; wanted metres")
        heights, corner, step = _resample(raster, 1, where, origin_deg, margin_m, MOST_CELLS, (LOWEST_M, HIGHEST_M))
        area = _area_text(raster, where, origin_deg)
    cells = np.rint((np.vstack([np.zeros((1, 2)), where]) - corner) / step).astype(int)
    inside = ((cells >= 0) & (cells < heights.shape[::-1])).all(axis=1)
    known = np.full(len(cells), np.nan)
    known[inside] = heights[cells[inside, 1], cells[inside, 0]]
    if not np.isfinite(known[1:]).any():
        raise InputError(f"elevation {path} covers {area}; it has no height there")
    base = float(known[0] if np.isfinite(known[0]) else np.nanmean(known[1:]))
    return Elevation(heights - base, (float(corner[0]), float(corner[1])), step, base)


def read_ortho(path: str | Path, places: np.ndarray, origin_deg: Degrees, margin_m: float = 100.0) -> Ortho:
    """A photo about places (N, 2); arguments and errors as for read_elevation, but one band of grey or three of colour.

    Where it shows nothing it is white.
    """
    where = _known_places(places)
    with _open_raster(path, "background", origin_deg) as raster:
        if raster.count not in (1, 3, 4) or raster.dtypes[0] != "uint8":
            raise InputError(
                f"background {path} has {raster.count} bands of {raster.dtypes[0]}; wanted a photo of red, green and "
                "blue, or grey, in 8 bits"
            )
        bands = [1, 1, 1] if raster.count == 1 else [3, 2, 1]
        values, corner, step = _resample(raster, bands, where, origin_deg, margin_m, MOST_PX)
        area = _area_text(raster, where, origin_deg)
    if not np.isfinite(values).any():
        raise InputError(f"background {path} covers {area}; none shows")
    picture = np.nan_to_num(values, nan=255.0).round().clip(0, 255).astype(np.uint8)[:, ::-1].transpose(1, 2, 0)
    top = corner[1] + (len(picture) - 1) * step
    return Ortho(np.ascontiguousarray(picture), np.array([[step, 0.0, corner[0]], [0.0, -step, top]]))


def _known_places(places: np.ndarray) -> np.ndarray:
    where = np.asarray(places, float).reshape(-1, 2)
    return where[np.isfinite(where).all(axis=1)]


@contextmanager
def _open_raster(path: str | Path, what: str, origin_deg: Degrees) -> Iterator[Any]:
    """An open GeoTIFF. Nothing else is read, whatever it names: its place and its CRS must be in the file itself.

    Raises InputError where rasterio is missing, the file is no GeoTIFF, or its CRS does not fit.
    """
    try:
        import rasterio
        from rasterio.errors import NotGeoreferencedWarning, RasterioError
    except ImportError:
        raise InputError(
            f"{what} {path} needs rasterio: pip install 'torchvision-dddas[elevation]', or leave it out"
        ) from None
    if not Path(path).is_file():  # GDAL would take an address, too
        raise InputError(f"{what} {path} cannot be read as a raster: there is no such file")
    try:
        with warnings.catch_warnings():
            # What it warns of is refused below, in one line.
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            # By its other drivers GDAL would take text for a raster, a VRT, and fetch what this names.
            with rasterio.Env(**_ALONE):
                raster = rasterio.open(Path(path), driver="GTiff")
        with rasterio.Env(**_ALONE), raster:
            if raster.tags(ns="OVERVIEWS"):
                raise InputError(f"{what} {path} names another file for its overviews; wanted one that does not")
            t = raster.transform
            if raster.crs is None and t.is_identity:
                raise InputError(f"{what} {path} does not say where it lies; wanted a georeferenced GeoTIFF")
            if not (np.isfinite([*t]).all() and 0 < abs(t.a * t.e - t.b * t.d) < math.inf):
                raise InputError(f"{what} {path} is damaged: its cells have no size")
            _check_blocks(raster, f"{what} {path}")
            if origin_deg is not None and raster.crs is None:
                raise InputError(
                    f"{what} {path} has no CRS: where it lies is not known; wanted a georeferenced GeoTIFF"
                )
            if origin_deg is None and raster.crs is not None and raster.crs.is_geographic:
                raise InputError(
                    f"{what} {path} is in degrees, the landmarks in local metres; give landmarks in longitude_deg,"
                    "latitude_deg, or a raster in the same metres"
                )
            yield raster
    except (RasterioError, OSError) as error:
        raise InputError(f"{what} {path} cannot be read as a raster: {' '.join(str(error).split())}") from None


def _check_blocks(raster: Any, name: str) -> None:
    """Raise InputError if a strip or tile of a raster, which is read as a whole, takes more memory than it may."""
    import rasterio

    copies = raster.count if raster.count == 1 else 2 * raster.count  # as stored, and by bands
    levels = [{}, *({"overview_level": level} for level in range(len(raster.overviews(1))))]
    for level in levels:
        with rasterio.open(raster.name, driver="GTiff", **level) as opened:
            rows, columns = opened.block_shapes[0]
        bytes_a_cell = copies * np.dtype(raster.dtypes[0]).itemsize
        what = f"{name} has strips or tiles of {columns}x{rows} cells"
        check_memory(rows * columns * bytes_a_cell, what, Path(raster.name).stat().st_size)


def _resample(
    raster: Any,
    bands: int | list[int],
    where: np.ndarray,
    origin_deg: Degrees,
    margin_m: float,
    most_cells: int,
    within: tuple[float, float] = (-math.inf, math.inf),
) -> Grid:
    """Bands of a raster about places (N, 2) in local metres; a finer one is averaged down to most_cells a side.

    within: values beyond are holes that the raster does not declare.
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
        # On the ellipsoid the orthographic projection is the tangent plane's east and north, as in geometry.east_north.
        local = CRS.from_proj4(f"+proj=ortho +lat_0={origin_deg[1]!r} +lon_0={origin_deg[0]!r} +datum=WGS84 +units=m")
        bounds = transform_bounds(local, own, *bounds)
    values = np.full((rows, columns) if isinstance(bands, int) else (len(bands), rows, columns), np.nan)
    source, transform = _read_part(raster, bands, bounds, 2 * most_cells)
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
    return values[..., ::-1, :], low, step


def _area_text(raster: Any, where: np.ndarray, origin_deg: Degrees) -> str:
    """Where a raster and places lie, in words."""
    from rasterio.warp import transform_bounds

    covered = metres = "east {0:.0f} to {2:.0f} m, north {1:.0f} to {3:.0f} m"
    bounds, of_origin = raster.bounds, ""
    if origin_deg is not None:
        bounds = transform_bounds(raster.crs, "EPSG:4326", *bounds)
        covered = "longitude {0:.5f} to {2:.5f}, latitude {1:.5f} to {3:.5f}"
        of_origin = f" of longitude {origin_deg[0]:.5f}, latitude {origin_deg[1]:.5f}"
    places = metres.format(*where.min(axis=0), *where.max(axis=0))
    return f"{covered.format(*bounds)}, the landmarks lie at {places}{of_origin}"


def _read_part(
    raster: Any, bands: int | list[int], bounds: tuple[float, ...], most: int
) -> tuple[np.ndarray | None, Any]:
    """What of the bands is within bounds, float64, NaN where there is none, and its transform; None if nothing is."""
    from rasterio.enums import Resampling
    from rasterio.transform import Affine
    from rasterio.windows import Window, from_bounds

    with np.errstate(all="ignore"):  # a damaged file may say that its cells are of no size
        asked = from_bounds(*bounds, transform=raster.transform)
    if not np.isfinite([asked.col_off, asked.row_off, asked.width, asked.height]).all():
        return None, None
    column, row = max(math.floor(asked.col_off) - 2, 0), max(math.floor(asked.row_off) - 2, 0)
    width = min(math.ceil(asked.col_off + asked.width) + 2, raster.width) - column
    height = min(math.ceil(asked.row_off + asked.height) + 2, raster.height) - row
    if width <= 0 or height <= 0:
        return None, None
    window = Window(column, row, width, height)
    shape = min(height, most), min(width, most)
    out = shape if isinstance(bands, int) else (len(bands), *shape)
    values = raster.read(bands, window=window, out_shape=out, masked=True, resampling=Resampling.average)
    wide, high, t = width / shape[1], height / shape[0], raster.window_transform(window)
    holes = np.ma.getmaskarray(values)
    # Of a photo, a band that is white is no hole, though the file's value for holes be 255.
    holes = holes if values.ndim == 2 else np.broadcast_to(holes.all(axis=0), values.shape)
    with np.errstate(invalid="ignore"):  # where a raster is damaged a value may be any bits
        part = np.where(holes, np.nan, values.data.astype(np.float64))
    return part, Affine(t.a * wide, t.b * high, t.c, t.d * wide, t.e * high, t.f)


def _resolution_m(raster: Any) -> float:
    """Side of a cell, in metres; of a raster in degrees along its meridian."""
    sides = abs(raster.transform.a), abs(raster.transform.e)
    if raster.crs is not None and raster.crs.is_geographic:
        middle = (raster.bounds.bottom + raster.bounds.top) / 2
        return min(sides[0] * max(math.cos(math.radians(middle)), 0.01), sides[1]) * DEGREE_M
    return float(min(sides))
