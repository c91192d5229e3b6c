"""Cleaning a mask of what moves."""

import cv2
import numpy as np

from torchvision_dddas.geometry import occupied


def ellipse(side: int) -> np.ndarray:
    """A morphological kernel."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def closed(mask: np.ndarray, side: int) -> np.ndarray:
    """The mask closed with an ellipse, to the bit as OpenCV closes it, but only where it is set at all."""
    if side <= 1:
        return mask
    kernel = ellipse(side)
    # A pixel's closing depends on what lies less than 2 x side away.
    boxes = occupied(mask, 2 * side)
    out = np.zeros_like(mask)
    for x, y, w, h in boxes:
        part = np.s_[y : y + h, x : x + w]
        cv2.morphologyEx(mask[part], cv2.MORPH_CLOSE, kernel, dst=out[part])
    return out
