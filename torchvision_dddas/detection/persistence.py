"""Persistence: blobs that are linked from frame to frame and move steadily are targets, flicker is not."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchvision_dddas.config import PersistenceParameters
from torchvision_dddas.detection.blob_motion import Motion
from torchvision_dddas.detection.blobs import Blob
from torchvision_dddas.geometry import transfer

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

    @cached_property
    def areas_px(self) -> np.ndarray:
        """(N,) of the blobs."""
        return np.array([blob.area_px for blob in self.blobs])

    @cached_property
    def centres_px(self) -> np.ndarray:
        """(N, 2)."""
        return np.array([blob.centre_px for blob in self.blobs])

    @cached_property
    def sizes_px(self) -> np.ndarray:
        """(N, 2) widths and heights."""
        return np.array([blob.box[2:] for blob in self.blobs])

    @cached_property
    def velocities_px(self) -> np.ndarray:
        """(N, 2), 0 where unknown."""
        return np.nan_to_num([motion.velocity_px for motion in self.motions])


def find_persistent(
    sightings: Sequence[Sighting], index: int, size: tuple[int, int], parameters: PersistenceParameters
) -> list[bool]:
    """Which blobs of `sightings[index]` are targets, judged by up to two frames before and after it.

    A blob that is linked over enough frames and moves steadily in enough of them is a target. Where blobs are few, or
    a blob is large, one link is enough, because parallax makes many small blobs. Weak blobs need the full test.
    size: (width, height) of the picture. Source: appendix B, S5, wants independently moving targets; we test each
    blob and not each pixel, which keeps targets whole.
    """
    crowded = np.median([sum(not blob.weak for blob in s.blobs) for s in sightings]) > parameters.trusted_blobs
    possible = min(index, 2) + 1 + min(len(sightings) - 1 - index, 2)
    verdicts = []
    for blob, motion in zip(sightings[index].blobs, sightings[index].motions, strict=True):
        links, passes = _seen((blob, motion), sightings, index, parameters.flow_share)
        if blob.weak:
            verdicts.append(links >= parameters.weak_links and passes >= parameters.weak_passes)
            continue
        steady = links >= min(parameters.links, possible) and passes >= min(parameters.passes, possible)
        share = blob.area_px / (size[0] * size[1])
        large = share >= parameters.large_share
        linked = links >= 2 or possible < 2
        trusted = (linked and large) if crowded else (linked or share >= parameters.large_share / 5)
        sure = motion.steady > parameters.sure_share and share >= parameters.large_share / 10
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
    there = sightings[at + direction]
    if not there.blobs:
        return None
    ratio = there.areas_px / max(blob.area_px, 1)
    size = np.array(blob.box[2:])
    overlap = np.maximum(*(_ious(place, size, there.centres_px, there.sizes_px) for place in (centre, unmoved)))
    away, unlike = there.centres_px - centre, there.velocities_px - velocity
    near = (np.hypot(*away.T) < 0.5 * np.hypot(*size)) & (np.hypot(*unlike.T) < _VELOCITY_PX)
    fits = (ratio > 1 / _SIZE_RATIO) & (ratio < _SIZE_RATIO) & ((overlap >= _LEAST_IOU) | near)
    best = int(np.argmax(np.where(fits, overlap, -1.0)))
    return (there.blobs[best], there.motions[best]) if fits[best] else None


def _ious(centre: np.ndarray, size: np.ndarray, centres: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """(N,) IoU of a box with others, all by centre and (width, height)."""
    common = np.minimum(centre + size / 2, centres + sizes / 2) - np.maximum(centre - size / 2, centres - sizes / 2)
    both = np.prod(np.maximum(common, 0), axis=1)
    shares: np.ndarray = both / (np.prod(size) + np.prod(sizes, axis=1) - both)
    return shares
