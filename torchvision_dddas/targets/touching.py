"""Where blobs are, and which patches and points they hold."""

import numpy as np

from torchvision_dddas.targets.boxes import shared_px

_NEAR_PX = 2.0
"""Boxes that are no further apart than this are beside each other."""


def centres_of(boxes: np.ndarray, foreground: np.ndarray | None) -> np.ndarray:
    """(N, 2) of the blobs' mass where the foreground is given, else of their boxes."""
    centres = boxes[:, :2] + (boxes[:, 2:] - 1) / 2
    if foreground is None:
        return centres
    middles = middles_of(boxes, foreground)
    return np.where(np.isfinite(middles), middles, centres)


def middles_of(boxes: np.ndarray, foreground: np.ndarray, core: np.ndarray | None = None) -> np.ndarray:
    """(N, 2) u, v of the mean of each blob's pixels, i + 1 in the (H, W) foreground; NaN for one without any.

    core: (H, W) bool, the pixels that count: of what is between the people of a crowd nothing follows. None: all.
    """
    middles = np.full((len(boxes), 2), np.nan)
    for row, box in enumerate(boxes):
        left, top, right, bottom = _pixels(box, foreground.shape)
        mine = foreground[top:bottom, left:right] == row + 1
        v, u = np.nonzero(mine if core is None else mine & core[top:bottom, left:right])
        if len(u):
            middles[row] = left + u.mean(), top + v.mean()
    return middles


def covering(
    box: np.ndarray | None, boxes: np.ndarray, area_px: np.ndarray, foreground: np.ndarray | None
) -> np.ndarray:
    """(N,) bool: the blobs, of areas (N,), that cover a good part of a patch's box, or are covered by it."""
    if box is None or not len(boxes):
        return np.zeros(len(boxes), bool)
    if foreground is not None:
        left, top, right, bottom = _pixels(box, foreground.shape)
        part = foreground[top:bottom, left:right]
        count = np.bincount(part.ravel(), minlength=len(boxes) + 1)[1 : len(boxes) + 1]
        return count > np.minimum(0.3 * part.size, 0.5 * area_px)
    common = shared_px(box, boxes)
    return common > 0.5 * np.minimum(box[2:].prod(), boxes[:, 2:].prod(axis=1))


def beside(box: np.ndarray | None, boxes: np.ndarray) -> np.ndarray:
    """(N,) bool: the blobs whose boxes overlap a patch's or nearly do."""
    if box is None:
        return np.zeros(len(boxes), bool)
    return shared_px(box + _NEAR_PX * np.array([-1, -1, 2, 2]), boxes) > 0


def inside(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(P, N) bool: which points lie in which boxes."""
    offset = points[:, None] - boxes[None, :, :2] + 0.5
    return ((offset >= 0) & (offset <= boxes[None, :, 2:])).all(axis=2)


def _pixels(box: np.ndarray, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """left, top, right, bottom of a box inside a picture (H, W)."""
    left, top, right, bottom = (round(v) for v in (*box[:2], *(box[:2] + box[2:])))
    return max(left, 0), max(top, 0), min(right, shape[1]), min(bottom, shape[0])
