"""From the foreground of one window to targets: blobs, their motion, their persistence, their outlines.

An outline follows from two explanations of every pixel. Pixels that only the target's motion explains are foreground,
those that the background explains are background; the rest (flat insides, places that only one picture shows) follow
their colours. A cast shadow is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from torchvision_dddas.chain import DetectionChain, OpenCVOperations, View, Window, ellipse, evidence_scale
from torchvision_dddas.config import EVIDENCE_SCALE, Settings, uses_tracklets
from torchvision_dddas.detection.blob_motion import DenseFlow, Motion, measure_motions, split_by_flow
from torchvision_dddas.detection.blobs import (
    Blob,
    Box,
    box_slices,
    fill_hull,
    find_blobs,
    group_fragments,
    leave_touching,
)
from torchvision_dddas.detection.candidates import SILHOUETTES, Candidates, Evidence, find_candidates
from torchvision_dddas.detection.engine import Foreground
from torchvision_dddas.detection.motion_history import MotionHistory, split_by_trail
from torchvision_dddas.detection.persistence import Links, Sighting, find_persistent
from torchvision_dddas.geometry import connected_parts
from torchvision_dddas.types import Detections

_MAX_MISFIT = 15.0  # noise units
# What the levels of texture and evidence maps mean: grey levels a pixel, and noise units.
_SLOPES, _UNITS = np.arange(256) / 4, np.arange(256) / EVIDENCE_SCALE
_DIFFERS = np.clip((_UNITS - 2) / 2, 0, 1)
# At most so many blobs of a picture are judged, the largest ones.
_MOST_BLOBS = 150
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
# When a shadow is removed, so are parts of the mask that are smaller than this share of its largest part.
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
    """What one frame shows, before its targets are chosen. Window and foreground are dropped once they are drawn.

    links: of its blobs to those of the frames beside it, as far as they are known. candidates: for tracklets.
    """

    window: Window[View] | None = None
    foreground: Foreground | None = None
    blobs: list[Blob] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)
    links: Links = field(default_factory=dict)
    candidates: Candidates | None = None


def observe(
    window: Window[View],
    foreground: Foreground,
    flow: DenseFlow,
    settings: Settings,
    history: MotionHistory | None = None,
) -> Observation:
    """The blobs of a window's reference frame and how each of them moves.

    history: already aligned to this frame; used for motion where dense flow is off.
    """
    view = window.reference
    blobs = _blobs_of(window, foreground, settings) if foreground.blobs is None else foreground.blobs
    if uses_tracklets(settings) and len(blobs) > _MOST_BLOBS:  # each is compared with all candidates of six looks
        blobs = sorted(blobs, key=lambda blob: -blob.area_px)[:_MOST_BLOBS]
    motions: list[Motion] = []
    if blobs and (settings.persistence.on or settings.refine.on):
        flows = flow(view.grey, foreground.warped, [blob.box for blob in blobs])
        motions = measure_motions(blobs, flows, foreground.offsets)
        if settings.history.on:
            parts = [split_by_flow(*both, flows, foreground.offsets) for both in zip(blobs, motions, strict=True)]
            if any(len(two) > 1 for two in parts):
                blobs = [part for two in parts for part in two]
                motions = measure_motions(blobs, flows, foreground.offsets)
    elif history is not None:
        history.add(foreground.core)
        ways = [part for blob in blobs for part in split_by_trail(blob, history, view.size, settings.history)]
        blobs, motions = [blob for blob, _ in ways], [Motion(velocity_px) for _, velocity_px in ways]
    candidates = None
    if uses_tracklets(settings):
        candidates = find_candidates(_evidence_by_gap(window, foreground), view.grey, blobs)
    return Observation(window, foreground, blobs, motions, candidates=candidates)


def _evidence_by_gap(window: Window[View], foreground: Foreground) -> Evidence:
    """The evidence of the nearest pair, of the next one and of the wide one."""
    nearest, further = foreground.pairs[0], foreground.pairs[1] if len(foreground.pairs) > 1 else None
    return nearest, further, foreground.wide if window.wide is not None else None


def _blobs_of(window: Window[View], foreground: Foreground, settings: Settings) -> list[Blob]:
    """Strong and weak blobs, by OpenCV."""
    blobs = find_blobs(foreground.core, foreground.evidence, *_blob_limits(settings), foreground.scale)
    if settings.persistence.on and window.looks_both_ways:
        blobs += find_weak_blobs(foreground.wide, blobs, settings)
    return blobs


def find_weak_blobs(wide: np.ndarray, found: list[Blob], settings: Settings) -> list[Blob]:
    """Blobs of the wide pair's evidence, (H, W) uint8, that touch none of those found: slow targets of even colour."""
    if min(wide.shape) < 2:
        return []
    core, half = DetectionChain(settings, OpenCVOperations()).find_weak(wide)
    return leave_touching(find_blobs(core, half, *_blob_limits(settings), scale=2), found, wide.shape)


