"""Motion segmentation (appendix B, step S5): heading and speed of a blob from its trail, and parting it by two trails.

A blob leaves a trail in the motion history. Where its trail falls into regions that point clearly different ways, the
blob is several targets that touch.
"""

from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.config import HistoryParameters
from torchvision_dddas.detection.blobs import Blob
from torchvision_dddas.detection.flow_split import cut
from torchvision_dddas.detection.motion_history import NEWEST, MotionHistory, gradient, region_orientation

# How far behind a blob its trail is looked for, px.
_REACH_PX = 48
# A trail shows the motion across its edge only, so that one motion can leave two trails that point up to a right angle
# apart, and with noise somewhat more. Beyond this it takes two motions.
_APART_RAD = np.radians(120)
# Flicker leaves trails whose gradients do not agree with each other, or that hardly move (px a frame).
_AGREEMENT, _LEAST_SPEED_PX = 0.5, 0.5
# Smaller trails (share of all) and smaller parts (share of the blob) are noise.
_LEAST_SHARE = 0.2


class Part(NamedTuple):
    """A blob that moves as one. velocity_px: (2,) pixels a frame over the background, NaN where unknown."""

    blob: Blob
    velocity_px: np.ndarray


def regions(stamps: np.ndarray, seeds: np.ndarray, threshold_frames: float) -> list[np.ndarray]:
    """(H, W) bool masks of the flood regions that hold a seed.

    Neighbours (8) whose stamps differ by at most the threshold belong together; stamp 0 belongs to none.
    stamps: (H, W) uint8. seeds: (H, W) bool.
    """
    # OpenCV's mask is one pixel larger on every side; nonzero is a wall.
    wall = np.ones((stamps.shape[0] + 2, stamps.shape[1] + 2), np.uint8)
    wall[1:-1, 1:-1] = stamps == 0
    threshold = int(min(threshold_frames, 254))  # stamps are whole frames
    flags = 8 | (2 << 8) | cv2.FLOODFILL_MASK_ONLY
    left, found = seeds & (stamps > 0), []
    while left.any():
        row, column = np.unravel_index(int(left.argmax()), left.shape)
        cv2.floodFill(stamps, wall, (int(column), int(row)), 0, threshold, threshold, flags)
        region = wall[1:-1, 1:-1] == 2
        wall[1:-1, 1:-1][region] = 1
        left &= ~region
        found.append(region)
    return found


def moving_parts(
    blob: Blob, history: MotionHistory, size: tuple[int, int], parameters: HistoryParameters
) -> list[Part]:
    """The blob with its velocity, or its parts with theirs where its trail shows two motions.

    The history has the current frame's silhouette. size: (width, height) of the picture. Slower than the trail is
    broad, or faster than its own length a frame, a blob leaves no usable trail: its velocity is NaN.
    """
    x, y, width, height = blob.box
    left, top = max(x - _REACH_PX, 0), max(y - _REACH_PX, 0)
    right, bottom = min(x + width + _REACH_PX, size[0]), min(y + height + _REACH_PX, size[1])
    stamps = history.stamps((left, top, right - left, bottom - top))
    body = np.zeros(stamps.shape, bool)
    body[y - top : y - top + height, x - left : x - left + width] = blob.mask
    body &= stamps == NEWEST
    angle, valid = gradient(stamps, parameters.delta_min_frames, parameters.delta_max_frames)
    old = np.where(stamps == NEWEST, np.uint8(0), stamps)
    trails = regions(old, _grown(body), parameters.segmentation_threshold_frames)
    total = sum(int(trail.sum()) for trail in trails)
    trails = [trail for trail in trails if trail.sum() >= _LEAST_SHARE * total]
    if not trails:
        return [Part(blob, np.full(2, np.nan))]
    pointing, agreement = zip(
        *(region_orientation(angle, valid, stamps, _grown(t), parameters.duration_frames) for t in trails), strict=True
    )
    pair = _apart([p if a >= _AGREEMENT else np.nan for p, a in zip(pointing, agreement, strict=True)])
    if pair is not None:
        shares = _shared_out(body, [trails[i] for i in pair], [pointing[i] for i in pair])
        if all(share.sum() >= _LEAST_SHARE * body.sum() for share in shares):
            inside = np.s_[y - top : y - top + height, x - left : x - left + width]
            parts = [
                Part(cut(blob, share[inside]), _velocity(stamps, share, trails[i], pointing[i]))
                for share, i in zip(shares, pair, strict=True)
            ]
            if all(np.hypot(*part.velocity_px) >= _LEAST_SPEED_PX for part in parts):
                return parts
    trail = np.logical_or.reduce(trails)
    heading, _ = region_orientation(angle, valid, stamps, _grown(trail), parameters.duration_frames)
    return [Part(blob, _velocity(stamps, body, trail, heading))]


def _grown(region: np.ndarray) -> np.ndarray:
    return cv2.dilate(region.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _apart(pointing: list[float]) -> tuple[int, int] | None:
    """The two trails that point furthest apart, if far enough."""
    best, pair = _APART_RAD, None
    for i in range(len(pointing)):
        for j in range(i):
            angle = abs(np.angle(np.exp(1j * (pointing[i] - pointing[j]))))
            if angle > best:
                best, pair = angle, (j, i)
    return pair


def _shared_out(body: np.ndarray, trails: list[np.ndarray], pointing: list[float]) -> list[np.ndarray]:
    """Each pixel of the body goes to the trail that it lies ahead of; between two of those, to the nearer."""
    row, column = np.nonzero(body)
    costs = []
    for trail, heading in zip(trails, pointing, strict=True):
        along, across = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        r, c = np.nonzero(trail)
        side, ahead = np.c_[c, r] @ across, np.c_[column, row] @ along
        lane = np.c_[column, row] @ across
        beside = np.maximum(np.maximum(side.min() - lane, lane - side.max()), 0)
        costs.append(1e3 * np.round(beside) + np.abs(ahead - (np.c_[c, r] @ along).max()))
    nearest = np.argmin(costs, axis=0)
    shares = []
    for i in range(len(trails)):
        share = np.zeros(body.shape, bool)
        share[row[nearest == i], column[nearest == i]] = True
        shares.append(share)
    return shares


def _velocity(stamps: np.ndarray, body: np.ndarray, trail: np.ndarray, heading: float) -> np.ndarray:
    """Velocity of a body that left a trail: what it swept a frame, over its breadth across the heading."""
    if not np.isfinite(heading) or not body.any():
        return np.full(2, np.nan)
    age = NEWEST - stamps[trail].astype(int)
    frames = int(age.max())
    row, column = np.nonzero(body)
    breadth = len(np.unique(np.round(column * np.sin(heading) - row * np.cos(heading))))
    return len(age) / (frames * breadth) * np.array([np.cos(heading), np.sin(heading)])
