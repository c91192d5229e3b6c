"""From a mask to blobs: labelling, gates, hulls."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from torchvision_dddas.config import MorphologyParameters
from torchvision_dddas.detection.mask_cleaning import closed, ellipse
from torchvision_dddas.geometry import occupied


@dataclass(frozen=True)
class Blob:
    """A connected region of the core mask.

    box: x, y, width, height in pixels. mask: (height, width) bool, its region (or its convex hull) inside the box.
    core: (height, width) bool, the pixels that are certain. peak: largest evidence in it. weak: seen over the wide pair
    only, where parallax shows too.
    """

    box: tuple[int, int, int, int]
    mask: np.ndarray
    core: np.ndarray
    peak: float
    weak: bool = False

    @property
    def area_px(self) -> int:
        """Pixels of the mask."""
        return int(self.mask.sum())

    @property
    def centre_px(self) -> np.ndarray:
        """(2,) centre of the box."""
        x, y, width, height = self.box
        return np.array([x + (width - 1) / 2, y + (height - 1) / 2])

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the box in the picture."""
        x, y, width, height = self.box
        return slice(y, y + height), slice(x, x + width)


def find_blobs(
    core: np.ndarray, evidence: np.ndarray, threshold: float, min_area_px: int, peak: float, hull: bool, scale: int = 1
) -> list[Blob]:
    """Connected regions (8 neighbours) of `core` with enough area and a high enough peak of evidence.

    core, evidence: (H, W) uint8. Evidence above `threshold` makes a pixel of a region certain. A hull that contains
    another region's hull swallows it. scale: pixels of the picture to one of the maps', along either side; areas
    and blobs are in the picture's.
    """
    blobs = []
    for left, top, wide, high in occupied(core, 2):
        part = np.s_[top : top + high, left : left + wide]
        count, labels, stats, _ = cv2.connectedComponentsWithStats(core[part], ltype=cv2.CV_32S)
        for label in range(1, count):
            x, y, width, height, area = (int(v) for v in stats[label])
            if area * scale**2 < min_area_px:
                continue
            window = np.s_[y : y + height, x : x + width]
            region = labels[window] == label
            seen = evidence[part][window]
            if (highest := float(seen[region].max())) < peak:
                continue
            certain, box = region & (seen > threshold), (left + x, top + y, width, height)
            if scale > 1:
                region, certain = (kept.repeat(scale, axis=0).repeat(scale, axis=1) for kept in (region, certain))
                box = box[0] * scale, box[1] * scale, width * scale, height * scale
            blobs.append(Blob(box, filled_hull(region) if hull else region, certain, highest))
    blobs.sort(key=lambda blob: (blob.box[1], blob.box[0]))
    return _without_swallowed(blobs) if hull else blobs


def weak_blobs(
    wide: np.ndarray,
    found: list[Blob],
    threshold: float,
    parameters: MorphologyParameters,
    min_area_px: int,
    peak: float,
) -> list[Blob]:
    """Blobs of the wide pair's evidence, (H, W) uint8, that touch none of those found: slow ones of even colour."""
    core = cv2.threshold(wide, int(threshold), 255, cv2.THRESH_BINARY)[1]
    core = closed(cv2.erode(core, ellipse(parameters.erode_px)), parameters.close_px)
    taken = np.zeros(wide.shape, bool)
    for blob in found:
        taken[blob.window] |= blob.mask
    others = find_blobs(core, wide, threshold, min_area_px, peak, parameters.hull)
    return [replace(blob, weak=True) for blob in others if not taken[blob.window][blob.mask].any()]


def filled_hull(region: np.ndarray) -> np.ndarray:
    """The convex hull of the true pixels of a (h, w) mask, as a mask of the same shape."""
    canvas = region.astype(np.uint8)
    outlines, _ = cv2.findContours(canvas, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if outlines:
        cv2.fillConvexPoly(canvas, cv2.convexHull(np.concatenate(outlines)), 1)
    return canvas > 0


def _without_swallowed(blobs: list[Blob]) -> list[Blob]:
    kept: list[Blob] = []
    for blob in sorted(blobs, key=lambda b: -b.box[2] * b.box[3]):
        x, y, width, height = blob.box
        if not any(_contains(other, x, y, width, height) for other in kept):
            kept.append(blob)
    return kept


def _contains(other: Blob, x: int, y: int, width: int, height: int) -> bool:
    ox, oy, ow, oh = other.box
    if x < ox or y < oy or x + width > ox + ow or y + height > oy + oh:
        return False
    return bool(other.mask[y - oy : y - oy + height, x - ox : x - ox + width].mean() > 0.9)
