"""Blobs over time: what is linked from frame to frame and moves steadily is a target, what flickers is not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.settings import PersistenceKnobs
from torchvision_dddas.targets.blobs import Blob
from torchvision_dddas.targets.motion import Motion
from torchvision_dddas.targets.projective import transfer

# Two blobs may be one target when their areas differ by less than this factor ...
_SIZE_RATIO = 2.5
# ... and the predicted box overlaps the found one, or lies close and moves alike (px a frame).
_LEAST_IOU, _VELOCITY_PX = 0.3, 0.6


@dataclass(frozen=True)
class Sighting:
    """The blobs of one frame and their motions. next_from_this: (3, 3) to the following frame, None at a cut."""

    blobs: Sequence[Blob]
    motions: Sequence[Motion]
    next_from_this: np.ndarray | None


def persistent(sightings: Sequence[Sighting], index: int, size: tuple[int, int], knobs: PersistenceKnobs) -> list[bool]:
    """Which blobs of `sightings[index]` are targets, judged by up to two frames before and after it.

    size: (width, height) of the picture. Source: METHOD.md section 1 asks for independently moving targets; the test
    per blob, not per pixel, is what keeps targets whole.
    """
    middle = sightings[index]
    crowded = np.median([len(s.blobs) for s in sightings]) > knobs.trusted_blobs
    verdicts = []
    for blob, motion in zip(middle.blobs, middle.motions, strict=True):
        members, passes = 1, int(motion.steady > knobs.flow_share)
        for direction in (1, -1):
            here, at = (blob, motion), index
            for _ in range(2):
                found = _follow(here, sightings, at, direction)
                if found is None:
                    break
                here, at = found, at + direction
                members += 1
                passes += here[1].steady > knobs.flow_share
        possible = min(index, 2) + 1 + min(len(sightings) - 1 - index, 2)
        share = blob.area_px / (size[0] * size[1])
        steady = members >= min(knobs.links, possible) and passes >= min(knobs.passes, possible)
        trusted = share >= knobs.large_share if crowded else True
        large = trusted and (members >= 2 or possible < 2 or share >= knobs.large_share / 5)
        sure = motion.steady > knobs.sure_share and share >= knobs.large_share / 10
        verdicts.append(bool(steady or large or sure))
    return verdicts


def _follow(
    here: tuple[Blob, Motion], sightings: Sequence[Sighting], at: int, direction: int
) -> tuple[Blob, Motion] | None:
    """The blob one frame on (or back) that continues this one, if any."""
    if not 0 <= at + direction < len(sightings):
        return None
    step = sightings[at].next_from_this if direction > 0 else sightings[at - 1].next_from_this
    if step is None:
        return None
    blob, motion = here
    velocity = np.nan_to_num(motion.velocity_px)
    there_from_here = step if direction > 0 else np.linalg.inv(step)
    # Where it is by its own motion, and where it is if that was measured wrongly.
    centre, unmoved = transfer(there_from_here, np.vstack([blob.centre_px + direction * velocity, blob.centre_px]))
    best, best_score = None, 0.0
    there = sightings[at + direction]
    for other, its in zip(there.blobs, there.motions, strict=True):
        ratio = other.area_px / max(blob.area_px, 1)
        if not 1 / _SIZE_RATIO < ratio < _SIZE_RATIO:
            continue
        overlap = max(_iou(c, blob.box[2:], other.centre_px, other.box[2:]) for c in (centre, unmoved))
        reach = 0.5 * float(np.hypot(*blob.box[2:]))
        alike = float(np.linalg.norm(velocity - np.nan_to_num(its.velocity_px)))
        near = float(np.linalg.norm(other.centre_px - centre)) < reach and alike < _VELOCITY_PX
        if (overlap >= _LEAST_IOU or near) and overlap + 0.01 > best_score:
            best, best_score = (other, its), overlap + 0.01
    return best


def _iou(a: np.ndarray, a_size: Sequence[int], b: np.ndarray, b_size: Sequence[int]) -> float:
    """IoU of two boxes given by centre and (width, height)."""
    overlap = np.minimum(a + np.array(a_size) / 2, b + np.array(b_size) / 2) - np.maximum(
        a - np.array(a_size) / 2, b - np.array(b_size) / 2
    )
    if (overlap <= 0).any():
        return 0.0
    both = float(overlap[0] * overlap[1])
    return both / (a_size[0] * a_size[1] + b_size[0] * b_size[1] - both)
