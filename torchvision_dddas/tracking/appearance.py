"""Appearance of targets: colour histograms of three strips of a box, their similarity, and the rule for their use."""

import cv2
import numpy as np

from torchvision_dddas.config import TrackParameters
from torchvision_dddas.geometry import namespace, shared_px

# Lower ends of the first two of three strips, as shares of a box's height: head, trunk and legs of a person; roof, body
# and wheels of a car.
_STRIP_ENDS = (0.2, 0.55)
_BINS = np.array([16, 32, 32])  # bins of L, a and b
_FIRST_BIN = np.array([0, 16, 48])
_STRIP_BINS = 80
SIGNATURE = 3 * _STRIP_BINS
"""Number of bins of a histogram of three strips."""
_COLUMNS, _ROWS = 24, 48  # samples of a box
_MIDDLE = 0.3  # distance from the middle, in box widths, at which the weight is 1/e: the sides are mostly background

# Links with association scores below _LEAST_SCORE need no histogram. Appearance cannot change the order of links whose
# scores differ by more than _CLEAR_LEAD.
_LEAST_SCORE, _CLEAR_LEAD = -8.0, 7.0
_WORST = -1.0  # lowest score of an appearance: light, shadow and a turn of the target can change it suddenly


def strip_histograms(image: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """Return (N, SIGNATURE) float32 histograms of Lab colour over three strips, with more weight in the middle columns.

    image: (H, W, 3) uint8 BGR or (H, W) grey. box_px: (N, 4) x, y, width, height; the part outside the image does not
    count. Each row sums to 1, so that sum(sqrt(a b)) is the mean Bhattacharyya coefficient. A box wholly outside the
    image has zeros.
    """
    count = len(box_px)
    samples = np.zeros((count, _ROWS, _COLUMNS, 3), np.uint8)
    visible = np.zeros((count, 4))  # the part of each box inside the image, px
    height, width = image.shape[:2]
    for n, (x, y, w, h) in enumerate(box_px.tolist()):
        left, right = max(int(np.floor(x)), 0), min(int(np.ceil(x + w)), width)
        top, bottom = max(int(np.floor(y)), 0), min(int(np.ceil(y + h)), height)
        if right > left and bottom > top:
            crop = image[top:bottom, left:right]
            is_larger = crop.shape[0] >= _ROWS and crop.shape[1] >= _COLUMNS
            how = cv2.INTER_AREA if is_larger else cv2.INTER_LINEAR
            sampled = cv2.resize(crop, (_COLUMNS, _ROWS), interpolation=how)
            samples[n] = sampled if image.ndim == 3 else sampled[..., None]
            visible[n] = left, top, right - left, bottom - top
    inside = visible[:, 2] > 0
    if not inside.any():
        return np.zeros((count, SIGNATURE), np.float32)
    lab = cv2.cvtColor(samples.reshape(-1, _COLUMNS, 3), cv2.COLOR_BGR2LAB).reshape(samples.shape)
    # Relative position of each sample in the whole box, of which the image's border may have cut off a part.
    across, down = (
        (visible[:, [axis]] - box_px[:, [axis]] + (np.arange(most) + 0.5) / most * visible[:, [axis + 2]])
        / box_px[:, [axis + 2]]
        for axis, most in enumerate((_COLUMNS, _ROWS))
    )
    weight = np.exp(-(((across - 0.5) / _MIDDLE) ** 2)) * inside[:, None]
    strip = np.searchsorted(_STRIP_ENDS, down.ravel()).reshape(down.shape)
    start = np.arange(count)[:, None] * SIGNATURE + strip * _STRIP_BINS
    place = start[:, :, None, None] + _FIRST_BIN + (lab * _BINS >> 8)
    weights = np.broadcast_to(weight[:, None, :, None], place.shape)
    counts = np.bincount(place.ravel(), weights.ravel(), count * SIGNATURE).reshape(count, 3, _STRIP_BINS)
    # Normalise each strip first, so that a partly visible strip has the same weight as a whole strip.
    return _normalize(_normalize(counts).reshape(count, SIGNATURE)).astype(np.float32)


def _normalize(counts: np.ndarray) -> np.ndarray:
    """Divide by the sum over the last axis; zeros stay zeros."""
    total = counts.sum(axis=-1, keepdims=True)
    return np.divide(counts, total, out=np.zeros_like(counts), where=total > 0)


def similarity(signature: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the (N, M) Bhattacharyya coefficients of histograms (N, D) and (M, D); NaN for zeros (unknown)."""
    is_known = np.any(signature, axis=1)[:, None] & np.any(other, axis=1)
    return np.where(is_known, np.sqrt(signature) @ np.sqrt(other).T, np.nan)


def appearance_scores(similarity: np.ndarray, visible: np.ndarray, parameters: TrackParameters) -> np.ndarray:
    """Convert similarities (N, M) to association scores, 0 for NaN. visible: (M,) visible shares. Arrays or tensors."""
    functions = namespace(similarity)
    is_known = similarity == similarity
    score = parameters.appearance_weight * (functions.where(is_known, similarity, 1.0) - parameters.appearance_offset)
    return functions.where(is_known, functions.clip(score, _WORST, None) * functions.sqrt(visible)[..., None, :], 0.0)


def ambiguity(score: np.ndarray, signature: np.ndarray) -> str:
    """Return why appearance is needed for the decision, in words; "" if it is not needed.

    score: (N, M) without appearance. signature: (N, D) histograms of the tracks. Appearance is needed if a track or a
    detection has two likely links, or if a likely link belongs to a track without a histogram.
    """
    if not score.size:
        return ""
    likely = score > _LEAST_SCORE
    for axis, one, others in ((1, "a track", "detections"), (0, "a detection", "tracks")):
        rivals = likely & (score > score.max(axis=axis, keepdims=True) - _CLEAR_LEAD)
        if (rivals.sum(axis=axis) > 1).any():
            return f"{one} has several likely {others}"
    unknown = ~np.any(signature, axis=1) if signature.shape[1] else np.ones(len(score), bool)
    return "a likely link belongs to a track without a histogram" if likely[unknown].any() else ""


def blend_histograms(signature: np.ndarray, seen: np.ndarray, visible: np.ndarray, hits: np.ndarray) -> np.ndarray:
    """Update (N, D) histograms of tracks with one detection each, weighted by the visible share of the detection.

    hits: (N,) detections so far, with this one. The first few histograms are averaged; later, older histograms decay.
    """
    gain = np.maximum(0.2, 1 / hits) * visible**2
    gain = np.where(np.any(signature, axis=1), np.where(np.any(seen, axis=1), gain, 0.0), 1.0)[:, None]
    return (1 - gain) * signature + gain * seen


def visible_shares(box_px: np.ndarray) -> np.ndarray:
    """Return the (N,) share of each box (N, 4) that no nearer box covers. A nearer box has a lower bottom edge."""
    bottom = box_px[:, 1] + box_px[:, 3]
    nearer = bottom > bottom[:, None]
    covered = (shared_px(box_px[:, None], box_px) * nearer).sum(axis=1) / (box_px[:, 2] * box_px[:, 3])
    return np.clip(1 - covered, 0.0, 1.0)