def _blob_limits(settings: Settings) -> tuple[float, int, float, bool]:
    """Threshold, least area, least peak of `find_blobs`, and whether hulls are filled."""
    difference, scale = settings.difference, evidence_scale(settings)
    return difference.threshold * scale, settings.gates.min_area_px, difference.peak * scale, settings.morphology.hull


def judge_persistence(
    observations: Sequence[Observation], steps: Sequence[np.ndarray | None], index: int, settings: Settings
) -> list[bool]:
    """Which blobs of `observations[index]` persist. steps: registration from each observation to the next, or None."""
    here = observations[index]
    if not settings.persistence.on or here.window is None:
        return [True] * len(here.blobs)
    sightings = [Sighting(o.blobs, o.motions, step, o.links) for o, step in zip(observations, steps, strict=True)]
    return find_persistent(sightings, index, here.window.reference.size, settings.persistence)


def draw_blobs(here: Observation, chosen: Sequence[int], settings: Settings) -> list[list[Target]]:
    """The targets that blobs show, with refined outlines, whose parts may lie apart: a list for each chosen index."""
    window, foreground = here.window, here.foreground
    if window is None or foreground is None:
        return []
    view = window.reference
    refined: list[np.ndarray] = []
    if here.motions and settings.refine.on:
        moving = [(here.blobs[i], here.motions[i]) for i in chosen]
        refined = refine_outlines(moving, view, foreground, settings)
    drawn: list[list[Target]] = []
    for k, i in enumerate(chosen):
        blob, mask, velocity_px = here.blobs[i], here.blobs[i].mask, np.full(2, np.nan)
        if here.motions:
            velocity_px = here.motions[i].velocity_px
            if settings.refine.on:
                mask = _without_shadow(refined[k], blob.box, blob.area_px, window, settings)
        # A confidence in [0, 1) that grows with the peak of evidence over the threshold.
        score = float(1 - np.exp(-blob.peak / (2 * settings.difference.threshold * evidence_scale(settings))))
        drawn.append([])
        for box, part in connected_parts(mask, blob.box, settings.gates.min_area_px // 2):
            core = blob.core[box_slices(box, *blob.box[:2])] & part
            drawn[-1].append(Target(box, part, velocity_px, score, core))
    return drawn


def draw_candidate(here: Observation, index: int, velocity_px: np.ndarray, score: float, settings: Settings) -> Target:
    """The target that a candidate shows: the hull of its evidence. score: confidence in [0, 1]."""
    window, foreground, candidates = here.window, here.foreground, here.candidates
    assert window is not None and foreground is not None and candidates is not None  # kept until a frame is drawn
    silhouette = SILHOUETTES[candidates.silhouette[index]]
    box: Box = tuple(candidates.box_px[index].astype(int).tolist())
    evidence, wide = foreground.evidence[box_slices(box)], foreground.wide[box_slices(box)]
    if 2 in silhouette.gaps:
        evidence = np.maximum(evidence, wide) if len(silhouette.gaps) > 1 else wide
    core = evidence > silhouette.threshold * EVIDENCE_SCALE
    mask = fill_hull(core) if core.any() else np.ones(core.shape, bool)
    if settings.refine.on:
        mask = _without_shadow(mask, box, int(mask.sum()), window, settings)
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    part = np.s_[top : top + height, left : left + width]
    box = (box[0] + left, box[1] + top, width, height)
    return Target(box, mask[part], velocity_px, score, (core & mask)[part])


def _without_shadow(mask: np.ndarray, box: Box, area_px: int, window: Window[View], settings: Settings) -> np.ndarray:
    """The mask without the shadow of a target that is small in the picture.

    From the air, where targets are small, shadows are as large; beside a car they are thin, and dark as its tyres.
    """
    view = window.reference
    if window.wide is None or area_px > settings.refine.shadow_share * view.grey.size:
        return mask
    grounds = [window.neighbours[k].image for k in window.wide]
    matrices = [window.neighbour_from_reference[k] for k in window.wide]
    return remove_shadow(mask, box, view.image, grounds, matrices)


def join_fragments(targets: list[Target]) -> list[Target]:
    """The same targets, those that are fragments of one moving thing joined."""
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


def refine_outlines(
    moving: Sequence[tuple[Blob, Motion]], view: View, foreground: Foreground, settings: Settings
) -> list[np.ndarray]:
    """The refined masks inside the blobs' boxes, (height, width) bool; never outside the blobs' own masks.

    view: the reference frame. foreground: its maps; `Motion.affine` describes the motion to its warped neighbours.
    """
    seeds, guides = [], []
    for blob, motion in moving:
        left, top, width, height = _surroundings(blob.box, view.size)
        here: np.ndarray = np.zeros((height, width, 2), np.float32)
        here[..., 1] = 1
        here[box_slices(blob.box, left, top)] = np.dstack(_explain_pixels(blob, motion, view, foreground, settings))
        half = max(width // 2, 1), max(height // 2, 1)
        image = view.image[box_slices((left, top, width, height))]
        guides.append(cv2.resize(image, half, interpolation=cv2.INTER_AREA))
        seeds.append(cv2.resize(here, half, interpolation=cv2.INTER_AREA))
    weights = smooth_along_edges(seeds, guides, settings.refine.spatial_px / 2, settings.refine.colour_levels)
    masks = []
    for (blob, _), weight in zip(moving, weights, strict=True):
        left, top, width, height = _surroundings(blob.box, view.size)
        share = cv2.resize(weight[..., 0] / (weight[..., 0] + weight[..., 1] + 1e-6), (width, height))
        masks.append((share[box_slices(blob.box, left, top)] > settings.refine.share) & blob.mask)
    return masks


def _surroundings(box: Box, size: tuple[int, int]) -> Box:
    """The box of the picture (width, height) in which a blob's evidence spreads."""
    x, y, width, height = box
    left, top = max(x - _PAD, 0), max(y - _PAD, 0)
    return left, top, min(x + width + _PAD, size[0]) - left, min(y + height + _PAD, size[1]) - top


def _explain_pixels(
    blob: Blob, motion: Motion, view: View, foreground: Foreground, settings: Settings
) -> tuple[np.ndarray, np.ndarray]:
    """How surely the pixels of a blob's box are target and background, (height, width) float32 each."""
    x, y, width, height = blob.box
    box, own = box_slices(blob.box), view.grey[box_slices(blob.box)]
    near, far, texture = (picture[box] for picture in (foreground.evidence, foreground.wide, foreground.texture))
    noise = np.hypot(settings.difference.noise_levels, settings.difference.gradient_share * _SLOPES)
    weight = _look_up(texture, 1 / noise)

    def misfit(pictures: Sequence[np.ndarray]) -> np.ndarray:
        """The smaller difference to two pictures of the box, noise units."""
        least = cv2.min(*(cv2.absdiff(own, picture) for picture in pictures))
        miss = cv2.multiply(least, weight, dtype=cv2.CV_32F)
        return cv2.blur(cv2.threshold(miss, _MAX_MISFIT, 0, cv2.THRESH_TRUNC)[1], (3, 3))

    still = misfit([picture[box] for picture in foreground.warped])
    # The parts of the neighbours that the target's motion brings into its box.
    centre_u, centre_v, scale = motion.frame
    moved = []
    for picture, (shift, by_u, by_v) in zip(foreground.warped, motion.affine, strict=True):
        # u + shift + by_u (u - cu) / s + by_v (v - cv) / s, with (u, v) counted from the box's corner
        slopes = np.stack([by_u, by_v], axis=1)
        matrix = np.empty((2, 3))
        matrix[:, :2] = np.eye(2) + slopes / scale
        matrix[:, 2] = np.array([x, y]) + shift + slopes @ np.array([x - centre_u, y - centre_v]) / scale
        moved.append(
            cv2.warpAffine(picture, matrix, (width, height), flags=_WARP_FLAGS, borderMode=cv2.BORDER_REPLICATE)
        )
    moving = misfit(moved)
    certain = _look_up(near, _DIFFERS) * np.clip(1.5 - moving / np.maximum(still, 1), 0, 1)
    filled = _look_up(far, _DIFFERS) * np.clip(1.5 - moving / 2, 0, 1)
    certain = np.where(certain < 0.2, np.maximum(certain, filled), certain) * blob.mask
    background = _look_up(texture, np.clip(_SLOPES / 8, 0, 1)) * np.clip(0.5 + (moving - still) / 2, 0, 1)
    background *= _look_up(near, np.clip(1 - _UNITS / 2, 0, 1))
    background *= _look_up(far, np.clip(1 - _UNITS / 3, 0, 1))
    background[~blob.mask] = 1
    return certain, background


def _look_up(picture: np.ndarray, table: np.ndarray) -> np.ndarray:
    """(H, W) float32 values of a uint8 picture's levels in a table of 256."""
    return cv2.LUT(picture, table.astype(np.float32))


def smooth_along_edges(
    values: Sequence[np.ndarray],
    guides: Sequence[np.ndarray],
    spatial_px: float,
    colour_levels: float,
    rounds: int = 2,
) -> list[np.ndarray]:
    """Smooth (H, W, K) values along the flat regions of pictures, without crossing their edges.

    guides: (H, W, 3) or (H, W) uint8. spatial_px: reach where the colour does not change. colour_levels: change of
    colour, summed over the channels, that counts as much as that reach.
    Source: the recursive domain transform, Gastal and Oliveira 2011.
    """
    if not values:
        return []
    distances: list[list[np.ndarray]] = [[], []]  # along columns, along rows
    for guide in guides:
        colours = np.atleast_3d(guide)
        # A grey picture is one of three equal channels.
        weight = np.full(colours.shape[2], 3 / colours.shape[2] * spatial_px / colour_levels, np.float32)
        for axis, lines in enumerate((colours, colours.swapaxes(0, 1))):
            change = np.maximum(lines[1:], lines[:-1]) - np.minimum(lines[1:], lines[:-1])
            distances[axis].append(1 + change.astype(np.float32) @ weight)
    # All pictures lie side by side, so that a step takes one line of each; nothing comes from beyond the last line.
    packed = [_pack(apart, np.inf) for apart in distances]
    for i in range(rounds):
        sigma = spatial_px * np.sqrt(3) * 2 ** (rounds - i - 1) / np.sqrt(4**rounds - 1)
        decay = np.float32(-np.sqrt(2) / sigma)
        for axis in (1, 0):
            lines = _pack([value.swapaxes(0, axis).swapaxes(1, 2) for value in values])
            _smooth_lines(lines, np.exp(decay * packed[axis]))
            ends = np.cumsum([value.shape[1 - axis] for value in values])
            parts = np.split(lines, ends[:-1], axis=2)
            values = [
                part[: value.shape[axis]].swapaxes(1, 2).swapaxes(0, axis)
                for part, value in zip(parts, values, strict=True)
            ]
    return list(values)


def _pack(pictures: Sequence[np.ndarray], beyond: float = 0.0) -> np.ndarray:
    """Pictures, (H, ..., W) each of its own size, side by side, float32; `beyond` where one has no more lines."""
    height, width = max(map(len, pictures)), sum(picture.shape[-1] for picture in pictures)
    packed = np.full((height, *pictures[0].shape[1:-1], width), beyond, np.float32)
    left = 0
    for picture in pictures:
        packed[: len(picture), ..., left : left + picture.shape[-1]] = picture
        left += picture.shape[-1]
    return packed


def _smooth_lines(lines: np.ndarray, shares: np.ndarray) -> None:
    """Down the lines, (H, K, W), and back: each takes the share, (H - 1, W), from the line before it; in place."""
    change = np.empty_like(lines[0])
    steps = [*zip(lines, lines[1:], shares, strict=False)]
    for before, after, kept in steps:
        np.subtract(before, after, out=change)
        change *= kept
        after += change
    for before, after, kept in reversed(steps):
        np.subtract(after, before, out=change)
        change *= kept
        before += change


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
    own, first, second = (
        np.stack(cv2.split(cv2.blur(picture, (3, 3)))).astype(np.float32)
        for picture in pictures  # colours first
    )
    bare = np.abs(first - second).max(axis=0) < _GROUNDS_ALIKE
    light = (own + 2) / ((first + second) / 2 + 2)
    mean = light.mean(axis=0)
    alike = np.abs(light - mean).max(axis=0) < _COLOURS_ALIKE * mean
    low, high = _LIGHT_LEFT
    is_shadow = bare & alike & (mean > low) & (mean < high)
    shadow = cv2.morphologyEx(is_shadow.astype(np.uint8), cv2.MORPH_OPEN, ellipse(5))
    body = cv2.morphologyEx((mask & (shadow == 0)).astype(np.uint8), cv2.MORPH_OPEN, ellipse(3))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(body)
    if count < 2:
        return mask
    kept = stats[:, cv2.CC_STAT_AREA] >= _CRUMB * stats[1:, cv2.CC_STAT_AREA].max()
    kept[0] = False
    left = kept[labels]
    return left if left.sum() >= _LEAST_LEFT * mask.sum() else mask
