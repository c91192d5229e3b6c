"""Read georeferenced rasters of the ground on grids of local metres: heights, and photos from straight above."""

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
"""Heights outside this range do not exist on Earth: they mark holes that the raster does not declare."""

GEOID_M = -120.0, 100.0
"""Lowest and highest geoid above the ellipsoid."""

MOST_CELLS = 2000
"""Largest number of heights along a side of the grid; a finer raster is averaged."""

MOST_PX = 1600
"""Largest number of pixels along a side; a finer photo is averaged."""

Degrees = tuple[float, float] | None
"""Longitude and latitude of the origin of local metres; None if local metres are the raster's own coordinates."""

_ALONE = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_PAM_ENABLED": "NO", "GDAL_CACHEMAX": 64}
"""GDAL settings that open only the raster itself, because a file beside it may name others, also on the network.

GDAL's block cache gets 64 MB; by default it takes 5 % of the machine's memory.
"""

Grid = tuple[np.ndarray, np.ndarray, float]
"""Values (R, C) or (B, R, C), with rows to the north and NaN for no data; place of the first value; metres a cell."""


def read_elevation(path: str | Path, places: np.ndarray, origin_deg: Degrees, *, margin_m: float = 500.0) -> Elevation:
    """Read the heights around places (N, 2), relative to the height at east = north = 0.

    places: local metres; margin_m: distance to read around them.
    If the raster does not cover the origin, up = 0 is the mean height at the places that it covers.
    Raise InputError if rasterio is missing, if the file is not a raster, has several bands, no CRS, or no metres, or if
    it covers none of the places.

    >>> import rasterio
    >>> form = {"driver": "GTiff", "width": 40, "height": 40, "count": 1, "crs": "EPSG:4326"}
    >>> corner = rasterio.transform.from_origin(11.0, 48.02, 0.001, 0.001)
    >>> with rasterio.open("dem.tif", "w", dtype="float32", transform=corner, **form) as file:
    ...     file.write(np.full((1, 40, 40), 210, np.float32))
    >>> ground = td.read_elevation("dem.tif", np.array([[11.02, 48.0]]), (11.02, 48.0))
    >>> ground.base_m
    210.0
    """
    where = _known_places(places)
    if not len(where):
        raise InputError(f"elevation {path}: no place is known at which to read it; give landmarks with places")
    with _open_raster(path, "elevation", origin_deg) as raster:
        if raster.count != 1:
            raise InputError(f"elevation {path} has {raster.count} bands; give one band of heights in metres")
        unit = (raster.units[0] or "m").lower()
        if unit not in ("m", "metre", "meter", "metres", "meters"):
            raise InputError(f"elevation {path} has heights in {unit}; give metres")
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


def read_geoid(path: str | Path, lonlat_deg: tuple[float, float]) -> float:
    """Return the height of the geoid above the ellipsoid at a longitude and latitude, from a raster in metres.

    Raise InputError as `read_elevation` does.
    """
    with _open_raster(path, "geoid", lonlat_deg) as raster:
        if raster.count != 1:
            raise InputError(f"geoid {path} has {raster.count} bands; give one band of heights in metres")
        margin_m = 2 * _resolution_m(raster)
        heights, corner, step = _resample(raster, 1, np.zeros((1, 2)), lonlat_deg, margin_m, MOST_CELLS, GEOID_M)
        column, row = np.rint(-corner / step).astype(int)
        if not np.isfinite(heights[row, column]):
            place = f"longitude {lonlat_deg[0]:.4f}, latitude {lonlat_deg[1]:.4f}"
            raise InputError(
                f"geoid {path} has no height from -120 to 100 m at {place}; give a raster of the geoid there"
            )
    return float(heights[row, column])


