"""The back end for one stream on a small CPU: OpenCV on 8-bit pictures, no torch."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from torchvision_dddas.config import DifferenceParameters, Settings
from torchvision_dddas.detection.engine import EVIDENCE_CAP, EVIDENCE_SCALE, Foreground, View, Window
from torchvision_dddas.detection.exposure import to_light_of
from torchvision_dddas.detection.mask_cleaning import closed, ellipse
from torchvision_dddas.detection.opencv_foreground import exposed, inside, lit, median_above, texture_of, warp
from torchvision_dddas.detection.opencv_half import (
    half_of,
    half_parameters,
    half_settings,
    half_window,
    whole_maps,
    whole_step,
)
from torchvision_dddas.detection.opencv_registration import register
from torchvision_dddas.types import Registration


class OpenCVEngine:
    """Implements `Engine` one pair and one window at a time."""

    name = "onboard"

    def __init__(self, settings: Settings) -> None:
        self.parameters = settings

    def prepare(self, image: np.ndarray) -> View:
        """The frame and its grey picture."""
        return View(image, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image)

    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """Keypoints, pyramidal Lucas-Kanade, RANSAC, refits on the inliers."""
        parameters = self.parameters.registration
        if parameters.halved:
            small = half_parameters(parameters)
            return [whole_step(register(half_of(a), half_of(b), small)) for a, b in pairs]
        return [register(earlier, later, parameters) for earlier, later in pairs]

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """Differences to the warped neighbours, threshold, morphology."""
        if not self.parameters.difference.halved:
            return [_foreground(window, self.parameters) for window in windows]
        found = [_foreground(half_window(window), half_settings(self.parameters)) for window in windows]
        flow = self.parameters.persistence.on or self.parameters.refine.on
        if not (
            flow or self.parameters.history.on or self.parameters.small.on
        ):  # blobs are found as well on the half maps
            return [replace(half, scale=2) for half in found]
        return [whole_maps(half, window.reference.size, flow) for half, window in zip(found, windows, strict=True)]


def _foreground(window: Window, settings: Settings) -> Foreground:
    parameters, grey = settings.difference, window.reference.grey
    if min(grey.shape) < 2:  # OpenCV takes a single column for a number
        return _nothing(grey)
    normalized = parameters.kind == "normalized"
    if normalized or settings.refine.on:
        texture = texture_of(grey)
    else:  # nobody asks
        texture = np.broadcast_to(np.uint8(0), grey.shape)
    if normalized:
        scale = EVIDENCE_SCALE
        noise = np.sqrt((np.arange(256) * parameters.gradient_share / 4) ** 2 + parameters.noise_levels**2)
        weight = cv2.LUT(texture, (EVIDENCE_SCALE / noise).astype(np.float32))
        textured = cv2.threshold(texture, 16, 255, cv2.THRESH_BINARY)[1]
    else:
        scale = 1.0
    neighbours = _Neighbours(window, parameters)

    def evidence(pair: tuple[int, int]) -> np.ndarray:
        both = neighbours.both(pair)
        z = neighbours.apart(pair) if parameters.kind == "between_later" else neighbours.least(pair)
        if not normalized:
            z = cv2.GaussianBlur(z, (parameters.blur_px,) * 2, 0)
            return cv2.bitwise_and(z, both, dst=z)
        z = cv2.multiply(cv2.bitwise_and(z, both), weight, dtype=cv2.CV_8U)
        z = cv2.threshold(z, EVIDENCE_CAP, EVIDENCE_CAP, cv2.THRESH_TRUNC)[1]
        z = cv2.GaussianBlur(z, (parameters.blur_px,) * 2, 0)
        unit = median_above(z, cv2.bitwise_and(both, textured, dst=both), EVIDENCE_SCALE) / EVIDENCE_SCALE
        return z if unit == 1.0 else cv2.convertScaleAbs(z, alpha=1 / unit)

    near = evidence(window.near[0])
    for pair in window.near[1:]:
        near = cv2.max(near, evidence(pair), dst=near)
    a, b = window.near[-1]
    warped, offsets = (neighbours[a][0], neighbours[b][0]), (window.offsets[a], window.offsets[b])
    neighbours.keep_for(window.wide, window.small)
    wide = near if window.wide is None else evidence(window.wide)
    neighbours.keep_for(window.small)
    core = cv2.threshold(near, int(parameters.threshold * scale), 255, cv2.THRESH_BINARY)[1]
    close_px = window.close_px or settings.morphology.close_px
    core = closed(cv2.erode(core, ellipse(settings.morphology.erode_px)), close_px)
    small = None
    if window.small is not None:
        small = cv2.GaussianBlur(neighbours.least(window.small), (5, 5), 0)
        small = cv2.bitwise_and(small, neighbours.both(window.small), dst=small)
        level = max(settings.small.threshold, settings.small.noise_ratio * cv2.mean(small)[0])
        small = closed(cv2.threshold(small, int(level), 255, cv2.THRESH_BINARY)[1], settings.small.close_px)
    return Foreground(core, near, wide, texture, small, warped, offsets)


def _nothing(grey: np.ndarray) -> Foreground:
    zero = np.zeros_like(grey)
    return Foreground(zero, zero, zero, zero, zero, (grey, grey), (-1, 1))


class _Neighbours:
    """The neighbours as the reference sees them, each made when it is first asked for.

    All of a window's at once, with where each is seen, would hold 15 MB at 1280x720.
    """

    def __init__(self, window: Window, parameters: DifferenceParameters) -> None:
        self.window, self.parameters = window, parameters
        self.made: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self.known: dict[tuple[int, int], np.ndarray] = {}

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """A neighbour warped, and 255 where it may be compared."""
        if index not in self.made:
            reference, neighbour_from_reference = self.window.reference, self.window.neighbour_from_reference[index]
            neighbour = self.window.neighbours[index]
            warped = warp(neighbour.grey, neighbour_from_reference)
            seen = inside(neighbour_from_reference, reference.size, self.parameters.border_px)
            if self.parameters.kind == "normalized":
                warped = exposed(reference.grey, warped, seen)
            elif self.parameters.kind == "to_reference":
                warped = lit(reference.grey, warped, *to_light_of(reference, neighbour))
            self.made[index] = warped, seen
        return self.made[index]

    def both(self, pair: tuple[int, int]) -> np.ndarray:
        """255 where both of a pair are seen."""
        return cv2.bitwise_and(self[pair[0]][1], self[pair[1]][1])

    def apart(self, pair: tuple[int, int]) -> np.ndarray:
        """The difference between the two of a pair."""
        return cv2.absdiff(self[pair[0]][0], self[pair[1]][0])

    def least(self, pair: tuple[int, int]) -> np.ndarray:
        """The smaller difference of the reference to the two of a pair, computed once."""
        if pair not in self.known:
            a, b = (cv2.absdiff(self.window.reference.grey, self[i][0]) for i in pair)
            self.known[pair] = cv2.min(a, b, dst=a)
        return self.known[pair]

    def keep_for(self, *pairs: tuple[int, int] | None) -> None:
        """Drop what none of these pairs looks at."""
        wanted = {i for pair in pairs if pair for i in pair}
        self.made = {i: kept for i, kept in self.made.items() if i in wanted}
        self.known = {pair: kept for pair, kept in self.known.items() if pair in pairs}
