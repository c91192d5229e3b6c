"""Seeing one frame from where another was taken (appendix B, step S3).

kornia.geometry.warp_perspective needs 9x OpenCV's time on a CPU, one `grid_sample` over a broadcast grid 3-4x.
"""

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.functional.homography import invert


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


def sample(
    image: Float[Tensor, "B C H W"],
    frame_from_reference: Float[Tensor, "B 3 3"],
    size: tuple[int, int] | None = None,
    subpixels: int = 32,
) -> Float[Tensor, "B C h w"]:
    """As `warp` without a mask: the frame's edge pixels continue outside it, and positions come from one product.

    Positions are rounded to 1/subpixels px as by cv2.warpPerspective, so this passes no gradient to the matrix; the
    caller rounds the grey levels.
    """
    height, width = image.shape[-2:]
    rows, columns = size or (height, width)
    matrix = frame_from_reference.double()
    u = torch.arange(columns, dtype=torch.float64, device=image.device)
    # Row y is [1, y] times a table whose columns are u, v, u, v, ...: the layout that `grid_sample` reads.
    table = torch.stack(
        [matrix[:, None, :, 0] * u[:, None] + matrix[:, None, :, 2], matrix[:, None, :, 1].expand(-1, columns, -1)], 1
    )
    ones = torch.ones(rows, dtype=torch.float64, device=image.device)
    row = torch.stack([ones, torch.arange(rows, dtype=torch.float64, device=image.device)], -1).to(image.dtype)
    place = row @ (table[..., :2] * subpixels).flatten(2).to(image.dtype)
    place /= row @ table[..., 2:].expand(-1, -1, -1, 2).flatten(2).to(image.dtype)
    # Once for every column: other runtimes are slow where two numbers meet a picture of pairs.
    per_pixel = torch.tensor([2.0 / width, 2.0 / height], dtype=image.dtype, device=image.device).repeat(columns)
    place = torch.addcmul(per_pixel / 2 - 1, place.round_(), per_pixel / subpixels).unflatten(-1, (columns, 2))
    return functional.grid_sample(image, place, mode="bilinear", padding_mode="border", align_corners=False)


def seen_columns(
    frame_from_reference: Float[Tensor, "B 3 3"],
    size: tuple[int, int],
    frame_size: tuple[int, int],
    border_px: int = 0,
) -> tuple[Int32[Tensor, "B h"], Int32[Tensor, "B h"]]:
    """First and last column of every reference row that the frame shows; first > last where it shows none.

    size, frame_size: (height, width). A strip border_px wide inside the frame's border counts as outside. The nearest
    frame pixel decides. The frame's outline is convex, so every row sees one run of columns.
    """
    height, width = frame_size
    matrix = frame_from_reference.double()
    along_u, along_v, depth = matrix.unbind(1)
    low, right, bottom = border_px - 0.5, width - border_px - 0.5, height - border_px - 0.5
    # Each edge, and being in front of the camera, is a half plane a x + b y + c >= 0.
    planes = [along_u - low * depth, right * depth - along_u, along_v - low * depth, bottom * depth - along_v, depth]
    a, b, c = torch.stack(planes, 1).unbind(-1)
    rows = torch.arange(size[0], dtype=torch.float64, device=matrix.device)
    rest = b[..., None] * rows + c[..., None]
    a = a[..., None]
    edge = -rest / torch.where(a == 0, torch.ones_like(a), a)
    first = torch.where(a > 0, edge, torch.full_like(edge, -1.0)).amax(1)
    last = torch.where(a < 0, edge, torch.full_like(edge, float(size[1]))).amin(1)
    unseen = ((a == 0) & (rest < 0)).any(1)
    first = first.clamp(0, size[1]).ceil().int().masked_fill(unseen, size[1])
    return first, last.clamp(-1, size[1] - 1).floor().int()


def between(first: Int32[Tensor, "B h"], last: Int32[Tensor, "B h"], width: int) -> Bool[Tensor, "B 1 h w"]:
    """The columns from first to last of every row, as a mask."""
    columns = torch.arange(width, dtype=first.dtype, device=first.device)
    return ((columns >= first[..., None]) & (columns <= last[..., None]))[:, None]
