"""Find target candidates in one look (a frame and its window): connected parts of several silhouettes of the evidence.

A single silhouette misses most targets. Small targets need no closing, large uniform targets need a wide closing, slow
targets need frames further apart, and faint targets need a low threshold. Which candidates are targets is decided later
by their tracklets (`tracklets`).
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
"""Four evidence maps, (H, W) uint8 or None each.

The first three come from the nearest, the further and the widest pair of compared frames. The fourth is the larger
difference of the nearest and the widest pair in grey levels; four grey levels count as one noise unit.
"""


class Silhouette(NamedTuple):
    """The mask where the maximum over some evidence maps exceeds a threshold.

    gaps: indices of the maps. threshold: noise units. erode_px, close_px: sides of the ellipses that clean the mask.
    """

    gaps: tuple[int, ...]
    threshold: float
    erode_px: int
    close_px: int


LEVELS = 3
"""Index of the grey-level map among the evidence maps."""

# This set was chosen by F1 and hits on the open clips, with data sets left out: dropping one more silhouette costs F1
# or hits, and adding one gains little. The last silhouette uses grey levels: it shows bright or dark targets on ground
# that itself differs from frame to frame.
SILHOUETTES = (
    Silhouette((0, 1), 3.5, 3, 1),
    Silhouette((1,), 5.0, 3, 1),
    Silhouette((2,), 7.0, 1, 5),
    Silhouette((0, 1), 5.0, 1, 15),
    Silhouette((LEVELS,), 5.0, 3, 25),
)
LOOK_WEIGHTS = {
    "peak2": 0.811,
    "around": 3.452,
    "around2": -2.677,
    "size": 1.197,
    "size2": -0.096,
    "levels_over_around": 1.716,
    "constant": -11.933,
}
"""Weights of the features that `describe_look` computes."""

# _LEAST_EVIDENCE is added to the evidence before its logarithm is taken. The logarithm of the evidence around a
# candidate counts as at least _QUIET: the weights were learned on noisy clips, and a picture without noise must not be
# judged worse.
_LEAST_EVIDENCE = 0.5
_QUIET = np.log(_LEAST_EVIDENCE + 0.7)
# Candidates with a score below _LEAST_SCORE are dropped, and at most _MOST_CANDIDATES of the rest are kept, because
# following candidates takes time.
_LEAST_SCORE, _MOST_CANDIDATES = -3.0, 40

_LEAST_AREA_PX, _LEAST_PEAK = 20, 5.0
# Of each silhouette, the _MOST_PARTS largest parts are kept. Two parts with an IoU above _ALIKE count as the same one.
_MOST_PARTS, _ALIKE = 30, 0.85
# Closings with at least this side are computed at half the resolution.
_HALVED_FROM_PX = 9
_HALF_SET = 60  # a halved mask is above this level if at least one of its four pixels is set
_LARGE_PX = 2**31 // 256  # the sum over more pixels than this does not fit into 32 bits
_PATCH_PX = 12
_PATCH_NOISE = 20.0  # added to a patch's norm, so that a patch without contrast matches no other patch


@dataclass(frozen=True)
class Candidates:
    """The N candidates of one look, measured on G evidence maps.

    box_px: (N, 4) x, y, width, height. silhouette: (N,) index of the first silhouette that shows the candidate, -1 for
    a blob; blobs come first. fill: (N,) share of the box that the candidate's pixels cover. peak: (N,) largest
    evidence, noise units. inside, around: (N, G) mean evidence in the box and in a margin around it, noise units; 0
    where a map is missing. patch: (N, P) grey levels of the box minus their mean, scaled to about unit length. score:
    (N,) log odds that the candidate is a target, from this look alone.
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
    """Return the candidates of one look. grey: (H, W) uint8 picture. blobs: they become the first candidates."""
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
    """Computes the silhouettes of one look's evidence, and caches the intermediate results that they share."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = {gap: picture for gap, picture in enumerate(evidence) if picture is not None}
        self._largest: dict[tuple[int, ...], np.ndarray] = {}
        self._cores: dict[tuple[tuple[int, ...], float, int], np.ndarray] = {}

    def parts(self, silhouette: Silhouette) -> np.ndarray | None:
        """Return (N, 6) x, y, width, height, fill, peak (noise units) of a silhouette's parts; None without a map."""
        gaps = tuple(gap for gap in silhouette.gaps if gap in self.evidence)
        if not gaps:
            return None
        core, scale, close_px = self._core(gaps, silhouette), 1, silhouette.close_px
        if close_px >= _HALVED_FROM_PX and min(core.shape) > 1:
            core = cv2.threshold(OpenCVOperations().halve(core), _HALF_SET, 255, cv2.THRESH_BINARY)[1]
            scale, close_px = 2, halve_side(close_px)
        core = close_mask(core, close_px)
        # Label only the parts of the picture where something is set: most of a picture is empty.
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
    """Return the features of candidates, (N,) each, by name in LOOK_WEIGHTS. Arguments: fields of `Candidates`."""
    restless = np.maximum(np.log(_LEAST_EVIDENCE + around[:, :LEVELS].max(axis=1)), _QUIET)
    size = 0.5 * np.log(box[:, 2:].prod(axis=1)) * fill
    levels, levels_around = (np.log(_LEAST_EVIDENCE + maps[:, LEVELS]) for maps in (inside, around))
    return {
        "peak2": np.log(peak) ** 2,
        "around": restless,
        "around2": (restless - _QUIET) ** 2,
        "size": size,
        "size2": size**2,
        "levels_over_around": levels - levels_around,
    }


