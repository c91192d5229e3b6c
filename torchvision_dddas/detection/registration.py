"""What every engine shares when it registers two frames: the keypoint grid, equal exposure, and the plausibility check.

Lucas-Kanade compares grey levels. A gain that jumps by 15 % between frames moves its homographies by 1 to 10 px at the
corners, and most of its points still agree with each other: hence the exposure.
"""

import math

import cv2
import numpy as np

from torchvision_dddas.config import RegistrationParameters
from torchvision_dddas.detection.engine import View
from torchvision_dddas.geometry import background_flow, transfer
from torchvision_dddas.types import Registration

# Exposures are compared by the grey levels below which these shares of a picture lie: a moving camera shifts them
# little, and not in the way a gain does.
_SHARES = np.linspace(0.02, 0.98, 33)
# Levels nearer to black or white than this may be clipped.
_CLIPPED = 3.0
# A smaller median difference of those levels does not disturb the search: 2 % of gain on a usual picture.
_MIN_DIFFERENCE = 2.0
# A gain and an offset must leave at most this share of the difference; otherwise it is the content that has changed.
_MAX_LEFT = 0.5
_MIN_LEVELS = 8
_EDGES = np.arange(257) - 0.5  # where grey levels begin and end


def cell_side(width: int, height: int, parameters: RegistrationParameters) -> int:
    """Side in pixels of the cells with one keypoint each that keeps their number within the budget."""
    return max(parameters.cell_px, math.ceil(math.sqrt(width * height / parameters.keypoints)))


def match_exposure(earlier: View, later: View) -> tuple[np.ndarray, np.ndarray]:
    """The grey pictures of both, (H, W) uint8, the darker one in the other's exposure where the two differ clearly.

    The darker one, so that what the lighter exposure has clipped at white is clipped in both.
    """
    gain, offset = exposure_between(earlier, later)
    if (gain, offset) == (1.0, 0.0):
        return earlier.grey, later.grey
    x = np.arange(256.0)
    if gain * 128 + offset >= 128:
        return earlier.grey, _apply_table(later.grey, gain * x + offset)
    return _apply_table(earlier.grey, (x - offset) / gain), later.grey


def exposure_between(reference: View, other: View) -> tuple[float, float]:
    """(gain, offset) that take the other frame's grey levels to the reference's, (1, 0) where they hardly differ."""
    return fit_exposure(_levels_at_shares(reference), _levels_at_shares(other))


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


def _levels_at_shares(view: View) -> np.ndarray:
    """The grey levels at the shares of a frame, from every 3rd pixel of every 5th row, computed once.

    Both are odd: pictures enlarged or coded in steps of 2, 4 or 8 px have less contrast on some of these, and a camera
    that pans would seem to change its exposure.
    """
    if "levels at shares" not in view.kept:
        sample = np.ascontiguousarray(view.grey[::5, ::3])
        below = np.zeros(257)
        below[1:] = np.cumsum(cv2.calcHist([sample], [0], None, [256], [0, 256]).ravel()) / sample.size
        # The pixels of a level are spread evenly over it, or shares would move in whole levels.
        view.kept["levels at shares"] = np.interp(_SHARES, below, _EDGES)
    levels: np.ndarray = view.kept["levels at shares"]
    return levels


def _apply_table(grey: np.ndarray, table: np.ndarray) -> np.ndarray:
    return cv2.LUT(grey, np.clip(np.round(table), 0, 255).astype(np.uint8))


def _median_size(difference: np.ndarray) -> float:
    size = np.sort(np.abs(difference))  # `np.median` takes four times as long for so few
    return float((size[(len(size) - 1) // 2] + size[len(size) // 2]) / 2)


def judge_points(
    later_from_earlier: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    size: tuple[int, int],
    parameters: RegistrationParameters,
) -> tuple[Registration, np.ndarray]:
    """The record of a registration, with a cause in words where nothing may be concluded from it; and its inliers.

    start, end: (N, 2) tracked keypoints in the earlier and the later frame; fewer than four make it unreliable,
    whatever the matrix. size: (width, height).
    """
    tracked, error_px = len(start), float("inf")
    if tracked < 4:
        later_from_earlier, inliers = np.eye(3), np.zeros(tracked, bool)
    else:
        miss = np.linalg.norm(transfer(later_from_earlier, start) - end, axis=1)
        inliers = miss < parameters.ransac_px
        error_px = float(np.median(miss[inliers])) if inliers.any() else error_px
    count, cause = int(inliers.sum()), ""
    if tracked < parameters.min_inliers:
        cause = f"only {tracked} keypoints could be followed, {parameters.min_inliers} wanted"
    elif count < parameters.min_inliers or count < parameters.min_inlier_share * tracked:
        cause = f"only {count} of {tracked} keypoints agree on one background motion"
    elif not is_plausible(later_from_earlier, size):
        cause = "the background motion found is not one of a camera"
    flow = background_flow(later_from_earlier, size) if not cause else float("nan")
    return Registration(later_from_earlier, tracked, count, error_px, flow, not cause, cause), inliers


def is_plausible(later_from_earlier: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether a homography may be the motion of a camera between successive frames. size: (width, height).

    The outline of the picture must stay convex and upright, and its area must not double or halve.
    """
    width, height = size
    corners = transfer(later_from_earlier, np.array([[0, 0], [width, 0], [width, height], [0, height]], float))
    if not np.isfinite(corners).all():
        return False
    order = [1, 2, 3, 0]
    edges = corners[order] - corners
    after = edges[order]
    turns = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
    area = 0.5 * (corners[:, 0] * corners[order][:, 1] - corners[:, 1] * corners[order][:, 0]).sum()
    return bool((turns > 0).all() and 0.5 < area / (width * height) < 2.0)
