"""Engines, which do the pixel work: their protocol and records, and what they share when they register two frames."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import cv2
import numpy as np

from torchvision_dddas.config import EVIDENCE_SCALE, RegistrationParameters, Settings
from torchvision_dddas.detection.blobs import Blob
from torchvision_dddas.geometry import background_flow, transfer
from torchvision_dddas.types import Registration

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


def evidence_scale(settings: Settings) -> float:
    """The step of evidence maps for one unit of the thresholds: grey levels unless the difference is normalized."""
    return EVIDENCE_SCALE if settings.difference.kind == "normalized" else 1.0


@dataclass
class View:
    """One frame as an engine holds it, made by `Engine.prepare`.

    image: uint8 (H, W) or (H, W, 3) BGR. grey: uint8 (H, W).
    kept: what the engine computed for this frame and will use again (pyramid, tensor, keypoints).
    """

    image: np.ndarray
    grey: np.ndarray
    kept: dict[str, Any] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.grey.shape[1], self.grey.shape[0]


@dataclass(frozen=True)
class Window:
    """A reference frame and its neighbours in time.

    neighbour_from_reference: (K, 3, 3). offsets: (K,) frames from the reference, negative = past.
    near: pairs of indices of neighbours whose evidence is combined; the last one is the widest and shows the motion.
    wide: a pair further apart, which fills the inside of large targets. small: one that shows small slow targets.
    close_px: side of the ellipse that closes gaps between fragments of a target; 0: that of the settings.
    settings: those of the frame, for engines that find blobs themselves; None: those of the engine.
    """

    reference: View
    neighbours: tuple[View, ...]
    neighbour_from_reference: np.ndarray
    offsets: tuple[int, ...]
    near: tuple[tuple[int, int], ...]
    wide: tuple[int, int] | None = None
    small: tuple[int, int] | None = None
    close_px: int = 0
    settings: Settings | None = None

    @property
    def looks_both_ways(self) -> bool:
        """Whether there is a wide pair, and it shows what is in the reference frame alone."""
        return self.wide is not None and self.offsets[self.wide[0]] * self.offsets[self.wide[1]] < 0


@dataclass(frozen=True)
class Foreground:
    """What differs from the background at the reference frame; all maps (H, W) uint8 in its pixel coordinates.

    core: 255 where a target is certain, cleaned by morphology.
    evidence: 16 x the difference in units of the local noise, the largest over the near pairs; `wide` the same for the
    wide pair. texture: mean gradient, 4 x grey levels a pixel.
    small: 255 where something small may move; None when it is not wanted.
    warped: the two neighbours of the widest near pair, in the reference's frame and exposure; `offsets` their frames.
    scale: side of a map's pixel in pixels of the frame; above 1 only where the maps are used for nothing but blobs.
    blobs: where the engine has found them itself. Then evidence, wide and texture hold only what their boxes show,
    `core` is filled only for a motion history, and `warped` only where flow needs it; all are 0 elsewhere.
    """

    core: np.ndarray
    evidence: np.ndarray
    wide: np.ndarray
    texture: np.ndarray
    small: np.ndarray | None
    warped: tuple[np.ndarray, np.ndarray]
    offsets: tuple[int, int]
    scale: int = 1
    blobs: list[Blob] | None = None


class Engine(Protocol):
    """What an engine offers. Lists go in and out, so that it may batch.

    parameters: the settings in force; they may be replaced between two frames.
    """

    name: str
    parameters: Settings

    def prepare(self, image: np.ndarray) -> View:
        """The view of a frame, with its grey picture."""
        return View(image, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image)

    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """The background's motion from the first to the second frame of each pair."""
        ...

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """What moves in each window's reference frame."""
        ...


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
    for view in (reference, other):
        if "levels at shares" not in view.kept:
            # From every 3rd pixel of every 5th row, both odd: pictures enlarged or coded in steps of 2, 4 or 8 px have
            # less contrast on some of these, and a camera that pans would seem to change its exposure.
            sample = np.ascontiguousarray(view.grey[::5, ::3])
            below = np.zeros(257)
            below[1:] = np.cumsum(cv2.calcHist([sample], [0], None, [256], [0, 256]).ravel()) / sample.size
            # The pixels of a level are spread evenly over it, or shares would move in whole levels.
            view.kept["levels at shares"] = np.interp(_SHARES, below, _EDGES)
    return fit_exposure(reference.kept["levels at shares"], other.kept["levels at shares"])


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
    tracked, error_px, flow_px, cause = len(start), float("inf"), float("nan"), ""
    if tracked < 4:
        later_from_earlier, inliers = np.eye(3), np.zeros(tracked, bool)
    else:
        miss = np.linalg.norm(transfer(later_from_earlier, start) - end, axis=1)
        inliers = miss < parameters.ransac_px
        error_px = float(np.median(miss[inliers])) if inliers.any() else error_px
    count = int(inliers.sum())
    if tracked < parameters.min_inliers:
        cause = f"only {tracked} keypoints could be followed, {parameters.min_inliers} wanted"
    elif count < parameters.min_inliers or count < parameters.min_inlier_share * tracked:
        cause = f"only {count} of {tracked} keypoints agree on one background motion"
    elif not _is_plausible(later_from_earlier, size):
        cause = "the background motion found is not one of a camera"
    else:
        flow_px = background_flow(later_from_earlier, size)
    return Registration(later_from_earlier, tracked, count, error_px, flow_px, not cause, cause), inliers


def _is_plausible(later_from_earlier: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether the outline of the picture stays convex and upright, and its area neither doubles nor halves."""
    width, height = size
    corners = transfer(later_from_earlier, np.array([[0, 0], [width, 0], [width, height], [0, height]], float))
    if not np.isfinite(corners).all():
        return False
    following = np.roll(corners, -1, axis=0)
    (u, v), (after_u, after_v) = (following - corners).T, np.roll(following - corners, -1, axis=0).T
    area = 0.5 * (corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]).sum()
    return bool((u * after_v - v * after_u > 0).all() and 0.5 < area / (width * height) < 2.0)
