"""Warp one frame into another (appendix B, step S3), and resize pictures.

On a CPU, Kornia's warp_perspective takes 4 to 6 times as long as its `remap` with maps made by broadcasting, in strips
that stay in the cache. Its resize takes 0.3 of the time of the exact one here (`python eval/speed.py operations`).
"""

from contextlib import suppress

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int32, Int64, Shaped
from kornia.geometry import remap
from torch import Tensor

from torchvision_dddas.errors import InputError
from torchvision_dddas.functional.filters import strip_rows, to_bytes
from torchvision_dddas.functional.plane_maps import invert_map
from torchvision_dddas.functional.soft import is_traced

# Strips of fewer rows need too many calls.
_LEAST_ROWS = 64


def warp_perspective(
    src: Float[Tensor, "B C H W"],
    M: Float[Tensor, "B 3 3"],
    dsize: tuple[int, int],
    mode: str = "bilinear",
    padding_mode: str = "zeros",
    *,
    inverse_map: bool = False,
    subpixels: int = 0,
    whole: bool = False,
) -> Shaped[Tensor, "B C h w"]:
    """Warp as `kornia.geometry.warp_perspective`: M maps pixels of the picture to pixels of the result.

    Pixels are (u, v) from the centre of the first pixel. dsize: (height, width). Positions are as with Kornia's
    align_corners=True. padding_mode: zeros, or border to repeat edge pixels outside. inverse_map: M maps the result's
    pixels to the picture's, as with cv2.WARP_INVERSE_MAP. subpixels: round positions to 1/subpixels px (32 in
    cv2.warpPerspective), so that no gradient reaches M; 0: do not round.
    whole: return bytes, halves rounded up; the pictures are grey levels up to 255. Raise InputError for another
    padding_mode, and unless src is a batch of pictures and M has one matrix for each.

    >>> picture = torch.arange(4.0).expand(1, 1, 4, 4)
    >>> right = torch.tensor([[[1.0, 0, 1], [0, 1, 0], [0, 0, 1]]])
    >>> F.warp_perspective(picture, right, (4, 4))[0, 0, 0]
    tensor([0., 0., 1., 2.])
    """
    check_batch("src", src, "(B, C, H, W)", 4)
    check_batch("M", M, "(B, 3, 3)", 3)
    if not src.is_floating_point():
        raise InputError(f"src must be of a floating-point type, got {src.dtype}: src.float()")
    if not is_traced() and M.shape[1:] != (3, 3):
        raise InputError(f"M must have the shape (B, 3, 3), got {tuple(M.shape)}; add the row 0, 0, 1 to affine maps")
    if not is_traced() and np.shape(dsize) != (2,):
        raise InputError(f"dsize must be (height, width), got {dsize}; tuple(src.shape[-2:]) keeps the size of src")
    if not is_traced() and len(M) != len(src):
        raise InputError(f"M has {len(M)} matrices for {len(src)} pictures: M.expand(len(src), -1, -1)")
    if padding_mode not in ("zeros", "border"):
        raise InputError(f"padding_mode must be zeros or border, got {padding_mode}; Kornia's function takes others")
    rows, columns = dsize
    matrix = M.double() if inverse_map else invert_map(M.double())
    u = torch.arange(columns, dtype=torch.float64, device=src.device)
    # The positions of row y are start + y * slope, in steps of the rounding.
    scale = matrix.new_tensor([max(subpixels, 1), max(subpixels, 1), 1])[:, None]
    start = ((matrix[:, :, 0, None] * u + matrix[:, :, 2:]) * scale).to(src.dtype)[:, :, None]
    slope = (matrix[:, :, 1, None] * scale).to(src.dtype)[:, :, None]
    # Kornia's normalised positions are -1 and 1 at the centres of the first and the last pixel.
    units = [2.0 / (max(subpixels, 1) * max(side - 1, 1e-9)) for side in (src.shape[-1], src.shape[-2])]
    y = torch.arange(rows, dtype=src.dtype, device=src.device)[:, None]

    def sample(y: Tensor) -> Tensor:
        along_u, along_v, depth = (torch.addcmul(start[:, k], y, slope[:, k]) for k in range(3))
        places = [along_u / depth, along_v / depth]
        if subpixels:
            places = [place.round_() for place in places]
        map_x, map_y = (place * unit - 1.0 for place, unit in zip(places, units, strict=True))
        found = remap(src, map_x, map_y, mode, padding_mode, align_corners=True, normalized_coordinates=True)
        return to_bytes(found.add_(0.5)) if whole else found

    step = max(strip_rows(src if src.requires_grad else M, rows, 2 * len(src) * columns), _LEAST_ROWS)
    return torch.cat([sample(y[top : top + step]) for top in range(0, rows, step)], -2)


def check_batch(name: str, value: object, shape: str, axes: int) -> None:
    """Raise InputError, with code that converts the value, unless it is a tensor with this number of axes."""
    if isinstance(value, Tensor) and value.dim() == axes:
        return
    code, shown = name, getattr(value, "shape", None)
    if not isinstance(value, Tensor):
        with suppress(ValueError, TypeError):
            shown = np.shape(np.asarray(value))  # this also takes lists
        code = f"torch.as_tensor({name})"
        code += ".permute(2, 0, 1) / 255" if axes == 4 and shown is not None and len(shown) == 3 else ""
    got, missing = f"{type(value).__name__} {tuple(shown or ())}", axes - len(shown or ())
    raise InputError(f"{name} must be a tensor {shape}, got {got}: " + f"({code})" + "[None]" * max(missing, 0))


