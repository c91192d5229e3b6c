"""Half the resolution, for a quarter of the cost: pictures, homographies, parameters and maps from one to the other.

A pixel of the half picture is the mean of 2 x 2 pixels, so that place p there is place 2 p + 1/2 in the whole picture.
"""

from dataclasses import replace

import cv2
import numpy as np

from torchvision_dddas.config import RegistrationParameters, Settings
from torchvision_dddas.detection.engine import Foreground, View, Window
from torchvision_dddas.types import Registration

_WHOLE_FROM_HALF = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]])
_HALF_FROM_WHOLE = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])


def half_of(view: View) -> View:
    """The view at half its resolution, grey, made once; an odd last row or column is left out."""
    if "half" not in view.kept:
        width, height = (max(side // 2, 1) for side in view.size)
        grey = cv2.resize(view.grey[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        view.kept["half"] = View(grey, grey)
    half: View = view.kept["half"]
    return half


def half_window(window: Window) -> Window:
    """The same window on half pictures."""
    return replace(
        window,
        reference=half_of(window.reference),
        neighbours=tuple(half_of(neighbour) for neighbour in window.neighbours),
        neighbour_from_reference=_HALF_FROM_WHOLE @ window.neighbour_from_reference @ _WHOLE_FROM_HALF,
        close_px=half_side(window.close_px) if window.close_px else 0,
    )


def half_parameters(parameters: RegistrationParameters) -> RegistrationParameters:
    """The registration's parameters with the lengths of half pictures; search windows stay, and so see twice as far."""
    return parameters.model_copy(
        update={"cell_px": max(parameters.cell_px // 2, 4), "ransac_px": parameters.ransac_px / 2}
        | {"forward_backward_px": parameters.forward_backward_px / 2}
    )


def half_settings(settings: Settings) -> Settings:
    """Settings of the difference whose lengths are those of the half picture, where slopes are twice as steep."""
    difference, morphology, small = settings.difference, settings.morphology, settings.small
    return settings.model_copy(
        update={
            "difference": difference.model_copy(
                update={"blur_px": half_side(difference.blur_px), "border_px": -(-difference.border_px // 2)}
                | {"gradient_share": difference.gradient_share / 2}
            ),
            "morphology": morphology.model_copy(
                update={"erode_px": half_side(morphology.erode_px), "close_px": half_side(morphology.close_px)}
            ),
            "small": small.model_copy(update={"close_px": half_side(small.close_px)}),
        }
    )


def half_side(side: int) -> int:
    """The odd side nearest to half of an odd one: 25 -> 13, 7 -> 3, 3 -> 1."""
    return 2 * (side // 4) + 1


def whole_step(found: Registration) -> Registration:
    """A registration of half pictures as one of the whole ones."""
    later_from_earlier = _WHOLE_FROM_HALF @ found.later_from_earlier @ _HALF_FROM_WHOLE
    return replace(
        found,
        later_from_earlier=later_from_earlier / later_from_earlier[2, 2],
        error_px=2 * found.error_px,
        flow_px=2 * found.flow_px,
    )


def whole_maps(half: Foreground, size: tuple[int, int], flow: bool) -> Foreground:
    """The maps of half pictures at the whole size (width, height). flow: whether anybody looks at those warped."""
    texture = half.texture
    if texture.strides != (0, 0):  # somebody asks
        texture = _whole(cv2.convertScaleAbs(texture, alpha=0.5), size)
    else:
        texture = np.broadcast_to(np.uint8(0), size[::-1])
    evidence = _whole(half.evidence, size)
    return Foreground(
        _whole(half.core, size),
        evidence,
        evidence if half.wide is half.evidence else _whole(half.wide, size),
        texture,
        None if half.small is None else _whole(half.small, size),
        (_whole(half.warped[0], size, smooth=True), _whole(half.warped[1], size, smooth=True)) if flow else half.warped,
        half.offsets,
    )


def _whole(picture: np.ndarray, size: tuple[int, int], smooth: bool = False) -> np.ndarray:
    """Twice as large; an odd last row or column is repeated."""
    twice = picture.shape[1] * 2, picture.shape[0] * 2
    large = cv2.resize(picture, twice, interpolation=cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)
    if twice == size:
        return large
    more = max(size[1] - twice[1], 0), max(size[0] - twice[0], 0)
    return cv2.copyMakeBorder(large, 0, more[0], 0, more[1], cv2.BORDER_REPLICATE)[: size[1], : size[0]]
