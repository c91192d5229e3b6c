"""Join fragments of one moving object: parts that lie close and move alike, and the two ends of a uniform body."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from torchvision_dddas.detection.blobs import Box, box_slices
from torchvision_dddas.detection.observation import Target
from torchvision_dddas.detection.outlines import GROUNDS_ALIKE, WARP_FLAGS

# The two ends of one body are apart by at most this many times the longer side of the larger end.
_FURTHEST = 2.0
# The sideways offset of the two ends of one body is at most _ASIDE times their distance along the motion. Other
# pictures must show at least the share _LEAST_FREE of the ground between the ends without the body, and in the frame
# the body must cover at least the share _COVERED of that free ground.
_ASIDE, _LEAST_FREE, _COVERED = 0.5, 0.1, 0.9


@dataclass(frozen=True)
class Ground:
    """A picture of the same ground at another time.

    grey: (H, W) uint8. offset: looks from the frame to this picture, negative if it is earlier. there_from_here: (3, 3)
    homography of the background from the frame to this picture.
    """

    grey: np.ndarray
    offset: int
    there_from_here: np.ndarray


def join_fragments(
    targets: list[Target], grey: np.ndarray | None = None, grounds: Sequence[Ground] = ()
) -> list[Target]:
    """Return the targets, with the fragments of one moving object joined.

    grey: (H, W) uint8, the picture of the frame. grounds: earlier and later pictures; they show whether two targets are
    the ends of one uniform body.
    """
    if len(targets) < 2:
        return targets
    boxes = np.array([target.box for target in targets], float)
    velocities = np.array([target.velocity_px for target in targets])
    is_one = None if grey is None else partial(_is_covered_between, grey, grounds)
    return [_join([targets[i] for i in group]) for group in group_fragments(boxes, velocities, is_one)]


def _is_covered_between(
    grey: np.ndarray, grounds: Sequence[Ground], one: np.ndarray, other: np.ndarray, velocity_px: np.ndarray
) -> bool:
    """Return whether a moving body covers the ground between two boxes (x, y, width, height), one ahead of the other.

    Compare the frame with pictures of the ground from times when a body that spans both boxes would not have covered
    it. Return False if no picture shows enough of that ground.
    """
    speed, ends = float(np.hypot(*velocity_px)), np.array([one, other])
    way, middle = velocity_px / speed, ends[:, :2] + ends[:, 2:] / 2
    left, top = np.floor(ends[:, :2].min(axis=0)).astype(int).tolist()
    right, bottom = np.ceil((ends[:, :2] + ends[:, 2:]).max(axis=0)).astype(int).tolist()
    box: Box = left, top, right - left, bottom - top
    # Positions of the common box's pixels along and across the motion; `share` is 0 at one centre and 1 at the other.
    apart = middle[1] - middle[0]
    length, slope = float(apart @ way), float(apart @ (-way[1], way[0]))
    if abs(slope) > _ASIDE * abs(length):
        return False
    v, u = np.mgrid[top:bottom, left:right]
    u, v = u - middle[0, 0], v - middle[0, 1]
    along, across = u * way[0] + v * way[1], v * way[0] - u * way[1]
    share = along / length
    between = (share > 0) & (share < 1) & (np.abs(across - share * slope) < ends[:, 2:].min() / 4)
    for end in ends.astype(int).tolist():
        between[box_slices((*end,), left, top)] = False
    reach = ends[:, 2:] @ np.abs(way) / 2
    rear, front = (np.array([0, length]) - reach).min(), (np.array([0, length]) + reach).max()
    own, free_px, covered_px = cv2.blur(grey[box_slices(box)], (3, 3)), 0, 0
    for ground in grounds:
        moved = ground.offset * speed
        free = between & ((along > front + moved) if moved < 0 else (along < rear + moved))
        there_from_box = ground.there_from_here @ np.array([[1, 0, left], [0, 1, top], [0, 0, 1.0]])
        seen = cv2.warpPerspective(ground.grey, there_from_box, box[2:], flags=WARP_FLAGS)
        covered = cv2.absdiff(own, cv2.blur(seen, (3, 3))) > GROUNDS_ALIKE
        free_px, covered_px = free_px + int(free.sum()), covered_px + int((free & covered).sum())
    return free_px > 0 and free_px >= _LEAST_FREE * between.sum() and covered_px >= _COVERED * free_px


def _join(parts: list[Target]) -> Target:
    """Join fragments of one moving object into one target."""
    if len(parts) == 1:
        return parts[0]
    corners = np.array([part.box for part in parts])
    left, top = corners[:, :2].min(axis=0).tolist()
    width, height = ((corners[:, :2] + corners[:, 2:]).max(axis=0) - (left, top)).tolist()
    mask, core = np.zeros((2, height, width), bool)
    for part in parts:
        mask[box_slices(part.box, left, top)] |= part.mask
        core[box_slices(part.box, left, top)] |= part.core
    largest = max(parts, key=lambda part: int(part.mask.sum()))
    score = max(part.score for part in parts)
    return Target((left, top, width, height), mask, largest.velocity_px, score, core)


def group_fragments(
    boxes_px: np.ndarray,
    velocities_px: np.ndarray,
    is_one: Callable[[np.ndarray, np.ndarray, np.ndarray], bool] | None = None,
) -> list[list[int]]:
    """Return groups of indices of boxes; the boxes of a group are fragments of one target.

    boxes_px: (N, 4) x, y, width, height. velocities_px: (N, 2) pixels a frame; a box with NaN velocity stays alone.
    Two boxes are fragments if the faster one moves by more than 1 px a frame and one of two rules holds. Near boxes:
    the gap along each axis is at most a fifth of the larger side, they overlap along one axis by half of the smaller
    side, and their velocities differ by at most a fifth of the faster speed. Intersecting boxes: their velocities
    differ by at most half of the faster speed. is_one: takes two boxes that are further apart, and their mean velocity,
    and returns whether they are one target.
    """
    low, size = boxes_px[:, :2], boxes_px[:, 2:]
    speed = np.hypot(*velocities_px.T)
    groups: list[list[int]] = []
    for i in range(len(boxes_px)):
        gap = np.maximum(low[i], low[:i]) - np.minimum(low[i] + size[i], low[:i] + size[:i])
        overlap = (-gap / np.minimum(size[i], size[:i])).max(axis=1)
        larger, intersects = np.maximum(size[i], size[:i]), (gap < 0).all(axis=1)
        near = ((gap <= 0.2 * larger).all(axis=1) & (overlap > 0.5)) | intersects
        faster = np.maximum(speed[i], speed[:i])
        apart = np.hypot(*(velocities_px[i] - velocities_px[:i]).T)
        alike = (apart <= np.where(intersects, 0.5, 0.2) * faster) & (faster > 1.0)
        fragments = set(np.flatnonzero(near & alike).tolist())
        if is_one is not None:
            far = np.flatnonzero(~near & alike & (gap.max(axis=1) <= _FURTHEST * larger.max(axis=1))).tolist()
            both = velocities_px[i] / 2 + velocities_px / 2
            fragments |= {k for k in far if is_one(boxes_px[i], boxes_px[k], both[k])}
        joined = [group for group in groups if fragments.intersection(group)]
        groups = [group for group in groups if group not in joined]
        groups.append(sorted([*(k for group in joined for k in group), i]))
    return sorted(groups)
