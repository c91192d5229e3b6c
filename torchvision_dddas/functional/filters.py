"""Gaussian smoothing (appendix B, step S5), gradients, box sums, and the continuation of pictures beyond their edges.

On a CPU, Kornia's `sobel` and `box_blur` take 5 to 10 times as long as `mean_gradient` (`python eval/speed.py
operations`). Kornia's Gaussian is fastest on whole batches; in strips of rows it takes 2 to 8 times as long.

Pictures are mirrored beyond their edges without repeating the edge pixel: Kornia's border `reflect`, OpenCV's 101.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int64, Shaped, UInt8
from kornia import filters
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.chain import uses_kornia
from torchvision_dddas.errors import InputError
from torchvision_dddas.functional.soft import is_traced

# With these sigmas the weights are nearest to the binomial weights that OpenCV uses for small kernels.
_SIGMAS = {3: 0.8493, 5: 1.0647, 7: 1.4474, 9: 1.7054}
# Number of pixels that are processed at once on a CPU, so that temporaries stay in the cache and are reused.
_STRIP_PIXELS = 100_000


def gaussian_blur2d(
    input: Shaped[Tensor, "B C H W"],  # noqa: A002 (Kornia's name)
    kernel_size: int | tuple[int, int],
    sigma: tuple[float, float] | Tensor | None = None,
    border_type: str = "reflect",
) -> Shaped[Tensor, "B C H W"]:
    """Smooth as `kornia.filters.gaussian_blur2d` does; without a sigma as cv2.GaussianBlur. Bytes stay bytes.

    Halves are rounded up. Pictures may have any size. Weights up to size 9 differ from OpenCV's by up to 0.006.

    Raise InputError for an even size, and for another border than `reflect` without a sigma.

    >>> F.gaussian_blur2d(torch.ones(1, 1, 8, 8), 5)[0, 0, 4, 4]
    tensor(1.)
    """
    if sigma is not None:
        blurred: Tensor = filters.gaussian_blur2d(input, kernel_size, sigma, border_type)
        return blurred
    sides = (kernel_size, kernel_size) if isinstance(kernel_size, int) else kernel_size
    if any(side < 1 or side % 2 == 0 for side in sides):
        raise InputError(f"kernel_size must be odd and at least 1, got {kernel_size}")
    if border_type != "reflect":
        raise InputError(f"border_type must be reflect without a sigma, got {border_type}; give a sigma")
    if sides == (1, 1):
        return input
    sigma = (_SIGMAS.get(sides[0], 0.15 * sides[0] + 0.35), _SIGMAS.get(sides[1], 0.15 * sides[1] + 0.35))

    levels = input.float() if input.dtype == torch.uint8 else input
    down, across = sides[0] // 2, sides[1] // 2
    if down < levels.shape[-2] and across < levels.shape[-1]:
        blurred = filters.gaussian_blur2d(levels, sides, sigma, border_type)
    else:  # Kornia mirrors only once
        padded = pad_reflect(levels, across, across, down, down)
        around = filters.gaussian_blur2d(padded, sides, sigma, "constant")
        blurred = around[..., down : down + levels.shape[-2], across : across + levels.shape[-1]]
    return to_bytes(blurred.add_(0.5)) if input.dtype == torch.uint8 else blurred


def box_sum(values: Shaped[Tensor, "B C H W"], block: int) -> Shaped[Tensor, "B C H W"]:
    """Return the sum over block x block pixels, mirrored at the edges, anchored as in OpenCV's box filter.

    >>> F.box_sum(torch.ones(1, 1, 4, 4), 3)[0, 0, 1]
    tensor([9., 9., 9., 9.])
    """
    before, after = block // 2, block - 1 - block // 2
    padded = pad_reflect(values, before, after, before, after)
    for dim in (-2, -1):
        size = padded.shape[dim] - block + 1
        total = padded.narrow(dim, 0, size) + padded.narrow(dim, 1, size) if block > 1 else padded
        for shift in range(2, block):
            total += padded.narrow(dim, shift, size)
        padded = total
    return padded


def mean_gradient(levels: Shaped[Tensor, "B 1 H W"], *, block: int = 5) -> Shaped[Tensor, "B 1 H W"]:
    """Return the mean gradient magnitude over block x block pixels, in 4 x grey levels a pixel, of whole grey levels.

    It is half of `kornia.filters.sobel` without normalisation, then `box_blur`. As in OpenCV's 8-bit pictures, values
    are rounded and clipped at 255 before and after the mean. Kornia's `sobel` repeats the edge pixel, so the rim
    differs. No gradient passes.

    >>> slope = torch.arange(8.0).expand(1, 1, 8, 8)
    >>> F.mean_gradient(slope)[0, 0, 4, 4]
    tensor(4.)
    """
    if uses_kornia("gradient", levels.device.type) and not is_traced():
        slope = filters.sobel(levels.detach(), normalized=False, eps=0.0).mul(0.5).round_().clamp_(max=255.0)
        return filters.box_blur(slope, block).round_()
    padded = pad_reflect(levels.detach(), 1, 1, 1, 1)
    steep = padded[..., 2:, :] - padded[..., :-2, :]
    smooth = torch.add(padded[..., 2:, :] + padded[..., :-2, :], padded[..., 1:-1, :], alpha=2.0)
    across = smooth[..., 2:] - smooth[..., :-2]
    down = torch.add(steep[..., 2:] + steep[..., :-2], steep[..., 1:-1], alpha=2.0)
    magnitude = across.square_().addcmul_(down, down).sqrt_().mul_(0.5).round_().clamp_(max=255.0)
    return (box_sum(magnitude, block) / block**2).round()


def to_bytes(levels: Float[Tensor, "*any"]) -> UInt8[Tensor, "*any"]:
    """Truncate numbers in [0, 256) to bytes."""
    # Conversion by way of 16 bits takes a third of the time.
    return levels.to(torch.int16).to(torch.uint8)


def is_above(levels: UInt8[Tensor, "*any"], limit: int) -> Bool[Tensor, "*any"]:
    """Return where levels are above the limit, in a sixth of the time that torch takes to compare bytes."""
    if is_traced() or not 0 <= limit < 255:
        # Torch would wrap a whole number to a byte: 300 to 44.
        return levels > float(limit)
    return levels.clamp(limit, limit + 1).sub_(limit).view(torch.bool)


def in_strips(work: Callable[[Tensor], Tensor], picture: Tensor, reach: int) -> Tensor:
    """Return work(picture), if a pixel of the result depends on at most `reach` rows on either side.

    On a CPU, work in strips of rows, which is several times as fast on large pictures. On other devices, in graphs, and
    if the picture takes gradients, work on the whole picture.
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
    """Return how many of `height` rows of `row` numbers are processed at once; see `in_strips`."""
    if like.device.type != "cpu" or (like.requires_grad and torch.is_grad_enabled()) or is_traced():
        return height
    return max(_STRIP_PIXELS // max(row, 1), 8)


def pad_reflect(
    image: Shaped[Tensor, "B C H W"], left: int, right: int, top: int, bottom: int
) -> Shaped[Tensor, "B C h w"]:
    """Pad as `torch.nn.functional.pad` in mode `reflect`. If a side is smaller than the border, the mirror repeats.

    >>> F.pad_reflect(torch.arange(3.0).reshape(1, 1, 1, 3), 2, 2, 0, 0).flatten()
    tensor([2., 1., 0., 1., 2., 1., 0.])
    """
    height, width = image.shape[-2:]
    if max(left, right) < width and max(top, bottom) < height:
        return functional.pad(image, (left, right, top, bottom), mode="reflect")
    rows = reflect_index(torch.arange(-top, height + bottom, device=image.device), height)
    columns = reflect_index(torch.arange(-left, width + right, device=image.device), width)
    return image.index_select(-2, rows).index_select(-1, columns)


def reflect_index(index: Int64[Tensor, "*any"], size: int) -> Int64[Tensor, "*any"]:
    """Return the pixel within 0 .. size - 1 to which an index outside is mirrored.

    >>> F.reflect_index(torch.tensor([-2, -1, 0, 3, 4]), 3)
    tensor([2, 1, 0, 1, 0])
    """
    period = max(2 * (size - 1), 1)
    folded = index.remainder(period)
    return torch.minimum(folded, period - folded) if size > 1 else torch.zeros_like(index)
