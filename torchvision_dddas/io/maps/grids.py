"""Places in map grids: UTM, and MGRS references to one metre. Both need the extra `grid`."""

from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.tables import Column, Rows

COLUMNS = {
    "": (),
    "mgrs": (Column("mgrs"),),
    "utm": (Column("utm_zone"), Column("utm_east_m", ".2f"), Column("utm_north_m", ".2f")),
}
"""The columns of each grid; "" means no grid."""


def check_grid(grid: str, has_degrees: bool) -> None:
    """Raise InputError if a grid is wanted but its package, or longitudes and latitudes, are missing."""
    if not grid:
        return
    try:
        import mgrs  # noqa: F401
        import utm  # noqa: F401
    except ImportError:
        raise InputError(f"aerial.grid={grid} needs mgrs and utm: pip install 'torchvision-dddas[grid]'") from None
    if not has_degrees:
        raise InputError(
            f"aerial.grid={grid} needs longitudes and latitudes, but this run is in local metres; leave the grid "
            "out, or give telemetry or landmarks in degrees"
        )


def grid_rows(grid: str, lonlat_deg: np.ndarray) -> Rows:
    """Return the grid columns of (N, 2) places, empty for unknown places, and in UTM outside latitudes -80 to 84."""
    if not grid:
        return {}
    import mgrs
    import utm

    cells: list[tuple[Any, ...]] = []
    for longitude, latitude in np.asarray(lonlat_deg, float).tolist():
        if not (abs(longitude) <= 180 and abs(latitude) <= 90):
            cells.append((None,) if grid == "mgrs" else (None, np.nan, np.nan))
        elif grid == "mgrs":
            cells.append((mgrs.MGRS().toMGRS(latitude, longitude, MGRSPrecision=5),))
        elif not -80 <= latitude <= 84:
            cells.append((None, np.nan, np.nan))
        else:
            east_m, north_m, zone, letter = utm.from_latlon(latitude, longitude)
            cells.append((f"{zone}{letter}", east_m, north_m))
    names = [column.name for column in COLUMNS[grid]]
    return {name: [row[k] for row in cells] for k, name in enumerate(names)}
