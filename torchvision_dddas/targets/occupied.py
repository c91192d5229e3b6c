"""Where a sparse mask is set, so that costly steps look only there."""

import cv2
import numpy as np

Box = tuple[int, int, int, int]
# Masks are looked over in blocks of this side, px.
_BLOCK_PX = 16


def occupied(mask: np.ndarray, apart: int) -> list[Box]:
    """Disjoint boxes, x, y, width, height, that hold all pixels set in a (H, W) uint8 mask.

    Set pixels lie at least `apart` / 2 px inside their box, save at the picture's border, and more than `apart` px from
    those in other boxes.
    """
    height, width = mask.shape
    block = _BLOCK_PX
    padded = cv2.copyMakeBorder(mask, 0, -height % block, 0, -width % block, cv2.BORDER_CONSTANT, value=0)
    blocks = cv2.resize(padded, (padded.shape[1] // block, padded.shape[0] // block), interpolation=cv2.INTER_AREA)
    reach = -(-apart // (2 * block))
    blocks = cv2.dilate(blocks, np.ones((2 * reach + 1,) * 2, np.uint8))
    count, _, stats, _ = cv2.connectedComponentsWithStats(cv2.threshold(blocks, 0, 255, cv2.THRESH_BINARY)[1])
    boxes = _disjoint([(x, y, x + w, y + h) for x, y, w, h, _ in stats[1:count].tolist()])
    return [
        (block * x0, block * y0, min(block * x1, width) - block * x0, min(block * y1, height) - block * y0)
        for x0, y0, x1, y1 in boxes
    ]


def _disjoint(boxes: list[Box]) -> list[Box]:
    """Boxes (left, top, right, bottom) that overlap are joined until none do."""
    apart: list[Box] = []
    while boxes:
        box = boxes.pop()
        over = [b for b in apart if b[0] < box[2] and box[0] < b[2] and b[1] < box[3] and box[1] < b[3]]
        if over:
            apart = [b for b in apart if b not in over]
            boxes.append(
                (
                    min(box[0], *(b[0] for b in over)),
                    min(box[1], *(b[1] for b in over)),
                    max(box[2], *(b[2] for b in over)),
                    max(box[3], *(b[3] for b in over)),
                )
            )
        else:
            apart.append(box)
    return apart
