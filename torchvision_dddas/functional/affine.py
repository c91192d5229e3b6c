"""The affine map between two frames, appendix A's registration: kept as the baseline of appendix B, Fig. 2 and 4.

Returned as (B, 3, 3) with last row 0 0 1, so that everything that takes a homography takes it too.
"""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvision_dddas.functional import consensus
from torchvision_dddas.functional.homography import _hartley, _shifted, _wide, solve_linear

SAMPLE_SIZE = 3


def three_point(
    p: Float[Tensor, "*batch 3 2"], q: Float[Tensor, "*batch 3 2"]
) -> tuple[Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:
    """The affine maps that take three points p exactly to q; not valid when a triple is (nearly) on one line."""
    p_side = p[..., 1:, :] - p[..., :1, :]
    q_side = q[..., 1:, :] - q[..., :1, :]
    (a, b), (c, d) = p_side[..., 0, :].unbind(-1), p_side[..., 1, :].unbind(-1)
    area = a * d - b * c
    q_area = q_side[..., 0, 0] * q_side[..., 1, 1] - q_side[..., 0, 1] * q_side[..., 1, 0]
    valid = (area.abs() > 1e-4 * p_side.square().sum((-2, -1))) & (q_area.abs() > 1e-4 * q_side.square().sum((-2, -1)))
    adjugate = torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2)
    # Rows are points, so the linear part acts from the right.
    right = adjugate @ q_side / torch.where(valid, area, torch.ones_like(area))[..., None, None]
    shift = q[..., 0, :] - (p[..., :1, :] @ right)[..., 0, :]
    matrix = _with_last_row(torch.cat([right.mT, shift[..., None]], -1))
    return torch.where(valid[..., None, None], matrix, torch.eye(3, dtype=p.dtype, device=p.device)), valid


def fit(
    p: Float[Tensor, "B N 2"], q: Float[Tensor, "B N 2"], weight: Float[Tensor, "B N"]
) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, "B"]]:
    """Weighted least squares over N pairs; valid is False with fewer than three pairs or when they are collinear."""
    wide = _wide(p)
    p_unit, p_mean, p_scale = _hartley(p.to(wide), weight.to(wide))
    q_unit, q_mean, q_scale = _hartley(q.to(wide), weight.to(wide))
    share = (weight.to(wide) / weight.to(wide).sum(1, keepdim=True).clamp(min=1e-12))[..., None]
    rows = torch.cat([p_unit, torch.ones_like(p_unit[..., :1])], -1)
    solution, valid = solve_linear(rows.mT @ (rows * share), rows.mT @ (q_unit * share), tolerance=1e-8)
    valid = valid & ((weight > 0).sum(1) >= SAMPLE_SIZE)
    matrix = _shifted(_with_last_row(solution.mT), p_mean, p_scale, q_mean, q_scale)
    return torch.where(valid[:, None, None], matrix, torch.eye(3, dtype=wide, device=p.device)).to(p.dtype), valid


def ransac(
    p: Float[Tensor, "B N 2"],
    q: Float[Tensor, "B N 2"],
    valid: Bool[Tensor, "B N"],
    samples: Int64[Tensor, "B S 3"],
    tolerance_px: float | Float[Tensor, "B"] = 3.0,
    refits: tuple[float, ...] = (3.0, 2.0, 1.0),
) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, "B N"], Bool[Tensor, "B"]]:
    """later_from_earlier, inliers and validity; samples: from `draw_samples(..., size=3)`. See `consensus.ransac`."""
    return consensus.ransac(p, q, valid, samples, tolerance_px, refits, three_point, fit)


def _with_last_row(top: Float[Tensor, "*batch 2 3"]) -> Float[Tensor, "*batch 3 3"]:
    last = torch.zeros_like(top[..., :1, :])
    last = torch.cat([last[..., :2], torch.ones_like(last[..., 2:])], -1)
    return torch.cat([top, last], -2)
