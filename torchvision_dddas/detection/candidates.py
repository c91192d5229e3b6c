"""What may be a target in one look: connected parts of several silhouettes of its evidence, and what they look like.

One silhouette misses most targets: small ones need no closing, large even ones a wide one, slow ones frames further
apart, faint ones a low threshold. Which of these parts are targets is decided later, on tracklets (`tracklets`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.chain import OpenCVOperations, close_mask, ellipse, halve_side
from torchvision_dddas.config import EVIDENCE_SCALE
from torchvision_dddas.detection.blobs import Blob, box_slices, label_parts
from torchvision_dddas.geometry import occupied, shared_px

Evidence = Sequence[np.ndarray | None]
"""The maps of evidence by how far apart the compared frames are: nearest, further, widest; (H, W) uint8 or None."""


class Silhouette(NamedTuple):
    """Where the largest of some maps is above a threshold. gaps: indices of maps. threshold: noise units.

    erode_px, close_px: sides of the ellipses that clean it.
    """

    gaps: tuple[int, ...]
    threshold: float
    erode_px: int
    close_px: int


# Of nine silhouettes that a prototype chose one after the other, so that some part overlaps each target of the open
# clips, these six lose the least.
SILHOUETTES = (
    Silhouette((0, 1), 3.5, 3, 1),
    Silhouette((0, 1), 2.5, 3, 15),
    Silhouette((1,), 5.0, 3, 1),
    Silhouette((2,), 7.0, 1, 5),
    Silhouette((0, 1), 5.0, 1, 15),
    Silhouette((0, 1, 2), 2.5, 1, 25),
)
LOOK_WEIGHTS = {
    "peak2": 1.032,
    "around": 3.428,
    "around2": -3.41,
    "size": 1.081,
    "size2": -0.073,
    "grows2": -0.119,
    "inside_over_around": 1.555,
    "constant": -12.333,
}
"""Weights of what one look shows, see `describe_look`."""

# _LEAST_EVIDENCE is added to evidence before its logarithm is taken. Surroundings count as restless as _QUIET at least:
# the weights were learned on clips with noise, and a picture without noise must not be judged worse for that.
_LEAST_EVIDENCE = 0.5
_QUIET = np.log(_LEAST_EVIDENCE + 0.7)
# Candidates with a smaller score, and all but the likeliest so many, are left out, since following them takes time.
_LEAST_SCORE, _MOST_CANDIDATES = -3.0, 60

_LEAST_AREA_PX, _LEAST_PEAK = 20, 5.0
# At most so many parts of a silhouette are kept, the largest ones. Two parts with a larger IoU than this are one.
_MOST_PARTS, _ALIKE = 30, 0.85
# Closings from this side on are done at half the resolution.
_HALVED_FROM_PX = 9
_HALF_SET = 60  # level of a halved mask: one of its four pixels is set, or more
_LARGE_PX = 2**31 // 256  # the sum of more pixels does not fit into 32 bits
_PATCH_PX = 12
_PATCH_NOISE = 20.0  # grey levels x pixels: a patch without contrast is like nothing


@dataclass(frozen=True)
class Candidates:
    """The N candidates of one look, and G maps of evidence.

    box_px: (N, 4) x, y, width, height. silhouette: (N,) index of the first silhouette that shows it, -1: a blob. fill:
    (N,) share of the box that its part covers. peak: (N,) largest evidence, noise units. inside, around: (N, G) mean
    evidence in the box and in a frame about it, noise units; 0 where there is no map. patch: (N, P) grey levels of the
    box without their mean, of about unit length. score: (N,) log odds that it is a target, by this look alone.
    """

    box_px: np.ndarray
    silhouette: np.ndarray
    fill: np.ndarray
    peak: np.ndarray
    inside: np.ndarray
    around: np.ndarray
    patch: np.ndarray
    score: np.ndarray

    def __len__(self) -> int:
        return len(self.box_px)


def find_candidates(evidence: Evidence, grey: np.ndarray, blobs: Sequence[Blob]) -> Candidates:
    """The candidates of one look. grey: (H, W) uint8, its picture. blobs: come first, in their order."""
    found = [np.array([[*blob.box, blob.mask.mean(), blob.peak / EVIDENCE_SCALE, -1] for blob in blobs]).reshape(-1, 7)]
    silhouettes = _Silhouettes(evidence)
    for index, silhouette in enumerate(SILHOUETTES):
        if (parts := silhouettes.parts(silhouette)) is not None:
            found.append(np.c_[parts, np.full(len(parts), index)])
    rows = np.concatenate(found)
    rows = rows[_first_of_alike(rows[:, :4], len(blobs))]
    box = rows[:, :4].astype(int)
    inside, around = measure_evidence(evidence, box)
    score = weigh(describe_look(rows[:, :4], rows[:, 4], rows[:, 5], inside, around), LOOK_WEIGHTS)
    likely = np.flatnonzero(score >= _LEAST_SCORE)
    likely = likely[np.argsort(-score[likely], kind="stable")[:_MOST_CANDIDATES]]
    kept = np.union1d(np.arange(len(blobs)), likely)
    patch = cut_patches(grey, box[kept])
    rows, silhouette = rows[kept], rows[kept, 6].astype(int)
    return Candidates(rows[:, :4], silhouette, rows[:, 4], rows[:, 5], inside[kept], around[kept], patch, score[kept])


class _Silhouettes:
    """The silhouettes of one look's evidence, which share their steps."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = {gap: picture for gap, picture in enumerate(evidence) if picture is not None}
        self._largest: dict[tuple[int, ...], np.ndarray] = {}
        self._cores: dict[tuple[tuple[int, ...], float, int], np.ndarray] = {}

    def parts(self, silhouette: Silhouette) -> np.ndarray | None:
        """(N, 6) x, y, width, height, fill, peak in noise units of its connected parts; None: no map shows it."""
        gaps = tuple(gap for gap in silhouette.gaps if gap in self.evidence)
        if not gaps:
            return None
        core, scale, close_px = self._core(gaps, silhouette), 1, silhouette.close_px
        if close_px >= _HALVED_FROM_PX and min(core.shape) > 1:
            core = cv2.threshold(OpenCVOperations().halve(core), _HALF_SET, 255, cv2.THRESH_BINARY)[1]
            scale, close_px = 2, halve_side(close_px)
        core = close_mask(core, close_px)
        # Only where something is set: most of a picture is empty.
        found = [label_parts(core[box_slices(box)])[1] + (*box[:2], 0, 0, 0) for box in occupied(core, 2)]
        stats = np.concatenate([np.zeros((0, 5), int), *found]) * (scale, scale, scale, scale, scale**2)
        stats = stats[stats[:, 4] >= _LEAST_AREA_PX]
        stats = stats[np.argsort(-stats[:, 4], kind="stable")[:_MOST_PARTS]]
        z = self._evidence_of(gaps)
        peak = np.array([z[y : y + h, x : x + w].max() for x, y, w, h, _ in stats.tolist()]) / EVIDENCE_SCALE
        parts = np.c_[stats[:, :4], stats[:, 4] / (stats[:, 2] * stats[:, 3]), peak] if len(stats) else np.zeros((0, 6))
        return parts[parts[:, 5] >= _LEAST_PEAK]

    def _evidence_of(self, gaps: tuple[int, ...]) -> np.ndarray:
        if gaps not in self._largest:
            self._largest[gaps] = reduce(cv2.max, [self.evidence[gap] for gap in gaps])
        return self._largest[gaps]

    def _core(self, gaps: tuple[int, ...], silhouette: Silhouette) -> np.ndarray:
        key = gaps, silhouette.threshold, silhouette.erode_px
        if key not in self._cores:
            z, level = self._evidence_of(gaps), int(silhouette.threshold * EVIDENCE_SCALE)
            core = cv2.threshold(z, level, 255, cv2.THRESH_BINARY)[1]
            self._cores[key] = cv2.erode(core, ellipse(silhouette.erode_px)) if silhouette.erode_px > 1 else core
        return self._cores[key]


