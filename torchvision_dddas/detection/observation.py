"""From the foreground of one window to targets: blobs, their motion, their persistence, their outlines."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.detection.blob_motion import DenseFlow, Motion, blob_motion, split_by_flow
from torchvision_dddas.detection.blobs import Blob, Box, box_slices, find_blobs, find_weak_blobs, group_fragments
from torchvision_dddas.detection.engine import Foreground, Window, evidence_scale
from torchvision_dddas.detection.motion_history import MotionHistory, split_by_trail
from torchvision_dddas.detection.outlines import refine_outline, remove_shadow
from torchvision_dddas.detection.persistence import Sighting, find_persistent
from torchvision_dddas.geometry import connected_parts
from torchvision_dddas.types import Detections


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

    history: moved on to this frame; it gives the motions where the settings want no dense flow.
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
