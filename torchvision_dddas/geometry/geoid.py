"""The height of the geoid, which is the mean sea level, above the ellipsoid WGS 84."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from torchvision_dddas.types import Float

TABLE = Path(__file__).with_name("egm96.npz")
"""EGM96 (NGA, NASA and Ohio State University; public domain), every 2 degrees; made by export/geoid_table.py."""
GEOID_SIGMA_M = 1.0
"""Root mean square error of the table against EGM96 (median 0.25 m, 95 % below 2.0 m, largest 17 m)."""


@lru_cache(maxsize=1)
def load_table() -> np.ndarray:
    """Return the heights in metres, (R, C + 1), from the south to the north pole and from 180 degrees west to east."""
    with np.load(TABLE) as file:
        metres = np.cumsum(file["east_steps"], axis=1, dtype=np.int64) / 10.0
    return np.column_stack([metres, metres[:, 0]])


def geoid_height(lonlat_deg: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
    """Return the height of the geoid EGM96 above the ellipsoid in metres, bilinear in the table.

    It is NaN where longitude or latitude is NaN. Add it to a height above sea level for the height above the ellipsoid.
    """
    table = load_table()
    longitude, latitude = np.asarray(lonlat_deg, float).reshape(-1, 2).T
    known = np.isfinite(longitude + latitude)
    step = 180 / (len(table) - 1)
    x = np.where(known, (longitude + 180) % 360, 0.0) / step
    y = np.where(known, np.clip(latitude, -90, 90) + 90, 0.0) / step
    column, row = np.minimum(x.astype(int), table.shape[1] - 2), np.minimum(y.astype(int), len(table) - 2)
    right, above = x - column, y - row
    low = table[row, column] * (1 - right) + table[row, column + 1] * right
    high = table[row + 1, column] * (1 - right) + table[row + 1, column + 1] * right
    return np.where(known, low * (1 - above) + high * above, np.nan)
