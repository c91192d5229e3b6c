"""What targets look like: histograms of colour over three strips of a box."""

import cv2
import numpy as np

_STRIPS = ((0.0, 0.2), (0.2, 0.55), (0.55, 1.0))  # head, trunk, legs of a person; roof, body, wheels of a car
_BINS = (16, 32, 32)
SIGNATURE = len(_STRIPS) * sum(_BINS)
_WIDTH = 24  # a box is sampled at so many columns and twice as many rows


def strips(image: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """(N, SIGNATURE) float32 histograms of Lab colour, weighted to the middle columns of each box.

    image: (H, W, 3) uint8 BGR or (H, W) grey. box_px: (N, 4) x, y, width, height; what lies outside does not count. All
    histograms of a box sum to 1 together, so that sum(sqrt(a b)) is their mean Bhattacharyya coefficient. A box wholly
    outside has zeros.
    """
    signature = np.zeros((len(box_px), SIGNATURE), np.float32)
    height, width = image.shape[:2]
    for row, (x, y, w, h) in zip(signature, box_px, strict=True):
        left, right = int(np.clip(np.floor(x), 0, width)), int(np.clip(np.ceil(x + w), 0, width))
        top, bottom = int(np.clip(np.floor(y), 0, height)), int(np.clip(np.ceil(y + h), 0, height))
        if right - left < 1 or bottom - top < 1:
            continue
        crop = image[top:bottom, left:right]
        if crop.shape[0] > 2 * _WIDTH or crop.shape[1] > _WIDTH:
            size = min(crop.shape[1], _WIDTH), min(crop.shape[0], 2 * _WIDTH)
            crop = cv2.resize(crop, size, interpolation=cv2.INTER_AREA)
        if crop.ndim == 2:
            crop = cv2.cvtColor(crop, cv2.COLOR_GRAY2BGR)
        lab = cv2.cvtColor(crop, cv2.COLOR_BGR2LAB)
        rows, columns = lab.shape[:2]
        # Where each pixel lies in the whole box, of which a border may have cut off a part.
        down = (top + (np.arange(rows) + 0.5) / rows * (bottom - top) - y) / h
        across = (left + (np.arange(columns) + 0.5) / columns * (right - left) - x) / w
        weight = np.exp(-(((across - 0.5) / 0.3) ** 2)).astype(np.float32)
        at = 0
        for low, high in _STRIPS:
            inside = lab[(down >= low) & (down < high)]
            weights = np.broadcast_to(weight, inside.shape[:2]).ravel()
            for channel, bins in enumerate(_BINS):
                if inside.size:
                    level = (inside[..., channel].ravel() * np.uint16(bins)) >> 8
                    counts = np.bincount(level, weights, bins)
                    row[at : at + bins] = counts / max(counts.sum(), 1e-9)
                at += bins
        row /= max(row.sum(), 1e-9)
    return signature
