"""How blobs move over the registered background, by dense flow; a blob with two motions is split in two."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.detection.blobs import Blob

# Slower motion cannot be told from errors of the registration, px a frame.
_MIN_SPEED_PX = 0.5
# Shares of the speed: disagreement of two flows that is still steady, and difference from the surroundings that counts.
_STEADY, _UNLIKE = 0.5, 0.25
_RING_NEAR_PX, _RING_FAR_PX = 5, 15
# An affine motion is fitted to so many pixels; it has converged when no term changes by more than this.
_SAMPLES, _CONVERGED_PX = 300, 0.01
# A small pull towards pure translation, for slim blobs.
_PULL = np.diag([1e-9, 0.02, 0.02])

# A part holds at least this share of the blob's core, and this share of a part is one connected piece.
_MIN_SHARE, _ONE_PIECE = 0.2, 0.8
# Two velocities differ clearly by more than this, px a frame, and this share of the faster one.
_CLEARLY_PX, _CLEARLY = 1.0, 0.3
# Flow falls short in flat insides and thin parts: a part that stands, or moves the same way more slowly, is no second
# target. (On real clips every split of that kind cut one car or walker in two.)
_ASIDE_RAD = np.radians(45)
# This share of a part's pixels misses the part's motion by less than half of the difference.
_EXPLAINED = 0.7
_ROUNDS = 4
_NO_AFFINE = np.zeros((3, 2))


@dataclass(frozen=True)
class Motion:
    """A blob's own motion over the registered background.

    velocity_px: (2,) pixels a frame, NaN where unknown. steady: share of its core that moves alike to both neighbours
    and unlike its surroundings. frame: centre_u, centre_v, scale. affine: for each neighbour (3, 2), the displacement
    affine[0] + affine[1] (u - centre_u) / scale + affine[2] (v - centre_v) / scale in pixels.
    """

    velocity_px: np.ndarray
    steady: float = 0.0
    affine: tuple[np.ndarray, np.ndarray] = (_NO_AFFINE, _NO_AFFINE)
    frame: tuple[float, float, float] = (0.0, 0.0, 1.0)


class DenseFlow:
    """Dense inverse search at half resolution (Kroeger et al. 2016), OpenCV's fastest preset.

    A class because OpenCV's object keeps its buffers from frame to frame.
    """

    def __init__(self) -> None:
        self._search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)

    def __call__(self, grey: np.ndarray, others: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(H/2, W/2, 2) displacements in full-resolution pixels from a grey picture to each of the others."""
        size = max(grey.shape[1] // 2, 1), max(grey.shape[0] // 2, 1)
        if min(size) < 16:  # smaller than the search's patches
            return [np.zeros((size[1], size[0], 2), np.float32) for _ in others]
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        pictures = (cv2.resize(other, size, interpolation=cv2.INTER_AREA) for other in others)
        return [2 * self._search.calc(small, picture, np.zeros((*small.shape, 2), np.float32)) for picture in pictures]


def blob_motion(blob: Blob, flows: Sequence[np.ndarray], offsets: tuple[int, int]) -> Motion:
    """The motion of one blob from two flow fields (half resolution) to frames that are `offsets` away."""
    x, y, width, height = blob.box
    (rows, columns), far = flows[0].shape[:2], _RING_FAR_PX
    top, left = max(y // 2 - far, 0), max(x // 2 - far, 0)
    bottom, right = min((y + height) // 2 + far, rows), min((x + width) // 2 + far, columns)
    near = [flow[top:bottom, left:right] for flow in flows]

    def at_half(mask: np.ndarray) -> np.ndarray:
        """A mask of the box at half resolution, in the window of `near`."""
        inside = np.zeros((bottom - top, right - left), bool)
        row, column = np.nonzero(mask[y % 2 :: 2, x % 2 :: 2])
        row, column = row + (y + 1) // 2 - top, column + (x + 1) // 2 - left
        fits = (row < inside.shape[0]) & (column < inside.shape[1])
        inside[row[fits], column[fits]] = True
        return inside

    body, core = at_half(blob.mask), at_half(blob.core)
    core = core if core.any() else body
    if not core.any():
        return Motion(np.full(2, np.nan), frame=(float(x), float(y), 1.0))
    a, b = near[0] / offsets[0], near[1] / offsets[1]
    outer, inner = (
        cv2.dilate(body.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) for reach in (far, _RING_NEAR_PX)
    )
    ring = outer > inner
    mean = (a + b) / 2
    around = np.median(mean[ring], axis=0) if ring.any() else np.zeros(2)
    v = mean[core]
    speed = np.maximum(np.linalg.norm(v, axis=1), 0.15)
    alike = np.linalg.norm(a[core] - b[core], axis=1) < _STEADY * speed
    unlike = np.linalg.norm(v - around, axis=1) > _UNLIKE * speed
    steady = float((alike & unlike & (speed > _MIN_SPEED_PX)).mean())
    places = np.argwhere(core)
    row, column = places[:: max(1, len(places) // _SAMPLES)].T
    centre_u, centre_v = 2 * (left + column.mean()) + 0.5, 2 * (top + row.mean()) + 0.5
    scale = float(max(width, height))
    u, w = (2 * (left + column) + 0.5 - centre_u) / scale, (2 * (top + row) + 0.5 - centre_v) / scale
    first, second = (fit_robust_affine(u, w, flow[row, column]) for flow in near)
    velocity = (first[0] / offsets[0] + second[0] / offsets[1]) / 2
    return Motion(velocity, steady, (first, second), (centre_u, centre_v, scale))


def fit_robust_affine(u: np.ndarray, v: np.ndarray, flow_px: np.ndarray, rounds: int = 5) -> np.ndarray:
    """(3, 2) affine motion of (N,) places and (N, 2) displacements, by iteratively reweighted least squares."""
    columns = np.stack([np.ones(len(u)), u, v], axis=1)
    middle = len(flow_px) // 2
    median = np.partition(flow_px, middle, axis=0)[middle]
    weight = 1 / (1 + ((flow_px - median) ** 2).sum(axis=1) / max(1.0, 0.1 * float(median @ median)))
    fit = np.zeros((3, 2))
    for _ in range(rounds):
        before = fit
        weighted = columns.T * weight
        normal = weighted @ columns + _PULL * max(float(weight.sum()), 1e-9)
        fit = np.linalg.solve(normal, weighted @ flow_px)
        if np.abs(fit - before).max() < _CONVERGED_PX:
            break
        miss = flow_px - columns @ fit
        weight = 1 / (1 + 2 * (miss[:, 0] ** 2 + miss[:, 1] ** 2))
    return fit


def split_by_flow(blob: Blob, flows: Sequence[np.ndarray], offsets: tuple[int, int]) -> list[Blob]:
    """The blob, or the two targets that touch in it, from two flow fields (half resolution) `offsets` frames away."""
    x, y, width, height = blob.box
    box = np.s_[y // 2 : (y + height + 1) // 2, x // 2 : (x + width + 1) // 2]
    velocity = (flows[0][box] / offsets[0] + flows[1][box] / offsets[1]) / 2
    size = velocity.shape[1], velocity.shape[0]
    if min(size) < 4:
        return [blob]
    core = cv2.resize(blob.core.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    second = find_second_motion(velocity, core)
    if second is None:
        return [blob]
    # Every pixel of the mask goes to the nearer part.
    away = [cv2.distanceTransform((~part).astype(np.uint8), cv2.DIST_L2, 5) for part in (core & ~second, second)]
    nearer = cv2.resize(away[0] - away[1], (width, height)) > 0
    return [blob.cut(~nearer), blob.cut(nearer)]


def find_second_motion(velocity_px: np.ndarray, core: np.ndarray) -> np.ndarray | None:
    """Which core pixels move by the second of two motions, (H, W) bool; None where one motion explains the core.

    velocity_px: (H, W, 2) pixels a frame. core: (H, W) bool. Where one affine motion misses too much, two are fitted,
    first to two clusters of the flow, and every pixel goes to the one that fits it better.
    """
    row, column = np.nonzero(core)
    if len(row) < 40:
        return None
    scale = max(float(np.ptp(row)), float(np.ptp(column)), 1.0)
    u, v = (column - column.mean()) / scale, (row - row.mean()) / scale
    columns, flow = np.stack([np.ones(len(u)), u, v], axis=1), velocity_px[row, column]
    # The two motions are sought in a sample.
    sample = slice(None, None, max(1, len(row) // 1000))
    some, some_flow = columns[sample], flow[sample]

    def fit(which: np.ndarray) -> np.ndarray:
        return fit_robust_affine(some[which, 1], some[which, 2], some_flow[which])

    # Plain least squares as well: the robust fit hardly follows a body that turns or grows.
    for one in (fit(np.ones(len(some), bool)), np.linalg.lstsq(some, some_flow, rcond=None)[0]):
        limit = max(_CLEARLY_PX / 2, _CLEARLY / 2 * float(np.linalg.norm(one[0])))
        if (_miss(some, some_flow, one) > limit).mean() < _MIN_SHARE:
            return None
    second = _find_second_cluster(some_flow)
    for _ in range(_ROUNDS):
        if not _MIN_SHARE <= second.mean() <= 1 - _MIN_SHARE:
            return None
        fits = fit(~second), fit(second)
        first_miss, second_miss = (_miss(some, some_flow, one) for one in fits)
        second = second_miss < first_miss
    misses = [_miss(columns, flow, one) for one in fits]
    second = misses[1] < misses[0]
    if not _MIN_SHARE <= second.mean() <= 1 - _MIN_SHARE:
        return None
    a, b = np.median(flow[~second], axis=0), np.median(flow[second], axis=0)
    difference, speeds = float(np.linalg.norm(a - b)), (float(np.linalg.norm(a)), float(np.linalg.norm(b)))
    if difference <= max(_CLEARLY_PX, _CLEARLY * max(speeds)) or min(speeds) < _CLEARLY_PX:
        return None
    if a @ b > np.cos(_ASIDE_RAD) * speeds[0] * speeds[1]:
        return None
    part = np.zeros(core.shape, bool)
    part[row[second], column[second]] = True
    for miss, chosen, mask in zip(misses, (~second, second), (core & ~part, part), strict=True):
        _, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        largest = stats[1:, cv2.CC_STAT_AREA].max() / chosen.sum()
        if (miss[chosen] < difference / 2).mean() < _EXPLAINED or largest < _ONE_PIECE:
            return None
    return part


def _miss(columns: np.ndarray, flow_px: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """(N,) by how much an affine motion misses each displacement."""
    across, down = (flow_px - columns @ affine).T
    return np.hypot(across, down)


def _find_second_cluster(flow_px: np.ndarray) -> np.ndarray:
    """(N,) bool, the second of two clusters of (N, 2) vectors: two means, started at the outermost vectors."""
    start = flow_px[np.linalg.norm(flow_px - np.median(flow_px, axis=0), axis=1).argmax()]
    means = [flow_px[np.linalg.norm(flow_px - start, axis=1).argmax()], start]
    second = np.ones(len(flow_px), bool)
    for _ in range(_ROUNDS):
        second = np.linalg.norm(flow_px - means[1], axis=1) < np.linalg.norm(flow_px - means[0], axis=1)
        if second.all() or not second.any():
            break
        means = [flow_px[~second].mean(axis=0), flow_px[second].mean(axis=0)]
    return second
