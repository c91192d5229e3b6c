"""Three frames with dummy targets: what a triplet gains over leaving its targets alone (appendix C, eq. 1-3).

A target that no triplet holds stays alone: it takes the dummy, index 0, on both other axes. Counted from there, a
dummy is worth nothing, and the source's problem is to choose triplets that share no target and gain the most.
"""

from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Float, Int


def checked_scores(score: Float[np.ndarray, "N1 M1 L1"]) -> Float[np.ndarray, "N1 M1 L1"]:
    """The scores as float64. Raises InputError if there is no dummy on each axis, or a score is not finite."""
    tensor = np.asarray(score, float)
    if tensor.ndim != 3 or 0 in tensor.shape:
        raise InputError(
            f"triplets need scores (N + 1, M + 1, L + 1), index 0 the dummy; got shape {tensor.shape}. "
            "Put a dummy first on each axis."
        )
    finite = np.isfinite(tensor)
    finite[0, 0, 0] = True  # never used
    if not finite.all():
        raise InputError("triplets need finite scores; got NaN or infinity. Give an impossible triplet a low score.")
    return tensor


def gain_over_alone(tensor: Float[np.ndarray, "N1 M1 L1"]) -> Float[np.ndarray, "N1 M1 L1"]:
    """What each triplet scores above its targets each with two dummies: 0 for those, and for (0, 0, 0)."""
    first, second, third = (alone.copy() for alone in (tensor[:, 0, 0], tensor[0, :, 0], tensor[0, 0, :]))
    first[0] = second[0] = third[0] = 0.0
    gain = tensor - (second[:, None] + third)
    gain -= first[:, None, None]
    gain[0, 0, 0] = 0.0
    return gain


def pair_gain_over_alone(score: Any) -> Any:
    """What each pair scores above both left with the dummy: (..., N + 1, M + 1) -> (..., N, M), arrays or tensors."""
    return score[..., 1:, 1:] - score[..., 1:, :1] - score[..., :1, 1:]


def with_the_rest_alone(chosen: Int[np.ndarray, "C 3"], shape: tuple[int, ...]) -> Int[np.ndarray, "Z 3"]:
    """The chosen triplets and, for each target that none of them holds, one with two dummies; sorted by i, j, k."""
    rows = [chosen]
    for axis, size in enumerate(shape):
        rest = np.setdiff1d(np.arange(1, size), chosen[:, axis])
        alone = np.zeros((len(rest), 3), np.int64)
        alone[:, axis] = rest
        rows.append(alone)
    triplets = np.concatenate(rows).astype(np.int64)
    return triplets[np.lexsort(triplets.T[::-1])]
