"""Colour histograms of boxes by OpenCV: what `ops.histogram` counts, for one picture without torch."""

import cv2
import numpy as np


def rgb_histograms(image_bgr: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """(N, 768) float32 numbers of pixels: 256 levels of red, of green, of blue (appendix C, eq. 3).

    image_bgr: (H, W, 3) uint8, or (H, W) grey, counted three times. box_px: (N, 4) x, y of the top left pixel, width,
    height; edges are rounded to whole pixels and cut at the picture. A box with no pixel in it has zeros.
    """
    image = image_bgr if image_bgr.ndim == 3 else cv2.cvtColor(image_bgr, cv2.COLOR_GRAY2BGR)
    boxes = np.array(box_px, float).reshape(-1, 4)
    boxes[~np.isfinite(boxes).all(axis=1)] = 0.0  # no number, no pixel
    limit = np.array(image.shape[1::-1])
    low = np.clip(np.rint(boxes[:, :2]), 0, limit).astype(int)
    high = np.clip(np.rint(boxes[:, :2] + boxes[:, 2:]), 0, limit).astype(int)
    counts = np.zeros((len(boxes), 3, 256), np.float32)
    for row, (left, top), (right, bottom) in zip(counts, low, high, strict=True):
        if right > left and bottom > top:
            crop = image[top:bottom, left:right]
            for place, channel in enumerate((2, 1, 0)):
                row[place] = cv2.calcHist([crop], [channel], None, [256], [0, 256])[:, 0]
    return counts.reshape(len(boxes), 3 * 256)
