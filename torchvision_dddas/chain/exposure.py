"""Estimate the change of exposure between two frames from quantiles of their grey levels."""

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

# The quantiles of the grey levels that are compared. Camera motion changes them little, and not as a gain would.
_SHARES = np.linspace(0.02, 0.98, 33)
_EDGES = np.arange(257) - 0.5  # edges of the histogram's bins
# Quantiles nearer to black or white than this may be clipped, and are not used.
_CLIPPED = 3.0
# A smaller median difference of the quantiles, about 2 % of gain on a usual picture, does not disturb Lucas-Kanade.
_MIN_DIFFERENCE = 2.0
# The fit of gain and offset must reduce the median difference to this share; otherwise the content has changed.
_MAX_LEFT = 0.5
_MIN_LEVELS = 8


@dataclass
class View:
    """A frame as `Engine.prepare` returns it. Engines subclass it to cache their own data.

    image: uint8 (H, W) or (H, W, 3) BGR. grey: uint8 (H, W). ignored: uint8 (H, W), 255 at excluded pixels, or None.
    """

    image: np.ndarray
    grey: np.ndarray
    ignored: np.ndarray | None = field(default=None, kw_only=True)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.grey.shape[1], self.grey.shape[0]

    @cached_property
    def level_shares(self) -> np.ndarray:
        """The grey levels of the picture at 33 shares of its pixels, (33,); see `measure_level_shares`."""
        return measure_level_shares(self.grey)


def match_exposure(earlier: View, later: View) -> tuple[np.ndarray, np.ndarray]:
    """Return both grey pictures, (H, W) uint8, the darker picture in the other's exposure if they differ clearly.

    Lucas-Kanade compares grey levels. A jump of the gain by 15 % moves its homographies by 1 to 10 px at the corners,
    although most of its points still agree. The darker picture is converted, so that pixels that are clipped at white
    in the lighter picture are clipped in both.
    """
    gain, offset = exposure_between(earlier, later)
    if (gain, offset) == (1.0, 0.0):
        return earlier.grey, later.grey
    x, greys = np.arange(256.0), [earlier.grey, later.grey]
    is_later = gain * 128 + offset >= 128
    table = gain * x + offset if is_later else (x - offset) / gain
    greys[is_later] = cv2.LUT(greys[is_later], np.clip(np.round(table), 0, 255).astype(np.uint8))
    return greys[0], greys[1]


def exposure_between(reference: View, other: View) -> tuple[float, float]:
    """Return (gain, offset) that convert the other frame's grey levels to the reference's, (1, 0) if nearly equal."""
    return fit_exposure(reference.level_shares, other.level_shares)


def measure_level_shares(grey: np.ndarray) -> np.ndarray:
    """Return the (33,) quantiles, 2 to 98 %, of the grey levels of a picture, (H, W) uint8."""
    # Use every 3rd pixel of every 5th row. The steps are odd: enlarged or compressed pictures have less contrast on a
    # grid of 2, 4 or 8 px, so that with even steps a panning camera would seem to change its exposure.
    sample = np.ascontiguousarray(grey[::5, ::3])
    below = np.zeros(257)
    below[1:] = np.cumsum(cv2.calcHist([sample], [0], None, [256], [0, 256]).ravel()) / sample.size
    # Interpolate within grey levels, because quantiles would otherwise jump by whole levels.
    return np.interp(_SHARES, below, _EDGES)


def fit_exposure(wanted: np.ndarray, given: np.ndarray) -> tuple[float, float]:
    """Fit (gain, offset) that convert the quantiles `given` to the quantiles `wanted`.

    Return (1, 0) if they are nearly equal, or if gain and offset do not explain the difference. The fit is iteratively
    reweighted least squares with Cauchy's weights, because objects that enter or leave the picture change some
    quantiles.
    """
    kept = (np.minimum(wanted, given) > _CLIPPED) & (np.maximum(wanted, given) < 255 - _CLIPPED)
    y, x = wanted[kept], given[kept]
    if len(x) < _MIN_LEVELS or (before := _median_size(y - x)) < _MIN_DIFFERENCE:
        return 1.0, 0.0
    gain, offset = float(np.median(y / x)), 0.0
    for _ in range(6):
        miss = np.abs(y - gain * x - offset)
        weight = 1 / (1 + (miss / max(1.0, 2 * float(np.median(miss)))) ** 2)
        total = weight.sum()
        mean_x, mean_y = weight @ x / total, weight @ y / total
        spread = weight @ (x - mean_x) ** 2
        gain = float((weight * (x - mean_x)) @ (y - mean_y) / spread) if spread > 1.0 else 1.0
        offset = float(mean_y - gain * mean_x)
    is_explained = 0.5 < gain < 2.0 and _median_size(y - gain * x - offset) < _MAX_LEFT * before
    return (gain, offset) if is_explained else (1.0, 0.0)


def _median_size(difference: np.ndarray) -> float:
    size = np.sort(np.abs(difference))  # for so few values `np.median` takes four times as long
    return float((size[(len(size) - 1) // 2] + size[len(size) // 2]) / 2)
