"""Parting a blob by its dense flow: two targets that touch but move differently."""

from collections.abc import Sequence

import cv2
import numpy as np

from torchvision_dddas.detection.blob_motion import robust_affine
from torchvision_dddas.detection.blobs import Blob

# A part holds at least this share of the blob's core, and this share of a part is one connected piece.
_LEAST_SHARE, _ONE_PIECE = 0.2, 0.8
# Velocities differ clearly by more than this, px a frame, and this share of the faster one.
_CLEARLY_PX, _CLEARLY = 1.0, 0.3
# Where flow fails on a flat inside or a thin part it falls short: a part that stands, or goes the same way more slowly,
# is no second target. (On real clips every parting of that kind cut one car or walker in two.)
_ASIDE_RAD = np.radians(45)
# Of the pixels of a part, this share is explained by its motion (missed by less than half of the difference).
_EXPLAINED = 0.7
_ROUNDS = 4


def two_motions(velocity_px: np.ndarray, core: np.ndarray) -> np.ndarray | None:
    """Which core pixels move by the second of two motions, (H, W) bool; None where one motion explains the core.

    velocity_px: (H, W, 2) pixels a frame. core: (H, W) bool. Where one affine motion misses too much, two are
    fitted, to the halves that two means of the flow make, and every pixel goes to the one that fits it better.
    """
    row, column = np.nonzero(core)
    if len(row) < 40:
        return None
    step = max(1, len(row) // 1000)
    sample = slice(None, None, step)
    scale = max(float(np.ptp(row)), float(np.ptp(column)), 1.0)
    u, v = (column - column.mean()) / scale, (row - row.mean()) / scale
    flow = velocity_px[row, column]
    columns = np.c_[np.ones(len(u)), u, v]

    def fitted(which: np.ndarray) -> np.ndarray:
        chosen = np.flatnonzero(which)[sample]
        return robust_affine(u[chosen], v[chosen], flow[chosen])

    # Least squares as well: the robust fit is slow to believe in a body that turns or grows.
    for one in (fitted(np.ones(len(u), bool)), np.linalg.lstsq(columns[sample], flow[sample], rcond=None)[0]):
        miss = np.linalg.norm(flow - columns @ one, axis=1)
        if (miss > max(_CLEARLY_PX / 2, _CLEARLY / 2 * float(np.linalg.norm(one[0])))).mean() < _LEAST_SHARE:
            return None
    second = _further(flow)
    for _ in range(_ROUNDS):
        if not _LEAST_SHARE <= second.mean() <= 1 - _LEAST_SHARE:
            return None
        fits = fitted(~second), fitted(second)
        misses = [np.linalg.norm(flow - columns @ fit, axis=1) for fit in fits]
        second = misses[1] < misses[0]
    if not _LEAST_SHARE <= second.mean() <= 1 - _LEAST_SHARE:
        return None
    a, b = np.median(flow[~second], axis=0), np.median(flow[second], axis=0)
    difference, speeds = float(np.linalg.norm(a - b)), (float(np.linalg.norm(a)), float(np.linalg.norm(b)))
    if difference <= max(_CLEARLY_PX, _CLEARLY * max(speeds)) or min(speeds) < _CLEARLY_PX:
        return None
    if a @ b > np.cos(_ASIDE_RAD) * speeds[0] * speeds[1]:
        return None
    explained = [float((misses[i][chosen] < difference / 2).mean()) for i, chosen in enumerate((~second, second))]
    part = np.zeros(core.shape, bool)
    part[row[second], column[second]] = True
    if min(explained) < _EXPLAINED or min(_one_piece(part), _one_piece(core & ~part)) < _ONE_PIECE:
        return None
    return part


def parted_by_flow(blob: Blob, flows: Sequence[np.ndarray], offsets: tuple[int, int]) -> list[Blob]:
    """The blob, or the two that it is made of, from two flow fields (half resolution) `offsets` frames away."""
    x, y, width, height = blob.box
    box = np.s_[y // 2 : (y + height + 1) // 2, x // 2 : (x + width + 1) // 2]
    velocity = (flows[0][box] / offsets[0] + flows[1][box] / offsets[1]) / 2
    size = velocity.shape[1], velocity.shape[0]
    if min(size) < 4:
        return [blob]
    core = cv2.resize(blob.core.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    second = two_motions(velocity, core)
    if second is None:
        return [blob]
    # Every pixel of the mask goes to the part that it is nearest to.
    away = [cv2.distanceTransform((~part).astype(np.uint8), cv2.DIST_L2, 5) for part in (core & ~second, second)]
    nearer = cv2.resize(away[0] - away[1], (width, height)) > 0
    return [cut(blob, ~nearer), cut(blob, nearer)]


def cut(blob: Blob, share: np.ndarray) -> Blob:
    """The part of a blob that lies in `share`, (height, width) bool of its box."""
    mask = blob.mask & share
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    window = np.s_[top : top + height, left : left + width]
    box = (blob.box[0] + left, blob.box[1] + top, width, height)
    return Blob(box, mask[window], (blob.core & mask)[window], blob.peak)


def _further(flow_px: np.ndarray) -> np.ndarray:
    """The one of two clusters of (N, 2) vectors: two means, begun at the vectors that lie furthest out."""
    start = flow_px[np.linalg.norm(flow_px - np.median(flow_px, axis=0), axis=1).argmax()]
    means = [flow_px[np.linalg.norm(flow_px - start, axis=1).argmax()], start]
    second = np.ones(len(flow_px), bool)
    for _ in range(_ROUNDS):
        second = np.linalg.norm(flow_px - means[1], axis=1) < np.linalg.norm(flow_px - means[0], axis=1)
        if second.all() or not second.any():
            break
        means = [flow_px[~second].mean(axis=0), flow_px[second].mean(axis=0)]
    return second


def _one_piece(part: np.ndarray) -> float:
    """Share of a mask's pixels that its largest connected region holds."""
    count, _, stats, _ = cv2.connectedComponentsWithStats(part.astype(np.uint8))
    return float(stats[1:count, cv2.CC_STAT_AREA].max() / part.sum()) if count > 1 else 0.0
