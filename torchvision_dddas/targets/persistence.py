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

    A blob that is linked over enough frames and moves steadily in enough of them is a target. Where blobs are few, or
    a blob is large, one link will do: parallax comes in crowds of small blobs. Weak blobs get no such leave.

    size: (width, height) of the picture. Source: appendix B, S5, asks for independently moving targets; the test
    per blob, not per pixel, is what keeps targets whole.
    """
    crowded = np.median([sum(not blob.weak for blob in s.blobs) for s in sightings]) > knobs.trusted_blobs
    possible = min(index, 2) + 1 + min(len(sightings) - 1 - index, 2)
    verdicts = []
    for blob, motion in zip(sightings[index].blobs, sightings[index].motions, strict=True):
        links, passes = _seen((blob, motion), sightings, index, knobs.flow_share)
        if blob.weak:
            verdicts.append(links >= knobs.weak_links and passes >= knobs.weak_passes)
            continue
        steady = links >= min(knobs.links, possible) and passes >= min(knobs.passes, possible)
        share = blob.area_px / (size[0] * size[1])
        large = share >= knobs.large_share
        linked = links >= 2 or possible < 2
        trusted = (linked and large) if crowded else (linked or share >= knobs.large_share / 5)
        sure = motion.steady > knobs.sure_share and share >= knobs.large_share / 10
        verdicts.append(steady or trusted or sure)
    return verdicts


def _seen(blob: tuple[Blob, Motion], sightings: Sequence[Sighting], index: int, flow_share: float) -> tuple[int, int]:
    """In how many of up to five frames around `index` a blob is seen, and in how many of those it moves steadily."""
    links, passes = 1, int(blob[1].steady > flow_share)
    for direction in (1, -1):
        here, at = blob, index
        for _ in range(2):
            found = _follow(here, sightings, at, direction)
            if found is None:
                break
            here, at = found, at + direction
            links += 1
            passes += here[1].steady > flow_share
    return links, passes


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
