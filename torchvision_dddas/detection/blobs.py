"""From a mask to blobs: cleaning, labelling, area and peak gates, convex hulls, fragments of one target."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from torchvision_dddas.config import MorphologyParameters
from torchvision_dddas.geometry import occupied

Box = tuple[int, int, int, int]


@dataclass(frozen=True)
class Blob:
    """A connected region of the core mask.

    box: x, y, width, height in pixels. mask: (height, width) bool, the region (or its convex hull) inside the box.
    core: (height, width) bool, the pixels that are certain. peak: its largest evidence. weak: only the wide pair shows
    it, in which parallax shows too.
    """

    box: Box
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

    def cut(self, share: np.ndarray) -> "Blob":
        """The part of the blob that lies in `share`, (height, width) bool of its box."""
        mask = self.mask & share
        left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
        window = np.s_[top : top + height, left : left + width]
        box = (self.box[0] + left, self.box[1] + top, width, height)
        return Blob(box, mask[window], (self.core & mask)[window], self.peak)


def ellipse(side: int) -> np.ndarray:
    """The morphological element."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def close_mask(mask: np.ndarray, side: int) -> np.ndarray:
    """Close a mask with an ellipse: the result of OpenCV bit for bit, computed only around set pixels."""
    if side <= 1:
        return mask
    kernel = ellipse(side)
    out = np.zeros_like(mask)
    # The closing of a pixel depends on what lies less than 2 x side away.
    for x, y, width, height in occupied(mask, 2 * side):
        part = np.s_[y : y + height, x : x + width]
        cv2.morphologyEx(mask[part], cv2.MORPH_CLOSE, kernel, dst=out[part])
    return out


def find_blobs(
    core: np.ndarray, evidence: np.ndarray, threshold: float, min_area_px: int, peak: float, hull: bool, scale: int = 1
) -> list[Blob]:
    """Connected regions (8 neighbours) of `core` with enough area and a high enough peak of evidence.

    core, evidence: (H, W) uint8. Pixels of a region whose evidence is above `threshold` are certain. hull: fill convex
    hulls; a hull that contains another one replaces it. scale: side of a map's pixel in pixels of the picture, in which
    areas and blobs are given.
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
            blobs.append(Blob(box, fill_hull(region) if hull else region, certain, highest))
    blobs.sort(key=lambda blob: (blob.box[1], blob.box[0]))
    return _drop_contained(blobs) if hull else blobs


def find_weak_blobs(
    wide: np.ndarray,
    found: list[Blob],
    threshold: float,
    parameters: MorphologyParameters,
    min_area_px: int,
    peak: float,
) -> list[Blob]:
    """Blobs of the wide pair's evidence, (H, W) uint8, that touch none of those found: slow ones of even colour."""
    core = cv2.threshold(wide, int(threshold), 255, cv2.THRESH_BINARY)[1]
    core = close_mask(cv2.erode(core, ellipse(parameters.erode_px)), parameters.close_px)
    taken = np.zeros(wide.shape, bool)
    for blob in found:
        taken[blob.window] |= blob.mask
    others = find_blobs(core, wide, threshold, min_area_px, peak, parameters.hull)
    return [replace(blob, weak=True) for blob in others if not taken[blob.window][blob.mask].any()]


def fill_hull(region: np.ndarray) -> np.ndarray:
    """The convex hull of the true pixels of a (h, w) mask, as a mask of the same shape."""
    canvas = region.astype(np.uint8)
    outlines, _ = cv2.findContours(canvas, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if outlines:
        cv2.fillConvexPoly(canvas, cv2.convexHull(np.concatenate(outlines)), 1)
    return canvas > 0


def _drop_contained(blobs: list[Blob]) -> list[Blob]:
    kept: list[Blob] = []
    for blob in sorted(blobs, key=lambda b: -b.box[2] * b.box[3]):
        if not any(_contains(other, blob.box) for other in kept):
            kept.append(blob)
    return kept


def _contains(other: Blob, box: Box) -> bool:
    (x, y, width, height), (ox, oy, ow, oh) = box, other.box
    if x < ox or y < oy or x + width > ox + ow or y + height > oy + oh:
        return False
    return bool(other.mask[y - oy : y - oy + height, x - ox : x - ox + width].mean() > 0.9)


def group_fragments(boxes_px: np.ndarray, velocities_px: np.ndarray) -> list[list[int]]:
    """Indices of boxes that are fragments of one target.

    boxes_px: (N, 4) x, y, width, height. velocities_px: (N, 2) pixels a frame; a box of NaN stays alone. Two fragments
    are at most a fifth of the larger one's size apart along either axis, overlap along one of them by half of the
    smaller one, move by more than 1 px a frame, and differ in velocity by at most a fifth of it.
    """
    leader = list(range(len(boxes_px)))

    def root(i: int) -> int:
        while leader[i] != i:
            i = leader[i]
        return i

    for i in range(len(boxes_px)):
        for j in range(i):
            if _are_fragments(boxes_px[i], boxes_px[j], velocities_px[i], velocities_px[j]):
                leader[root(i)] = root(j)
    groups: dict[int, list[int]] = {}
    for i in range(len(boxes_px)):
        groups.setdefault(root(i), []).append(i)
    return list(groups.values())


def _are_fragments(a: np.ndarray, b: np.ndarray, va: np.ndarray, vb: np.ndarray) -> bool:
    if not (np.isfinite(va).all() and np.isfinite(vb).all()):
        return False
    gap = np.maximum(a[:2], b[:2]) - np.minimum(a[:2] + a[2:], b[:2] + b[2:])
    reach = 0.2 * np.maximum(a[2:], b[2:])
    speed = max(float(np.hypot(*va)), float(np.hypot(*vb)))
    alike = float(np.hypot(*(va - vb))) <= 0.2 * speed and speed > 1.0
    overlap = -gap / np.minimum(a[2:], b[2:])
    return bool((gap <= reach).all() and overlap.max() > 0.5 and alike)
