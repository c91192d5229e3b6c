"""How blobs move against the registered background: dense flow, a steady share, one affine motion a blob."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.detection.blobs import Blob

# Motion below this cannot be told from errors of the registration, px a frame.
_LEAST_SPEED_PX = 0.5
# Disagreement that is still steady, and difference from the surroundings that counts: shares of the own speed.
_STEADY, _UNLIKE = 0.5, 0.25
_RING_NEAR_PX, _RING_FAR_PX = 5, 15
# So many pixels of a blob are enough for its affine motion, which has settled once no term changes by more than this.
_SAMPLES, _SETTLED_PX = 300, 0.01
_PULL = np.diag([1e-9, 0.02, 0.02])


@dataclass(frozen=True)
class Motion:
    """A blob's own motion over the registered background.

    velocity_px: (2,) pixels a frame, NaN where unknown. steady: share of its core that moves alike at both neighbours
    and unlike its surroundings. frame: centre_u, centre_v, scale. affine: for each neighbour (3, 2), the displacement
    affine[0] + affine[1] (u - centre_u) / scale + affine[2] (v - centre_v) / scale in pixels.
    """

    velocity_px: np.ndarray
    steady: float
    affine: tuple[np.ndarray, np.ndarray]
    frame: tuple[float, float, float]


class DenseFlow:
    """Dense inverse search at half resolution (Kroeger et al. 2016), OpenCV's quickest preset.

    A class because OpenCV's object keeps its buffers from frame to frame.
    """

    def __init__(self) -> None:
        self._search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)

    def __call__(self, grey: np.ndarray, others: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(H/2, W/2, 2) displacements in full-resolution pixels from a grey picture to each of the others."""
        size = max(grey.shape[1] // 2, 1), max(grey.shape[0] // 2, 1)
        if min(size) < 16:  # smaller than the search's patches
            return [np.zeros((size[1], size[0], 2), np.float32) for _ in others]
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        pictures = (cv2.resize(other, size, interpolation=cv2.INTER_AREA) for other in others)
        return [2 * self._search.calc(small, picture, np.zeros((*small.shape, 2), np.float32)) for picture in pictures]


def blob_motion(blob: Blob, flows: Sequence[np.ndarray], offsets: tuple[int, int]) -> Motion:
    """The motion of one blob from two flow fields (half resolution), `offsets` frames away from the reference."""
    x, y, width, height = blob.box
    rows, columns = flows[0].shape[:2]
    far = _RING_FAR_PX
    top, left = max(y // 2 - far, 0), max(x // 2 - far, 0)
    bottom, right = min((y + height) // 2 + far, rows), min((x + width) // 2 + far, columns)
    shape = bottom - top, right - left
    near = [flow[top:bottom, left:right] for flow in flows]
    core = _at_half(blob, blob.core, shape, left, top)
    if not core.any():
        core = _at_half(blob, blob.mask, shape, left, top)
    if not core.any():
        nothing = np.zeros((3, 2))
        return Motion(np.full(2, np.nan), 0.0, (nothing, nothing), (float(x), float(y), 1.0))
    a, b = near[0] / offsets[0], near[1] / offsets[1]
    body = _at_half(blob, blob.mask, shape, left, top).astype(np.uint8)
    ring = cv2.dilate(body, np.ones((2 * far + 1,) * 2, np.uint8)) > cv2.dilate(
        body, np.ones((2 * _RING_NEAR_PX + 1,) * 2, np.uint8)
    )
    mean = (a + b) / 2
    around = np.median(mean[ring], axis=0) if ring.any() else np.zeros(2)
    va, vb, v = a[core], b[core], mean[core]
    speed = np.maximum(np.linalg.norm(v, axis=1), 0.15)
    alike = np.linalg.norm(va - vb, axis=1) < _STEADY * speed
    unlike = np.linalg.norm(v - around, axis=1) > _UNLIKE * speed
    steady = float((alike & unlike & (speed > _LEAST_SPEED_PX)).mean())
    row, column = np.nonzero(core)
    step = max(1, len(row) // _SAMPLES)
    row, column = row[::step], column[::step]
    centre_u, centre_v = 2 * (left + column.mean()) + 0.5, 2 * (top + row.mean()) + 0.5
    scale = float(max(width, height))
    u, w = (2 * (left + column) + 0.5 - centre_u) / scale, (2 * (top + row) + 0.5 - centre_v) / scale
    affine = [robust_affine(u, w, flow[row, column]) for flow in near]
    velocity = (affine[0][0] / offsets[0] + affine[1][0] / offsets[1]) / 2
    return Motion(velocity, steady, (affine[0], affine[1]), (centre_u, centre_v, scale))


def only_velocity(velocity_px: np.ndarray) -> Motion:
    """A motion of which nothing but the velocity is known."""
    nothing = np.zeros((3, 2))
    return Motion(velocity_px, 0.0, (nothing, nothing), (0.0, 0.0, 1.0))


def _at_half(blob: Blob, mask: np.ndarray, shape: tuple[int, int], left: int, top: int) -> np.ndarray:
    """A mask of the blob's box, at half resolution, in a window of the half-resolution picture."""
    x, y, _, _ = blob.box
    inside = np.zeros(shape, bool)
    row, column = np.nonzero(mask[y % 2 :: 2, x % 2 :: 2])
    row, column = row + (y + 1) // 2 - top, column + (x + 1) // 2 - left
    fits = (row < shape[0]) & (column < shape[1])
    inside[row[fits], column[fits]] = True
    return inside


def robust_affine(u: np.ndarray, v: np.ndarray, flow_px: np.ndarray, rounds: int = 5) -> np.ndarray:
    """(3, 2) affine motion by reweighted least squares; a small pull towards pure translation keeps slim blobs sane."""
    columns = np.stack([np.ones(len(u)), u, v], axis=1)
    median = np.median(flow_px, axis=0)
    weight = 1 / (1 + ((flow_px - median) ** 2).sum(axis=1) / max(1.0, 0.1 * float(median @ median)))
    fit = np.zeros((3, 2))
    for _ in range(rounds):
        before = fit
        weighted = columns.T * weight
        normal = weighted @ columns + _PULL * max(float(weight.sum()), 1e-9)
        fit = np.linalg.solve(normal, weighted @ flow_px)
        if np.abs(fit - before).max() < _SETTLED_PX:
            break
        miss = flow_px - columns @ fit
        weight = 1 / (1 + 2 * (miss[:, 0] ** 2 + miss[:, 1] ** 2))
    return fit
