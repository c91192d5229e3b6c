"""Seeing one frame from where another was taken (appendix B, step S3).

kornia.geometry.warp_perspective needs 9x OpenCV's time on a CPU, one `grid_sample` over a broadcast grid 3-4x.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from .homography import invert


def warp(
    image: Float[Tensor, "B C H W"],
    reference_from_frame: Float[Tensor, "B 3 3"],
    size: tuple[int, int] | None = None,
    fill: float = 0.0,
    nearest: bool = False,
    subpixels: int = 0,
) -> tuple[Float[Tensor, "B C h w"], Bool[Tensor, "B 1 h w"]]:
    """The frame in reference coordinates, and where it was seen there; `fill` elsewhere.

    size: (height, width) of the result, by default the frame's. A pixel is inside when all four pixels that it is
    interpolated from are (nearest: the one that it is taken from). subpixels: round positions to 1/subpixels px; 32 is
    what cv2.warpPerspective does, at up to 3 grey levels on sharp edges; 0 does not round, and passes gradients.
    """
    height, width = image.shape[-2:]
    u, v, inside = source_positions(reference_from_frame, size or (height, width), (height, width), nearest)
    if subpixels:
        u, v = (u * subpixels).round() / subpixels, (v * subpixels).round() / subpixels
    grid = torch.stack([u * (2.0 / width) + (1.0 / width - 1.0), v * (2.0 / height) + (1.0 / height - 1.0)], -1)
    mode = "nearest" if nearest else "bilinear"
    # Positions outside are masked, so the border's way of padding only has to keep the arithmetic finite.
    warped = functional.grid_sample(image, grid, mode=mode, padding_mode="border", align_corners=False)
    return torch.where(inside, warped, torch.full_like(warped[:, :1], fill)), inside


def source_positions(
    reference_from_frame: Float[Tensor, "B 3 3"],
    reference_size: tuple[int, int],
    frame_size: tuple[int, int],
    nearest: bool = False,
) -> tuple[Float[Tensor, "B h w"], Float[Tensor, "B h w"], Bool[Tensor, "B 1 h w"]]:
    """For every reference pixel where it lies in the frame (u, v in pixels), and whether that is inside the frame."""
    frame_from_reference = invert(reference_from_frame)
    (height, width), dtype, device = frame_size, reference_from_frame.dtype, reference_from_frame.device
    rows = torch.arange(reference_size[0], dtype=dtype, device=device)[:, None]
    columns = torch.arange(reference_size[1], dtype=dtype, device=device)
    h = frame_from_reference[..., None, None]
    depth = torch.add(h[:, 2, 0] * columns, h[:, 2, 1] * rows + h[:, 2, 2])
    ahead = depth > 1e-6
    inverse = torch.where(ahead, depth, torch.ones_like(depth)).reciprocal()
    u = torch.add(h[:, 0, 0] * columns, h[:, 0, 1] * rows + h[:, 0, 2]) * inverse
    v = torch.add(h[:, 1, 0] * columns, h[:, 1, 1] * rows + h[:, 1, 2]) * inverse
    # Rounding must not put the edge of a frame that did not move outside.
    margin = 0.5 if nearest else 1e-3
    inside = ahead & (u >= -margin) & (u <= width - 1 + margin) & (v >= -margin) & (v <= height - 1 + margin)
    return u, v, inside[:, None]
