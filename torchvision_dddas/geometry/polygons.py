"""Polygons and lines in a plane: points inside, nearest points on a line, and crossings of a path."""

from collections.abc import Sequence

import numpy as np

Edges = tuple[np.ndarray, np.ndarray]
"""The start points and the end points, (E, 2) each, of the segments of lines."""


def edges_of(rings: Sequence[np.ndarray], closed: bool) -> Edges:
    """Return the segments of lines (N, 2). closed: whether each line returns to its first point."""
    ends = [np.roll(ring, -1, axis=0) if closed else ring[1:] for ring in rings]
    starts = [ring if closed else ring[:-1] for ring in rings]
    return np.concatenate(starts), np.concatenate(ends)


def area_of(ring: np.ndarray) -> float:
    """Return the area of a polygon (N, 2), in its units squared."""
    across, up = (ring - ring[0]).T
    return abs(float((across * np.roll(up, -1) - up * np.roll(across, -1)).sum())) / 2


def is_inside(points: np.ndarray, edges: Edges) -> np.ndarray:
    """Return (P,) whether points (P, 2) lie inside polygons. By the even-odd rule, inner polygons are holes."""
    start, end = edges
    x, y = points[:, None, 0], points[:, None, 1]
    spans = (start[:, 1] > y) != (end[:, 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = start[:, 0] + (y - start[:, 1]) * (end[:, 0] - start[:, 0]) / (end[:, 1] - start[:, 1])
    odd: np.ndarray = (spans & (x < at)).sum(axis=1) % 2 == 1
    return odd


def nearest_on(points: np.ndarray, edges: Edges) -> np.ndarray:
    """Return for each of the points (P, 2) the nearest point (P, 2) on the lines."""
    start, way = edges[0], edges[1] - edges[0]
    along = np.einsum("pek,ek->pe", points[:, None] - start, way) / np.maximum((way**2).sum(axis=1), 1e-12)
    at = start + np.clip(along, 0, 1)[..., None] * way
    best = ((at - points[:, None]) ** 2).sum(axis=2).argmin(axis=1)
    nearest: np.ndarray = at[np.arange(len(points)), best]
    return nearest


def crossings(before: np.ndarray, after: np.ndarray, edges: Edges) -> tuple[int, float]:
    """Count the crossings of lines by a step from (2,) to (2,), and return also the position of the last crossing.

    The count is the crossings to the lines' right minus those to their left. The position is a share of the step, NaN
    without a crossing. A step through a corner counts as one crossing.
    """
    start, end = edges
    way, step = end - start, after - before
    left_before, left_after = _cross(way, before - start), _cross(way, after - start)
    crossed = ((left_before > 0) != (left_after > 0)) & (
        (_cross(step, start - before) > 0) != (_cross(step, end - before) > 0)
    )
    if not crossed.any():
        return 0, float("nan")
    one, other = left_before[crossed], left_after[crossed]
    return int(np.where(one > 0, 1, -1).sum()), float((one / (one - other)).max())


def crosses_itself(ring: np.ndarray) -> bool:
    """Return whether two sides of a polygon (N, 2) cross or touch, except neighbours at their common corner."""
    start, end = edges_of([ring], closed=True)
    for k in range(len(ring) - 1):
        later = slice(k + 2, len(ring) - (k == 0))  # the last side is a neighbour of the first
        if meets(start[k], end[k], (start[later], end[later])).any():
            return True
    return False


def meets(a: np.ndarray, b: np.ndarray, edges: Edges) -> np.ndarray:
    """Return (E,) whether the segment from a to b, (2,) each, shares a point with each segment of `edges`."""
    start, end = edges
    one = _cross(b - a, start - a) * _cross(b - a, end - a)
    other = _cross(end - start, a - start) * _cross(end - start, b - start)
    apart = (np.maximum(start, end) < np.minimum(a, b)) | (np.minimum(start, end) > np.maximum(a, b))
    shared: np.ndarray = (one <= 0) & (other <= 0) & ~apart.any(axis=1)
    return shared


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    found: np.ndarray = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return found
