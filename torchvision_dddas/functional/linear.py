"""Small linear systems, batched, by Gaussian elimination with row exchange: the source's own solver (appendix A, IV-B).

Written out because `torch.linalg.solve` neither exports nor survives a singular member of a batch.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def solve(
    matrix: Float[Tensor, "*batch n n"], right: Float[Tensor, "*batch n m"], tolerance: float | None = None
) -> tuple[Float[Tensor, "*batch n m"], Bool[Tensor, "*batch"]]:
    """Solve matrix @ x = right for every member of the batch; valid is False where the matrix is singular.

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
