"""The engine for one stream on a small CPU: OpenCV on 8-bit pictures, no torch.

It can work at half the resolution, for a quarter of the cost. A pixel of the half picture is the mean of 2 x 2 pixels,
so that place p there is place 2 p + 1/2 in the whole picture.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from torchvision_dddas.config import RegistrationParameters, Settings
from torchvision_dddas.detection.engine import Foreground, View, Window
from torchvision_dddas.detection.opencv_foreground import find_foreground, no_texture
from torchvision_dddas.detection.opencv_registration import register
from torchvision_dddas.types import Registration

_WHOLE_FROM_HALF = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]])
_HALF_FROM_WHOLE = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])


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
            small = halve_parameters(parameters)
            return [double_registration(register(halve_view(a), halve_view(b), small)) for a, b in pairs]
        return [register(earlier, later, parameters) for earlier, later in pairs]

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """Differences to the warped neighbours, threshold, morphology."""
        if not self.parameters.difference.halved:
            return [find_foreground(window, self.parameters) for window in windows]
        settings = self.parameters
        found = [find_foreground(halve_window(window), halve_settings(settings)) for window in windows]
        flow = settings.persistence.on or settings.refine.on
        if not (flow or settings.history.on or settings.small.on):  # blobs alone are found on the half maps as well
            return [replace(half, scale=2) for half in found]
        return [double_maps(half, window.reference.size, flow) for half, window in zip(found, windows, strict=True)]


def halve_view(view: View) -> View:
    """The view at half its resolution, grey, computed once; an odd last row or column is left out."""
    if "half" not in view.kept:
        width, height = (max(side // 2, 1) for side in view.size)
        grey = cv2.resize(view.grey[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        view.kept["half"] = View(grey, grey)
    half: View = view.kept["half"]
    return half


def halve_window(window: Window) -> Window:
    """The same window on half pictures."""
    return replace(
        window,
        reference=halve_view(window.reference),
        neighbours=tuple(halve_view(neighbour) for neighbour in window.neighbours),
        neighbour_from_reference=_HALF_FROM_WHOLE @ window.neighbour_from_reference @ _WHOLE_FROM_HALF,
        close_px=halve_side(window.close_px) if window.close_px else 0,
    )


def halve_parameters(parameters: RegistrationParameters) -> RegistrationParameters:
    """The parameters with the lengths of half pictures; search windows keep their size, and so reach twice as far."""
    return parameters.model_copy(
        update={"cell_px": max(parameters.cell_px // 2, 4), "ransac_px": parameters.ransac_px / 2}
        | {"forward_backward_px": parameters.forward_backward_px / 2}
    )


def halve_settings(settings: Settings) -> Settings:
    """Settings of the difference whose lengths are those of the half picture, where slopes are twice as steep."""
    difference, morphology, small = settings.difference, settings.morphology, settings.small
    return settings.model_copy(
        update={
            "difference": difference.model_copy(
                update={"blur_px": halve_side(difference.blur_px), "border_px": -(-difference.border_px // 2)}
                | {"gradient_share": difference.gradient_share / 2}
            ),
            "morphology": morphology.model_copy(
                update={"erode_px": halve_side(morphology.erode_px), "close_px": halve_side(morphology.close_px)}
            ),
            "small": small.model_copy(update={"close_px": halve_side(small.close_px)}),
        }
    )


def halve_side(side: int) -> int:
    """The odd side nearest to half of an odd one: 25 -> 13, 7 -> 3, 3 -> 1."""
    return 2 * (side // 4) + 1


def double_registration(found: Registration) -> Registration:
    """A registration of half pictures as one of the whole ones."""
    later_from_earlier = _WHOLE_FROM_HALF @ found.later_from_earlier @ _HALF_FROM_WHOLE
    return replace(
        found,
        later_from_earlier=later_from_earlier / later_from_earlier[2, 2],
        error_px=2 * found.error_px,
        flow_px=2 * found.flow_px,
    )


def double_maps(half: Foreground, size: tuple[int, int], flow: bool) -> Foreground:
    """The maps of half pictures at the whole size (width, height). flow: whether the warped pictures are needed."""
    is_needed = half.texture.strides != (0, 0)
    texture = _double(cv2.convertScaleAbs(half.texture, alpha=0.5), size) if is_needed else no_texture(size[::-1])
    evidence = _double(half.evidence, size)
    return Foreground(
        _double(half.core, size),
        evidence,
        evidence if half.wide is half.evidence else _double(half.wide, size),
        texture,
        None if half.small is None else _double(half.small, size),
        (_double(half.warped[0], size, smooth=True), _double(half.warped[1], size, smooth=True))
        if flow
        else half.warped,
        half.offsets,
    )


def _double(picture: np.ndarray, size: tuple[int, int], smooth: bool = False) -> np.ndarray:
    """Twice as large; an odd last row or column is repeated."""
    twice = picture.shape[1] * 2, picture.shape[0] * 2
    large = cv2.resize(picture, twice, interpolation=cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)
    if twice == size:
        return large
    more = max(size[1] - twice[1], 0), max(size[0] - twice[0], 0)
    return cv2.copyMakeBorder(large, 0, more[0], 0, more[1], cv2.BORDER_REPLICATE)[: size[1], : size[0]]
