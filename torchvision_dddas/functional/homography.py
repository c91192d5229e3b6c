"""The plane homography between two frames: minimal solution, least squares, robust estimation (appendix B, step S3).

Matrices are (B, 3, 3), act on (u, v, 1) in pixels and have h33 = 1. kornia.geometry.homography uses SVD, which does not
export, and its RANSAC is 16x plain OpenCV on a CPU where this one, all hypotheses at once, is about 4.6x.
"""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torchvision_dddas.functional import consensus

SAMPLE_SIZE = 4
# Depth of a point, as a share of the depth of the middle of all, from which on it is on the horizon.
HORIZON = 1e-6


def four_point(
    p: Float[Tensor, "*batch 4 2"], q: Float[Tensor, "*batch 4 2"]
) -> tuple[Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:
    """The homographies that take four points p exactly to q, in closed form, by way of a projective basis.

    valid is False when three of the points are (nearly) on one line, or when a triple turns over between p and q,
    which no camera that stays on one side of the plane can do.
    """
    # Around the first point and in units of the sample's own size, so that float32 keeps its digits.
    from_p, p_scale = _local(p)
    from_q, q_scale = _local(q)
    p_dual, p_weight, p_area = _basis(from_p)
    _, q_weight, q_area = _basis(from_q)
    # Column i of Q times c_i times row i of P's adjugate; c_i = mu_i lambda_j lambda_k avoids every division.
    coefficient = q_weight * p_weight.roll(1, -1) * p_weight.roll(-1, -1)
    columns = torch.nn.functional.pad(from_q[..., :3, :], (0, 1), value=1.0)
    matrix = (columns * coefficient[..., None]).mT @ p_dual
    turned = torch.cat([p_weight * q_weight, p_area * q_area], -1)
    thin = torch.minimum(
        torch.cat([p_weight, p_area], -1).abs().amin(-1), torch.cat([q_weight, q_area], -1).abs().amin(-1)
    )
    valid = (turned > 0).all(-1) & (thin > 1e-4)
    matrix = _shifted(matrix, p[..., 0, :], p_scale, q[..., 0, :], q_scale)
    valid = valid & (matrix[..., 2, 2].abs() > 1e-12) & torch.isfinite(matrix).all(-1).all(-1)
    matrix = torch.where(valid[..., None, None], matrix, torch.eye(3, dtype=p.dtype, device=p.device))
    return normalize(matrix), valid


def fit(
    p: Float[Tensor, "B N 2"], q: Float[Tensor, "B N 2"], weight: Float[Tensor, "B N"]
) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, "B"]]:
    """Weighted least squares over N pairs, Hartley-normalised, h33 = 1 in normalised coordinates, by elimination.

    A pair of weight 0 is as if it were not there, whatever it holds; four pairs are met exactly. valid is False with
    fewer than four pairs of positive weight, when they do not fix eight parameters (collinear), and when one of them
    would lie on or behind the horizon: so it is with three of four points on one line and noise in their partners.
    """
    used = weight > 0
    p, q = (torch.where(used[..., None], points, torch.zeros_like(points)) for points in (p, q))
    # In float64: the normal equations square the condition, and float32 leaves pixels of error outside the points.
    wide = _wide(p)
    p_unit, p_mean, p_scale = _hartley(p.to(wide), weight.to(wide))
    q_unit, q_mean, q_scale = _hartley(q.to(wide), weight.to(wide))
    (x, y), (u, v) = p_unit.unbind(-1), q_unit.unbind(-1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    rows_u = torch.stack([x, y, one, zero, zero, zero, -u * x, -u * y, u], -1)
    rows_v = torch.stack([zero, zero, zero, x, y, one, -v * x, -v * y, v], -1)
    rows = torch.cat([rows_u, rows_v], 1)
    share = weight.to(wide) / weight.to(wide).sum(1, keepdim=True).clamp(min=1e-12)
    normal = rows.mT @ (rows * share.repeat(1, 2)[..., None])
    solution, valid = solve_linear(normal[:, :8, :8], normal[:, :8, 8:], tolerance=1e-10)
    depth = x * solution[:, 6] + y * solution[:, 7] + 1
    valid = valid & ((depth > HORIZON) | ~used).all(1)
    matrix = torch.cat([solution[..., 0], torch.ones_like(solution[:, :1, 0])], 1).reshape(-1, 3, 3)
    matrix = _shifted(matrix, p_mean, p_scale, q_mean, q_scale)
    valid = valid & (used.sum(1) >= SAMPLE_SIZE) & (matrix[:, 2, 2].abs() > 1e-9)
    matrix = torch.where(valid[:, None, None], matrix, torch.eye(3, dtype=wide, device=p.device))
    return normalize(matrix).to(p.dtype), valid


def fit_raw(p: Float[Tensor, "B N 2"], q: Float[Tensor, "B N 2"]) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, "B"]]:
    """As the source prints it (appendix A, eq. 8 to 10): A m = k of four pairs, AᵀA m = Aᵀk of more, as they are given.

    No weights and no normalisation: in degrees cond(A) is about 1e13, that of AᵀA beyond float64, and what comes out
    of more than four pairs is wrong by decimetres or more even if the pairs are perfect. It is kept to show just that.
    Therefore a pivot counts as zero only if it is zero: any larger tolerance would refuse degrees altogether. valid is
    False then, or with fewer than four pairs; that landmarks lie on one line must be seen elsewhere.
    """
    (x, y), (u, v) = p.unbind(-1), q.unbind(-1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    rows_u = torch.stack([x, y, one, zero, zero, zero, -u * x, -u * y, u], -1)
    rows_v = torch.stack([zero, zero, zero, x, y, one, -v * x, -v * y, v], -1)
    rows = torch.cat([rows_u, rows_v], 1)
    if p.shape[1] != SAMPLE_SIZE:
        rows = rows[..., :8].mT @ rows
    solution, valid = solve_linear(rows[..., :8], rows[..., 8:], tolerance=0.0)
    valid = valid & torch.isfinite(solution).all(-1).all(-1) & (p.shape[1] >= SAMPLE_SIZE)
    matrix = torch.cat([solution[..., 0], torch.ones_like(solution[:, :1, 0])], 1).reshape(-1, 3, 3)
    return torch.where(valid[:, None, None], matrix, torch.eye(3, dtype=p.dtype, device=p.device)), valid


def ransac(
    p: Float[Tensor, "B N 2"],
    q: Float[Tensor, "B N 2"],
    valid: Bool[Tensor, "B N"],
    samples: Int64[Tensor, "B S 4"],
    tolerance_px: float | Float[Tensor, "B"] = 3.0,
    refits: tuple[float, ...] = (3.0, 2.0, 1.0),
) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, "B N"], Bool[Tensor, "B"]]:
    """later_from_earlier from pairs of which many are wrong, the inliers, and whether it may be believed.

    samples: from `draw_samples`; numbers are spread over the valid points when some are not. See `consensus.ransac`.
    """
    return consensus.ransac(p, q, valid, samples, tolerance_px, refits, four_point, fit)