def describe_look(
    box: np.ndarray, fill: np.ndarray, peak: np.ndarray, inside: np.ndarray, around: np.ndarray
) -> dict[str, np.ndarray]:
    """What one look shows, (N,) each, by the names of LOOK_WEIGHTS. The arguments are those of `Candidates`."""
    outside = np.log(_LEAST_EVIDENCE + around.max(axis=1))
    restless = np.maximum(outside, _QUIET)
    size = 0.5 * np.log(box[:, 2:].prod(axis=1)) * fill
    grows = np.minimum(inside[:, -1] / (inside[:, 0] + 0.3), 5)
    return {
        "peak2": np.log(peak) ** 2,
        "around": restless,
        "around2": (restless - _QUIET) ** 2,
        "size": size,
        "size2": size**2,
        "grows2": grows**2,
        "inside_over_around": np.log(_LEAST_EVIDENCE + inside.max(axis=1)) - outside,
    }


def weigh(described: Mapping[str, np.ndarray], weights: Mapping[str, float]) -> np.ndarray:
    """(N,) log odds: the sum of what is described, (N,) each, by its weights, and a constant."""
    columns = np.array(list(described.values()))
    return weights["constant"] + np.array([weights[name] for name in described]) @ columns


def measure_evidence(evidence: Evidence, box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean evidence, noise units, in boxes and in the frames about them; (N, G) each, 0 where there is no map.

    box: (N, 4) int.
    """
    inside, around = np.zeros((2, len(box), len(evidence)))
    wide = np.floor(2 + 0.2 * box[:, 2:]).astype(int)
    rim = np.c_[box[:, :2] - wide, box[:, 2:] + 2 * wide]
    for gap, picture in enumerate(evidence):
        if picture is None or not len(box):
            continue
        table = cv2.integral(picture, sdepth=cv2.CV_32S if picture.size < _LARGE_PX else cv2.CV_64F)
        (own, area), (both, whole) = _sum_boxes(table, box), _sum_boxes(table, rim)
        inside[:, gap] = own / np.maximum(area, 1) / EVIDENCE_SCALE
        around[:, gap] = (both - own) / np.maximum(whole - area, 1) / EVIDENCE_SCALE
    return inside, around


def _sum_boxes(table: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums over boxes, cut at the picture's border, by an integral picture; and their areas."""
    height, width = table.shape[0] - 1, table.shape[1] - 1
    left, top = np.clip(box[:, 0], 0, width), np.clip(box[:, 1], 0, height)
    right, bottom = np.clip(box[:, 0] + box[:, 2], 0, width), np.clip(box[:, 1] + box[:, 3], 0, height)
    sums = table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]
    return sums, (right - left) * (bottom - top)


