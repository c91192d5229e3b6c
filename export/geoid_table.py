"""Make the package's table of the geoid: `python export/geoid_table.py`, after `pip install egm96`.

The undulations are those of EGM96 (NGA, NASA and Ohio State University; public domain), on a grid of 5 minutes, from
the package egm96 0.3.0 (MIT). The table keeps one undulation every 2 degrees, in decimetres. The script prints the
error of the bilinear interpolation against the whole grid, weighted by area.
"""

from pathlib import Path

import numpy as np
from egm96 import undulation

from torchvision_dddas.geometry import geoid

STEP_DEG = 2


def main() -> None:
    longitude, latitude = np.meshgrid(np.arange(-180, 180, STEP_DEG), np.arange(-90, 91, STEP_DEG))
    decimetres = np.round(10 * np.asarray(undulation(latitude, longitude))).astype(np.int16)
    # Store differences between neighbours. They are small numbers and take a quarter less space.
    np.savez_compressed(Path(geoid.TABLE), east_steps=np.diff(decimetres, axis=1, prepend=0))
    geoid.load_table.cache_clear()
    longitude, latitude = np.meshgrid(np.arange(-180, 180, 0.25), np.arange(-89.875, 90, 0.25))
    places = np.column_stack([longitude.ravel(), latitude.ravel()])
    error_m = np.abs(geoid.geoid_height(places) - np.asarray(undulation(places[:, 1], places[:, 0])))
    order, weight = np.argsort(error_m), np.cos(np.radians(places[:, 1]))
    share = np.cumsum(weight[order]) / weight.sum()
    at = {percent: error_m[order][np.searchsorted(share, percent / 100)] for percent in (50, 95)}
    rms_m = np.sqrt((weight * error_m**2).sum() / weight.sum())
    print(f"rms {rms_m:.2f} m, median {at[50]:.2f} m, 95 % below {at[95]:.2f} m, most {error_m.max():.1f} m")


if __name__ == "__main__":
    main()
