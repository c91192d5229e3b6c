"""An ortho-photo laid on the world's ground in place of the synthetic soil."""

from collections.abc import Callable

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Ortho

_EMPTY_SHARE = 1e-3  # a white or black area of less of the photo, inside it, is a thing in it and no hole


def laid(photo: Ortho, side_m: float, side_px: int) -> tuple[np.ndarray, np.ndarray]:
    """The photo on the world's grid: (side_px, side_px, 3) uint8, and which of its pixels are known, uint8 0 or 255.

    Unknown is what the photo does not cover, and its white or black margins and holes. A finer photo is averaged.
    Raises InputError where nothing of the world is known.
    """
    texel = side_m / side_px
    image, known = photo.image, _filled(photo.image)
    pixel_from_metres = cv2.invertAffineTransform(np.asarray(photo.east_north_from_pixel, float))
    finer = texel / _pixel_m(photo)
    if finer > 1.2:
        size = max(round(image.shape[1] / finer), 1), max(round(image.shape[0] / finer), 1)
        shrunk = np.array([size[0] / image.shape[1], size[1] / image.shape[0]])[:, None]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        known = cv2.resize(known, size, interpolation=cv2.INTER_AREA)
        pixel_from_metres = shrunk * pixel_from_metres
        pixel_from_metres = pixel_from_metres + np.c_[np.zeros((2, 2)), 0.5 * shrunk - 0.5]
    first = np.array([-side_m / 2 + texel / 2, side_m / 2 - texel / 2])
    metres_from_texel = np.array([[texel, 0, first[0]], [0, -texel, first[1]], [0, 0, 1]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    matrix, size = pixel_from_metres @ metres_from_texel, (side_px, side_px)
    # The outermost pixels are known to their edges.
    wider, moved = cv2.copyMakeBorder(known, 1, 1, 1, 1, cv2.BORDER_REPLICATE), matrix + np.array([0.0, 0, 1])
    sure = cv2.warpAffine(wider, moved, size, flags=flags, borderValue=0)
    sure = cv2.threshold(sure, 250, 255, cv2.THRESH_BINARY)[1]
    if not sure.any():
        height, width = photo.image.shape[:2]
        corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]])
        metres = corners @ np.asarray(photo.east_north_from_pixel, float).T
        (west, south), (east, north) = metres.min(0), metres.max(0)
        half = side_m / 2
        raise InputError(
            f"the photo shows nothing of the world: it lies from {west:.0f} m to {east:.0f} m east and {south:.0f} m "
            f"to {north:.0f} m north of world.origin_deg, and the world from {-half:.0f} m to {half:.0f} m; "
            "set world.origin_deg, or give another photo"
        )
    return cv2.warpAffine(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), sure


class Photographed:
    """The ground as a photo shows it, row by row, and synthetic soil where it shows none.

    synthetic: gives rows [first, last) of the soil, (3, n, W) float32. It takes the photo's colours, and lends its fine
    structure to a photo that is coarser than the world's grid.
    """

    def __init__(
        self, photo: Ortho, side_m: float, side_px: int, synthetic: Callable[[tuple[int, int]], np.ndarray]
    ) -> None:
        self._image, sure = laid(photo, side_m, side_px)
        self._synthetic, self._side_px = synthetic, side_px
        self._blur_px = 0.5 * _pixel_m(photo) * side_px / side_m
        shown = self._image[::8, ::8][sure[::8, ::8] > 0] if sure[::8, ::8].any() else self._image[sure > 0]
        middle = side_px // 2
        sample = synthetic((middle, min(middle + 64, side_px)))
        self._tint = (shown.mean(0) / sample.mean((1, 2)))[:, None, None].astype(np.float32)
        # The seam between photo and soil is soft.
        self._share = cv2.blur(cv2.erode(sure, np.ones((9, 9), np.uint8)), (9, 9)) if not sure.all() else sure

    def rows(self, rows: tuple[int, int]) -> np.ndarray:
        """Rows [first, last), (3, n, W) float32 BGR."""
        first, last = rows
        share = self._share[first:last].astype(np.float32) / 255
        image = np.ascontiguousarray(self._image[first:last].transpose(2, 0, 1), np.float32)
        coarse = self._blur_px > 0.75
        if share.min() == 1 and not coarse:
            return image
        edge = int(3 * self._blur_px) + 1
        soil = self._synthetic((first - edge, last + edge)) * self._tint
        inner = soil[:, edge : edge + last - first]
        if coarse:
            for k in range(3):
                broad = cv2.GaussianBlur(soil[k], (0, 0), self._blur_px)[edge : edge + last - first]
                image[k] *= np.clip(inner[k] / np.maximum(broad, 1), 0.6, 1.4)
        return inner + share * (image - inner)


def _pixel_m(photo: Ortho) -> float:
    """Length of a pixel of a photo on the ground."""
    return float(np.sqrt(np.abs(np.linalg.det(np.asarray(photo.east_north_from_pixel, float)[:, :2]))))


def _filled(image: np.ndarray) -> np.ndarray:
    """(H, W) uint8, 255 where a photo shows something, 0 in its white or black margins and holes."""
    low, high = image.min(axis=2), image.max(axis=2)
    known = np.full(low.shape, 255, np.uint8)
    for empty in (low >= 252, high <= 3):
        count, label, stats, _ = cv2.connectedComponentsWithStats(empty.astype(np.uint8))
        left, top, width, height, area = stats.T
        at_edge = (left == 0) | (top == 0) | (left + width == low.shape[1]) | (top + height == low.shape[0])
        hole = (area >= _EMPTY_SHARE * low.size) | (at_edge & (area >= _EMPTY_SHARE / 20 * low.size))
        hole[0] = False
        if count > 1 and hole.any():
            known[hole[label]] = 0
    # A lossy photo smears its margins over a pixel or two.
    return cv2.erode(known, np.ones((5, 5), np.uint8)) if not known.all() else known
