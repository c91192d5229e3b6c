"""Homographies and affine maps between two frames: minimal solutions, least squares, RANSAC (appendix B, step S3).

Matrices are (B, 3, 3), act on (u, v, 1) in pixels and have h33 = 1. Affine maps (appendix A's registration, the
baseline of appendix B, Fig. 2 and 4) have the last row 0 0 1. Random numbers are an input (the pairs of each
hypothesis), so that runs repeat and graphs can be exported. Kornia moves the points and measures the errors.

Kornia's find_homography_dlt takes 0.7 to 1.0 of our time (`python eval/speed.py operations`). Ours remains for three
reasons: it solves by elimination and can be exported to ONNX, unlike Kornia's LU; it reports which members of a batch
have no solution; it computes in float64. Kornia's RANSAC takes one pair of frames at a time, and over five times as
long at batch 8.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from kornia.geometry import oneway_transfer_error
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.errors import InputError

Minimal = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
Fit = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]

# A point is on the horizon if its depth is at most this share of the depth of the points' centre.
HORIZON = 1e-6


class PlaneModel(NamedTuple):
    """A kind of map. size: number of pairs that fix it. minimal: its maps from `size` pairs. fit: least squares."""

    size: int
    minimal: Minimal
    fit: Fit


def four_point(
    p: Float[Tensor, "*batch 4 2"], q: Float[Tensor, "*batch 4 2"]
) -> tuple[Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:
    """Return the homographies that map four points p exactly to q, in closed form by a projective basis.

    valid is False if three of the points are nearly on one line, or if the orientation of a triple changes between p
    and q. A camera that stays on one side of the plane cannot change it.
    """
    # Use coordinates around the first point, in units of the sample's size, so that float32 keeps its digits.
    from_p, p_scale = _local(p)
    from_q, q_scale = _local(q)
    p_dual, p_weight, p_area = _basis(from_p)
    _, q_weight, q_area = _basis(from_q)
    # Column i of Q times c_i times row i of P's adjugate. c_i = mu_i lambda_j lambda_k needs no division.
    coefficient = q_weight * p_weight.roll(1, -1) * p_weight.roll(-1, -1)
    columns = functional.pad(from_q[..., :3, :], (0, 1), value=1.0)
    matrix = (columns * coefficient[..., None]).mT @ p_dual
    turned = torch.cat([p_weight * q_weight, p_area * q_area], -1)
    thin = torch.cat([p_weight, p_area, q_weight, q_area], -1).abs().amin(-1)
    matrix = _to_pixels(matrix, p[..., 0, :], p_scale, q[..., 0, :], q_scale)
    valid = (turned > 0).all(-1) & (thin > 1e-4)
    valid = valid & (matrix[..., 2, 2].abs() > 1e-12) & torch.isfinite(matrix).all(-1).all(-1)
    return normalize_map(_or_identity(matrix, valid)), valid


def three_point(
    p: Float[Tensor, "*batch 3 2"], q: Float[Tensor, "*batch 3 2"]
) -> tuple[Float[Tensor, "*batch 3 3"], Bool[Tensor, "*batch"]]:
    """Return the affine maps that map three points p exactly to q. A triple that is nearly on one line is not valid."""
    p_side = p[..., 1:, :] - p[..., :1, :]
    q_side = q[..., 1:, :] - q[..., :1, :]
    (a, b), (c, d) = p_side[..., 0, :].unbind(-1), p_side[..., 1, :].unbind(-1)
    area = a * d - b * c
    q_area = q_side[..., 0, 0] * q_side[..., 1, 1] - q_side[..., 0, 1] * q_side[..., 1, 0]
    valid = (area.abs() > 1e-4 * p_side.square().sum((-2, -1))) & (q_area.abs() > 1e-4 * q_side.square().sum((-2, -1)))
    adjugate = torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2)
    # Points are rows, so the linear part acts from the right.
    right = adjugate @ q_side / torch.where(valid, area, torch.ones_like(area))[..., None, None]
    shift = q[..., 0, :] - (p[..., :1, :] @ right)[..., 0, :]
    return _or_identity(_with_last_row(torch.cat([right.mT, shift[..., None]], -1)), valid), valid


def find_homography(
    points1: Float[Tensor, "B N 2"], points2: Float[Tensor, "B N 2"], weights: Float[Tensor, "B N"] | None = None
) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, "B"]]:
    """Return the homographies from points1 to points2, as in Kornia, and whether each is valid.

    Weighted least squares over N pairs, Hartley-normalised, h33 = 1 in normalised coordinates, by elimination. A pair
    of weight 0 has no effect, whatever its values. Four pairs are met exactly. valid is False with fewer than four
    pairs of positive weight, if the pairs do not determine eight parameters (collinear points), and if a pair would lie
    on or behind the horizon, as happens with three of four points on one line and noise in q.

    >>> p = torch.tensor([[[0.0, 0], [1, 0], [0, 1], [1, 1]]])
    >>> matrix, valid = F.find_homography(p, 2 * p + 3)
    >>> F.transform_points(matrix, p).round(decimals=3)[0, 3], valid
    (tensor([5., 5.]), tensor([True]))
    """
    weight = torch.ones_like(points1[..., 0]) if weights is None else weights
    used = weight > 0
    p, q = (torch.where(used[..., None], points, torch.zeros_like(points)) for points in (points1, points2))
    # Solve in float64: the normal equations square the condition number, and float32 errs by pixels outside the points.
    wide = _wide(p)
    p_unit, p_mean, p_scale = _hartley(p.to(wide), weight.to(wide))
    q_unit, q_mean, q_scale = _hartley(q.to(wide), weight.to(wide))
    rows = _equations(p_unit, q_unit)
    share = weight.to(wide) / weight.to(wide).sum(1, keepdim=True).clamp(min=1e-12)
    normal = rows.mT @ (rows * share.repeat(1, 2)[..., None])
    solution, valid = solve_linear(normal[:, :8, :8], normal[:, :8, 8:], tolerance=1e-10)
    depth = p_unit[..., 0] * solution[:, 6] + p_unit[..., 1] * solution[:, 7] + 1
    valid = valid & ((depth > HORIZON) | ~used).all(1)
    matrix = _to_pixels(_matrix_of(solution), p_mean, p_scale, q_mean, q_scale)
    valid = valid & (used.sum(1) >= 4) & (matrix[:, 2, 2].abs() > 1e-9)
    return normalize_map(_or_identity(matrix, valid)).to(p.dtype), valid


def find_affine(
    p: Float[Tensor, "B N 2"], q: Float[Tensor, "B N 2"], weight: Float[Tensor, "B N"]
) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, "B"]]:
    """Return least-squares affine maps of N pairs. Fewer than three or collinear pairs give valid = False.

    >>> p = torch.tensor([[[0.0, 0], [1, 0], [0, 1]]])
    >>> matrix, valid = F.find_affine(p, 2 * p + 3, torch.ones(1, 3))
    >>> F.transform_points(matrix, p).round(decimals=3)[0, 1], valid
    (tensor([5., 3.]), tensor([True]))
    """
    wide = _wide(p)
    p_unit, p_mean, p_scale = _hartley(p.to(wide), weight.to(wide))
    q_unit, q_mean, q_scale = _hartley(q.to(wide), weight.to(wide))
    share = (weight.to(wide) / weight.to(wide).sum(1, keepdim=True).clamp(min=1e-12))[..., None]
    rows = torch.cat([p_unit, torch.ones_like(p_unit[..., :1])], -1)
    solution, valid = solve_linear(rows.mT @ (rows * share), rows.mT @ (q_unit * share), tolerance=1e-8)
    valid = valid & ((weight > 0).sum(1) >= 3)
    matrix = _to_pixels(_with_last_row(solution.mT), p_mean, p_scale, q_mean, q_scale)
    return _or_identity(matrix, valid).to(p.dtype), valid


HOMOGRAPHY = PlaneModel(4, four_point, find_homography)
MODELS = {"homography": HOMOGRAPHY, "affine": PlaneModel(3, three_point, find_affine)}
"""Models by the names that registration.model takes."""


def find_homography_raw(
    p: Float[Tensor, "B N 2"], q: Float[Tensor, "B N 2"]
) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, "B"]]:
    """Solve as the source prints it (appendix A, eq. 8 to 10): A m = k for four pairs, AᵀA m = Aᵀk for more.

    There are no weights and no normalisation. In degrees cond(A) is about 1e13, and cond(AᵀA) exceeds float64: the
    result of more than four pairs is wrong by decimetres or more even for perfect pairs. The function shows exactly
    this. A pivot therefore counts as zero only if it is 0; any tolerance would refuse degrees altogether. valid is
    False in this case and with fewer than four pairs. Collinear landmarks must be detected elsewhere.

    >>> p = torch.tensor([[[0.0, 0], [1, 0], [0, 1], [1, 1]]])
    >>> matrix, valid = F.find_homography_raw(p, 2 * p + 3)
    >>> F.transform_points(matrix, p).round(decimals=3)[0, 3], valid
    (tensor([5., 5.]), tensor([True]))
    """
    rows = _equations(p, q)
    if p.shape[1] != 4:
        rows = rows[..., :8].mT @ rows
    solution, valid = solve_linear(rows[..., :8], rows[..., 8:], tolerance=0.0)
    valid = valid & torch.isfinite(solution).all(-1).all(-1) & (p.shape[1] >= 4)
    return _or_identity(_matrix_of(solution), valid), valid


def draw_samples(
    generator: torch.Generator, batch: int, hypotheses: int, count: int, *, size: int = 4
) -> Int64[Tensor, "B S size"]:
    """Draw `size` different numbers from 0 .. count - 1 for every hypothesis, on the generator's device.

    Raise InputError if there are fewer than `size` numbers to draw from.

    >>> F.draw_samples(torch.Generator().manual_seed(0), 1, 128, 50).shape
    torch.Size([1, 128, 4])
    """
    if count < size:
        raise InputError(f"a hypothesis is drawn from {size} points; got room for {count}. Raise the keypoint budget.")
    uniform = torch.rand(batch, hypotheses, size, generator=generator, device=generator.device, dtype=torch.float64)
    drawn: list[Tensor] = []
    for k in range(size):
        number = (uniform[..., k] * (count - k)).long().clamp(max=count - k - 1)
        # Skip the numbers that are already drawn, smallest first: the new number is a rank among the others.
        for taken in torch.stack(drawn, -1).sort(-1).values.unbind(-1) if drawn else ():
            number = number + (number >= taken)
        drawn.append(number)
    return torch.stack(drawn, -1)


def invert_map(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the inverse by cofactors: `torch.linalg.inv` cannot be exported. Singular maps give no finite values.

    >>> F.invert_map(torch.diag(torch.tensor([2.0, 4.0, 1.0])))
    tensor([[0.5000, 0.0000, 0.0000],
            [0.0000, 0.2500, 0.0000],
            [0.0000, 0.0000, 1.0000]])
    """
    a, b, c = matrix.unbind(-2)
    cross = torch.linalg.cross
    columns = torch.stack([cross(b, c), cross(c, a), cross(a, b)], -1)
    return columns / (a * columns[..., 0]).sum(-1)[..., None, None]


