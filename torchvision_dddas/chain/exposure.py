"""The exposure between two frames, from the grey levels below which equal shares of their pixels lie."""

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

# Exposures are compared by the grey levels below which these shares of a picture lie: a moving camera shifts them
# little, and not in the way a gain does.
_SHARES = np.linspace(0.02, 0.98, 33)
_EDGES = np.arange(257) - 0.5  # where grey levels begin and end
# Levels nearer to black or white than this may be clipped.
_CLIPPED = 3.0
# A smaller median difference of those levels does not disturb the search: 2 % of gain on a usual picture.
_MIN_DIFFERENCE = 2.0
# A gain and an offset must leave at most this share of the difference; otherwise it is the content that has changed.
_MAX_LEFT = 0.5
_MIN_LEVELS = 8


@dataclass
class View:
    """One frame as an engine holds it, made by `Engine.prepare`; engines add what they use again.

    image: uint8 (H, W) or (H, W, 3) BGR. grey: uint8 (H, W). ignored: uint8 (H, W), 255 in what is left out, or None.
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
        """(33,) grey levels; see `measure_level_shares`."""
        return measure_level_shares(self.grey)


def match_exposure(earlier: View, later: View) -> tuple[np.ndarray, np.ndarray]:
    """The grey pictures of both, (H, W) uint8, the darker one in the other's exposure where the two differ clearly.

    Lucas-Kanade compares grey levels: a gain that jumps by 15 % moves its homographies by 1 to 10 px at the corners,
    and most of its points still agree with each other. The darker one, so that what the lighter exposure has clipped
    at white is clipped in both.
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
    """(gain, offset) that take the other frame's grey levels to the reference's, (1, 0) where they hardly differ."""
    return fit_exposure(reference.level_shares, other.level_shares)


def measure_level_shares(grey: np.ndarray) -> np.ndarray:
    """(33,) the grey levels below which 2 to 98 % of a picture lie, (H, W) uint8."""
    # From every 3rd pixel of every 5th row, both odd: pictures enlarged or coded in steps of 2, 4 or 8 px have less
    # contrast on some of these, and a camera that pans would seem to change its exposure.
    sample = np.ascontiguousarray(grey[::5, ::3])
    below = np.zeros(257)
    below[1:] = np.cumsum(cv2.calcHist([sample], [0], None, [256], [0, 256]).ravel()) / sample.size
    # The pixels of a level are spread evenly over it, or shares would move in whole levels.
    return np.interp(_SHARES, below, _EDGES)


def fit_exposure(wanted: np.ndarray, given: np.ndarray) -> tuple[float, float]:
    """(gain, offset) that take the grey levels `given` to the levels `wanted` at the same shares of a picture.

    (1, 0) where they hardly differ, or not as exposures do. Iteratively reweighted least squares (Cauchy's weights):
    what enters or leaves the picture changes some shares, not all.
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
    size = np.sort(np.abs(difference))  # `np.median` takes four times as long for so few
    return float((size[(len(size) - 1) // 2] + size[len(size) // 2]) / 2)
