"""What moves while the shutter is open is drawn out along its way."""

import cv2
import numpy as np

LEAST_PX = 0.7  # shorter ways are lost in the lens's own blur
_MOST = 40  # pictures that are averaged for one that is blurred


def smeared(picture: np.ndarray, way_px: np.ndarray) -> np.ndarray:
    """A picture (H, W, C) uint8 whose parts moved so far while it was exposed.

    way_px: (r, c, 2) float32 from the beginning to the end, at points that span the picture from corner to corner.
    """
    longest = float(np.linalg.norm(way_px, axis=-1).max())
    if longest < LEAST_PX:
        return picture
    if np.ptp(way_px.reshape(-1, 2), axis=0).max() < LEAST_PX:
        return np.asarray(cv2.filter2D(picture, -1, streak(way_px.mean(axis=(0, 1))), borderType=cv2.BORDER_REPLICATE))
    height, width = picture.shape[:2]
    rows, columns = way_px.shape[:2]
    # The points are at the corners: pixel 0 is at the first of them and the last pixel at the last.
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    across, down = u * np.float32((columns - 1) / (width - 1)), v * np.float32((rows - 1) / (height - 1))
    way = [cv2.remap(np.ascontiguousarray(way_px[..., k], np.float32), across, down, cv2.INTER_LINEAR) for k in (0, 1)]
    count = min(int(np.ceil(longest)) + 1, _MOST)
    total = np.zeros(picture.shape, np.float32)
    for share in ((np.arange(count, dtype=np.float32) + 0.5) / count - 0.5).astype(np.float32):
        moved = cv2.remap(picture, u + share * way[0], v + share * way[1], cv2.INTER_LINEAR,
                          borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
        cv2.accumulate(moved, total)
    return np.round(total / count).astype(np.uint8)


def streak(way_px: np.ndarray) -> np.ndarray:
    """(K, K) float32 kernel of a way (2,) across the picture, its middle in the middle; the sum is 1."""
    reach = int(np.ceil(np.abs(way_px).max() / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    count = 4 * reach + 1
    for u, v in (((np.arange(count) + 0.5) / count - 0.5)[:, None] * way_px + reach).tolist():
        x, y = int(u), int(v)
        for column, wide in ((x, 1 - (u - x)), (x + 1, u - x)):
            for row, high in ((y, 1 - (v - y)), (y + 1, v - y)):
                if wide * high > 0:
                    kernel[row, column] += wide * high
    return kernel / kernel.sum()