def ransac(
    p: Float[Tensor, "B N 2"],
    q: Float[Tensor, "B N 2"],
    valid: Bool[Tensor, "B N"],
    samples: Int64[Tensor, "B S size"],
    *,
    model: PlaneModel = HOMOGRAPHY,
    tolerance_px: float | Float[Tensor, "B"] = 3.0,
    refits: Sequence[float | Tensor] = (3.0, 2.0, 1.0),
) -> tuple[Float[Tensor, "B 3 3"], Bool[Tensor, "B N"], Bool[Tensor, "B"]]:
    """Return later_from_earlier from pairs of which many are wrong, the inliers, and whether it is reliable.

    Take the best of all hypotheses, then fit least squares to its inliers with tightening tolerances (appendix B, step
    S3). Hypotheses are ranked by their truncated squared error, which also ranks equal numbers of inliers. samples:
    from `draw_samples`; the numbers are spread over the valid points if some are not valid. If none fits, return the
    identity, not reliable. Raise InputError without any points.

    >>> p = torch.rand(1, 50, 2) * 100
    >>> q = p + 5
    >>> q[:, :15] += 40 * torch.rand(1, 15, 2)
    >>> samples = F.draw_samples(torch.Generator().manual_seed(0), 1, 128, 50)
    >>> matrix, inliers, reliable = F.ransac(p, q, torch.ones(1, 50, dtype=torch.bool), samples)
    >>> matrix[0, :2, 2].round(decimals=2), bool(inliers[:, 15:].all())
    (tensor([5., 5.]), True)
    """
    if not p.shape[1]:
        raise InputError(f"RANSAC needs {model.size} pairs of points, got none")
    tolerance = torch.as_tensor(tolerance_px, dtype=p.dtype, device=p.device).reshape(-1, 1)
    chosen = _ranks_to_points(valid, samples).flatten(1)[..., None].expand(-1, -1, 2)
    shape = (*samples.shape, 2)
    hypotheses, possible = model.minimal(p.gather(1, chosen).reshape(shape), q.gather(1, chosen).reshape(shape))
    squared = _squared_errors(hypotheses, p, q)
    cost = (torch.minimum(squared, tolerance.square()[..., None]) * valid[:, None]).sum(-1)
    cost = torch.where(possible, cost, torch.full_like(cost, torch.inf))
    best = cost.argmin(1, keepdim=True)
    matrix = hypotheses.gather(1, best[..., None, None].expand(-1, 1, 3, 3))[:, 0]
    found = possible.gather(1, best)[:, 0] & (valid.sum(1) >= model.size)
    matrix = refit_map(p, q, valid & found[:, None], _or_identity(matrix, found), refits, model)
    inliers = valid & found[:, None] & (oneway_transfer_error(p, q, matrix, squared=False) < tolerance)
    return matrix, inliers, found & (inliers.sum(1) >= model.size)


