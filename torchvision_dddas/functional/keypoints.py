"""Good features to track: where both eigenvalues of the structure tensor are large (appendix B, step S1).

kornia.feature.gftt_response needs 13x plain OpenCV's time on a CPU, shifts and additions 3.3x or less.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.functional.blur import box_sum
from torchvision_dddas.functional.borders import reflected
from torchvision_dddas.functional.morphology import dilate


def min_eigenvalue(gray: Float[Tensor, "B 1 H W"], block: int = 3) -> Float[Tensor, "B 1 H W"]:
    """Smaller eigenvalue of the structure tensor summed over block x block pixels: cv2.cornerMinEigenVal's values."""
    padded = reflected(gray, 1, 1)
    scale = 1.0 / (4.0 * block)
    above, middle, below = padded[..., :-2, :], padded[..., 1:-1, :], padded[..., 2:, :]
    smooth = torch.add(above + below, middle, alpha=2.0) * scale
    steep = (below - above) * scale
    along_u = smooth[..., 2:] - smooth[..., :-2]
    along_v = torch.add(steep[..., 2:] + steep[..., :-2], steep[..., 1:-1], alpha=2.0)
    products = torch.cat([along_u * along_u, along_v * along_v, along_u * along_v], 1)
    uu, vv, uv = box_sum(products, block).split(1, 1)
    # The floor keeps the gradient of the root finite on a blank picture.
    root = torch.addcmul((0.5 * (uu - vv)).square(), uv, uv).clamp(min=1e-24).sqrt()
    return 0.5 * (uu + vv) - root


def good_features(
    gray: Float[Tensor, "B 1 H W"],
    budget: int = 500,
    quality: float | Float[Tensor, "B"] = 0.01,
    min_distance_px: float = 8.0,
    block: int = 3,
    allowed: Bool[Tensor, "B 1 H W"] | None = None,
    candidates: int | None = None,
    rounds: int = 12,
) -> tuple[Float[Tensor, "B N 2"], Float[Tensor, "B N"], Bool[Tensor, "B N"]]:
    """The places that cv2.goodFeaturesToTrack finds, best first: points, their eigenvalue, and which slots are filled.

    Local maxima above quality times the frame's maximum, among which the better of two that are closer than
    min_distance_px stays. Only the best `candidates` (default 4 x budget) maxima compete, and chains of more than
    `rounds` maxima of much the same strength that suppress one another in turn are cut short.
    """
    eigen = min_eigenvalue(gray, block)
    score = _above_quality(eigen, quality, allowed)
    # A maximum among all its neighbours, also those that are not allowed or lie on the frame's edge.
    peak = eigen == dilate(eigen, 3)
    flat = (score * peak).flatten(1)
    width = gray.shape[-1]
    taken = min(candidates or 4 * budget, flat.shape[1])
    best, index = flat.topk(taken, dim=1)
    points = torch.stack([index % width, index.div(width, rounding_mode="floor")], -1).to(gray.dtype)
    standing = best > 0
    standing = standing & _undisturbed(points, standing, min_distance_px, rounds)
    # Move the survivors to the front, in order of score; unique keys, because a stable sort does not export.
    budget_here = min(budget, taken)
    place = torch.arange(taken, device=gray.device)
    order = torch.where(standing, place, place + taken).sort(1).indices[:, :budget_here]
    chosen = points.gather(1, order[..., None].expand(-1, -1, 2))
    filled = standing.gather(1, order)
    missing = budget - budget_here
    return (
        functional.pad(chosen, (0, 0, 0, missing)),
        functional.pad(best.gather(1, order) * filled, (0, missing)),
        functional.pad(filled, (0, missing)),
    )


def grid_features(
    gray: Float[Tensor, "B 1 H W"],
    cell_px: int,
    quality: float | Float[Tensor, "B"] = 0.01,
    block: int = 3,
    allowed: Bool[Tensor, "B 1 H W"] | None = None,
    least: float = 1e-7,
) -> tuple[Float[Tensor, "B N 2"], Float[Tensor, "B N"], Bool[Tensor, "B N"]]:
    """The best pixel of every whole cell_px x cell_px cell, row by row: spread over the frame, and faster.

    N is the number of cells that lie in the frame as a whole, which may be none. valid where the cell holds a pixel
    above quality times the frame's maximum, and above `least`: the rounding that a blank picture shows.
    """
    eigen = min_eigenvalue(gray, block)
    admitted = eigen if allowed is None else eigen * allowed
    (height, width), batch = gray.shape[-2:], len(gray)
    rows, columns = height // cell_px, width // cell_px
    if not rows or not columns:
        return gray.new_zeros(batch, 0, 2), gray.new_zeros(batch, 0), gray.new_zeros(batch, 0, dtype=torch.bool)
    best, index = functional.max_pool2d(admitted, cell_px, cell_px, return_indices=True)
    best, index = best.flatten(1), index.flatten(1)
    points = torch.stack([index % width, index.div(width, rounding_mode="floor")], -1).to(gray.dtype)
    share = torch.as_tensor(quality, dtype=eigen.dtype, device=eigen.device).reshape(-1, 1)
    valid = best > (share * admitted.flatten(1).amax(1, keepdim=True)).clamp(min=least)
    return points, best * valid, valid


def _above_quality(eigen: Tensor, quality: float | Tensor, allowed: Tensor | None) -> Tensor:
    """Eigenvalues above quality x the maximum over what is allowed, else 0; nothing on the frame's outermost pixels."""
    height, width = eigen.shape[-2:]
    admitted = eigen if allowed is None else eigen * allowed
    threshold = torch.as_tensor(quality, dtype=eigen.dtype, device=eigen.device).reshape(-1, 1, 1, 1) * admitted.amax(
        (-2, -1), keepdim=True
    )
    inner = functional.pad(
        (admitted > threshold)[..., 1 : height - 1, 1 : width - 1],
        (min(1, width - 1), 1, min(1, height - 1), 1) if min(height, width) > 1 else (1, 0, 1, 0),
    )
    return torch.where(inner & (admitted > 0), admitted, torch.zeros_like(eigen))


def _undisturbed(points: Tensor, standing: Tensor, min_distance_px: float, rounds: int, chunk: int = 256) -> Tensor:
    """Which candidates, given best first, the greedy rule keeps: those that no better kept one is too close to.

    Chunk by chunk down the list. Inside a chunk, started from "all are kept", each round settles every candidate whose
    betters are settled; a few rounds reach the greedy result because chains of mutual suppression are short.
    """
    kept: list[Tensor] = []
    for start in range(0, points.shape[1], chunk):
        here, open_here = points[:, start : start + chunk], standing[:, start : start + chunk]
        if kept:
            close = _closer(here, points[:, :start], min_distance_px)
            open_here = open_here & ~(close & torch.cat(kept, 1)[:, None]).any(-1)
        rank = torch.arange(here.shape[1], device=here.device)
        disturbs = _closer(here, here, min_distance_px) & (rank < rank[:, None])
        keep_here = open_here
        for _ in range(rounds):
            keep_here = open_here & ~(disturbs & keep_here[:, None]).any(-1)
        kept.append(keep_here)
    return torch.cat(kept, 1)


def _closer(these: Tensor, those: Tensor, distance_px: float) -> Tensor:
    difference = these[:, :, None] - those[:, None]
    return difference[..., 0].square() + difference[..., 1].square() < distance_px**2
