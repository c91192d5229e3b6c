"""Where targets are, as far as the noise parameters have a say: with gradients, about what the hard fit found.

`targets.pose.fit_pose` finds the likeliest pose and places of landmarks. At that point one more step of its own
(Gauss and Newton's) is zero, and the step's derivative by the parameters is that of the fit itself, but for the
curvature of the projection where the picture disagrees with it. So places have the value of the hard fit and the
gradient of that step: nothing is softened, and nothing but the linear algebra is written twice.

Every standard deviation that counts is a sum of squares of parameters: `Spread` holds what each of them adds.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

Parameters = Mapping[str, Tensor]


@dataclass(frozen=True)
class Spread:
    """Variances (..., N) that are base + sum of gain x knob². gain: by knob's name, each as base."""

    base: Tensor
    gain: Mapping[str, Tensor] = field(default_factory=dict)

    def variance(self, parameters: Parameters) -> Tensor:
        """(..., N). parameters: all that there is a gain of."""
        total = self.base
        for name, gain in self.gain.items():
            total = total + gain * parameters[name].to(gain) ** 2
        return total


@dataclass(frozen=True)
class Linear:
    """The least squares of poses and landmarks' places about the hard solutions of B pictures of m landmarks each.

    missing: (B, 2m) px. slopes: (B, 2m, S) of the pixels by the S = 7 + 2n numbers of pose and places. correction:
    (B, S) of telemetry and reports. by_turn: (B, S, S) how that grows with a step. known: (B, S) of which of them
    something is expected, 0 or 1. As `targets.pose.Slopes`.
    """

    missing: Tensor
    slopes: Tensor
    correction: Tensor
    by_turn: Tensor
    known: Tensor


def gauss_newton_step(
    problem: Linear, pixel_variance: Float[Tensor, "B 2m"], variance: Float[Tensor, "B S"]
) -> tuple[Float[Tensor, "B 7"], Float[Tensor, "B 7 7"]]:
    """The pose's next step, zero at the solution but not its derivative, and the pose's covariance.

    pixel_variance: px², of the landmarks' pixels. variance: of what telemetry and reports say, in the units of Fix.
    """
    # The normal equations of `fit_pose`, which this cannot share: there they are of one problem at a time, in NumPy for
    # the onboard install, with an information matrix that is full once frames are remembered; here of a batch, with a
    # diagonal one that has a gradient. The tests of `tuning.places` hold loss and slope to those of the hard fit.
    information = problem.known / variance.clamp(min=1e-12)
    weighed = problem.slopes.mT / pixel_variance[:, None]
    pulled = problem.by_turn.mT * information[:, None]
    curvature = weighed @ problem.slopes + pulled @ problem.by_turn
    downhill = weighed @ problem.missing[..., None] - pulled @ problem.correction[..., None]
    # Radians beside hundreds of metres: brought to a diagonal of ones, the inverse keeps its digits.
    scale = curvature.diagonal(dim1=1, dim2=2).detach().rsqrt()
    inverse = torch.linalg.inv(curvature * scale[:, :, None] * scale[:, None]) * scale[:, :, None] * scale[:, None]
    return (inverse @ downhill)[:, :7, 0], inverse[:, :7, :7]


def project_to_ground(
    off_m: Float[Tensor, "B T 2"],
    by_pose: Float[Tensor, "B T 2 7"],
    by_pixel: Float[Tensor, "B T 2 2"],
    step: Float[Tensor, "B 7"],
    covariance: Float[Tensor, "B 7 7"],
    pixel_variance: Float[Tensor, "B T"],
) -> tuple[Float[Tensor, "B T 2"], Float[Tensor, "B T 2 2"]]:
    """Errors of targets' places after the pose's step, and their covariance; by_*: `targets.ground_rays`."""
    moved = off_m + (by_pose @ step[:, None, :, None])[..., 0]
    spread = by_pose @ covariance[:, None] @ by_pose.mT
    return moved, spread + pixel_variance[..., None, None] * by_pixel @ by_pixel.mT


def gaussian_nll(off_m: Float[Tensor, "... 2"], covariance_m2: Float[Tensor, "... 2 2"]) -> Float[Tensor, "..."]:
    """Negative log-likelihood of errors under their ellipses, in nats: least where these are as large as the errors.

    Written out for two by two. A covariance that is none, flat or turned over, gives NaN.
    """
    (a, b), (_, c) = (row.unbind(-1) for row in covariance_m2.unbind(-2))
    x, y = off_m.unbind(-1)
    size = a * c - b * b
    return ((c * x * x - 2 * b * x * y + a * y * y) / size + size.log()) / 2 + math.log(2 * math.pi)