def refit_map(
    p: Float[Tensor, "B N 2"],
    q: Float[Tensor, "B N 2"],
    valid: Bool[Tensor, "B N"],
    guess: Float[Tensor, "B 3 3"],
    gates_px: Sequence[float | Tensor],
    model: PlaneModel,
) -> Float[Tensor, "B 3 3"]:
    """Return the guess, refitted once per gate to the valid pairs whose error is below the gate.

    A fit is accepted only if twice the minimal number of points support it.

    >>> p = torch.rand(1, 50, 2) * 100
    >>> guess = torch.tensor([[[1.0, 0, 1], [0, 1, 1], [0, 0, 1]]])
    >>> fitted = F.refit_map(p, p + 2, torch.ones(1, 50, dtype=torch.bool), guess, [3.0, 1.0], F.MODELS["homography"])
    >>> fitted[0, :2, 2].round(decimals=2)
    tensor([2., 2.])
    """
    matrix = guess
    for gate_px in gates_px:
        support = valid & (oneway_transfer_error(p, q, matrix, squared=False) < gate_px)
        # Dividing by the denominator of the transfer turns the algebraic residual into pixels. It is written out, so
        # that a batch of one takes the same path as a larger batch.
        depth = p[..., 0] * matrix[:, 2, :1] + p[..., 1] * matrix[:, 2, 1:2] + matrix[:, 2, 2:]
        found, solved = model.fit(p, q, support.to(p.dtype) / depth.abs().clamp(min=1e-3).square())
        solved = solved & (support.sum(1) >= 2 * model.size)
        matrix = torch.where(solved[:, None, None], found, matrix)
    return matrix


