"""Colours in pictures: masks of ranges of hue, saturation and value, by OpenCV or torch, and the patches in a mask."""

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np

from torchvision_dddas.geometry import occupied
from torchvision_dddas.runtime import wants_torch
from torchvision_dddas.types import Table

# Gaps of a patch up to about this wide are closed: an antenna, a seam, a pixel of noise.
_CLOSE_PX = 5
_CLOSE_KERNEL = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_CLOSE_PX, _CLOSE_PX))
# Pixels processed together: their planes stay in the cache. With one channel at a time this takes 0.6 of the time that
# cv2.inRange takes on the whole picture, for eight colours at 1080p.
_PIXELS = 1 << 17


class ColourFinder(Protocol):
    """Finds colours in pictures."""

    name: str

    def masks(self, image: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """(K, H, W) uint8, 255 where the BGR image lies within a range of hue, saturation and value, else 0.

        low, high: (K, 3) in OpenCV's units (hue 0 to 180). A range whose lowest hue is above its highest goes over 0.
        A grey picture has no colours.
        """
        ...


def load_colours(backend: str) -> ColourFinder:
    """The colour finder of a back end: auto, onboard or torch. Raises InputError for another name."""
    return TorchColourFinder() if wants_torch(backend) else OpenCVColourFinder()


class OpenCVColourFinder:
    """ColourFinder with the values of cv2.inRange and one conversion for all colours."""

    name = "onboard"

    def masks(self, image: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """See ColourFinder."""
        if image.ndim == 2 or not len(low) or not image.size:
            return np.zeros((len(low), *image.shape[:2]), np.uint8)
        found = np.empty((len(low), *image.shape[:2]), np.uint8)
        rows = max(1, _PIXELS // image.shape[1])
        other = np.empty((rows, image.shape[1]), np.uint8)
        for top in range(0, len(image), rows):
            hue, *rest = cv2.split(cv2.cvtColor(image[top : top + rows], cv2.COLOR_BGR2HSV))
            spare = other[: len(hue)]
            for mask, lowest, highest in zip(found[:, top : top + rows], low, high, strict=True):
                if lowest[0] <= highest[0]:
                    cv2.inRange(hue, float(lowest[0]), float(highest[0]), dst=mask)
                else:
                    cv2.inRange(hue, float(lowest[0]), 255.0, dst=mask)
                    cv2.bitwise_or(mask, cv2.inRange(hue, 0.0, float(highest[0]), dst=spare), dst=mask)
                for plane, least, most in zip(rest, lowest[1:], highest[1:], strict=True):
                    cv2.bitwise_and(mask, cv2.inRange(plane, float(least), float(most), dst=spare), dst=mask)
        return found


class TorchColourFinder:
    """ColourFinder by `functional.color`, on a CPU or GPU.

    Hue and saturation are compared unrounded. OpenCV's 8-bit conversion is up to 0.64 of a level off, so a pixel next
    to a bound may be classified differently.
    """

    name = "torch"

    def __init__(self, device: Any = None) -> None:
        """device: by default the GPU where there is one."""
        import torch

        from torchvision_dddas.functional import color

        self._torch, self._color = torch, color
        self.device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))

    def masks(self, image: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """See ColourFinder."""
        if image.ndim == 2 or not len(low) or not image.size:
            return np.zeros((len(low), *image.shape[:2]), np.uint8)
        torch = self._torch
        with torch.inference_mode():
            pixels = torch.from_numpy(np.ascontiguousarray(image)).to(self.device).permute(2, 0, 1)[None]
            lowest, highest = (torch.from_numpy(np.array(bound, np.float32)).to(self.device) for bound in (low, high))
            found = self._color.within_ranges(self._color.bgr_to_hsv(pixels.float() / 255), lowest, highest)[0]
            masks: np.ndarray = (found * 255).byte().cpu().numpy()
        return masks


@dataclass(frozen=True)
class Patches(Table):
    """The connected patches of one colour, one row a patch.

    centre_px: (P, 2) u, v of the centroid. area_px: (P,). box_px: (P, 4) x, y of the top left pixel, width, height.
    """

    centre_px: np.ndarray
    area_px: np.ndarray
    box_px: np.ndarray

    def __len__(self) -> int:
        return len(self.area_px)


def find_patches(mask: np.ndarray, least_area_px: int) -> Patches:
    """The patches (8-connected) of a (H, W) uint8 mask with at least an area, after small gaps were closed."""
    centres: list[np.ndarray] = [np.zeros((0, 2))]
    areas: list[np.ndarray] = [np.zeros(0)]
    boxes: list[np.ndarray] = [np.zeros((0, 4))]
    for left, top, wide, high in occupied(mask, 2 * _CLOSE_PX):
        part = cv2.morphologyEx(mask[top : top + high, left : left + wide], cv2.MORPH_CLOSE, _CLOSE_KERNEL)
        count, _, stats, middles = cv2.connectedComponentsWithStats(part, ltype=cv2.CV_32S)
        large = 1 + np.flatnonzero(stats[1:count, cv2.CC_STAT_AREA] >= least_area_px)
        centres.append(middles[large] + (left, top))
        areas.append(stats[large, cv2.CC_STAT_AREA].astype(float))
        boxes.append((stats[large, :4] + (left, top, 0, 0)).astype(float))
    return Patches(np.concatenate(centres), np.concatenate(areas), np.concatenate(boxes))
