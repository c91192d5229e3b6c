"""A photo of the ground from straight above, to lie under a map."""

from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.elevation.raster import area, laid, lie, opened
from torchvision_dddas.types import Ortho

MOST_PX = 1600
"""Pixels along a side; a finer photo is averaged down to it."""


def read_ortho(
    path: str | Path, places: np.ndarray, origin_deg: tuple[float, float] | None, margin_m: float = 100.0
) -> Ortho:
    """A photo about places (N, 2); arguments and errors as for read_elevation, but one band of grey or three of colour.

    Where it shows nothing it is white.
    """
    where = np.asarray(places, float).reshape(-1, 2)
    where = where[np.isfinite(where).all(axis=1)]
    with opened(path, "background", origin_deg is not None) as raster:
        if raster.count not in (1, 3, 4) or raster.dtypes[0] != "uint8":
            raise InputError(
                f"background {path} has {raster.count} bands of {raster.dtypes[0]}; wanted a photo of red, green and "
                "blue, or grey, in 8 bits"
            )
        bands = [1, 1, 1] if raster.count == 1 else [3, 2, 1]
        grid = laid(raster, bands, where, origin_deg, margin_m, MOST_PX)
        covers = area(raster, origin_deg is not None)
    if not np.isfinite(grid.values).any():
        raise InputError(
            f"background {path} covers {covers}, the landmarks lie at {lie(where, origin_deg)}; none shows"
        )
    picture = np.nan_to_num(grid.values, nan=255.0).round().clip(0, 255).astype(np.uint8)[:, ::-1]
    top = grid.corner_m[1] + (picture.shape[1] - 1) * grid.step_m
    step = grid.step_m
    return Ortho(
        np.ascontiguousarray(picture.transpose(1, 2, 0)),
        np.array([[step, 0.0, grid.corner_m[0]], [0.0, -step, top]]),
    )