def seen_columns(
    frame_from_reference: Float[Tensor, "B 3 3"],
    size: tuple[int, int],
    frame_size: tuple[int, int],
    *,
    border_px: int = 0,
) -> tuple[Int32[Tensor, "B h"], Int32[Tensor, "B h"]]:
    """Return the first and last column of every reference row that the frame shows; first > last if it shows none.

    size, frame_size: (height, width). A strip border_px wide inside the frame's border counts as outside. The nearest
    frame pixel decides. The frame's outline is convex, so every row shows one run of columns.

    >>> moved = torch.tensor([[[1.0, 0, 2], [0, 1, 0], [0, 0, 1]]])
    >>> F.seen_columns(moved, (2, 6), (2, 6))
    (tensor([[0, 0]], dtype=torch.int32), tensor([[3, 3]], dtype=torch.int32))
    """
    height, width = frame_size
    matrix = frame_from_reference.double()
    along_u, along_v, depth = matrix.unbind(1)
    low, right, bottom = border_px - 0.5, width - border_px - 0.5, height - border_px - 0.5
    # Each edge, and the condition of being in front of the camera, is a half plane a x + b y + c >= 0.
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


def columns_between(first: Int32[Tensor, "B h"], last: Int32[Tensor, "B h"], width: int) -> Bool[Tensor, "B 1 h w"]:
    """Return a mask of the columns from first to last of every row.

    >>> F.columns_between(torch.tensor([[1, 2]]), torch.tensor([[2, 1]]), 4)[0, 0].int()
    tensor([[0, 1, 1, 0],
            [0, 0, 0, 0]], dtype=torch.int32)
    """
    columns = torch.arange(width, dtype=first.dtype, device=first.device)
    if is_traced():
        return ((columns >= first[..., None]) & (columns <= last[..., None]))[:, None]
    # Torch compares slowly. Row k of these steps is 1 from column width - k on.
    steps = torch.cat([torch.zeros_like(columns), torch.ones_like(columns)]).bool().unfold(0, width, 1)
    return (steps[(width - first).long()] & ~steps[(width - 1 - last).long()])[:, None]


def seen_by_both(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor], width: int) -> Bool[Tensor, "B 1 h w"]:
    """Return the mask of the pixels that two frames show. one, other: as `seen_columns` returns them.

    >>> moved = torch.tensor([[[1.0, 0, 2], [0, 1, 0], [0, 0, 1]]])
    >>> one, other = F.seen_columns(torch.eye(3)[None], (4, 6), (4, 6)), F.seen_columns(moved, (4, 6), (4, 6))
    >>> F.seen_by_both(one, other, 6)[0, 0, 0].int()
    tensor([1, 1, 1, 1, 0, 0], dtype=torch.int32)
    """
    return columns_between(torch.maximum(one[0], other[0]), torch.minimum(one[1], other[1]), width)


def resize(
    input: Float[Tensor, "B C H W"],  # noqa: A002 (Kornia's name)
    size: tuple[int, int],
    *,
    rows: Int64[Tensor, "h"] | None = None,
    columns: Int64[Tensor, "w"] | None = None,
    rounded: bool = False,
) -> Float[Tensor, "B C h w"]:
    """Resize pictures to (height, width) as `kornia.geometry.resize` without antialiasing.

    With `rounded` the result equals OpenCV's INTER_LINEAR_EXACT on 8-bit levels, bit for bit. Beyond the edge, the edge
    pixel is repeated. The pyramid of a HOG detector needs these weights, which are rounded to 1/256: plain
    interpolation moves the scores of a trained detector by up to 0.15.

    rows, columns: the wanted rows and columns of the result, in any order and number; all by default.
    rounded: input is levels 0 .. 255, the result whole levels, halves up. For whole levels every sum is a multiple of
    1/65536 below 256, which float32 holds exactly, so that every device gives OpenCV's result. Gradients pass the
    rounding unchanged. Not rounded, the result is linear in the levels.

    >>> F.resize(torch.rand(1, 3, 48, 64), (24, 32)).shape
    torch.Size([1, 3, 24, 32])
    """
    height, width = input.shape[-2:]
    found = _rows(input, *_taps(height, size[0]), rows)
    # Rows are copied as they lie in memory. Copying columns one by one would take twice the time.
    found = _rows(found.transpose(-1, -2).contiguous(), *_taps(width, size[1]), columns).transpose(-1, -2)
    if not rounded:
        return found.contiguous()
    whole = (found.detach() + 0.5).floor_()
    return found + (whole - found.detach()) if found.requires_grad else whole.contiguous()


def _taps(have: int, wanted: int) -> tuple[Int64[Tensor, "n"], Float64[Tensor, "n"]]:
    """Return for each place of the result the first of its two sources, and the second's share, a multiple of 1/256.

    The step is computed as in OpenCV, 1 / (wanted / have), which differs from have / wanted in the last bit.
    """
    at = (torch.arange(wanted, dtype=torch.float64) + 0.5) * (1.0 / (wanted / have)) - 0.5
    left = at.floor()
    inside = (left >= 0) & (left < have - 1)
    share = torch.where(inside, ((at - left) * 256).round() / 256, torch.zeros_like(at))
    return left.clamp(0, have - 1).long(), share


def _rows(levels: Tensor, first: Tensor, share: Tensor, places: Tensor | None) -> Tensor:
    """Interpolate rows: all, or those at the given places."""
    first, share = first.to(levels.device), share.to(levels)
    if places is not None:
        first, share = first[places], share[places]
    second = (first + 1).clamp(max=levels.shape[-2] - 1)
    return torch.lerp(levels.index_select(-2, first), levels.index_select(-2, second), share[:, None])