def read_ortho(path: str | Path, places: np.ndarray, origin_deg: Degrees, *, margin_m: float = 100.0) -> Ortho:
    """Read a photo, with one grey band or three colour bands, around places (N, 2). Errors: as in `read_elevation`.

    origin_deg, margin_m: as in `read_elevation`. Pixels without data are white.

    >>> import rasterio
    >>> form = {"driver": "GTiff", "width": 40, "height": 40, "count": 3, "crs": "EPSG:4326"}
    >>> corner = rasterio.transform.from_origin(11.0, 48.02, 0.001, 0.001)
    >>> with rasterio.open("map.tif", "w", dtype="uint8", transform=corner, **form) as file:
    ...     file.write(np.full((3, 40, 40), 128, np.uint8))
    >>> td.read_ortho("map.tif", np.array([[11.02, 48.0]]), (11.02, 48.0)).image.dtype
    dtype('uint8')
    """
    where = _known_places(places)
    with _open_raster(path, "background", origin_deg) as raster:
        if raster.count not in (1, 3, 4) or raster.dtypes[0] != "uint8":
            raise InputError(
                f"background {path} has {raster.count} bands of {raster.dtypes[0]}; give a photo of red, green and "
                "blue, or grey, in 8 bits"
            )
        bands = [1, 1, 1] if raster.count == 1 else [3, 2, 1]
        values, corner, step = _resample(raster, bands, where, origin_deg, margin_m, MOST_PX)
        area = _area_text(raster, where, origin_deg)
    if not np.isfinite(values).any():
        raise InputError(f"background {path} covers {area}; it has no data there")
    picture = np.nan_to_num(values, nan=255.0).round().clip(0, 255).astype(np.uint8)[:, ::-1].transpose(1, 2, 0)
    top = corner[1] + (len(picture) - 1) * step
    return Ortho(np.ascontiguousarray(picture), np.array([[step, 0.0, corner[0]], [0.0, -step, top]]))


def _known_places(places: np.ndarray) -> np.ndarray:
    where = np.asarray(places, float).reshape(-1, 2)
    return where[np.isfinite(where).all(axis=1)]


@contextmanager
def _open_raster(path: str | Path, what: str, origin_deg: Degrees) -> Iterator[Any]:
    """Open a GeoTIFF, but no other file that it names. The place and the CRS must be in the GeoTIFF itself.

    Raise InputError if rasterio is missing, the file is not a GeoTIFF, or its CRS does not fit.
    """
    try:
        import rasterio
        from rasterio.errors import NotGeoreferencedWarning, RasterioError
    except ImportError:
        raise InputError(
            f"{what} {path} needs rasterio: pip install 'torchvision-dddas[elevation]', or leave it out"
        ) from None
    if not Path(path).is_file():  # GDAL would also accept an address
        raise InputError(f"{what} {path} cannot be read as a raster: there is no such file")
    try:
        with warnings.catch_warnings():
            # The missing georeference is reported below, in one line.
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            # Other GDAL drivers would read text as a VRT raster, and fetch the files that it names.
            with rasterio.Env(**_ALONE):
                raster = rasterio.open(Path(path), driver="GTiff")
        with rasterio.Env(**_ALONE), raster:
            if raster.tags(ns="OVERVIEWS"):
                raise InputError(f"{what} {path} keeps its overviews in another file; give a single GeoTIFF")
            t = raster.transform
            if raster.crs is None and t.is_identity:
                raise InputError(f"{what} {path} does not say where it lies; give a georeferenced GeoTIFF")
            if not (np.isfinite([*t]).all() and 0 < abs(t.a * t.e - t.b * t.d) < math.inf):
                raise InputError(f"{what} {path} is damaged: its cells have no size")
            _check_blocks(raster, f"{what} {path}")
            if origin_deg is not None and raster.crs is None:
                raise InputError(f"{what} {path} has no CRS, so its place is unknown; give a georeferenced GeoTIFF")
            if origin_deg is None and raster.crs is not None and raster.crs.is_geographic:
                raise InputError(
                    f"{what} {path} is in degrees, the landmarks in local metres; give landmarks in longitude_deg,"
                    "latitude_deg, or a raster in the same metres"
                )
            yield raster
    except (RasterioError, OSError) as error:
        raise InputError(f"{what} {path} cannot be read as a raster: {' '.join(str(error).split())}") from None


