"""Boxes and masks: overlap, containment, and the boxes that enclose the set pixels of a mask."""

import cv2
import numpy as np

Box = tuple[int, int, int, int]
"""x, y, width, height in pixels."""

# Masks are searched in blocks of this side, px.
_BLOCK_PX = 16


def shared_px(box_px: np.ndarray, other_px: np.ndarray) -> np.ndarray:
    """Return the intersection area (...) of boxes (..., 4), which are broadcast; 0 for disjoint boxes."""
    low = np.maximum(box_px[..., :2], other_px[..., :2])
    high = np.minimum(box_px[..., :2] + box_px[..., 2:], other_px[..., :2] + other_px[..., 2:])
    across, down = np.moveaxis(high - low, -1, 0)
    return np.maximum(across, 0) * np.maximum(down, 0)


def inside(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return (P, N) bool: whether each point (P, 2) lies in each box (N, 4)."""
    offset = points[:, None] - boxes[None, :, :2] + 0.5
    return ((offset >= 0) & (offset <= boxes[None, :, 2:])).all(axis=2)


def window_of(box: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the row and column slices of a box in a picture (H, W, ...), clipped to the picture."""
    left, top, right, bottom = (round(v) for v in (*box[:2], *(box[:2] + box[2:])))
    return slice(max(top, 0), min(bottom, shape[0])), slice(max(left, 0), min(right, shape[1]))


def middles_of(boxes: np.ndarray, foreground: np.ndarray, core: np.ndarray | None = None) -> np.ndarray:
    """Return (N, 2) u, v, the mean position of each blob's pixels; NaN for a blob without pixels.

    foreground: (H, W), value i + 1 at the pixels of blob i. core: (H, W) bool, use only these pixels, without the gaps
    between the people of a crowd; None: use all pixels.
    """
    middles = np.full((len(boxes), 2), np.nan)
    for row, box in enumerate(boxes):
        rows, columns = window_of(box, foreground.shape)
        mine = foreground[rows, columns] == row + 1
        v, u = np.nonzero(mine if core is None else mine & core[rows, columns])
        if len(u):
            middles[row] = columns.start + u.mean(), rows.start + v.mean()
    return middles


def occupied(mask: np.ndarray, apart: int) -> list[Box]:
    """Return disjoint boxes (x, y, width, height) that contain all set pixels of a (H, W) uint8 mask.

    Set pixels lie at least `apart` / 2 px inside their box, except at the picture's border, and more than `apart` px
    away from the set pixels of other boxes.
    """
    height, width = mask.shape
    block = _BLOCK_PX
    whole = height // block * block
    # Take the maximum down the columns first, because that reads whole rows of memory.
    rows = mask[:whole].reshape(-1, block, width).max(axis=1)
    if whole < height:
        rows = np.concatenate([rows, mask[whole:].max(axis=0, keepdims=True)])
    blocks = np.maximum.reduceat(rows, np.arange(0, width, block), axis=1)
    reach = -(-apart // (2 * block))
    blocks = cv2.dilate(blocks, np.ones((2 * reach + 1,) * 2, np.uint8))
    count, _, stats, _ = cv2.connectedComponentsWithStats(blocks)
    waiting: list[Box] = [(x, y, x + w, y + h) for x, y, w, h, _ in stats[1:count].tolist()]
    # Join overlapping boxes (left, top, right, bottom) until all boxes are disjoint.
    apart_boxes: list[Box] = []
    while waiting:
        box = waiting.pop()
        over = [b for b in apart_boxes if b[0] < box[2] and box[0] < b[2] and b[1] < box[3] and box[1] < b[3]]
        if over:
            apart_boxes = [b for b in apart_boxes if b not in over]
            left, top, right, bottom = zip(box, *over, strict=True)
            waiting.append((min(left), min(top), max(right), max(bottom)))
        else:
            apart_boxes.append(box)
    return [
        (block * x0, block * y0, min(block * x1, width) - block * x0, min(block * y1, height) - block * y0)
        for x0, y0, x1, y1 in apart_boxes
    ]


def connected_parts(mask: np.ndarray, box: Box, min_area_px: float) -> list[tuple[Box, np.ndarray]]:
    """Return the connected parts (8 neighbours) of a (height, width) bool mask inside a box, as (box, mask) pairs.

    box: x, y, width, height in the picture. Parts with fewer than min_area_px pixels are left out.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), ltype=cv2.CV_32S)
    parts = []
    for label, (left, top, width, height, area) in enumerate(stats[1:count].tolist(), 1):
        if area >= min_area_px:
            part = labels[top : top + height, left : left + width] == label
            parts.append(((box[0] + left, box[1] + top, width, height), part))
    return parts
