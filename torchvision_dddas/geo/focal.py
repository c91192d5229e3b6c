"""The focal length of a camera, from a person of known height at known distances (appendix A, eq. 13)."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Bool, Float

OUTLIER = 3.5
"""A measurement is an outlier so many robust standard deviations from the median, or SURE of it where that is more."""

SURE, FINEST = 0.03, 0.01
"""Shares of the focal length. A box is never read more surely than SURE; no calibration of people is finer than FINEST,
for all their boxes may be too tall or too low together."""


@dataclass(frozen=True)
class Focal:
    """focal_px: the focal length. sigma_px: its standard deviation. outlier: (N,) the measurements that were not used.

    spread_px: standard deviation of one measurement; NaN where there is but one.
    """

    focal_px: float
    sigma_px: float
    spread_px: float
    outlier: np.ndarray


def focal_length(distance_m: Float[np.ndarray, "N"], height_px: Float[np.ndarray, "N"], body_height_m: float) -> Focal:
    """F = D h / H of each measurement, and of all: least squares of relative errors, which are alike at every distance.

    distance_m: along the optical axis of a level camera. height_px: the body's, in the picture.
    Raises InputError where there is no measurement, or one is not positive and finite.
    """
    distance, height = np.asarray(distance_m, float), np.asarray(height_px, float)
    if len(height) == 0:
        raise InputError("no measurement to calibrate by; wanted one or more heights in pixels, each with its distance")
    for name, values in (("distance", distance), ("height in pixels", height), ("body height", [body_height_m])):
        if not all(np.isfinite(v) and v > 0 for v in values):
            wrong = next(v for v in values if not (np.isfinite(v) and v > 0))
            raise InputError(f"a {name} of {wrong:g} will not do to calibrate by; wanted a number above 0")
    with np.errstate(over="ignore"):
        each = distance * height / body_height_m
    if not np.isfinite(each).all():
        raise InputError("a distance times a height in pixels is beyond all numbers; wanted metres and pixels")
    middle = float(np.median(each))
    spread = 1.4826 * float(np.median(np.abs(each - middle)))
    outlier: Bool[np.ndarray, N] = np.abs(each - middle) > OUTLIER * max(spread, SURE * middle)
    used = each[~outlier]
    focal = float(used.mean())
    deviation = float(used.std(ddof=1)) if len(used) > 1 else np.nan
    single = np.fmax(deviation, SURE * focal)
    return Focal(focal, float(max(single / np.sqrt(len(used)), FINEST * focal)), deviation, outlier)
