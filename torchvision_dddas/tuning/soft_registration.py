"""What the registration's knobs make of points that were followed: a motion refitted on soft inliers, and its error.

The hard registration at the same parameters is the guess (see `ops.relax.inliers`): its own last refit, done once more
with soft weights, gives the value of the hard one as softness vanishes, and a slope by the tolerances.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.functional.consensus import transfer_error
from torchvision_dddas.functional.soft.inliers import Fit, fitted, weights


@dataclass(frozen=True)
class TrackedFrame:
    """The points of one frame that were found in the next one, and again on the way back.

    earlier_px, later_px: u, v. missed_px: by how much the way back missed its start. still: which lie on background,
    out of reach of what moves.
    """

    earlier_px: Float[Tensor, "N 2"]
    later_px: Float[Tensor, "N 2"]
    missed_px: Float[Tensor, " N"]
    still: Bool[Tensor, " N"]


class Refitted(NamedTuple):
    """later_from_earlier: (3, 3). off_px: mean miss of the points on background. share: of the points that agree."""

    later_from_earlier: Float[Tensor, "3 3"]
    off_px: Float[Tensor, ""]
    share: Float[Tensor, ""]


def refitted(
    points: TrackedFrame,
    guess: Float[Tensor, "3 3"],
    tolerance_px: Tensor,
    check_px: Tensor | None,
    last_share: float,
    fit: Fit,
    softness: float = 0.0,
) -> Refitted:
    """The motion of the points that agree with a guess and were followed there and back.

    tolerance_px, check_px: the parameters ransac_px and forward_backward_px, the latter None where there is no check.
    last_share: of the tolerance, which the refit keeps to. fit: as `ops.homography.fit`. softness: a share of each.
    """
    earlier, later = points.earlier_px[None], points.later_px[None]
    trusted = torch.ones_like(earlier[..., 0])
    if check_px is not None:
        trusted = weights(points.missed_px[None], check_px, softness)
    matrix, _ = fitted(earlier, later, trusted, guess[None], last_share * tolerance_px, fit, softness)
    error_px = transfer_error(matrix, earlier, later)
    agreeing = weights(error_px, tolerance_px, softness) * trusted
    # Distances, not their squares: a point on background that was lost on the way has no more say than another.
    return Refitted(
        matrix[0],
        error_px[0, points.still].mean(),
        agreeing.sum() / trusted.sum().clamp(min=1),
    )
