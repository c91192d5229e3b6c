"""Landmarks in the picture: found by their colours, told from targets, followed.

Source: appendix A, IV-A.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.settings import LandmarkKnobs
from torchvision_dddas.targets.occupied import occupied
from torchvision_dddas.types import Detections


def separate(colour_px: np.ndarray, blob_px: np.ndarray, knobs: LandmarkKnobs) -> np.ndarray:
    """(n,) int64, which of the m blobs is each landmark's, -1 for none; no blob is of two.

    colour_px: (n, 2), NaN for a colour that was not found. blob_px: (m, 2) centres of what moves.
    exact: as many matches as there can be within reach_px, then the least distance in all. The source asks for one blob
    for each landmark, which is infeasible where one has none in reach; its text says "if any". greedy: its heuristic,
    row by row, each landmark the nearest blob that is left.
    """
    distance = np.linalg.norm(colour_px[:, None] - blob_px[None], axis=2)
    within = distance <= knobs.reach_px  # False for NaN
    match = np.full(len(colour_px), -1, np.int64)
    if not within.any():
        return match
    if knobs.differentiation == "greedy":
        for i in range(len(match)):
            left = np.where(within[i] & ~np.isin(np.arange(len(blob_px)), match), distance[i], np.inf)
            if np.isfinite(left.min()):
                match[i] = left.argmin()
        return match
    # One pair more is worth more than any saving of distance.
    missing = 1.0 + knobs.reach_px * (min(distance.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(within, distance, missing))
    good = within[rows, columns]
    match[rows[good]] = columns[good]
    return match


@dataclass(frozen=True)
class Patches:
    """The connected patches of one colour: centre_px (P, 2), of their mass; area_px (P,); box_px (P, 4)."""

    centre_px: np.ndarray
    area_px: np.ndarray
    box_px: np.ndarray


def patches_of(mask: np.ndarray, least_area_px: int) -> Patches:
    """The patches of a (H, W) uint8 mask that are large enough, 8 neighbours."""
    centres, areas, boxes = [], [], []
    for left, top, wide, high in occupied(mask, 2):
        part = mask[top : top + high, left : left + wide]
        count, _, stats, middles = cv2.connectedComponentsWithStats(part, ltype=cv2.CV_32S)
        for label in range(1, count):
            x, y, width, height, area = stats[label].tolist()
            if area >= least_area_px:
                centres.append(middles[label] + (left, top))
                areas.append(float(area))
                boxes.append((left + x, top + y, width, height))
    return Patches(
        np.array(centres, float).reshape(-1, 2), np.array(areas, float), np.array(boxes, float).reshape(-1, 4)
    )


@dataclass(frozen=True)
class Sighted:
    """The landmarks in one frame's picture, one row a landmark of the names given.

    image_px: (K, 2) where each is, NaN where it was not found. by: (K,) motion, colour, or "" where not found.
    blob: (K,) int64, which detection is its own, -1 for none. rows: (N,) bool, the detections that are landmarks and
    nothing else: no targets. shared: (N,) bool, those that hold a landmark and something beside it.
    """

    image_px: np.ndarray
    by: tuple[str, ...]
    blob: np.ndarray
    rows: np.ndarray
    shared: np.ndarray
    colour_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


class LandmarkFollower:
    """Finds landmarks in picture after picture by their colours and by what moves."""

    def __init__(self, names: tuple[str, ...], knobs: LandmarkKnobs) -> None:
        self.names, self._knobs = names, knobs

    def step(
        self,
        frame: int,
        masks: np.ndarray,
        detections: Detections,
        now_from_before: np.ndarray | None = None,
        foreground: np.ndarray | None = None,
        expected_px: np.ndarray | None = None,
    ) -> Sighted:
        """The landmarks of the next frame.

        masks: (K, H, W) uint8 of the landmarks' colours. now_from_before: (3, 3) how the background moved since the
        frame before; None: unknown. foreground: (H, W), i + 1 where detection i is, as in Scene; without it a blob's
        centre is its box's. expected_px: (K, 2) where each should be by what else is known, NaN or None: unknown.
        """
        k = len(self.names)
        found = [patches_of(mask, self._knobs.least_area_px) for mask in masks]
        colour = np.full((k, 2), np.nan)
        for i, patches in enumerate(found):
            if len(patches.area_px):
                colour[i] = patches.centre_px[patches.area_px.argmax()]
        blobs = detections.box_px[:, :2] + (detections.box_px[:, 2:] - 1) / 2
        match = separate(colour, blobs, self._knobs)
        rows = np.zeros(len(blobs), bool)
        rows[match[match >= 0]] = True
        image = colour.copy()
        if self._knobs.centre == "motion":
            image[match >= 0] = blobs[match[match >= 0]]
        by = tuple(
            "motion" if m >= 0 else "" if np.isnan(c) else "colour" for m, c in zip(match, colour[:, 0], strict=True)
        )
        return Sighted(image, by, match, rows, np.zeros_like(rows), colour)
