"""One light for two frames before they are compared: the same rule for every back end.

Lucas-Kanade compares grey levels. A gain that jumps by 15 % between frames moves its homographies by 1 to 10 px at the
corners, and most of its points still agree with each other.
"""

import cv2
import numpy as np

from torchvision_dddas.detection.engine import View

# The grey levels below which these shares of a picture lie are what two exposures are compared by: a moving camera
# shifts them little, and not in the way a gain does.
_SHARES = np.linspace(0.02, 0.98, 33)
# Levels nearer to black or white than this may be cut off.
_CUT_OFF = 3.0
# A smaller median difference of those levels does not disturb the search: 2 % of gain on a usual picture.
_DIFFERENCE = 2.0
# What a gain and an offset must leave at most of the difference; otherwise it is the content that has changed.
_LEFT = 0.5
_LEAST_LEVELS = 8
# Where grey levels begin and end.
_EDGES = np.arange(257) - 0.5


def in_one_light(earlier: View, later: View) -> tuple[np.ndarray, np.ndarray]:
    """The grey pictures of both, (H, W) uint8, the darker one in the other's exposure where the two differ clearly.

    The darker one, so that what the lighter exposure has cut off at white is cut off in both.
    """
    gain, offset = to_light_of(earlier, later)
    if (gain, offset) == (1.0, 0.0):
        return earlier.grey, later.grey
    x = np.arange(256.0)
    if gain * 128 + offset >= 128:
        return earlier.grey, _through(later.grey, gain * x + offset)
    return _through(earlier.grey, (x - offset) / gain), later.grey


def to_light_of(reference: View, other: View) -> tuple[float, float]:
    """(gain, offset) that take the other frame's grey levels to the reference's, (1, 0) where they hardly differ."""
    return exposure(_levels(reference), _levels(other))


def exposure(wanted: np.ndarray, given: np.ndarray) -> tuple[float, float]:
    """(gain, offset) that take the grey levels `given` to the levels `wanted` at the same shares of a picture.

    (1, 0) where they hardly differ, or not as exposures do. Iteratively reweighted least squares (Cauchy's weights):
    what enters or leaves the picture changes some shares, not all.
    """
    kept = (np.minimum(wanted, given) > _CUT_OFF) & (np.maximum(wanted, given) < 255 - _CUT_OFF)
    y, x = wanted[kept], given[kept]
    if len(x) < _LEAST_LEVELS or (before := _median(y - x)) < _DIFFERENCE:
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
    explained = 0.5 < gain < 2.0 and _median(y - gain * x - offset) < _LEFT * before
    return (gain, offset) if explained else (1.0, 0.0)


def _levels(view: View) -> np.ndarray:
    """The grey levels at the shares of a frame, looked at once on every 3rd pixel of every 5th row.

    Both are odd: pictures enlarged or coded in steps of 2, 4 or 8 px have less contrast on some of these, and a camera
    that pans would seem to change its exposure.
    """
    if "levels at shares" not in view.kept:
        sample = np.ascontiguousarray(view.grey[::5, ::3])
        below = np.zeros(257)
        below[1:] = np.cumsum(cv2.calcHist([sample], [0], None, [256], [0, 256]).ravel()) / sample.size
        # A level's pixels are spread evenly over it, or shares would move in whole levels.
        view.kept["levels at shares"] = np.interp(_SHARES, below, _EDGES)
    levels: np.ndarray = view.kept["levels at shares"]
    return levels


def _through(grey: np.ndarray, table: np.ndarray) -> np.ndarray:
    return cv2.LUT(grey, np.clip(np.round(table), 0, 255).astype(np.uint8))


def _median(difference: np.ndarray) -> float:
    size = np.sort(np.abs(difference))  # `np.median` takes four times as long for so few
    return float((size[(len(size) - 1) // 2] + size[len(size) // 2]) / 2)
