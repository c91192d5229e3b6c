"""From the foreground of one window to targets: blobs, their motion, their persistence, their outlines.

An outline follows from two explanations of every pixel. Pixels that only the target's motion explains are foreground,
those that the background explains are background; the rest (flat insides, places that only one picture shows) follow
their colours. A cast shadow is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.detection.blob_motion import DenseFlow, Motion, blob_motion, split_by_flow
from torchvision_dddas.detection.blobs import (
    Blob,
    Box,
    box_slices,
    ellipse,
    find_blobs,
    find_weak_blobs,
    group_fragments,
)
from torchvision_dddas.detection.engine import EVIDENCE_SCALE, Foreground, View, Window, evidence_scale
from torchvision_dddas.detection.motion_history import MotionHistory, split_by_trail
from torchvision_dddas.detection.persistence import Sighting, find_persistent
from torchvision_dddas.geometry import connected_parts
from torchvision_dddas.types import Detections

_MAX_MISFIT = 15.0  # noise units
# How much of the surroundings is smoothed with a blob, px.
_PAD = 24
_WARP_FLAGS = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP

# A shadow leaves this share of the light on the ground ...
_LIGHT_LEFT = (0.25, 0.85)
# ... in every colour alike, to this share of it.
_COLOURS_ALIKE = 0.1
# Two pictures show the same bare ground if they agree to so many grey levels.
_GROUNDS_ALIKE = 12
# If less than this share of the mask is left, the target itself is dark.
_LEAST_LEFT = 0.35
# Parts smaller than this share of the largest one left go with the shadow.
_CRUMB = 0.15


@dataclass(frozen=True)
class Target:
    """One target of a frame. box: x, y, width, height. mask: (height, width) bool inside the box.

    core: the pixels of the mask that differ by themselves, before gaps are closed and hulls are filled.
    """

    box: Box
    mask: np.ndarray
    velocity_px: np.ndarray
    score: float
    core: np.ndarray


@dataclass
class Observation:
    """What one frame shows, before its targets are chosen. Window and foreground are dropped once they are drawn."""

    window: Window | None = None
    foreground: Foreground | None = None
    blobs: list[Blob] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)


def observe(
    window: Window, foreground: Foreground, flow: DenseFlow, settings: Settings, history: MotionHistory | None = None
) -> Observation:
    """The blobs of a window's reference frame and how each of them moves.

    history: already aligned to this frame; used for motion where dense flow is off.
    """
    view, morphology, scale = window.reference, settings.morphology, evidence_scale(settings)
    threshold, peak = settings.difference.threshold * scale, settings.difference.peak * scale
    min_area_px = settings.gates.min_area_px
    blobs = find_blobs(
        foreground.core, foreground.evidence, threshold, min_area_px, peak, morphology.hull, foreground.scale
    )
    # A wide pair that looks both ways shows what is in the reference frame alone.
    wide = window.wide
    if settings.persistence.on and wide is not None and window.offsets[wide[0]] * window.offsets[wide[1]] < 0:
        blobs += find_weak_blobs(foreground.wide, blobs, threshold, morphology, min_area_px, peak)
    motions: list[Motion] = []
    if blobs and (settings.persistence.on or settings.refine.on):
        flows = flow(view.grey, foreground.warped)
        if settings.history.on:
            blobs = [part for blob in blobs for part in split_by_flow(blob, flows, foreground.offsets)]
        motions = [blob_motion(blob, flows, foreground.offsets) for blob in blobs]
    elif history is not None:
        history.add(foreground.core)
        parts = [part for blob in blobs for part in split_by_trail(blob, history, view.size, settings.history)]
        blobs, motions = [blob for blob, _ in parts], [Motion(velocity_px) for _, velocity_px in parts]
    return Observation(window, foreground, blobs, motions)


def draw_targets(
    observations: Sequence[Observation], steps: Sequence[np.ndarray | None], index: int, settings: Settings
) -> list[Target]:
    """The targets of `observations[index]`: the blobs that persist, with refined outlines, fragments joined.

    steps: registration from each observation to the next, None at a cut.
    """
    here = observations[index]
    window, foreground = here.window, here.foreground
    if window is None or foreground is None or not here.blobs:
        return []
    view = window.reference
    kept = [True] * len(here.blobs)
    if settings.persistence.on:
        sightings = [Sighting(o.blobs, o.motions, step) for o, step in zip(observations, steps, strict=True)]
        kept = find_persistent(sightings, index, view.size, settings.persistence)
    targets = []
    for i in np.flatnonzero(kept):
        blob, mask, velocity_px = here.blobs[i], here.blobs[i].mask, np.full(2, np.nan)
        if here.motions:
            velocity_px = here.motions[i].velocity_px
            if settings.refine.on:
                mask = refine_outline(blob, here.motions[i], view, foreground, settings)
                # From the air, where targets are small and shadows as large; beside a car they are thin and dark as
                # its tyres.
                if window.wide is not None and blob.area_px <= settings.refine.shadow_share * view.grey.size:
                    grounds = [window.neighbours[k].image for k in window.wide]
                    matrices = [window.neighbour_from_reference[k] for k in window.wide]
                    mask = remove_shadow(mask, blob.box, view.image, grounds, matrices)
        # A confidence in [0, 1) that grows with the peak of evidence over the threshold.
        score = float(1 - np.exp(-blob.peak / (2 * settings.difference.threshold * evidence_scale(settings))))
        for box, part in connected_parts(mask, blob.box, settings.gates.min_area_px // 2):
            core = blob.core[box_slices(box, *blob.box[:2])] & part
            targets.append(Target(box, part, velocity_px, score, core))
    if len(targets) < 2:
        return targets
    boxes = np.array([target.box for target in targets], float)
    groups = group_fragments(boxes, np.array([target.velocity_px for target in targets]))
    return [_join([targets[i] for i in group]) for group in groups]


def _join(parts: list[Target]) -> Target:
    """Fragments of one moving thing as one target."""
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


def build_detections(targets: Sequence[Target], size: tuple[int, int]) -> tuple[Detections, np.ndarray, np.ndarray]:
    """The targets as a table, as a (H, W) uint16 mask whose value i + 1 is row i, and their (H, W) bool core.

    size: (width, height).
    """
    mask, core = np.zeros(size[::-1], np.uint16), np.zeros(size[::-1], bool)
    for i, target in enumerate(targets, 1):
        mask[box_slices(target.box)][target.mask] = i
        core[box_slices(target.box)] |= target.core
    velocity = np.array([target.velocity_px for target in targets]).reshape(-1, 2)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    detections = Detections(
        box_px=np.array([target.box for target in targets], float).reshape(-1, 4),
        score=np.array([target.score for target in targets], float),
        area_px=np.array([target.mask.sum() for target in targets], float),
        heading_rad=np.where(speed > 0, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan),
        speed_px=speed,
    )
    return detections, mask, core


def refine_outline(blob: Blob, motion: Motion, view: View, foreground: Foreground, settings: Settings) -> np.ndarray:
    """The refined mask inside the blob's box, (height, width) bool; never outside the blob's own mask.

    view: the reference frame. foreground: its maps; `motion.affine` describes the motion to its warped neighbours.
    """
    x, y, width, height = blob.box
    box, own = box_slices(blob.box), view.grey[box_slices(blob.box)]
    slope = foreground.texture[box].astype(np.float32) / 4
    noise = np.sqrt(settings.difference.noise_levels**2 + (settings.difference.gradient_share * slope) ** 2)

    def misfit(pictures: Sequence[np.ndarray]) -> np.ndarray:
        """The smaller difference to two pictures of the box, noise units."""
        misses = (np.minimum(cv2.absdiff(own, p) / noise, _MAX_MISFIT).astype(np.float32) for p in pictures)
        return cv2.blur(np.minimum(*misses), (3, 3))

    still = misfit([picture[box] for picture in foreground.warped])
    # The parts of the neighbours that the target's motion brings into its box.
    centre_u, centre_v, scale = motion.frame
    moved = []
    for picture, (shift, by_u, by_v) in zip(foreground.warped, motion.affine, strict=True):
        # u + shift + by_u (u - cu) / s + by_v (v - cv) / s, with (u, v) counted from the box's corner
        slopes = np.c_[by_u, by_v]
        origin = np.array([x, y]) + shift + slopes @ np.array([x - centre_u, y - centre_v]) / scale
        matrix = np.c_[np.eye(2) + slopes / scale, origin]
        moved.append(
            cv2.warpAffine(picture, matrix, (width, height), flags=_WARP_FLAGS, borderMode=cv2.BORDER_REPLICATE)
        )
    moving = misfit(moved)
    near, far = foreground.evidence[box] / np.float32(EVIDENCE_SCALE), foreground.wide[box] / np.float32(EVIDENCE_SCALE)
    certain = np.clip((near - 2) / 2, 0, 1) * np.clip(1.5 - moving / np.maximum(still, 1), 0, 1)
    filled = np.clip((far - 2) / 2, 0, 1) * np.clip(1.5 - moving / 2, 0, 1)
    certain = np.where(certain < 0.2, np.maximum(certain, filled), certain) * blob.mask
    background = np.clip(slope / 8, 0, 1) * np.clip(1 - near / 2, 0, 1) * np.clip(0.5 + (moving - still) / 2, 0, 1)
    background *= np.clip(1 - far / 3, 0, 1)
    background[~blob.mask] = 1

    left, top = max(x - _PAD, 0), max(y - _PAD, 0)
    right, bottom = min(x + width + _PAD, view.size[0]), min(y + height + _PAD, view.size[1])
    inside = box_slices(blob.box, left, top)
    seeds: np.ndarray = np.zeros((bottom - top, right - left, 2), np.float32)
    seeds[..., 1] = 1
    seeds[inside] = np.dstack([certain, background])
    half = max((right - left) // 2, 1), max((bottom - top) // 2, 1)
    guide = cv2.resize(view.image[top:bottom, left:right], half, interpolation=cv2.INTER_AREA)
    seeds = cv2.resize(seeds, half, interpolation=cv2.INTER_AREA)
    weight = smooth_along_edges(seeds, guide, settings.refine.spatial_px / 2, settings.refine.colour_levels)
    share = cv2.resize(weight[..., 0] / (weight[..., 0] + weight[..., 1] + 1e-6), (right - left, bottom - top))
    return (share[inside] > settings.refine.share) & blob.mask


def smooth_along_edges(
    values: np.ndarray, guide: np.ndarray, spatial_px: float, colour_levels: float, rounds: int = 2
) -> np.ndarray:
    """Smooth (H, W, K) values along the flat regions of a picture, without crossing its edges.

    guide: (H, W, 3) or (H, W) uint8. spatial_px: reach where the colour does not change. colour_levels: change of
    colour, summed over the channels, that counts as much as that reach.
    Source: the recursive domain transform, Gastal and Oliveira 2011.
    """
    colours = np.atleast_3d(guide).astype(np.float32)
    colours *= 3 / colours.shape[2]  # a grey picture is one of three equal channels
    across, down = (1 + spatial_px / colour_levels * np.abs(np.diff(colours, axis=axis)).sum(axis=2) for axis in (1, 0))

    def filter_both_ways(lines: np.ndarray, keep: np.ndarray) -> None:
        """Over the first axis and back: each line takes the share `keep` from the line before it."""
        keep = np.ascontiguousarray(keep)[:, :, None]
        for i in range(1, len(lines)):
            lines[i] += keep[i - 1] * (lines[i - 1] - lines[i])
        for i in range(len(lines) - 2, -1, -1):
            lines[i] += keep[i] * (lines[i + 1] - lines[i])

    # Rows are made contiguous for either direction: each step then works on whole rows.
    rows = np.ascontiguousarray(values, np.float32)
    for i in range(rounds):
        sigma = spatial_px * np.sqrt(3) * 2 ** (rounds - i - 1) / np.sqrt(4**rounds - 1)
        decay = np.log(np.float32(np.exp(-np.sqrt(2) / sigma)))
        columns = np.ascontiguousarray(rows.transpose(1, 0, 2))
        filter_both_ways(columns, np.exp(decay * across).T)
        rows = np.ascontiguousarray(columns.transpose(1, 0, 2))
        filter_both_ways(rows, np.exp(decay * down))
    return rows


def remove_shadow(
    mask: np.ndarray,
    box: Box,
    image: np.ndarray,
    grounds: Sequence[np.ndarray],
    ground_from_image: Sequence[np.ndarray],
) -> np.ndarray:
    """The target's mask without its cast shadow: darker ground of unchanged colour. Unchanged where none is found.

    mask: (height, width) bool inside box = x, y, width, height of image, (H, W, 3) uint8. grounds: two other frames,
    (H, W, 3), far enough in time that the target is elsewhere in them. ground_from_image: their (3, 3) registrations.
    """
    if len(grounds) != 2 or any(picture.ndim != 3 for picture in [image, *grounds]):
        return mask
    pictures = [image[box_slices(box)]]
    for ground, matrix in zip(grounds, ground_from_image, strict=True):
        ground_from_box = matrix @ np.array([[1, 0, box[0]], [0, 1, box[1]], [0, 0, 1]], float)
        pictures.append(
            cv2.warpPerspective(ground, ground_from_box, box[2:], flags=_WARP_FLAGS, borderMode=cv2.BORDER_REPLICATE)
        )
    own, first, second = (cv2.blur(picture, (3, 3)).astype(np.float32) for picture in pictures)
    bare = np.abs(first - second).max(axis=2) < _GROUNDS_ALIKE
    light = (own + 2) / ((first + second) / 2 + 2)
    mean = light.mean(axis=2)
    alike = np.abs(light - mean[..., None]).max(axis=2) < _COLOURS_ALIKE * mean
    low, high = _LIGHT_LEFT
    shadow = (bare & alike & (mean > low) & (mean < high)).astype(np.uint8)
    shadow = cv2.morphologyEx(shadow, cv2.MORPH_OPEN, ellipse(5))
    body = (mask & (shadow == 0)).astype(np.uint8)
    body = cv2.morphologyEx(body, cv2.MORPH_OPEN, ellipse(3))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(body)
    if count < 2:
        return mask
    kept = stats[:, cv2.CC_STAT_AREA] >= _CRUMB * stats[1:, cv2.CC_STAT_AREA].max()
    kept[0] = False
    left = kept[labels]
    return left if left.sum() >= _LEAST_LEFT * mask.sum() else mask
