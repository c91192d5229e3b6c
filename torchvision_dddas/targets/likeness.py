"""What the look of targets adds to the score of a link."""

import numpy as np

from torchvision_dddas.settings import TrackKnobs

_WORST = -1.0  # light, shadow and turning change a look at once: little of it speaks against a link for long


def likeness_scores(
    signature: np.ndarray, other: np.ndarray, other_visible: np.ndarray, knobs: TrackKnobs
) -> np.ndarray:
    """(N, M) scores from histograms (N, D) of tracks and (M, D) of detections, each of sum 1 or, where unknown, 0.

    The likeness is the Bhattacharyya coefficient; what is unknown scores 0. other_visible: (M,) shares of the boxes.
    """
    likeness = np.sqrt(signature) @ np.sqrt(other).T
    known = np.any(signature, axis=1).reshape(-1, 1) & np.any(other, axis=1)
    score = knobs.appearance_weight * (likeness - knobs.appearance_offset)
    return np.where(known, np.maximum(score, _WORST) * np.sqrt(other_visible), 0.0)


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