def _check_blocks(raster: Any, name: str) -> None:
    """Raise InputError if a strip or tile of a raster needs too much memory. It can only be read as a whole."""
    import rasterio

    copies = raster.count if raster.count == 1 else 2 * raster.count  # as stored, and sorted by band
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
    """Resample bands of a raster around places (N, 2), m. Average a finer raster to at most most_cells a side.

    within: values outside this range are holes that the raster does not declare.
    """
    from rasterio.crs import CRS
    from rasterio.transform import from_origin
    from rasterio.warp import Resampling, reproject, transform_bounds

    low, high = where.min(axis=0) - margin_m, where.max(axis=0) + margin_m
    step = max(_resolution_m(raster), float((high - low).max()) / most_cells)
    # Put a grid point at the origin itself, so that its value is exactly the raster's.
    low, high = np.floor(low / step) * step, np.ceil(high / step) * step
    columns, rows = (np.rint((high - low) / step).astype(int) + 1).tolist()
    # A raster without CRS has the same coordinates as the grid, so any CRS serves for both.
    own = raster.crs or CRS.from_epsg(3857)
    local, bounds = own, (*low, *high)
    if origin_deg is not None:
        # On the ellipsoid, the orthographic projection gives the tangent plane's east and north, as
        # geometry.east_north.
        local = CRS.from_proj4(f"+proj=ortho +lat_0={origin_deg[1]!r} +lon_0={origin_deg[0]!r} +datum=WGS84 +units=m")
        bounds = transform_bounds(local, own, *bounds)
    values = np.full((rows, columns) if isinstance(bands, int) else (len(bands), rows, columns), np.nan)
    source, transform = _read_part(raster, bands, bounds, 2 * most_cells)
    if source is not None:
        # Mark holes before they are mixed with their neighbours.
        source[~((source >= within[0]) & (source <= within[1]))] = np.nan
        reproject(
            source,
            values,
            src_transform=transform,
            src_crs=own,
            src_nodata=np.nan,
            # Grid points lie at the centres of cells; raster rows run from north to south.
            dst_transform=from_origin(low[0] - step / 2, high[1] + step / 2, step, step),
            dst_crs=local,
            dst_nodata=np.nan,
            resampling=Resampling.bilinear,
        )
    return values[..., ::-1, :], low, step


def _area_text(raster: Any, where: np.ndarray, origin_deg: Degrees) -> str:
    """Return a message on the extents of the raster and of the places."""
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
    """Return the part of the bands within bounds, float64, NaN without data, and its transform; None if it is empty."""
    from rasterio.enums import Resampling
    from rasterio.transform import Affine
    from rasterio.windows import Window, from_bounds

    with np.errstate(all="ignore"):  # a damaged file may have cells of zero size
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
    # In a photo, a pixel is a hole only if all bands have the nodata value: one white band is not a hole.
    holes = holes if values.ndim == 2 else np.broadcast_to(holes.all(axis=0), values.shape)
    with np.errstate(invalid="ignore"):  # a damaged raster may hold any bits
        part = np.where(holes, np.nan, values.data.astype(np.float64))
    return part, Affine(t.a * wide, t.b * high, t.c, t.d * wide, t.e * high, t.f)


def _resolution_m(raster: Any) -> float:
    """Return the side of a cell in metres; for a raster in degrees, along its meridian."""
    sides = abs(raster.transform.a), abs(raster.transform.e)
    if raster.crs is not None and raster.crs.is_geographic:
        middle = (raster.bounds.bottom + raster.bounds.top) / 2
        return min(sides[0] * max(math.cos(math.radians(middle)), 0.01), sides[1]) * DEGREE_M
    return float(min(sides))
