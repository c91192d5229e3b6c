"""Patches of colour in a picture."""

from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.geometry import occupied

_CLOSE_PX = 5
"""Gaps of a patch up to about this wide are closed: an antenna, a seam, a pixel of noise."""

_CLOSING = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_CLOSE_PX, _CLOSE_PX))


@dataclass(frozen=True)
class Patches:
    """The connected patches of one colour, one row a patch.

    centre_px: (P, 2) of their mass, u, v. area_px: (P,). box_px: (P, 4) x, y of the top left pixel, width, height.
    """

    centre_px: np.ndarray
    area_px: np.ndarray
    box_px: np.ndarray

    def __len__(self) -> int:
        return len(self.area_px)


def patches_of(mask: np.ndarray, least_area_px: int) -> Patches:
    """The patches of a (H, W) uint8 mask, 8 neighbours, small gaps closed, of at least an area."""
    centres, areas, boxes = [], [], []
    for left, top, wide, high in occupied(mask, 2 * _CLOSE_PX):
        part = cv2.morphologyEx(mask[top : top + high, left : left + wide], cv2.MORPH_CLOSE, _CLOSING)
        count, _, stats, middles = cv2.connectedComponentsWithStats(part, ltype=cv2.CV_32S)
        large = 1 + np.flatnonzero(stats[1:count, cv2.CC_STAT_AREA] >= least_area_px)
        centres.append(middles[large] + (left, top))
        areas.append(stats[large, cv2.CC_STAT_AREA])
        boxes.append(stats[large, :4] + (left, top, 0, 0))
    if not areas:
        return Patches(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 4)))
    return Patches(np.concatenate(centres), np.concatenate(areas).astype(float), np.concatenate(boxes).astype(float))
