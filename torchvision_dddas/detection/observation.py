"""Turn the foreground of one window into targets: find blobs or candidates, measure their motion, draw their masks."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.chain import View, Window, evidence_scale
from torchvision_dddas.config import EVIDENCE_SCALE, Settings, uses_tracklets
from torchvision_dddas.detection.blobs import (
    Blob,
    Box,
    box_slices,
    fill_hull,
    find_blobs,
    widen_box,
)
from torchvision_dddas.detection.candidates import SILHOUETTES, Candidates, Evidence, find_candidates
from torchvision_dddas.detection.engine import Foreground
from torchvision_dddas.detection.motion_history import MotionHistory, split_by_trail
from torchvision_dddas.detection.outlines import refine_outlines, remove_shadow
from torchvision_dddas.geometry import connected_parts
from torchvision_dddas.types import Detections

_STEPS_OF_A_LEVEL = EVIDENCE_SCALE / 4  # four grey levels count as a noise unit
# Only the largest blobs of a picture are judged, at most this many.
_MOST_BLOBS = 150


@dataclass(frozen=True)
class Target:
    """One target of a frame. box: x, y, width, height. mask: (height, width) bool inside the box.

    core: (height, width) bool, the mask's pixels whose own evidence is above the threshold, without closed gaps and
    filled hulls.
    """

    box: Box
    mask: np.ndarray
    velocity_px: np.ndarray
    score: float
    core: np.ndarray


@dataclass
class Observation:
    """The measurements of one frame, from which its targets are chosen.

    window, foreground: dropped once the targets are drawn. velocities_px: (2,) pixels a frame for each blob, unless
    targets are judged by tracklets. candidates: set only if they are.
    """

    window: Window[View] | None = None
    foreground: Foreground | None = None
    blobs: list[Blob] = field(default_factory=list)
    velocities_px: list[np.ndarray] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)
    candidates: Candidates | None = None


def observe(
    window: Window[View], foreground: Foreground, settings: Settings, history: MotionHistory | None = None
) -> Observation:
    """Find the blobs of a window's reference frame and their motions, or, with tracklets, its blobs and candidates.

    history: the motion history, already aligned to this frame. It gives the motion of blobs.
    """
    view = window.reference
    if uses_tracklets(settings):
        blobs = _find_blobs(foreground, settings)
        blobs = sorted(blobs, key=lambda blob: -blob.area_px)[
            :_MOST_BLOBS
        ]  # the limit saves time: each blob is compared with the candidates of six looks
        candidates = find_candidates(_evidence_by_gap(window, foreground), view.grey, blobs)
        return Observation(window, foreground, blobs, candidates=candidates)
    blobs = _find_blobs(foreground, settings) if foreground.blobs is None else foreground.blobs
    ways = [(blob, np.full(2, np.nan)) for blob in blobs]
    if history is not None:
        history.add(foreground.core)
        ways = [part for blob in blobs for part in split_by_trail(blob, history, view.size, settings.history)]
    return Observation(window, foreground, [blob for blob, _ in ways], [velocity_px for _, velocity_px in ways])


def _evidence_by_gap(window: Window[View], foreground: Foreground, place: Any = np.s_[:]) -> Evidence:
    """Return the evidence maps in which candidates are found, or their part inside `place`."""
    nearest, further = foreground.pairs[0], foreground.pairs[1] if len(foreground.pairs) > 1 else None
    wide = None if window.wide is None else foreground.wide
    near = [None if evidence is None else evidence[place] for evidence in (nearest, further, wide)]
    if foreground.levels is None:
        return *near, None
    return *near, cv2.convertScaleAbs(foreground.levels[place], alpha=_STEPS_OF_A_LEVEL)


def _find_blobs(foreground: Foreground, settings: Settings) -> list[Blob]:
    """Find with OpenCV the blobs that pass the gates of area and peak."""
    difference, gates, unit = settings.difference, settings.gates, evidence_scale(settings)
    limits = difference.threshold * unit, gates.min_area_px, difference.peak * unit
    return find_blobs(foreground.core, foreground.evidence, *limits, settings.morphology.hull, foreground.scale)


def draw_blobs(
    here: Observation, blobs: list[Blob], velocities_px: Sequence[np.ndarray], settings: Settings
) -> list[Target]:
    """Return the targets of blobs, with refined outlines. velocities_px: (2,) pixels a frame for each blob."""
    window, foreground = here.window, here.foreground
    if window is None or foreground is None:
        return []
    masks = [blob.mask for blob in blobs]
    if settings.refine.on:
        masks = refine_outlines(blobs, velocities_px, window.reference, foreground, settings)
    targets: list[Target] = []
    for blob, velocity_px, mask in zip(blobs, velocities_px, masks, strict=True):
        if settings.refine.on:
            mask = _without_shadow(mask, blob.box, blob.area_px, window, settings)
        # The score is a confidence in [0, 1) that grows with the ratio of the peak evidence to the threshold.
        score = float(1 - np.exp(-blob.peak / (2 * settings.difference.threshold * evidence_scale(settings))))
        for box, part in connected_parts(mask, blob.box, settings.gates.min_area_px // 2):
            core = blob.core[box_slices(box, *blob.box[:2])] & part
            targets.append(Target(box, part, velocity_px, score, core))
    return targets


def draw_chosen(
    here: Observation, chosen: Sequence[int], velocity_px: np.ndarray, scores: np.ndarray, settings: Settings
) -> list[Target]:
    """Return the targets of chosen candidates. velocity_px, scores: (N, 2) and (N,) of all candidates' tracklets."""
    count = len(here.blobs)
    blobs = [i for i in chosen if i < count]
    targets = draw_blobs(here, [here.blobs[i] for i in blobs], list(velocity_px[blobs]), settings)
    for i in chosen:
        if i >= count:
            confidence = float(1 / (1 + np.exp(-scores[i])))
            targets.append(_draw_candidate(here, i, velocity_px[i], confidence, settings))
    return targets


