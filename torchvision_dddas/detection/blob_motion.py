"""How blobs move over the registered background, by dense flow; a blob with two motions is split in two."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.detection.blobs import Blob, Box

# Slower motion cannot be told from errors of the registration, px a frame.
_MIN_SPEED_PX = 0.5
# Shares of the speed: disagreement of two flows that is still steady, and difference from the surroundings that counts.
_STEADY, _UNLIKE = 0.5, 0.25
_RING_NEAR_PX, _RING_FAR_PX = 5, 15
# Flow is searched so far around all blobs, px of the half picture: coarse levels of the search need surroundings.
_SEARCH_PX = 64
# OpenCV's search works at a quarter of the resolution it is given. In pictures smaller than this it takes a finer
# scale, and keeps that scale for all later pictures, at five times the time.
_FINEST_SCALE, _LEAST_SIDE_PX = 2, 96
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
    affine[0] + affine[1] (u - centre_u) / scale + affine[2] (v - centre_v) / scale in pixels. missed: share of its core
    whose motion that does not explain.
    """

    velocity_px: np.ndarray
    steady: float = 0.0
    affine: tuple[np.ndarray, np.ndarray] = (_NO_AFFINE, _NO_AFFINE)
    frame: tuple[float, float, float] = (0.0, 0.0, 1.0)
    missed: float = 0.0


