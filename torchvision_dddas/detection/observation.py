"""From one window's foreground to targets: blobs, their motion, their persistence, their outlines."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.detection.blob_motion import DenseFlow, Motion, blob_motion, only_velocity
from torchvision_dddas.detection.blobs import Blob, find_blobs, weak_blobs
from torchvision_dddas.detection.engine import EVIDENCE_SCALE, Foreground, Window
from torchvision_dddas.detection.flow_split import parted_by_flow
from torchvision_dddas.detection.fragments import groups
from torchvision_dddas.detection.gates import Gates
from torchvision_dddas.detection.motion_history import MotionHistory
from torchvision_dddas.detection.motion_segmentation import moving_parts
from torchvision_dddas.detection.outlines import refine
from torchvision_dddas.detection.persistence import Sighting, persistent
from torchvision_dddas.detection.shadows import without_shadow
from torchvision_dddas.geometry import parts_of
from torchvision_dddas.types import Detections


@dataclass(frozen=True)
class Found:
    """One target of a frame. box: x, y, width, height. mask: (height, width) bool inside the box.

    core: the same of those pixels that differ by themselves, before gaps are closed and hulls are filled; None: all.
    """

    box: tuple[int, int, int, int]
    mask: np.ndarray
    velocity_px: np.ndarray
    score: float
    core: np.ndarray | None = None


@dataclass
class Observation:
    """What one frame showed, before it is judged. Window and foreground are dropped once its targets are drawn."""

    window: Window | None
    foreground: Foreground | None
    blobs: list[Blob] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    targets: list[Found] | None = None


def observe(
    window: Window, foreground: Foreground, flow: DenseFlow, settings: Settings, history: MotionHistory | None = None
) -> Observation:
    """The blobs of a window's reference frame and how each of them moves.

    history: moved on to this frame; it tells the motions where the settings ask for no dense flow.
    """
    parameters, view = settings.difference, window.reference
    scale = EVIDENCE_SCALE if parameters.kind == "normalized" else 1.0
    blobs = find_blobs(
        foreground.core,
        foreground.evidence,
        parameters.threshold * scale,
        settings.gates.min_area_px,
        parameters.peak * scale,
        settings.morphology.hull,
        foreground.scale,
    )
    if settings.persistence.on and _looks_both_ways(window):
        knobs_of = settings.morphology, settings.gates.min_area_px, parameters.peak * scale
        blobs += weak_blobs(foreground.wide, blobs, parameters.threshold * scale, *knobs_of)
    motions: list[Motion] = []
    if blobs and (settings.persistence.on or settings.refine.on):
        flows = flow(view.grey, foreground.warped)
        if settings.history.on:
            blobs = [part for blob in blobs for part in parted_by_flow(blob, flows, foreground.offsets)]
        motions = [blob_motion(blob, flows, foreground.offsets) for blob in blobs]
    elif history is not None:
        history.add(foreground.core)
        parts = [part for blob in blobs for part in moving_parts(blob, history, view.size, settings.history)]
        blobs, motions = [part.blob for part in parts], [only_velocity(part.velocity_px) for part in parts]
    return Observation(window, foreground, blobs, motions)


def _looks_both_ways(window: Window) -> bool:
    """Whether the wide pair shows what is there in the reference frame alone."""
    return window.wide is not None and window.offsets[window.wide[0]] * window.offsets[window.wide[1]] < 0


def draw_targets(
    observations: Sequence[Observation], steps: Sequence[np.ndarray | None], index: int, settings: Settings
) -> list[Found]:
    """The targets of `observations[index]`: the blobs that persist, with refined outlines, fragments joined.

    steps: registration from each observation to the next, None at a cut.
    """
    here = observations[index]
    if here.window is None or here.foreground is None or not here.blobs:
        return []
    kept = [True] * len(here.blobs)
    if settings.persistence.on:
        sightings = [Sighting(o.blobs, o.motions, step) for o, step in zip(observations, [*steps, None], strict=False)]
        kept = persistent(sightings, index, here.window.reference.size, settings.persistence)
    found = []
    for i, (blob, keep) in enumerate(zip(here.blobs, kept, strict=True)):
        if not keep:
            continue
        motion = here.motions[i] if here.motions else None
        mask = blob.mask
        if settings.refine.on and motion is not None:
            mask = _refined(blob, motion, here, settings)
        velocity = motion.velocity_px if motion is not None else np.full(2, np.nan)
        score = score_of(blob.peak, settings)
        for box, part in parts_of(mask, blob.box, settings.gates.min_area_px // 2):
            x, y = box[0] - blob.box[0], box[1] - blob.box[1]
            core = blob.core[y : y + box[3], x : x + box[2]] & part
            found.append(Found(box, part, velocity, score, core))
    return join(found)


def _refined(blob: Blob, motion: Motion, here: Observation, settings: Settings) -> np.ndarray:
    window, foreground = here.window, here.foreground
    assert window is not None and foreground is not None
    view = window.reference
    mask = refine(
        blob,
        motion,
        view.image,
        view.grey,
        foreground.evidence,
        foreground.wide,
        foreground.texture,
        foreground.warped,
        EVIDENCE_SCALE,
        settings,
    )
    # From the air, where targets are small and shadows as large; beside a car they are thin and dark as its tyres.
    if window.wide is not None and blob.area_px <= settings.refine.shadow_share * view.grey.size:
        grounds = [window.neighbours[i].image for i in window.wide]
        maps = [window.neighbour_from_reference[i] for i in window.wide]
        mask = without_shadow(mask, blob.box, view.image, grounds, maps)
    return mask


def score_of(peak: float, settings: Settings) -> float:
    """A confidence in [0, 1) that grows with the peak of evidence over the threshold."""
    scale = EVIDENCE_SCALE if settings.difference.kind == "normalized" else 1.0
    return float(1 - np.exp(-peak / (2 * settings.difference.threshold * scale)))


def join(found: Sequence[Found]) -> list[Found]:
    """Fragments of one mover as one target."""
    if len(found) < 2:
        return list(found)
    joined = []
    boxes, velocities = np.array([f.box for f in found], float), np.array([f.velocity_px for f in found])
    for members in groups(boxes, velocities):
        if len(members) == 1:
            joined.append(found[members[0]])
            continue
        parts = [found[i] for i in members]
        left, top = min(p.box[0] for p in parts), min(p.box[1] for p in parts)
        right, bottom = max(p.box[0] + p.box[2] for p in parts), max(p.box[1] + p.box[3] for p in parts)
        mask, core = np.zeros((2, bottom - top, right - left), bool)
        for p in parts:
            x, y, width, height = p.box
            window = np.s_[y - top : y - top + height, x - left : x - left + width]
            mask[window] |= p.mask
            core[window] |= p.mask if p.core is None else p.core
        largest = max(parts, key=lambda p: int(p.mask.sum()))
        box = (left, top, right - left, bottom - top)
        joined.append(Found(box, mask, largest.velocity_px, max(p.score for p in parts), core))
    return joined


def admitted(found: Sequence[Found], gates: Gates | None) -> list[Found]:
    """The targets that the gates let through; all of them without gates."""
    return [f for f in found if gates is None or gates.admit(f.box[2], f.box[3], f.velocity_px)]


def table(found: Sequence[Found], size: tuple[int, int]) -> tuple[Detections, np.ndarray]:
    """The targets as a table and as a (H, W) uint16 mask whose value i + 1 is row i. size: (width, height)."""
    mask = np.zeros((size[1], size[0]), np.uint16)
    for i, target in enumerate(found):
        x, y, width, height = target.box
        mask[y : y + height, x : x + width][target.mask] = i + 1
    velocity = np.array([f.velocity_px for f in found]).reshape(-1, 2)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    return Detections(
        box_px=np.array([f.box for f in found], float).reshape(-1, 4),
        score=np.array([f.score for f in found], float),
        area_px=np.array([f.mask.sum() for f in found], float),
        heading_rad=np.where(speed > 0, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan),
        speed_px=speed,
    ), mask


def cores(found: Sequence[Found], size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool, the pixels of the targets that differ by themselves. size: (width, height)."""
    core = np.zeros((size[1], size[0]), bool)
    for target in found:
        x, y, width, height = target.box
        core[y : y + height, x : x + width] |= target.mask if target.core is None else target.core
    return core
