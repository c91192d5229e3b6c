"""Fragments of one mover: close together, moving alike."""

import numpy as np


def groups(boxes_px: np.ndarray, velocities_px: np.ndarray) -> list[list[int]]:
    """Indices of boxes that belong together.

    boxes_px: (N, 4) x, y, width, height. velocities_px: (N, 2) pixels a frame, NaN where unknown (such a box stays
    alone). Fragments lie within a fifth of the larger one's size of each other, across or
    down, overlap in the other direction, and differ in velocity by at most a fifth of it.
    """
    count = len(boxes_px)
    leader = list(range(count))

    def top(i: int) -> int:
        while leader[i] != i:
            i = leader[i]
        return i

    for i in range(count):
        for j in range(i):
            if _fragments(boxes_px[i], boxes_px[j], velocities_px[i], velocities_px[j]):
                leader[top(i)] = top(j)
    found: dict[int, list[int]] = {}
    for i in range(count):
        found.setdefault(top(i), []).append(i)
    return list(found.values())


def _fragments(a: np.ndarray, b: np.ndarray, va: np.ndarray, vb: np.ndarray) -> bool:
    if not (np.isfinite(va).all() and np.isfinite(vb).all()):
        return False
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[:2] + a[2:], b[:2] + b[2:])
    gap = low - high
    reach = 0.2 * np.maximum(a[2:], b[2:])
    speed = max(float(np.hypot(*va)), float(np.hypot(*vb)))
    alike = float(np.hypot(*(va - vb))) <= 0.2 * speed and speed > 1.0
    overlap = -gap / np.minimum(a[2:], b[2:])
    return bool((gap <= reach).all() and overlap.max() > 0.5 and alike)