def normalize(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The same mapping with h33 = 1."""
    corner = matrix[..., 2:, 2:]
    tiny = torch.finfo(matrix.dtype).tiny
    return matrix / torch.where(corner.abs() < tiny, torch.full_like(corner, tiny), corner)


def solve_linear(
    matrix: Float[Tensor, "*batch n n"], right: Float[Tensor, "*batch n m"], tolerance: float | None = None
) -> tuple[Float[Tensor, "*batch n m"], Bool[Tensor, "*batch"]]:
    """Solve matrix @ x = right for every member of the batch; valid is False where the matrix is singular.

    Gaussian elimination with row exchange, the source's own solver (appendix A, IV-B). Written out because
    `torch.linalg.solve` neither exports nor survives a singular member of a batch.

    A pivot smaller than `tolerance` times the matrix's largest entry counts as zero (default: 8 n machine epsilons).
    Invalid members come back as zeros. Differentiable in both inputs.
    """
    n = matrix.shape[-1]
    if tolerance is None:
        tolerance = 8 * n * torch.finfo(matrix.dtype).eps
    smallest = tolerance * matrix.detach().abs().amax((-2, -1))
    joined = torch.cat([matrix, right], -1)
    rows = torch.arange(n, device=matrix.device)
    valid = torch.ones_like(smallest, dtype=torch.bool)
    for k in range(n):
        pivot_row = joined[..., k:, k].detach().abs().argmax(-1, keepdim=True) + k
        exchanged = torch.where(rows == k, pivot_row, torch.where(rows == pivot_row, k, rows))
        joined = joined.gather(-2, exchanged[..., None].expand(joined.shape))
        pivot = joined[..., k, k]
        usable = pivot.detach().abs() > smallest
        valid = valid & usable
        row = joined[..., k : k + 1, :] / torch.where(usable, pivot, torch.ones_like(pivot))[..., None, None]
        # Subtracting (pivot - 1) of the scaled row from itself leaves the scaled row: no special case for row k.
        factor = joined[..., k : k + 1] - (rows == k).to(joined.dtype)[:, None]
        joined = joined - factor * row
    solution = joined[..., n:]
    return torch.where(valid[..., None, None], solution, torch.zeros_like(solution)), valid


def _wide(points: Tensor) -> torch.dtype:
    return points.dtype if points.device.type == "mps" else torch.float64


def _local(points: Float[Tensor, "*batch 4 2"]) -> tuple[Float[Tensor, "*batch 4 2"], Float[Tensor, "*batch"]]:
    relative = points - points[..., :1, :]
    scale = relative.abs().amax((-2, -1)).clamp(min=1e-6).reciprocal()
    return relative * scale[..., None, None], scale


def _basis(points: Float[Tensor, "*batch 4 2"]) -> tuple[Tensor, Tensor, Tensor]:
    """Adjugate (rows) of the first three points, the fourth's weights in them, and twice the area of the three."""
    a, b, c, d = torch.nn.functional.pad(points, (0, 1), value=1.0).unbind(-2)
    cross = torch.linalg.cross
    dual = torch.stack([cross(b, c), cross(c, a), cross(a, b)], -2)
    return dual, (dual @ d[..., None])[..., 0], (dual[..., :1, :] @ a[..., None])[..., 0]


def _hartley(points: Float[Tensor, "B N 2"], weight: Float[Tensor, "B N"]) -> tuple[Tensor, Tensor, Tensor]:
    """Points with weighted mean zero and root mean square distance sqrt 2, and the mean and scale that did it."""
    share = (weight / weight.sum(1, keepdim=True).clamp(min=1e-12))[..., None]
    mean = (points * share).sum(1)
    relative = points - mean[:, None]
    spread = (relative.square() * share).sum((1, 2))
    scale = (2.0 / spread.clamp(min=1e-12)).sqrt()
    return relative * scale[:, None, None], mean, scale


def _shifted(matrix: Tensor, p_origin: Tensor, p_scale: Tensor, q_origin: Tensor, q_scale: Tensor) -> Tensor:
    """From local coordinates (x - origin) * scale on either side back to pixels."""
    into = torch.cat([matrix[..., :2] * p_scale[..., None, None], matrix[..., 2:]], -1)
    last = into[..., 2:] - (into[..., :2] @ p_origin[..., None])
    into = torch.cat([into[..., :2], last], -1)
    top = into[..., :2, :] / q_scale[..., None, None] + q_origin[..., None] * into[..., 2:, :]
    return torch.cat([top, into[..., 2:, :]], -2)
