"""From the foreground of one window to targets: blobs, their motion, their persistence, their outlines."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.detection.blob_motion import DenseFlow, Motion, blob_motion, split_by_flow
from torchvision_dddas.detection.blobs import Blob, find_blobs, find_weak_blobs, group_fragments
from torchvision_dddas.detection.engine import EVIDENCE_SCALE, Foreground, Window
from torchvision_dddas.detection.motion_history import MotionHistory, split_by_trail
from torchvision_dddas.detection.outlines import refine_outline, remove_shadow
from torchvision_dddas.detection.persistence import Sighting, find_persistent
from torchvision_dddas.geometry import connected_parts
from torchvision_dddas.types import Detections


@dataclass(frozen=True)
class Target:
    """One target of a frame. box: x, y, width, height. mask: (height, width) bool inside the box.

    core: the pixels of the mask that differ by themselves, before gaps are closed and hulls are filled; None: all.
    """

    box: tuple[int, int, int, int]
    mask: np.ndarray
    velocity_px: np.ndarray
    score: float
    core: np.ndarray | None = None

    def covers(self, u: float, v: float) -> bool:
        """Whether a point lies in the box."""
        x, y, width, height = self.box
        return x <= u <= x + width and y <= v <= y + height

    def window_in(self, left: int = 0, top: int = 0) -> tuple[slice, slice]:
        """Rows and columns of the box in a picture whose first pixel is at (left, top)."""
        x, y, width, height = self.box
        return slice(y - top, y - top + height), slice(x - left, x - left + width)


@dataclass
class Observation:
    """What one frame shows, before its targets are chosen. Window and foreground are dropped once they are drawn."""

    window: Window | None
    foreground: Foreground | None
    blobs: list[Blob] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    targets: list[Target] | None = None


def observe(
    window: Window, foreground: Foreground, flow: DenseFlow, settings: Settings, history: MotionHistory | None = None
) -> Observation:
    """The blobs of a window's reference frame and how each of them moves.

    history: moved on to this frame; it gives the motions where the settings want no dense flow.
    """
    parameters, view, scale = settings.difference, window.reference, _evidence_scale(settings)
    threshold, peak = parameters.threshold * scale, parameters.peak * scale
    min_area_px = settings.gates.min_area_px
    blobs = find_blobs(
        foreground.core,
        foreground.evidence,
        threshold,
        min_area_px,
        peak,
        settings.morphology.hull,
        foreground.scale,
    )
    # A wide pair that looks both ways shows what is in the reference frame alone.
    wide = window.wide
    if settings.persistence.on and wide is not None and window.offsets[wide[0]] * window.offsets[wide[1]] < 0:
        blobs += find_weak_blobs(foreground.wide, blobs, threshold, settings.morphology, min_area_px, peak)
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
    if here.window is None or here.foreground is None or not here.blobs:
        return []
    kept = [True] * len(here.blobs)
    if settings.persistence.on:
        sightings = [Sighting(o.blobs, o.motions, step) for o, step in zip(observations, [*steps, None], strict=False)]
        kept = find_persistent(sightings, index, here.window.reference.size, settings.persistence)
    targets = []
    for i in np.flatnonzero(kept):
        blob, motion = here.blobs[i], here.motions[i] if here.motions else None
        mask = blob.mask
        if settings.refine.on and motion is not None:
            mask = _refine(blob, motion, here.window, here.foreground, settings)
        velocity_px = motion.velocity_px if motion is not None else np.full(2, np.nan)
        score = rate_peak(blob.peak, settings)
        for box, part in connected_parts(mask, blob.box, settings.gates.min_area_px // 2):
            x, y = box[0] - blob.box[0], box[1] - blob.box[1]
            core = blob.core[y : y + box[3], x : x + box[2]] & part
            targets.append(Target(box, part, velocity_px, score, core))
    return join_fragments(targets)


def _refine(blob: Blob, motion: Motion, window: Window, foreground: Foreground, settings: Settings) -> np.ndarray:
    view = window.reference
    mask = refine_outline(blob, motion, view, foreground, settings)
    # From the air, where targets are small and shadows as large; beside a car they are thin and dark as its tyres.
    if window.wide is not None and blob.area_px <= settings.refine.shadow_share * view.grey.size:
        grounds = [window.neighbours[i].image for i in window.wide]
        matrices = [window.neighbour_from_reference[i] for i in window.wide]
        mask = remove_shadow(mask, blob.box, view.image, grounds, matrices)
    return mask


def _evidence_scale(settings: Settings) -> float:
    return EVIDENCE_SCALE if settings.difference.kind == "normalized" else 1.0


def rate_peak(peak: float, settings: Settings) -> float:
    """A confidence in [0, 1) that grows with the peak of evidence over the threshold."""
    return float(1 - np.exp(-peak / (2 * settings.difference.threshold * _evidence_scale(settings))))


def join_fragments(targets: Sequence[Target]) -> list[Target]:
    """Fragments of one moving thing become one target."""
    if len(targets) < 2:
        return list(targets)
    joined = []
    boxes = np.array([target.box for target in targets], float)
    for members in group_fragments(boxes, np.array([target.velocity_px for target in targets])):
        parts = [targets[i] for i in members]
        if len(parts) == 1:
            joined += parts
            continue
        low, high = boxes[members, :2].min(axis=0), (boxes[members, :2] + boxes[members, 2:]).max(axis=0)
        (left, top), (width, height) = low.astype(int).tolist(), (high - low).astype(int).tolist()
        mask, core = np.zeros((2, height, width), bool)
        for part in parts:
            window = part.window_in(left, top)
            mask[window] |= part.mask
            core[window] |= part.mask if part.core is None else part.core
        largest = max(parts, key=lambda part: int(part.mask.sum()))
        score = max(part.score for part in parts)
        joined.append(Target((left, top, width, height), mask, largest.velocity_px, score, core))
    return joined


def build_detections(targets: Sequence[Target], size: tuple[int, int]) -> tuple[Detections, np.ndarray]:
    """The targets as a table and as a (H, W) uint16 mask whose value i + 1 is row i. size: (width, height)."""
    mask = np.zeros((size[1], size[0]), np.uint16)
    for i, target in enumerate(targets):
        mask[target.window_in()][target.mask] = i + 1
    velocity = np.array([target.velocity_px for target in targets]).reshape(-1, 2)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    return Detections(
        box_px=np.array([target.box for target in targets], float).reshape(-1, 4),
        score=np.array([target.score for target in targets], float),
        area_px=np.array([target.mask.sum() for target in targets], float),
        heading_rad=np.where(speed > 0, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan),
        speed_px=speed,
    ), mask


def build_core_mask(targets: Sequence[Target], size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool, the pixels of the targets that differ by themselves. size: (width, height)."""
    core = np.zeros((size[1], size[0]), bool)
    for target in targets:
        core[target.window_in()] |= target.mask if target.core is None else target.core
    return core
