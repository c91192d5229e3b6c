"""Measure by dense flow how blobs move over the registered background, and split blobs that have two motions."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.detection.blobs import Blob, Box

# Slower motion, px a frame, cannot be distinguished from registration errors.
_MIN_SPEED_PX = 0.5
# As shares of the speed: the largest disagreement of two flows that counts as steady motion, and the smallest
# difference from the surroundings that counts as motion of its own.
_STEADY, _UNLIKE = 0.5, 0.25
_RING_NEAR_PX, _RING_FAR_PX = 5, 15
# Flow is computed in the bounding box of all blobs, extended by this margin (px of the half picture). The coarse
# levels of the search need the surroundings.
_SEARCH_PX = 64
# OpenCV's search works at a quarter of the resolution of its input. For pictures with a shorter side than this, OpenCV
# switches to a finer scale and keeps that scale for all later pictures, which takes five times as long.
_FINEST_SCALE, _LEAST_SIDE_PX = 2, 96
# An affine motion is fitted to at most _SAMPLES pixels. The fit has converged when no term changes by more than
# _CONVERGED_PX.
_SAMPLES, _CONVERGED_PX = 300, 0.01
# A weak regularisation towards pure translation. Slim blobs need it because they do not determine an affine motion.
_PULL = np.diag([1e-9, 0.02, 0.02])

# When a blob is split, each part holds at least _MIN_SHARE of the blob's core, and the largest connected piece of a
# part holds at least _ONE_PIECE of that part.
_MIN_SHARE, _ONE_PIECE = 0.2, 0.8
# Two velocities differ clearly if their difference exceeds both _CLEARLY_PX (px a frame) and _CLEARLY times the faster
# speed.
_CLEARLY_PX, _CLEARLY = 1.0, 0.3
# Flow is too small in flat interiors and thin parts. A part that stands still, or moves more slowly in the same
# direction, is therefore not a second target. (On real clips every split of that kind cut one car or walker in two.)
_ASIDE_RAD = np.radians(45)
# At least this share of a part's pixels must miss the part's motion by less than half the difference of both motions.
_EXPLAINED = 0.7
_ROUNDS = 4
_NO_AFFINE = np.zeros((3, 2))


@dataclass(frozen=True)
class BlobMotion:
    """The motion of a blob over the registered background.

    velocity_px: (2,) pixels a frame, NaN where unknown. steady: share of the blob's core that has the same velocity to
    both neighbour frames, but not the velocity of the surroundings. frame: centre_u, centre_v, scale. affine: (3, 2)
    for each neighbour frame; the displacement in pixels is affine[0] + affine[1] (u - centre_u) / scale + affine[2]
    (v - centre_v) / scale. missed: share of the core whose flow the affine motion does not explain.
    """

    velocity_px: np.ndarray
    steady: float = 0.0
    affine: tuple[np.ndarray, np.ndarray] = (_NO_AFFINE, _NO_AFFINE)
    frame: tuple[float, float, float] = (0.0, 0.0, 1.0)
    missed: float = 0.0


class DenseFlow:
    """Compute dense flow at half resolution by dense inverse search (Kroeger et al. 2016) with OpenCV's fastest preset.

    This is a class because OpenCV's object reuses its buffers from frame to frame.
    """

    def __init__(self) -> None:
        self._search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)

    def __call__(
        self, grey: np.ndarray, others: Sequence[np.ndarray], boxes: Sequence[Box] | None = None
    ) -> list[np.ndarray]:
        """Return (H/2, W/2, 2) displacements in full-resolution pixels from a grey picture to each of the others.

        boxes: compute the flow only in and around these boxes, and set it to 0 elsewhere. By default compute it
        everywhere.
        """
        height, width = (max(side // 2, 1) for side in grey.shape)
        flows = [np.zeros((height, width, 2), np.float32) for _ in others]
        if min(height, width) < 16:  # the picture is smaller than the patches of the search
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
    """Widen a span to at least _LEAST_SIDE_PX, or to the whole side if the picture is smaller."""
    first = max(min(first, end - _LEAST_SIDE_PX), 0)
    return first, min(max(end, first + _LEAST_SIDE_PX), size)


def measure_motions(blobs: Sequence[Blob], flows: Sequence[np.ndarray], offsets: tuple[int, int]) -> list[BlobMotion]:
    """Return the motion of each blob from two flow fields (half resolution) to frames that are `offsets` away."""
    if not blobs:
        return []
    # For every blob: the sampled positions of its core as shares of its size, and their displacements.
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
        BlobMotion(motion[i, 0], float(steady[i]), (fits[i, 0], fits[i, 1]), frames[i], float(missed_share[i]))
        for i in range(len(blobs))
    ]


def _at_half(blob: Blob, shape: tuple[int, int]) -> tuple[tuple[int, int], np.ndarray, np.ndarray]:
    """Return (left, top) and two (H, W) masks at half resolution: the blob's core, and the ring around the blob.

    shape: (rows, columns) of the half picture. If no core pixel is left, the first mask holds the whole blob.
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
    """Return the rows and columns of at most `_SAMPLES` of the pixels that are set in a mask."""
    row, column = np.nonzero(mask)
    sample = _choose_samples(len(row))
    return row[sample], column[sample]