def _first_of_alike(box: np.ndarray, always: int) -> np.ndarray:
    """(N,) bool: boxes that overlap none before them nearly wholly, and the first so many in any case."""
    first = np.ones(len(box), bool)
    alike = overlaps(box, box) > _ALIKE
    for i in range(len(box)):
        if first[i]:
            first[i + 1 :] &= ~alike[i, i + 1 :]
    first[:always] = True
    return first


def overlaps(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N, M) IoU of boxes (N, 4) and (M, 4) x, y, width, height."""
    both = shared_px(one[:, None], other)
    either = np.prod(one[:, 2:], axis=1)[:, None] + np.prod(other[:, 2:], axis=1)[None] - both
    return both / np.maximum(either, 1e-9)


def cut_patches(grey: np.ndarray, box: np.ndarray) -> np.ndarray:
    """(N, P) float32 grey levels of boxes, (N, 4) int, made as large as one another, without their mean."""
    patches: np.ndarray = np.empty((len(box), _PATCH_PX, _PATCH_PX), np.float32)
    for patch, (x, y, width, height) in zip(patches, box.tolist(), strict=True):
        pad = 2 + max(width, height) // 10
        part = grey[max(y - pad, 0) : y + height + pad, max(x - pad, 0) : x + width + pad]
        patch[:] = cv2.resize(part, (_PATCH_PX, _PATCH_PX), interpolation=cv2.INTER_AREA)
    flat = patches.reshape(len(box), _PATCH_PX**2)
    flat -= flat.mean(axis=1, keepdims=True)
    return flat / (np.linalg.norm(flat, axis=1, keepdims=True) + _PATCH_NOISE)