def _draw_candidate(here: Observation, index: int, velocity_px: np.ndarray, score: float, settings: Settings) -> Target:
    """Return the target of a candidate, whose mask is the hull of its evidence. score: confidence in [0, 1]."""
    window, foreground, candidates = here.window, here.foreground, here.candidates
    assert window is not None and foreground is not None and candidates is not None  # dropped only after drawing
    silhouette = SILHOUETTES[candidates.silhouette[index]]
    found: Box = tuple(candidates.box_px[index].astype(int).tolist())
    box = widen_box(found, silhouette.erode_px // 2, window.reference.size)  # erosion made the candidate narrower
    evidence = _evidence_by_gap(window, foreground, box_slices(box))
    seen = [picture for picture in (evidence[gap] for gap in silhouette.gaps) if picture is not None]
    core = np.max(seen, axis=0) > silhouette.threshold * EVIDENCE_SCALE
    mask = fill_hull(core) if core.any() else np.ones(core.shape, bool)
    if settings.refine.on:
        mask = _without_shadow(mask, box, int(mask.sum()), window, settings)
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    part = np.s_[top : top + height, left : left + width]
    box = (box[0] + left, box[1] + top, width, height)
    return Target(box, mask[part], velocity_px, score, (core & mask)[part])


def _without_shadow(mask: np.ndarray, box: Box, area_px: int, window: Window[View], settings: Settings) -> np.ndarray:
    """Remove the shadow from the mask of a target that is small in the picture, and keep the mask of a larger target.

    In aerial pictures, where targets are small, shadows are as large as the targets. In close views the shadow beside a
    car is thin and as dark as the tyres, so that removing it would damage the mask.
    """
    view = window.reference
    if window.wide is None or area_px > settings.refine.shadow_share * view.grey.size:
        return mask
    grounds = [window.neighbours[k].image for k in window.wide]
    matrices = [window.neighbour_from_reference[k] for k in window.wide]
    return remove_shadow(mask, box, view.image, grounds, matrices)


def build_detections(targets: Sequence[Target], size: tuple[int, int]) -> tuple[Detections, np.ndarray, np.ndarray]:
    """Return the targets as a table, a (H, W) uint16 mask with value i + 1 for row i, and their (H, W) bool core.

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
