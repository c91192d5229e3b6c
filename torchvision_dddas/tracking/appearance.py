"""What targets look like: histograms of colour over three strips of a box."""

import cv2
import numpy as np

_STRIPS = (0.2, 0.55)  # where one ends and the next begins: head, trunk, legs of a person; roof, body, wheels of a car
_BINS = np.array([16, 32, 32])  # of L, a and b
_CHANNEL = np.array([0, 16, 48])  # where each channel's bins begin
_STRIP = 80  # bins of a strip
SIGNATURE = 3 * _STRIP
_COLUMNS, _ROWS = 24, 48  # samples of a box
_MIDDLE = 0.3  # widths from the middle at which a column counts 1/e: the rest of a box is mostly background


def strips(image: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """(N, SIGNATURE) float32 histograms of Lab colour, weighted to the middle columns of each box.

    image: (H, W, 3) uint8 BGR or (H, W) grey. box_px: (N, 4) x, y, width, height; what lies outside does not count. All
    histograms of a box sum to 1 together, so that sum(sqrt(a b)) is their mean Bhattacharyya coefficient. A box wholly
    outside has zeros.
    """
    samples = np.zeros((len(box_px), _ROWS, _COLUMNS, 3), np.uint8)
    seen = np.zeros((len(box_px), 4))  # the part of each box inside the image, in pixels
    height, width = image.shape[:2]
    for n, (x, y, w, h) in enumerate(box_px.tolist()):
        left, right = max(int(np.floor(x)), 0), min(int(np.ceil(x + w)), width)
        top, bottom = max(int(np.floor(y)), 0), min(int(np.ceil(y + h)), height)
        if right > left and bottom > top:
            crop = image[top:bottom, left:right]
            shrinks = crop.shape[0] >= _ROWS and crop.shape[1] >= _COLUMNS
            sampled = cv2.resize(crop, (_COLUMNS, _ROWS), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
            samples[n] = sampled if image.ndim == 3 else sampled[..., None]
            seen[n] = left, top, right - left, bottom - top
    inside = seen[:, 2] > 0
    if not inside.any():
        return np.zeros((len(box_px), SIGNATURE), np.float32)
    lab = cv2.cvtColor(samples.reshape(-1, _COLUMNS, 3), cv2.COLOR_BGR2LAB).reshape(samples.shape)
    # Where each sample lies in the whole box, of which the image's border may have cut off a part.
    down = (seen[:, 1:2] - box_px[:, 1:2] + (np.arange(_ROWS) + 0.5) / _ROWS * seen[:, 3:]) / box_px[:, 3:]
    across = (seen[:, :1] - box_px[:, :1] + (np.arange(_COLUMNS) + 0.5) / _COLUMNS * seen[:, 2:3]) / box_px[:, 2:3]
    weight = np.exp(-(((across - 0.5) / _MIDDLE) ** 2)) * inside[:, None]
    start = (
        np.arange(len(box_px))[:, None] * SIGNATURE
        + np.searchsorted(_STRIPS, down.ravel()).reshape(down.shape) * _STRIP
    )
    place = start[:, :, None, None] + _CHANNEL + (lab * _BINS >> 8)
    weights = np.broadcast_to(weight[:, None, :, None], place.shape)
    counts = np.bincount(place.ravel(), weights.ravel(), len(box_px) * SIGNATURE).reshape(len(box_px), 3, _STRIP)
    # A strip counts the same however much of it is seen.
    total = counts.sum(axis=2, keepdims=True)
    shares = np.divide(counts, total, out=np.zeros_like(counts), where=total > 0).reshape(len(box_px), SIGNATURE)
    whole = shares.sum(axis=1, keepdims=True)
    return np.divide(shares, whole, out=np.zeros_like(shares), where=whole > 0).astype(np.float32)