def spread_ranks(valid: Bool[Tensor, "B N"], count: int) -> Int64[Tensor, "B count"]:
    """Return the places of `count` valid entries, evenly spread over all of them. With fewer, some repeat.

    >>> F.spread_ranks(torch.tensor([[True, False, True, True, False, True]]), 2)
    tensor([[0, 3]])
    """
    batch, available = valid.shape
    samples = torch.arange(count, device=valid.device) * available // count
    return _ranks_to_points(valid, samples.expand(batch, 1, -1))[:, 0]


def normalize_map(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the same map with h33 = 1."""
    corner = matrix[..., 2:, 2:]
    tiny = torch.finfo(matrix.dtype).tiny
    return matrix / torch.where(corner.abs() < tiny, torch.full_like(corner, tiny), corner)


def solve_linear(
    matrix: Float[Tensor, "*batch n n"], right: Float[Tensor, "*batch n m"], *, tolerance: float | None = None
) -> tuple[Float[Tensor, "*batch n m"], Bool[Tensor, "*batch"]]:
    """Solve matrix @ x = right for every member of the batch; valid is False where the matrix is singular.

    Gaussian elimination with row exchange, the source's own solver (appendix A, IV-B). `torch.linalg.solve` cannot be
    exported, and fails on a singular member of a batch. A pivot smaller than `tolerance` times the matrix's largest
    entry counts as zero (default: 8 n machine epsilons). Invalid members are returned as zeros.

    >>> F.solve_linear(torch.tensor([[2.0, 0], [0, 4]]), torch.tensor([[2.0], [2.0]]))
    (tensor([[1.0000],
            [0.5000]]), tensor(True))
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
        # Subtracting (pivot - 1) times the scaled row from row k leaves the scaled row, so that row k is no special
        # case.
        joined = joined - (joined[..., k : k + 1] - (rows == k).to(joined.dtype)[:, None]) * row
    solution = joined[..., n:]
    return torch.where(valid[..., None, None], solution, torch.zeros_like(solution)), valid


def _equations(p: Float[Tensor, "B N 2"], q: Float[Tensor, "B N 2"]) -> Float[Tensor, "B 2N 9"]:
    """Return the linear equations of a homography with h33 = 1; the last column is the right side."""
    (x, y), (u, v) = p.unbind(-1), q.unbind(-1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    rows_u = torch.stack([x, y, one, zero, zero, zero, -u * x, -u * y, u], -1)
    rows_v = torch.stack([zero, zero, zero, x, y, one, -v * x, -v * y, v], -1)
    return torch.cat([rows_u, rows_v], 1)


def _matrix_of(solution: Float[Tensor, "B 8 1"]) -> Float[Tensor, "B 3 3"]:
    return torch.cat([solution[..., 0], torch.ones_like(solution[:, :1, 0])], 1).reshape(-1, 3, 3)


def _with_last_row(top: Float[Tensor, "*batch 2 3"]) -> Float[Tensor, "*batch 3 3"]:
    last = torch.zeros_like(top[..., :1, :])
    return torch.cat([top, torch.cat([last[..., :2], torch.ones_like(last[..., 2:])], -1)], -2)


def _or_identity(matrix: Float[Tensor, "*batch 3 3"], valid: Bool[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    return torch.where(valid[..., None, None], matrix, torch.eye(3, dtype=matrix.dtype, device=matrix.device))


def _wide(points: Tensor) -> torch.dtype:
    return points.dtype if points.device.type == "mps" else torch.float64


def _local(points: Float[Tensor, "*batch 4 2"]) -> tuple[Float[Tensor, "*batch 4 2"], Float[Tensor, "*batch"]]:
    relative = points - points[..., :1, :]
    scale = relative.abs().amax((-2, -1)).clamp(min=1e-6).reciprocal()
    return relative * scale[..., None, None], scale


def _basis(points: Float[Tensor, "*batch 4 2"]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the adjugate (rows) of the first three points, the fourth's weights in them, and twice their area."""
    a, b, c, d = functional.pad(points, (0, 1), value=1.0).unbind(-2)
    cross = torch.linalg.cross
    dual = torch.stack([cross(b, c), cross(c, a), cross(a, b)], -2)
    return dual, (dual @ d[..., None])[..., 0], (dual[..., :1, :] @ a[..., None])[..., 0]


def _hartley(points: Float[Tensor, "B N 2"], weight: Float[Tensor, "B N"]) -> tuple[Tensor, Tensor, Tensor]:
    """Shift and scale points to weighted mean 0 and root mean square distance sqrt 2; return mean and scale too."""
    share = (weight / weight.sum(1, keepdim=True).clamp(min=1e-12))[..., None]
    mean = (points * share).sum(1)
    relative = points - mean[:, None]
    spread = (relative.square() * share).sum((1, 2))
    scale = (2.0 / spread.clamp(min=1e-12)).sqrt()
    return relative * scale[:, None, None], mean, scale


def _to_pixels(matrix: Tensor, p_origin: Tensor, p_scale: Tensor, q_origin: Tensor, q_scale: Tensor) -> Tensor:
    """Convert a map of local coordinates (x - origin) * scale on both sides to a map of pixels."""
    into = torch.cat([matrix[..., :2] * p_scale[..., None, None], matrix[..., 2:]], -1)
    last = into[..., 2:] - (into[..., :2] @ p_origin[..., None])
    into = torch.cat([into[..., :2], last], -1)
    top = into[..., :2, :] / q_scale[..., None, None] + q_origin[..., None] * into[..., 2:, :]
    return torch.cat([top, into[..., 2:, :]], -2)


def _ranks_to_points(valid: Bool[Tensor, "B N"], samples: Int64[Tensor, "B S size"]) -> Int64[Tensor, "B S size"]:
    """Spread sample numbers over the valid points: number r of N becomes valid point floor(r n / N)."""
    # Order the valid points first. The keys are unique, because a stable sort cannot be exported.
    place = torch.arange(valid.shape[1], device=valid.device)
    order = torch.where(valid, place, place + valid.shape[1]).sort(1).indices
    available = valid.sum(1).reshape(-1, 1, 1)
    rank = torch.div(samples * available, valid.shape[1], rounding_mode="floor")
    rank = torch.minimum(rank, (available - 1).clamp(min=0))
    return order.gather(1, rank.flatten(1)).reshape(samples.shape)


def _squared_errors(
    matrices: Float[Tensor, "B S 3 3"], p: Float[Tensor, "B N 2"], q: Float[Tensor, "B N 2"]
) -> Float[Tensor, "B S N"]:
    """Return the squared transfer error of every hypothesis at every point; infinite behind the horizon."""
    batch, count = matrices.shape[:2]
    homogeneous = torch.cat([p, torch.ones_like(p[..., :1])], -1)
    # Use one product for all hypotheses: broadcast 3x3 products are several times slower on a CPU.
    u, v, depth = (matrices.flatten(1, 2) @ homogeneous.mT).reshape(batch, count, 3, -1).unbind(2)
    behind = depth < 1e-6
    inverse = torch.where(behind, torch.ones_like(depth), depth).reciprocal()
    squared = (u * inverse - q[:, None, :, 0]).square() + (v * inverse - q[:, None, :, 1]).square()
    return squared.masked_fill(behind, torch.inf)
