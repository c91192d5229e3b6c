"""What the look of targets adds to the score of a link."""

import numpy as np

from torchvision_dddas.config import TrackParameters
from torchvision_dddas.geometry import namespace

_HOPELESS, _CLOSE = -8.0, 7.0  # links that no look can save, and apart by more than looks can turn
_WORST = -1.0  # light, shadow and turning change a look at once: little of it speaks against a link for long


def likeness_scores(
    signature: np.ndarray, other: np.ndarray, other_visible: np.ndarray, parameters: TrackParameters
) -> np.ndarray:
    """(N, M) scores from histograms (N, D) of tracks and (M, D) of detections, each of sum 1 or, where unknown, 0.

    What is unknown scores 0. other_visible: (M,) shares of the boxes.
    """
    return scores_of(likeness(signature, other), other_visible, parameters)


def likeness(signature: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N, M) Bhattacharyya coefficients of histograms (N, D) and (M, D); NaN where either is unknown."""
    known = np.any(signature, axis=1).reshape(-1, 1) & np.any(other, axis=1)
    return np.where(known, np.sqrt(signature) @ np.sqrt(other).T, np.nan)


def scores_of(likeness: np.ndarray, visible: np.ndarray, parameters: TrackParameters) -> np.ndarray:
    """(N, M) scores of likenesses, 0 for NaN. visible: (M,) shares of the boxes. Arrays or tensors."""
    functions = namespace(likeness)
    known = likeness == likeness
    score = parameters.appearance_weight * (functions.where(known, likeness, 1.0) - parameters.appearance_offset)
    return functions.where(known, functions.clip(score, _WORST, None) * functions.sqrt(visible)[..., None, :], 0.0)


def in_doubt(links: np.ndarray, signature: np.ndarray) -> bool:
    """Whether locations leave a doubt that looks may settle, from scores (N, M) without them and histograms (N, D).

    So they do where a track or a detection has two links that looks could exchange, and where a track that might go on
    here has not been looked at yet.
    """
    if not links.size:
        return False
    likely = links > _HOPELESS
    rivals = likely & (links > links.max(axis=1, keepdims=True) - _CLOSE)
    rivals_of_detections = likely & (links > links.max(axis=0, keepdims=True) - _CLOSE)
    if (rivals.sum(axis=1) > 1).any() or (rivals_of_detections.sum(axis=0) > 1).any():
        return True
    unknown = ~np.any(signature, axis=1) if signature.shape[1] else np.ones(len(links), bool)
    return bool(likely[unknown].any())


def blended(signature: np.ndarray, seen: np.ndarray, visible: np.ndarray, hits: np.ndarray) -> np.ndarray:
    """(N, D) histograms of tracks after a detection each, which counts as far as it could be seen.

    hits: (N,) detections so far, this one included: the first few are averaged, later ones fade the old away.
    """
    gain = np.maximum(0.2, 1 / hits) * visible**2
    gain = np.where(np.any(signature, axis=1), np.where(np.any(seen, axis=1), gain, 0.0), 1.0)[:, None]
    return (1 - gain) * signature + gain * seen


def visible_share(box_px: np.ndarray) -> np.ndarray:
    """(N,) share of each box (N, 4) that no nearer box covers; nearer is what stands lower in the picture."""
    low, high = box_px[:, :2], box_px[:, :2] + box_px[:, 2:]
    side = np.maximum(np.minimum(high[:, None], high) - np.maximum(low[:, None], low), 0)
    nearer = high[:, 1] > high[:, 1:2]
    covered = (side[..., 0] * side[..., 1] * nearer).sum(axis=1) / (box_px[:, 2] * box_px[:, 3])
    return np.clip(1 - covered, 0.0, 1.0)
