"""Gaussian smoothing (appendix B, step S5), gradients, box sums, and what pictures are outside their edges.

`gaussian_blur2d` is Kornia's. `mean_gradient` takes a twentieth of the time of Kornia's `sobel` and `box_blur` on a CPU
(see docs/benchmarks.md), and rounds where OpenCV's 8-bit pictures do.
"""

import cv2
import torch
from jaxtyping import Float, Int64
from kornia.filters import filter2d_separable
from torch import Tensor
from torch.nn import functional


def gaussian_blur2d(
    input: Float[Tensor, "B C H W"],  # noqa: A002 (Kornia's name)
    kernel_size: int | tuple[int, int],
    sigma: tuple[float, float] | None = None,
    border_type: str = "reflect",
) -> Float[Tensor, "B C H W"]:
    """`kornia.filters.gaussian_blur2d`, but with the weights of cv2.GaussianBlur and for pictures of any size.

    kernel_size: odd, one number or (rows, columns). sigma: (rows, columns) in pixels; without it OpenCV's own, which
    for small kernels are binomial, so that blurred whole levels are exact in float32 up to a kernel of 9. border_type:
    as in Kornia; `reflect` repeats where a side is smaller than the border.
    """
    sizes = (kernel_size, kernel_size) if isinstance(kernel_size, int) else kernel_size
    kernel_y, kernel_x = (
        torch.from_numpy(cv2.getGaussianKernel(size, spread).T).to(input)
        for size, spread in zip(sizes, sigma or (0.0, 0.0), strict=True)
    )
    above, left = (size // 2 for size in sizes)
    if border_type != "reflect" or (above < input.shape[-2] and left < input.shape[-1]):
        blurred: Tensor = filter2d_separable(input, kernel_x, kernel_y, border_type)
    else:
        blurred = filter2d_separable(pad_reflect(input, left, left, above, above), kernel_x, kernel_y, padding="valid")
    return blurred


def box_sum(values: Float[Tensor, "B C H W"], block: int) -> Float[Tensor, "B C H W"]:
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


def mean_gradient(levels: Float[Tensor, "B 1 H W"], block: int = 5) -> Float[Tensor, "B 1 H W"]:
    """Mean gradient magnitude over block x block pixels, 4 x grey levels a pixel, for pictures in whole grey levels.

    Half of `kornia.filters.sobel` without normalisation, through `box_blur`; rounded to whole numbers and cut off at
    255 before and after the mean, as OpenCV's 8-bit pictures are.
    """
    padded = pad_reflect(levels, 1, 1, 1, 1)
    steep = padded[..., 2:, :] - padded[..., :-2, :]
    smooth = torch.add(padded[..., 2:, :] + padded[..., :-2, :], padded[..., 1:-1, :], alpha=2.0)
    across = smooth[..., 2:] - smooth[..., :-2]
    down = torch.add(steep[..., 2:] + steep[..., :-2], steep[..., 1:-1], alpha=2.0)
    magnitude = across.square_().addcmul_(down, down).sqrt_().mul_(0.5).round_().clamp_(max=255.0)
    return (box_sum(magnitude, block) / block**2).round()


def pad_reflect(
    image: Float[Tensor, "B C H W"], left: int, right: int, top: int, bottom: int
) -> Float[Tensor, "B C h w"]:
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
