"""Gaussian smoothing (appendix B, step S5), gradients, box sums, and what pictures are outside their edges.

On a CPU Kornia's convolutions hold a copy of the picture for every weight: its Gaussian takes five times the memory and
1.1 to 1.7 times the time, its `sobel` and `box_blur` 5 to 10 times that of `mean_gradient`
(`python eval/speed.py operations`).

Outside its edges a picture is mirrored, the edge pixel not repeated: Kornia's border `reflect`, OpenCV's 101.
"""

from collections.abc import Callable, Sequence

import cv2
import torch
from jaxtyping import Bool, Float, Int64, Shaped, UInt8
from kornia import filters
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.errors import InputError
from torchvision_dddas.functional.soft import is_traced

# Pixels in work at once on a CPU: temporaries then stay in its cache, and their memory is used again.
_STRIP_PIXELS = 100_000


def gaussian_blur2d(
    input: Shaped[Tensor, "B C H W"],  # noqa: A002 (Kornia's name)
    kernel_size: int | tuple[int, int],
    sigma: tuple[float, float] | None = None,
    border_type: str = "reflect",
) -> Shaped[Tensor, "B C H W"]:
    """`kornia.filters.gaussian_blur2d`, which is called where a sigma is given; without one, cv2.GaussianBlur.

    OpenCV's own weights are binomial for small kernels, the border is mirrored, and pictures may be of any size. Bytes
    stay bytes, halves rounded up: equal to OpenCV's up to a kernel of 9; beyond, OpenCV rounds its weights, and one
    level may differ.

    Raises InputError for an even size, and another border without a sigma.
    """
    if isinstance(kernel_size, int) and (kernel_size < 1 or kernel_size % 2 == 0):
        raise InputError(f"kernel_size must be odd and at least 1, got {kernel_size}")
    if sigma is None and border_type != "reflect":
        raise InputError(f"border_type must be reflect where no sigma is given, got {border_type}; give a sigma")
    if sigma is not None or not isinstance(kernel_size, int):
        blurred: Tensor = filters.gaussian_blur2d(input, kernel_size, sigma or (0.0, 0.0), border_type)
        return blurred
    if kernel_size == 1:
        return input
    weights: list[float] = cv2.getGaussianKernel(kernel_size, 0).ravel().tolist()
    border = (kernel_size // 2,) * 4
    if input.dtype != torch.uint8:
        return _weighted(_weighted(pad_reflect(input, *border), weights, -1), weights, -2)
    if kernel_size > 9:
        return to_bytes(gaussian_blur2d(input.float(), kernel_size) + 0.5)
    # Sums in whole numbers are exact, and 16 bits hold those of the small kernels at half the time of floats.
    unit = {3: 4, 5: 16, 7: 64, 9: 256}[kernel_size]
    whole = [round(weight * unit) for weight in weights]
    across = _weighted(pad_reflect(input, *border).to(torch.int16 if kernel_size < 9 else torch.int32), whole, -1)
    if kernel_size > 5 or is_traced():
        return to_bytes(_weighted(across.float(), whole, -2).mul_(1.0 / unit**2).add_(0.5))
    # A sum of up to 65280 wraps into the sign of 16 bits; its high byte, which is what is wanted, does not care.
    down = _weighted(across, whole, -2)
    return down.mul_(256 // unit**2).add_(128).bitwise_right_shift_(8).to(torch.uint8)


def _weighted(padded: Tensor, weights: Sequence[float], dim: int) -> Tensor:
    """Weighted sum of shifts along one axis; symmetric weights."""
    middle = len(weights) // 2
    length = padded.shape[dim] - 2 * middle
    total = padded.narrow(dim, middle, length) * weights[middle]
    for shift in range(1, middle + 1):
        for place in (middle - shift, middle + shift):
            total.add_(padded.narrow(dim, place, length), alpha=weights[middle + shift])
    return total


def box_sum(values: Shaped[Tensor, "B C H W"], block: int) -> Shaped[Tensor, "B C H W"]:
    """Sum over block x block pixels, mirrored at the edges, anchored where OpenCV's box filter is."""
    before, after = block // 2, block - 1 - block // 2
    padded = pad_reflect(values, before, after, before, after)
    for dim in (-2, -1):
        size = padded.shape[dim] - block + 1
        total = padded.narrow(dim, 0, size) + padded.narrow(dim, 1, size) if block > 1 else padded
        for shift in range(2, block):
            total += padded.narrow(dim, shift, size)
        padded = total
    return padded


def mean_gradient(levels: Shaped[Tensor, "B 1 H W"], block: int = 5) -> Shaped[Tensor, "B 1 H W"]:
    """Mean gradient magnitude over block x block pixels, 4 x grey levels a pixel, for pictures in whole grey levels.

    Half of `kornia.filters.sobel` without normalisation, through `box_blur`; rounded to whole numbers and cut off at
    255 before and after the mean, as OpenCV's 8-bit pictures are. Kornia's `sobel` repeats the edge pixel: the rim
    differs. No gradient passes.
    """
    padded = pad_reflect(levels.detach(), 1, 1, 1, 1)
    steep = padded[..., 2:, :] - padded[..., :-2, :]
    smooth = torch.add(padded[..., 2:, :] + padded[..., :-2, :], padded[..., 1:-1, :], alpha=2.0)
    across = smooth[..., 2:] - smooth[..., :-2]
    down = torch.add(steep[..., 2:] + steep[..., :-2], steep[..., 1:-1], alpha=2.0)
    magnitude = across.square_().addcmul_(down, down).sqrt_().mul_(0.5).round_().clamp_(max=255.0)
    return (box_sum(magnitude, block) / block**2).round()


def to_bytes(levels: Float[Tensor, "*any"]) -> UInt8[Tensor, "*any"]:
    """Numbers in [0, 256), cut down to whole ones."""
    # By way of 16 bits in a third of the time.
    return levels.to(torch.int16).to(torch.uint8)


def is_above(levels: UInt8[Tensor, "*any"], limit: int) -> Bool[Tensor, "*any"]:
    """Where levels are above the limit, in a sixth of the time that torch takes to compare bytes."""
    if is_traced() or not 0 <= limit < 255:
        # Torch would cut a whole number down to a byte: 300 to 44.
        return levels > float(limit)
    return levels.clamp(limit, limit + 1).sub_(limit).view(torch.bool)


def in_strips(work: Callable[[Tensor], Tensor], picture: Tensor, reach: int) -> Tensor:
    """work(picture), where a pixel of the result depends on `reach` rows on either side at most.

    On a CPU in strips of rows: several times as fast on large pictures. At once on other devices, for graphs, and where
    the picture takes gradients.
    """
    height = picture.shape[-2]
    step = strip_rows(picture, height, picture.numel() // max(height, 1))
    if step >= height:
        return work(picture)
    parts = []
    for top in range(0, height, step):
        above = min(top, reach)
        done = work(picture[..., top - above : top + step + reach, :])
        parts.append(done[..., above : above + step, :])
    return torch.cat(parts, -2)


def strip_rows(like: Tensor, height: int, row: int) -> int:
    """How many of `height` rows of `row` numbers are worked on at once; see `in_strips`."""
    if like.device.type != "cpu" or (like.requires_grad and torch.is_grad_enabled()) or is_traced():
        return height
    return max(_STRIP_PIXELS // max(row, 1), 8)


def pad_reflect(
    image: Shaped[Tensor, "B C H W"], left: int, right: int, top: int, bottom: int
) -> Shaped[Tensor, "B C h w"]:
    """As `torch.nn.functional.pad` in mode `reflect`; where a side is smaller than the border the mirror repeats."""
    height, width = image.shape[-2:]
    if max(left, right) < width and max(top, bottom) < height:
        return functional.pad(image, (left, right, top, bottom), mode="reflect")
    rows = reflect_index(torch.arange(-top, height + bottom, device=image.device), height)
    columns = reflect_index(torch.arange(-left, width + right, device=image.device), width)
    return image.index_select(-2, rows).index_select(-1, columns)


def reflect_index(index: Int64[Tensor, "*any"], size: int) -> Int64[Tensor, "*any"]:
    """The pixel inside 0 .. size - 1 that an index outside mirrors."""
    period = max(2 * (size - 1), 1)
    folded = index.remainder(period)
    return torch.minimum(folded, period - folded) if size > 1 else torch.zeros_like(index)