def _choose_samples(count: int) -> np.ndarray:
    """Return at most `_SAMPLES` evenly spread indices below `count`."""
    chosen = min(count, _SAMPLES)
    return np.arange(chosen) * count // max(chosen, 1)


def fit_robust_affine(places: np.ndarray, flow_px: np.ndarray, valid: np.ndarray, rounds: int = 5) -> np.ndarray:
    """Fit (..., 3, 2) affine motions to (..., 2, N) positions and (..., N, 2) displacements.

    All motions are fitted at once by iteratively reweighted least squares. valid: (..., N), 1 for positions to use,
    0 for the others.
    """
    columns = _columns(places)
    # Invalid displacements sort last, so that the median lies at half the number of the valid ones.
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
    """Return (..., 3, N) columns 1, u, v for (..., 2, N) positions."""
    return np.concatenate([np.ones_like(places[..., :1, :]), places], axis=-2)


def _miss(columns: np.ndarray, flow_px: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """Return (..., N) distances between the displacements and those that an affine motion predicts."""
    return _length(flow_px - columns.swapaxes(-1, -2) @ affine)


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2)


def _clear_miss(affine: np.ndarray) -> np.ndarray:
    """Return (...) the largest residual, px, up to which (..., 3, 2) affine motions explain a displacement."""
    return np.maximum(_CLEARLY_PX / 2, _CLEARLY / 2 * _length(affine[..., 0, :]))


def split_by_flow(blob: Blob, motion: BlobMotion, flows: Sequence[np.ndarray], offsets: tuple[int, int]) -> list[Blob]:
    """Return the blob, or two parts if two targets touch in it. flows: half resolution, to frames `offsets` away."""
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
    # Assign every pixel of the mask to the nearer part.
    away = [cv2.distanceTransform((~part).astype(np.uint8), cv2.DIST_L2, 5) for part in (core & ~second, second)]
    nearer = cv2.resize(away[0] - away[1], (width, height)) > 0
    return [blob.cut(~nearer), blob.cut(nearer)]


def find_second_motion(velocity_px: np.ndarray, core: np.ndarray) -> np.ndarray | None:
    """Return an (H, W) bool mask of the core pixels that have the second of two motions; None if one motion suffices.

    velocity_px: (H, W, 2) pixels a frame. core: (H, W) bool. If one affine motion leaves too many pixels unexplained,
    fit two motions, starting from two clusters of the flow, and assign every pixel to the motion that fits it better.
    """
    row, column = np.nonzero(core)
    if len(row) < 40:
        return None
    scale = max(float(np.ptp(row)), float(np.ptp(column)), 1.0)
    places, flow = np.stack([column - column.mean(), row - row.mean()]) / scale, velocity_px[row, column]
    # Fit the two motions to a sample of the pixels.
    sample = _choose_samples(len(row))
    columns, some = _columns(places), places[:, sample]
    some_columns, some_flow = columns[:, sample], flow[sample]
    # Also try plain least squares, because the robust fit follows a body that turns or grows only slowly.
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
    """Return (N,) bool, the second of two clusters of (N, 2) vectors, by two-means from the outermost vectors."""
    start = flow_px[np.linalg.norm(flow_px - np.median(flow_px, axis=0), axis=1).argmax()]
    means = [flow_px[np.linalg.norm(flow_px - start, axis=1).argmax()], start]
    second = np.ones(len(flow_px), bool)
    for _ in range(_ROUNDS):
        second = np.linalg.norm(flow_px - means[1], axis=1) < np.linalg.norm(flow_px - means[0], axis=1)
        if second.all() or not second.any():
            break
        means = [flow_px[~second].mean(axis=0), flow_px[second].mean(axis=0)]
    return second
