"""Good features to track: where both eigenvalues of the structure tensor are large (appendix B, step S1).

The window is OpenCV's box, not the Gaussian of kornia.feature.gftt_response. Kornia's gradients under its box take
2 to 7 times as long on a CPU (`python eval/speed.py operations`). The picture is mirrored outside, as by OpenCV;
Kornia's gradients repeat the edge pixel.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.functional.filters import box_sum, in_strips, pad_reflect


def corner_min_eigenvalue(gray: Float[Tensor, "B 1 H W"], block: int = 3) -> Float[Tensor, "B 1 H W"]:
    """Smaller eigenvalue of the structure tensor summed over block x block pixels: cv2.cornerMinEigenVal's values."""
    return in_strips(lambda strip: _min_eigenvalue(strip, block), gray, 1 + block // 2)


def _min_eigenvalue(gray: Tensor, block: int) -> Tensor:
    padded = pad_reflect(gray, 1, 1, 1, 1)
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


def grid_features(
    gray: Float[Tensor, "B 1 H W"],
    cell_px: int,
    quality: float | Float[Tensor, "B"] = 0.01,
    block: int = 3,
    least: float = 1e-7,
) -> tuple[Float[Tensor, "B N 2"], Float[Tensor, "B N"], Bool[Tensor, "B N"]]:
    """The best pixel of every whole cell_px x cell_px cell, row by row: spread over the frame, and faster.

    N is the number of cells that lie in the frame as a whole, which may be none. valid where the cell holds a pixel
    above quality times the frame's maximum, and above `least`: the rounding that a blank picture shows.
    """
    eigen = corner_min_eigenvalue(gray, block)
    (height, width), batch = gray.shape[-2:], len(gray)
    rows, columns = height // cell_px, width // cell_px
    if not rows or not columns:
        return gray.new_zeros(batch, 0, 2), gray.new_zeros(batch, 0), gray.new_zeros(batch, 0, dtype=torch.bool)
    best, index = functional.max_pool2d(eigen, cell_px, cell_px, return_indices=True)
    best, index = best.flatten(1), index.flatten(1)
    points = torch.stack([index % width, index.div(width, rounding_mode="floor")], -1).to(gray.dtype)
    share = torch.as_tensor(quality, dtype=eigen.dtype, device=eigen.device).reshape(-1, 1)
    valid = best > (share * eigen.flatten(1).amax(1, keepdim=True)).clamp(min=least)
    return points, best * valid, valid