class DenseFlow:
    """Dense inverse search at half resolution (Kroeger et al. 2016), OpenCV's fastest preset.

    A class because OpenCV's object keeps its buffers from frame to frame.
    """

    def __init__(self) -> None:
        self._search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)

    def __call__(
        self, grey: np.ndarray, others: Sequence[np.ndarray], boxes: Sequence[Box] | None = None
    ) -> list[np.ndarray]:
        """(H/2, W/2, 2) displacements in full-resolution pixels from a grey picture to each of the others.

        boxes: where they are wanted, by default everywhere; they are 0 further away.
        """
        height, width = (max(side // 2, 1) for side in grey.shape)
        flows = [np.zeros((height, width, 2), np.float32) for _ in others]
        if min(height, width) < 16:  # smaller than the search's patches
            return flows
        left, top, right, bottom = 0, 0, width, height
        if boxes is not None:
            corners = np.array(boxes) // 2
            left, top = np.maximum(corners[:, :2].min(axis=0) - _SEARCH_PX, 0).tolist()
            ends = (corners[:, :2] + corners[:, 2:]).max(axis=0) + _SEARCH_PX
            right, bottom = np.minimum(ends, (width, height)).tolist()
            left, right = _widen(left, right, width)
            top, bottom = _widen(top, bottom, height)
        inside, size = np.s_[top:bottom, left:right], (right - left, bottom - top)
        here, *there = (
            cv2.resize(picture[2 * top : 2 * bottom, 2 * left : 2 * right], size, interpolation=cv2.INTER_AREA)
            for picture in (grey, *others)
        )
        for flow, picture in zip(flows, there, strict=True):
            self._search.setFinestScale(_FINEST_SCALE)
            flow[inside] = self._search.calc(here, picture, np.zeros((*here.shape, 2), np.float32))
            flow[inside] *= 2
        return flows


def _widen(first: int, end: int, size: int) -> tuple[int, int]:
    """A span of at least _LEAST_SIDE_PX, as far as the picture has it."""
    first = max(min(first, end - _LEAST_SIDE_PX), 0)
    return first, min(max(end, first + _LEAST_SIDE_PX), size)


def measure_motions(blobs: Sequence[Blob], flows: Sequence[np.ndarray], offsets: tuple[int, int]) -> list[Motion]:
    """The motion of each blob from two flow fields (half resolution) to frames that are `offsets` away."""
    if not blobs:
        return []
    # Of every blob the places of its core that are sampled, in shares of its size, and their displacements.
    places, valid = np.zeros((len(blobs), 2, _SAMPLES)), np.zeros((len(blobs), _SAMPLES))
    displacements, around = np.zeros((len(blobs), 2, _SAMPLES, 2)), np.zeros((len(blobs), 1, 2))
    frames, per_frame = [(0.0, 0.0, 1.0)] * len(blobs), 1 / np.array(offsets)[:, None, None]
    for i, blob in enumerate(blobs):
        (left, top), core, ring = _at_half(blob, flows[0].shape[:2])
        near = [flow[top : top + core.shape[0], left : left + core.shape[1]] for flow in flows]
        row, column = _sample(core)
        if not len(row):
            continue
        u, v = 2 * (left + column) + 0.5, 2 * (top + row) + 0.5
        centre_u, centre_v, scale = frames[i] = (float(u.mean()), float(v.mean()), float(max(blob.box[2:])))
        places[i, 0, : len(u)], places[i, 1, : len(u)] = (u - centre_u) / scale, (v - centre_v) / scale
        displacements[i, :, : len(u)] = [flow[row, column] for flow in near]
        valid[i, : len(u)] = 1
        row, column = _sample(ring)
        if middle := len(row) // 2:
            beside = (np.array([flow[row, column] for flow in near]) * per_frame).mean(axis=0)
            around[i] = np.partition(beside, middle, axis=0)[middle]
    count = np.maximum(valid.sum(axis=1), 1)
    before, after = (displacements * per_frame).swapaxes(0, 1)
    velocities = (before + after) / 2
    speed = np.maximum(_length(velocities), 0.15)
    alike, unlike = _length(before - after) < _STEADY * speed, _length(velocities - around) > _UNLIKE * speed
    steady = (valid * (alike & unlike & (speed > _MIN_SPEED_PX))).sum(axis=1) / count
    fits = fit_robust_affine(places[:, None], displacements, valid[:, None])
    motion = (fits * per_frame).mean(axis=1)
    missed = _miss(_columns(places), velocities, motion) > _clear_miss(motion)[:, None]
    missed_share = (valid * missed).sum(axis=1) / count
    motion[~valid.any(axis=1)] = np.nan
    return [
        Motion(motion[i, 0], float(steady[i]), (fits[i, 0], fits[i, 1]), frames[i], float(missed_share[i]))
        for i in range(len(blobs))
    ]


def _at_half(blob: Blob, shape: tuple[int, int]) -> tuple[tuple[int, int], np.ndarray, np.ndarray]:
    """Masks of the blob at half resolution: (left, top), and (H, W) of its core and of the ring around it.

    shape: (rows, columns) of the half picture. Where no pixel of the core is left, the core is all of the blob.
    """
    x, y, width, height = blob.box
    (rows, columns), far = shape, _RING_FAR_PX
    top, left = max(y // 2 - far, 0), max(x // 2 - far, 0)
    bottom, right = min((y + height) // 2 + far, rows), min((x + width) // 2 + far, columns)
    body, core = np.zeros((2, bottom - top, right - left), np.uint8)
    row, column = (y + 1) // 2 - top, (x + 1) // 2 - left
    for mask, full in ((body, blob.mask), (core, blob.core)):
        part = full[y % 2 :: 2, x % 2 :: 2][: max(len(mask) - row, 0), : max(mask.shape[1] - column, 0)]
        mask[row : row + part.shape[0], column : column + part.shape[1]] = part
    outer, inner = (cv2.dilate(body, np.ones((2 * reach + 1,) * 2, np.uint8)) for reach in (far, _RING_NEAR_PX))
    return (left, top), core if core.any() else body, outer > inner


def _sample(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a sample of the pixels set in a mask."""
    row, column = np.nonzero(mask)
    sample = _choose_samples(len(row))
    return row[sample], column[sample]


def _choose_samples(count: int) -> np.ndarray:
    """Places of at most `_SAMPLES` of so many, evenly spread."""
    chosen = min(count, _SAMPLES)
    return np.arange(chosen) * count // max(chosen, 1)


def fit_robust_affine(places: np.ndarray, flow_px: np.ndarray, valid: np.ndarray, rounds: int = 5) -> np.ndarray:
    """(..., 3, 2) affine motions of (..., 2, N) places and (..., N, 2) displacements.

    Iteratively reweighted least squares, all at once. valid: (..., N), 1 for the places that count and 0 for the rest.
    """
    columns = _columns(places)
    # Half of the valid displacements are below their median.
    ordered = np.sort(np.where(valid[..., None] > 0, flow_px, np.inf), axis=-2)
    middle = (valid.sum(axis=-1).astype(int) // 2)[..., None, None]
    median = np.take_along_axis(ordered, np.broadcast_to(middle, (*ordered.shape[:-2], 1, 2)), axis=-2)
    median = np.where(np.isfinite(median), median, 0)
    spread = np.maximum(1.0, 0.1 * (median**2).sum(axis=(-2, -1)))[..., None]
    weight = valid / (1 + ((flow_px - median) ** 2).sum(axis=-1) / spread)
    fit = np.zeros((3, 2))
    for _ in range(rounds):
        before = fit
        weighted = columns * weight[..., None, :]
        pull = _PULL * np.maximum(weight.sum(axis=-1), 1e-9)[..., None, None]
        fit = np.linalg.solve(weighted @ columns.swapaxes(-1, -2) + pull, weighted @ flow_px)
        if np.abs(fit - before).max() < _CONVERGED_PX:
            break
        weight = valid / (1 + 2 * _miss(columns, flow_px, fit) ** 2)
    return fit


def _columns(places: np.ndarray) -> np.ndarray:
    """(..., 3, N): 1, u, v of (..., 2, N) places."""
    return np.concatenate([np.ones_like(places[..., :1, :]), places], axis=-2)


def _miss(columns: np.ndarray, flow_px: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """(..., N) by how much an affine motion misses each displacement."""
    return _length(flow_px - columns.swapaxes(-1, -2) @ affine)


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2)


def _clear_miss(affine: np.ndarray) -> np.ndarray:
    """(...) a displacement that an affine motion, (..., 3, 2), misses by more than this is not explained by it."""
    return np.maximum(_CLEARLY_PX / 2, _CLEARLY / 2 * _length(affine[..., 0, :]))


def split_by_flow(blob: Blob, motion: Motion, flows: Sequence[np.ndarray], offsets: tuple[int, int]) -> list[Blob]:
    """The blob, or the two targets that touch in it, from two flow fields (half resolution) `offsets` frames away."""
    if motion.missed < _MIN_SHARE:
        return [blob]
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
    places, flow = np.stack([column - column.mean(), row - row.mean()]) / scale, velocity_px[row, column]
    # The two motions are sought in a sample.
    sample = _choose_samples(len(row))
    columns, some = _columns(places), places[:, sample]
    some_columns, some_flow = columns[:, sample], flow[sample]
    # Plain least squares as well: the robust fit hardly follows a body that turns or grows.
    robust = fit_robust_affine(some, some_flow, np.ones(len(some_flow)))
    for one in (robust, np.linalg.lstsq(some_columns.T, some_flow, rcond=None)[0]):
        if (_miss(some_columns, some_flow, one) > _clear_miss(one)).mean() < _MIN_SHARE:
            return None
    second = _find_second_cluster(some_flow)
    for _ in range(_ROUNDS):
        if not _MIN_SHARE <= second.mean() <= 1 - _MIN_SHARE:
            return None
        fits = fit_robust_affine(some, some_flow, np.stack([~second, second]).astype(float), rounds=2)
        first_miss, second_miss = _miss(some_columns, some_flow, fits)
        before, second = second, second_miss < first_miss
        if np.array_equal(before, second):
            break
    misses = _miss(columns, flow, fits)
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
