"""Soft inliers: a weight that falls with the error, in place of a count of those within a tolerance."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.functional.consensus import transfer_error
from torchvision_dddas.functional.threshold import step

Fit = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


def weights(
    error_px: Float[Tensor, "*batch N"],
    tolerance_px: float | Tensor,
    softness: float = 0.0,
) -> Float[Tensor, "*batch N"]:
    """1 for a pair that misses by less than the tolerance, else 0; softness is a share of the tolerance."""
    return step(1 - error_px / tolerance_px, softness)


def fitted(
    earlier_px: Float[Tensor, "B N 2"],
    later_px: Float[Tensor, "B N 2"],
    valid: Bool[Tensor, "B N"] | Float[Tensor, "B N"],
    guess: Float[Tensor, "B 3 3"],
    tolerance_px: float | Tensor,
    fit: Fit,
    softness: float = 0.0,
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B"]]:
    """later_from_earlier by least squares over the inliers of a guess, and their share of the valid pairs.

    valid: whether a pair counts, or how much. fit: as `homography.fit` takes pairs and weights. The gradient reaches
    the points, the tolerance and what counts; that of the guess is left out, for a refit forgets what it began with.
    """
    weight = weights(transfer_error(guess.detach(), earlier_px, later_px), tolerance_px, softness) * valid
    matrix, solved = fit(earlier_px, later_px, weight)
    matrix = torch.where(solved[:, None, None], matrix, guess)
    return matrix, weight.sum(-1) / valid.sum(-1).clamp(min=1)
