"""Good features to track: points where both eigenvalues of the structure tensor are large (appendix B, step S1).

The window is OpenCV's box, not the Gaussian of kornia.feature.gftt_response. Kornia's gradients with this box take 2 to
7 times as long on a CPU (`python eval/speed.py operations`). The picture is mirrored beyond its edges, as in OpenCV;
Kornia's gradients repeat the edge pixel.
"""

import torch
from jaxtyping import Bool, Float
from kornia.filters import box_blur, spatial_gradient
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.chain import uses_kornia
from torchvision_dddas.functional.filters import box_sum, in_strips, pad_reflect
from torchvision_dddas.functional.soft import is_traced


def corner_min_eigenvalue(gray: Float[Tensor, "B 1 H W"], *, block: int = 3) -> Float[Tensor, "B 1 H W"]:
    """Return the smaller eigenvalue of the structure tensor over block x block pixels, as cv2.cornerMinEigenVal does.

    >>> picture = torch.zeros(1, 1, 16, 16)
    >>> picture[..., 8:, 8:] = 1
    >>> strength = F.corner_min_eigenvalue(picture)[0, 0]
    >>> bool(strength[8, 8] > strength[8, 14])
    True
    """
    if uses_kornia("corners", gray.device.type) and not is_traced():
        return _min_eigenvalue_by_kornia(gray, block)
    return in_strips(lambda strip: _min_eigenvalue(strip, block), gray, 1 + block // 2)


def _min_eigenvalue_by_kornia(gray: Tensor, block: int) -> Tensor:
    # Kornia's Sobel filters return an eighth of OpenCV's sums, and its box a mean.
    du, dv = spatial_gradient(gray, order=1).mul(2.0 / block).unbind(2)
    uu, vv, uv = (box_blur(product, block).mul(block**2) for product in (du * du, dv * dv, du * dv))
    return 0.5 * (uu + vv) - torch.addcmul((0.5 * (uu - vv)).square(), uv, uv).clamp(min=1e-24).sqrt()


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
    *,
    quality: float | Float[Tensor, "B"] = 0.01,
    block: int = 3,
    least: float = 1e-7,
) -> tuple[Float[Tensor, "B N 2"], Float[Tensor, "B N"], Bool[Tensor, "B N"]]:
    """Return the best pixel of every cell of cell_px x cell_px, row by row, its score, and whether it is valid.

    They spread over the frame, and are found faster than the best of the frame. N is the number of whole
    cells in the frame, possibly 0. valid: the score is above quality times the frame's maximum, and above `least`,
    which exceeds the rounding of a blank picture.

    >>> points, score, valid = F.grid_features(torch.rand(1, 1, 64, 64), 16)
    >>> points.shape, valid.shape
    (torch.Size([1, 16, 2]), torch.Size([1, 16]))
    """
    eigen = corner_min_eigenvalue(gray, block=block)
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


def frame_features(
    gray: Float[Tensor, "B 1 H W"],
    count: int,
    *,
    quality: float = 0.01,
    min_distance_px: float = 8.0,
    block: int = 3,
    least: float = 1e-7,
) -> tuple[Float[Tensor, "B N 2"], Bool[Tensor, "B N"]]:
    """Return the best `count` corners of the frame, best first, and whether each exists, as cv2.goodFeaturesToTrack.

    A corner is a local maximum (3 x 3) above quality times the frame's maximum and above `least`, not in the frame's
    outermost pixels. A corner is left out if it is nearer than min_distance_px to a better corner that is kept. Only
    the best 4 x count corners are examined.

    >>> points, valid = F.frame_features(F.gaussian_blur2d(torch.rand(1, 1, 64, 64), 7), 20)
    >>> points.shape, bool(valid.all())
    (torch.Size([1, 20, 2]), True)
    """
    eigen = corner_min_eigenvalue(gray, block=block)
    limit = (quality * eigen.amax((1, 2, 3), keepdim=True)).clamp(min=least)
    peak = (eigen == functional.max_pool2d(eigen, 3, 1, 1)) & (eigen > limit)
    inside = torch.zeros_like(peak)
    inside[..., 1:-1, 1:-1] = True
    value = torch.where(peak & inside, eigen, 0.0).flatten(1)
    value, index = value.topk(min(4 * count, value.shape[1]))
    width = gray.shape[-1]
    points = torch.stack([index % width, index.div(width, rounding_mode="floor")], -1).to(gray.dtype)
    is_near = (torch.cdist(points, points) < min_distance_px).tril(-1)  # a better corner is near
    found = kept = value > 0
    while True:  # decide from the best corner on; every round decides at least one more corner
        before, kept = kept, found & ~(is_near & kept[:, None]).any(2)
        if torch.equal(before, kept):
            break
    first = kept.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, :count]
    return points.gather(1, first[..., None].expand(-1, -1, 2)), kept.gather(1, first)
