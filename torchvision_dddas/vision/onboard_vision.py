"""The back end for one stream on a small CPU: OpenCV on 8-bit pictures, no torch."""

from collections.abc import Sequence

import cv2
import numpy as np

from torchvision_dddas.settings import Settings
from torchvision_dddas.types import Registration
from torchvision_dddas.vision.onboard_pixels import closed, ellipse, exposed, inside, median_above, texture_of, warp
from torchvision_dddas.vision.onboard_registration import register
from torchvision_dddas.vision.protocol import EVIDENCE_CAP, EVIDENCE_SCALE, Foreground, View, Window


class OnboardVision:
    """Implements `Vision` one pair and one window at a time."""

    name = "onboard"

    def __init__(self, settings: Settings) -> None:
        self.knobs = settings

    def prepare(self, image: np.ndarray) -> View:
        """The frame and its grey picture."""
        return View(image, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image)

    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """Keypoints, pyramidal Lucas-Kanade, RANSAC, refits on the inliers."""
        return [register(earlier, later, self.knobs.registration) for earlier, later in pairs]

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """Differences to the warped neighbours, threshold, morphology."""
        return [_foreground(window, self.knobs) for window in windows]


def _foreground(window: Window, settings: Settings) -> Foreground:
    knobs, grey = settings.difference, window.reference.grey
    if min(grey.shape) < 2:  # OpenCV takes a single column for a number
        return _nothing(grey)
    normalized = knobs.kind == "normalized"
    warped = [
        warp(view.grey, neighbour_from_reference)
        for view, neighbour_from_reference in zip(window.neighbours, window.neighbour_from_reference, strict=True)
    ]
    seen = [inside(m, window.reference.size, knobs.border_px) for m in window.neighbour_from_reference]
    if normalized:
        warped = [exposed(grey, picture, mask) for picture, mask in zip(warped, seen, strict=True)]
    least = _LeastDifference(grey, warped)

    if normalized or settings.refine.on:
        texture = texture_of(grey)
    else:  # nobody asks
        texture = np.broadcast_to(np.uint8(0), grey.shape)
    if normalized:
        scale = EVIDENCE_SCALE
        noise = np.sqrt((np.arange(256) * knobs.gradient_share / 4) ** 2 + knobs.noise_levels**2)
        weight = cv2.LUT(texture, (EVIDENCE_SCALE / noise).astype(np.float32))
        textured = cv2.threshold(texture, 16, 255, cv2.THRESH_BINARY)[1]
    else:
        scale = 1.0

    def evidence(pair: tuple[int, int]) -> np.ndarray:
        both = cv2.bitwise_and(seen[pair[0]], seen[pair[1]])
        if knobs.kind == "between_later":
            z = cv2.absdiff(warped[pair[0]], warped[pair[1]])
        else:
            z = least(pair)
        if not normalized:
            z = cv2.GaussianBlur(z, (knobs.blur_px,) * 2, 0)
            return cv2.bitwise_and(z, both, dst=z)
        z = cv2.multiply(cv2.bitwise_and(z, both), weight, dtype=cv2.CV_8U)
        z = cv2.threshold(z, EVIDENCE_CAP, EVIDENCE_CAP, cv2.THRESH_TRUNC)[1]
        z = cv2.GaussianBlur(z, (knobs.blur_px,) * 2, 0)
        unit = median_above(z, cv2.bitwise_and(both, textured, dst=both), EVIDENCE_SCALE) / EVIDENCE_SCALE
        return z if unit == 1.0 else cv2.convertScaleAbs(z, alpha=1 / unit)

    near = evidence(window.near[0])
    for pair in window.near[1:]:
        near = cv2.max(near, evidence(pair), dst=near)
    wide = near if window.wide is None else evidence(window.wide)
    core = cv2.threshold(near, int(knobs.threshold * scale), 255, cv2.THRESH_BINARY)[1]
    core = closed(cv2.erode(core, ellipse(settings.morphology.erode_px)), settings.morphology.close_px)
    small = None
    if window.small is not None:
        a, b = window.small
        small = cv2.GaussianBlur(least(window.small), (5, 5), 0)
        small = cv2.bitwise_and(cv2.bitwise_and(small, seen[a], dst=small), seen[b], dst=small)
        level = max(settings.small.threshold, settings.small.noise_ratio * cv2.mean(small)[0])
        small = closed(cv2.threshold(small, int(level), 255, cv2.THRESH_BINARY)[1], settings.small.close_px)
    a, b = window.near[-1]
    offsets = (window.offsets[a], window.offsets[b])
    return Foreground(core, near, wide, texture, small, (warped[a], warped[b]), offsets)


def _nothing(grey: np.ndarray) -> Foreground:
    zero = np.zeros_like(grey)
    return Foreground(zero, zero, zero, zero, zero, (grey, grey), (-1, 1))


class _LeastDifference:
    """The smaller difference of the reference to a pair of warped neighbours; each pair is computed once."""

    def __init__(self, grey: np.ndarray, warped: Sequence[np.ndarray]) -> None:
        self.grey, self.warped = grey, warped
        self.known: dict[tuple[int, int], np.ndarray] = {}

    def __call__(self, pair: tuple[int, int]) -> np.ndarray:
        if pair not in self.known:
            a, b = (cv2.absdiff(self.grey, self.warped[i]) for i in pair)
            self.known[pair] = cv2.min(a, b, dst=a)
        return self.known[pair]
