"""Find blobs in a mask: label its regions, gate them by area and peak, and fill convex hulls."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.geometry import occupied

Box = tuple[int, int, int, int]


def box_slices(box: Box, left: int = 0, top: int = 0) -> tuple[slice, slice]:
    """Return the row and column slices of a box (x, y, width, height) in a picture that starts at (left, top)."""
    x, y, width, height = box
    return slice(y - top, y - top + height), slice(x - left, x - left + width)


def widen_box(box: Box, margin_px: int, size: tuple[int, int]) -> Box:
    """Return a box with a margin on each side, clipped to a picture of size (width, height)."""
    x, y, width, height = box
    left, top = max(x - margin_px, 0), max(y - margin_px, 0)
    return left, top, min(x + width + margin_px, size[0]) - left, min(y + height + margin_px, size[1]) - top


@dataclass(frozen=True)
class Blob:
    """A connected region of the core mask.

    box: x, y, width, height in pixels. mask: (height, width) bool, the region (or its convex hull) inside the box.
    core: (height, width) bool, the pixels with evidence above the threshold. peak: the largest evidence of the region.
    """

    box: Box
    mask: np.ndarray
    core: np.ndarray
    peak: float

    @property
    def area_px(self) -> int:
        """Number of pixels of the mask."""
        return int(self.mask.sum())

    @property
    def centre_px(self) -> np.ndarray:
        """(2,) centre of the box."""
        x, y, width, height = self.box
        return np.array([x + (width - 1) / 2, y + (height - 1) / 2])

    def cut(self, share: np.ndarray) -> "Blob":
        """Return the part of the blob inside `share`, a (height, width) bool mask of its box."""
        mask = self.mask & share
        left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
        window = np.s_[top : top + height, left : left + width]
        box = (self.box[0] + left, self.box[1] + top, width, height)
        return Blob(box, mask[window], (self.core & mask)[window], self.peak)


@dataclass(frozen=True)
class Region:
    """A connected region that passes the area and peak gates, found by OpenCV or on the torch engine's device.

    box: x, y, width, height. mask: (height, width) bool. evidence: (height, width) uint8 inside the box. peak: the
    largest evidence of the region.
    """

    box: Box
    mask: np.ndarray
    evidence: np.ndarray
    peak: float


def find_blobs(
    core: np.ndarray, evidence: np.ndarray, threshold: float, min_area_px: int, peak: float, hull: bool, scale: int = 1
) -> list[Blob]:
    """Return the connected regions (8 neighbours) of `core` that have enough area and a high enough peak of evidence.

    core, evidence: (H, W) uint8. threshold: evidence above which a pixel belongs to the blob's core. hull: fill convex
    hulls; a hull replaces the hulls that it contains. scale: side of a map pixel in picture pixels; areas and blobs
    are in picture pixels.
    """
    return make_blobs(find_regions(core, evidence, min_area_px, peak, scale), threshold, hull, scale)


def find_regions(core: np.ndarray, evidence: np.ndarray, min_area_px: int, peak: float, scale: int = 1) -> list[Region]:
    """Find with OpenCV the regions that `find_blobs` turns into blobs. Their boxes are in map pixels."""
    regions = []
    for part in occupied(core, 2):
        labels, stats = label_parts(core[box_slices(part)])
        for label, (x, y, width, height, area) in enumerate(stats.tolist(), 1):
            if area * scale**2 < min_area_px:
                continue
            region = labels[y : y + height, x : x + width] == label
            box = part[0] + x, part[1] + y, width, height
            seen = evidence[box_slices(box)]
            if (highest := float(seen[region].max())) < peak:
                continue
            regions.append(Region(box, region, seen, highest))
    return regions


def label_parts(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Label the connected parts (8 neighbours) of a (H, W) uint8 mask, and return (H, W) labels and (N, 5) int32 rows.

    Labels start at 1. A row is x, y, width, height and area. OpenCV's default algorithm takes two to three times as
    long as this algorithm.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(mask, 8, cv2.CV_32S, cv2.CCL_GRANA)
    return labels, stats[1:]


def make_blobs(regions: Iterable[Region], threshold: float, hull: bool, scale: int = 1) -> list[Blob]:
    """Turn regions into blobs. The arguments are those of `find_blobs`."""
    blobs = []
    for part in regions:
        box, region, certain = part.box, part.mask, part.mask & (part.evidence > threshold)
        if scale > 1:
            region, certain = (kept.repeat(scale, axis=0).repeat(scale, axis=1) for kept in (region, certain))
            box = box[0] * scale, box[1] * scale, box[2] * scale, box[3] * scale
        blobs.append(Blob(box, fill_hull(region) if hull else region, certain, part.peak))
    blobs.sort(key=lambda blob: (blob.box[1], blob.box[0]))
    if not hull:
        return blobs
    kept: list[Blob] = []
    for blob in sorted(blobs, key=lambda b: -b.box[2] * b.box[3]):
        if not any(_contains(larger, blob.box) for larger in kept):
            kept.append(blob)
    return kept


def _contains(larger: Blob, box: Box) -> bool:
    x, y = box[0] - larger.box[0], box[1] - larger.box[1]
    if x < 0 or y < 0 or x + box[2] > larger.box[2] or y + box[3] > larger.box[3]:
        return False
    return bool(larger.mask[y : y + box[3], x : x + box[2]].mean() > 0.9)


def fill_hull(region: np.ndarray) -> np.ndarray:
    """Return the convex hull of the true pixels of a (h, w) mask, as a mask of the same shape."""
    canvas = region.astype(np.uint8)
    outlines, _ = cv2.findContours(canvas, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if outlines:
        cv2.fillConvexPoly(canvas, cv2.convexHull(np.concatenate(outlines)), 1)
    return canvas > 0
