"""RANSAC: the robust part of registration, shared by the homography and the affine baseline.

Randomness is an input (which pairs each hypothesis is drawn from), so that a run repeats and the graph exports.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvision_dddas.errors import InputError
from torchvision_dddas.functional.soft import step

Minimal = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
Fit = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


def draw_samples(
    generator: torch.Generator, batch: int, hypotheses: int, count: int, size: int = 4
) -> Int64[Tensor, "B S size"]:
    """Draw `size` different numbers from 0 .. count - 1 for every hypothesis, on the generator's device.

    Raises InputError if there are fewer than `size` numbers to draw from.
    """
    if count < size:
        raise InputError(f"a hypothesis is drawn from {size} points; got room for {count}. Raise the keypoint budget.")
    uniform = torch.rand(batch, hypotheses, size, generator=generator, device=generator.device, dtype=torch.float64)
    drawn: list[Tensor] = []
    for k in range(size):
        number = (uniform[..., k] * (count - k)).long().clamp(max=count - k - 1)
        # Skip over what is taken already, smallest first: the number is a rank among those that are left.
        for taken in torch.stack(drawn, -1).sort(-1).values.unbind(-1) if drawn else ():
            number = number + (number >= taken)
        drawn.append(number)
    return torch.stack(drawn, -1)


def transfer(
    later_from_earlier: Float[Tensor, "*batch 3 3"], points: Float[Tensor, "*points N 2"]
) -> Float[Tensor, "*both N 2"]:
    """Where the points land under each matrix; leading axes broadcast. On the horizon that is far away, not NaN."""
    mapped = points @ later_from_earlier[..., :2].mT + later_from_earlier[..., None, :, 2]
    depth = mapped[..., 2:]
    tiny = torch.finfo(mapped.dtype).eps
    return mapped[..., :2] / torch.where(depth.abs() < tiny, torch.full_like(depth, tiny), depth)


def transfer_error(
    later_from_earlier: Float[Tensor, "*batch 3 3"],
    earlier_px: Float[Tensor, "*points N 2"],
    later_px: Float[Tensor, "*points N 2"],
) -> Float[Tensor, "*both N"]:
    """Distance in pixels between where a point lands and where it was found."""
    squared = (transfer(later_from_earlier, earlier_px) - later_px).square().sum(-1)
    # The floor keeps the gradient of the root finite where a point fits exactly.
    return squared.clamp(min=1e-18).sqrt()


def ransac(
    p: Float[Tensor, "B N 2"],
    q: Float[Tensor, "B N 2"],
    valid: Bool[Tensor, "B N"],
    samples: Int64[Tensor, "B S size"],
    tolerance_px: float | Float[Tensor, "B"],
    refits: tuple[float, ...],
    minimal: Minimal,
    fit: Fit,
) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, "B N"], Bool[Tensor, "B"]]:
    """Best of all hypotheses at once, then least squares on its inliers, ever more strictly (appendix B, step S3).

    Hypotheses are ranked by their truncated squared error, which ranks those with equally many inliers.
    A refit counts only if twice the minimal number of points support it. When nothing fits: identity, valid False.
    """
    size = samples.shape[-1]
    tolerance = torch.as_tensor(tolerance_px, dtype=p.dtype, device=p.device).reshape(-1, 1)
    chosen = _ranks_to_points(valid, samples).flatten(1)[..., None].expand(-1, -1, 2)
    shape = (*samples.shape, 2)
    hypotheses, possible = minimal(p.gather(1, chosen).reshape(shape), q.gather(1, chosen).reshape(shape))
    squared = _squared_errors(hypotheses, p, q)
    cost = (torch.minimum(squared, tolerance.square()[..., None]) * valid[:, None]).sum(-1)
    cost = torch.where(possible, cost, torch.full_like(cost, torch.inf))
    best = cost.argmin(1, keepdim=True)
    matrix = hypotheses.gather(1, best[..., None, None].expand(-1, 1, 3, 3))[:, 0]
    found = possible.gather(1, best)[:, 0] & (valid.sum(1) >= size)
    matrix = torch.where(found[:, None, None], matrix, torch.eye(3, dtype=p.dtype, device=p.device))
    matrix = refit(p, q, valid & found[:, None], matrix, refits, size, fit)
    inliers = valid & found[:, None] & (transfer_error(matrix, p, q) < tolerance)
    return matrix, inliers, found & (inliers.sum(1) >= size)


def refit(
    p: Float[Tensor, "B N 2"],
    q: Float[Tensor, "B N 2"],
    valid: Bool[Tensor, "B N"],
    guess: Float[Tensor, "B 3 3"],
    gates_px: tuple[float, ...],
    size: int,
    fit: Fit,
) -> Float[Tensor, "B 3 3"]:
    """The guess, fitted anew once per gate to the valid pairs that miss it by less.

    A fit counts only if twice the minimal number of points, `size`, support it.
    """
    matrix = guess
    for gate_px in gates_px:
        support = valid & (transfer_error(matrix, p, q) < gate_px)
        found, solved = fit(p, q, support.to(p.dtype) / _depth(matrix, p).square())
        solved = solved & (support.sum(1) >= 2 * size)
        matrix = torch.where(solved[:, None, None], found, matrix)
    return matrix


def spread(valid: Bool[Tensor, "B N"], count: int) -> Int64[Tensor, "B count"]:
    """The places of `count` valid entries, evenly spread over all of them; some repeat where there are fewer."""
    batch, available = valid.shape
    samples = torch.arange(count, device=valid.device) * available // count
    return _ranks_to_points(valid, samples.expand(batch, 1, -1))[:, 0]


def inlier_weights(
    error_px: Float[Tensor, "*batch N"],
    tolerance_px: float | Tensor,
    softness: float = 0.0,
) -> Float[Tensor, "*batch N"]:
    """1 for a pair that misses by less than the tolerance, else 0; softness is a share of the tolerance."""
    return step(1 - error_px / tolerance_px, softness)


def fit_to_inliers(
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
    weight = inlier_weights(transfer_error(guess.detach(), earlier_px, later_px), tolerance_px, softness) * valid
    matrix, solved = fit(earlier_px, later_px, weight)
    matrix = torch.where(solved[:, None, None], matrix, guess)
    return matrix, weight.sum(-1) / valid.sum(-1).clamp(min=1)


def _ranks_to_points(valid: Bool[Tensor, "B N"], samples: Int64[Tensor, "B S size"]) -> Int64[Tensor, "B S size"]:
    """Spread sample numbers over the valid points alone: number r of N becomes valid point floor(r n / N)."""
    # Valid points first, in order; unique keys, because a stable sort does not export.
    place = torch.arange(valid.shape[1], device=valid.device)
    order = torch.where(valid, place, place + valid.shape[1]).sort(1).indices
    available = valid.sum(1).reshape(-1, 1, 1)
    rank = torch.div(samples * available, valid.shape[1], rounding_mode="floor")
    rank = torch.minimum(rank, (available - 1).clamp(min=0))
    return order.gather(1, rank.flatten(1)).reshape(samples.shape)


def _squared_errors(
    matrices: Float[Tensor, "B S 3 3"], p: Float[Tensor, "B N 2"], q: Float[Tensor, "B N 2"]
) -> Float[Tensor, "B S N"]:
    """Squared transfer error of every hypothesis at every point; infinite behind the horizon."""
    batch, count = matrices.shape[:2]
    homogeneous = torch.cat([p, torch.ones_like(p[..., :1])], -1)
    # One product for all hypotheses: broadcasting 3x3 products is several times slower on a CPU.
    u, v, depth = (matrices.flatten(1, 2) @ homogeneous.mT).reshape(batch, count, 3, -1).unbind(2)
    behind = depth < 1e-6
    inverse = torch.where(behind, torch.ones_like(depth), depth).reciprocal()
    squared = (u * inverse - q[:, None, :, 0]).square() + (v * inverse - q[:, None, :, 1]).square()
    return squared.masked_fill(behind, torch.inf)


def _depth(matrix: Float[Tensor, "B 3 3"], p: Float[Tensor, "B N 2"]) -> Float[Tensor, "B N"]:
    """The denominator of the transfer: dividing by it turns the algebraic residual into pixels."""
    # Written out, so that a batch of one takes the same path as a larger one.
    depth = p[..., 0] * matrix[:, 2, :1] + p[..., 1] * matrix[:, 2, 1:2] + matrix[:, 2, 2:]
    return depth.abs().clamp(min=1e-3)