def weigh(described: Mapping[str, np.ndarray], weights: Mapping[str, float]) -> np.ndarray:
    """Return (N,) log odds: the weighted sum of the features, (N,) each, plus the constant."""
    columns = np.array(list(described.values()))
    return weights["constant"] + np.array([weights[name] for name in described]) @ columns


def measure_evidence(evidence: Evidence, box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean evidence in boxes and in the margins around them, noise units, (N, G) each.

    The value is 0 where a map is missing. box: (N, 4) int.
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
    """Return the sums over boxes that are clipped to the picture, from an integral picture, and the boxes' areas."""
    height, width = table.shape[0] - 1, table.shape[1] - 1
    left, top = np.clip(box[:, 0], 0, width), np.clip(box[:, 1], 0, height)
    right, bottom = np.clip(box[:, 0] + box[:, 2], 0, width), np.clip(box[:, 1] + box[:, 3], 0, height)
    sums = table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]
    return sums, (right - left) * (bottom - top)


def _first_of_alike(box: np.ndarray, always: int) -> np.ndarray:
    """Return (N,) bool, whether each box is kept: it differs from all kept boxes before it, or is one of the first.

    always: number of the first boxes that are kept anyway.
    """
    first = np.ones(len(box), bool)
    alike = overlaps(box, box) > _ALIKE
    for i in range(len(box)):
        if first[i]:
            first[i + 1 :] &= ~alike[i, i + 1 :]
    first[:always] = True
    return first


def overlaps(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the (N, M) IoU of boxes (N, 4) and (M, 4), each x, y, width, height."""
    both = shared_px(one[:, None], other)
    either = np.prod(one[:, 2:], axis=1)[:, None] + np.prod(other[:, 2:], axis=1)[None] - both
    return both / np.maximum(either, 1e-9)


def cut_patches(grey: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Cut (N, 4) int boxes from a picture, and return (N, P) float32 grey levels of equal size, minus their mean."""
    patches: np.ndarray = np.empty((len(box), _PATCH_PX, _PATCH_PX), np.float32)
    for patch, (x, y, width, height) in zip(patches, box.tolist(), strict=True):
        pad = 2 + max(width, height) // 10
        part = grey[max(y - pad, 0) : y + height + pad, max(x - pad, 0) : x + width + pad]
        patch[:] = cv2.resize(part, (_PATCH_PX, _PATCH_PX), interpolation=cv2.INTER_AREA)
    flat = patches.reshape(len(box), _PATCH_PX**2)
    flat -= flat.mean(axis=1, keepdims=True)
    return flat / (np.linalg.norm(flat, axis=1, keepdims=True) + _PATCH_NOISE)
