"""Gaussian smoothing (appendix B, step S5), box sums, and what pictures are outside their edges.

kornia.filters.gaussian_blur2d needs 7.6x OpenCV's time on a CPU, weighted shifts about 3x.
"""

import cv2
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor
from torch.nn import functional


def gaussian(image: Float[Tensor, "B C H W"], size: int, sigma: float | None = None) -> Float[Tensor, "B C H W"]:
    """Smooth with a size x size Gaussian, size odd, mirrored at the edges: cv2.GaussianBlur, in floats."""
    weights = kernel(size, sigma)
    middle = size // 2
    smoothed = pad_reflect(image, middle, middle)
    for dim in (-2, -1):
        length = smoothed.shape[dim] - 2 * middle
        total = smoothed.narrow(dim, middle, length) * weights[middle]
        for shift in range(1, middle + 1):
            pair = smoothed.narrow(dim, middle - shift, length) + smoothed.narrow(dim, middle + shift, length)
            total = torch.add(total, pair, alpha=weights[middle + shift])
        smoothed = total
    return smoothed


def kernel(size: int, sigma: float | None = None) -> list[float]:
    """The weights of one axis, summing to 1; without a sigma in pixels OpenCV's own, small sizes from its table."""
    weights: list[float] = cv2.getGaussianKernel(size, sigma or 0.0).ravel().tolist()
    return weights


def gaussian_levels(image: UInt8[Tensor, "B C H W"], size: int) -> UInt8[Tensor, "B C H W"]:
    """As `gaussian` with OpenCV's own sigma, on whole grey levels, halves rounded up.

    Equal to cv2.GaussianBlur up to size 9; beyond, OpenCV rounds its weights, and one level may differ.
    """
    if size == 1:
        return image
    weights = kernel(size)
    middle = size // 2
    if size > 9:
        return (gaussian(image.float(), size) + 0.5).to(torch.uint8)
    # All weights are multiples of the outermost one of the first three sizes, and of 1/256 in the last: sums in whole
    # numbers are exact, and 16 bits hold those of the small kernels at half the time of floats.
    unit = {3: 4, 5: 16, 7: 64, 9: 256}[size]
    whole = [round(weight * unit) for weight in weights]
    narrow = torch.int16 if size < 9 else torch.int32
    across = _weighted(pad_reflect(image, middle, middle).to(narrow), whole, -1)
    if size > 5:
        down = _weighted(across.float(), whole, -2)
        return down.mul_(1.0 / unit**2).add_(0.5).to(torch.uint8)
    # A sum of up to 65280 wraps into the sign of 16 bits; its high byte, which is what is wanted, does not care.
    down = _weighted(across, whole, -2)
    return down.mul_(256 // unit**2).add_(128).bitwise_right_shift_(8).to(torch.uint8)


def box_sum(values: Float[Tensor, "B C H W"], block: int) -> Float[Tensor, "B C H W"]:
    """Sum over block x block pixels, mirrored at the edges, anchored where OpenCV's box filter is."""
    padded = pad_reflect(values, block // 2, block - 1 - block // 2)
    for dim in (-2, -1):
        size = padded.shape[dim] - block + 1
        total = padded.narrow(dim, 0, size) + padded.narrow(dim, 1, size) if block > 1 else padded
        for shift in range(2, block):
            total += padded.narrow(dim, shift, size)
        padded = total
    return padded


def _weighted(padded: Tensor, weights: list[int], dim: int) -> Tensor:
    """Weighted sum of shifts along one axis; symmetric weights."""
    middle = len(weights) // 2
    length = padded.shape[dim] - 2 * middle
    total = padded.narrow(dim, middle, length) * weights[middle]
    for shift in range(1, middle + 1):
        weight = weights[middle + shift]
        total.add_(padded.narrow(dim, middle - shift, length), alpha=weight)
        total.add_(padded.narrow(dim, middle + shift, length), alpha=weight)
    return total


def pad_reflect(image: Float[Tensor, "B C H W"], before: int, after: int) -> Tensor:
    """The picture with `before` pixels above and to the left and `after` below and to the right, mirrored at the edges.

    Where a side is smaller than the border the mirror repeats.
    """
    height, width = image.shape[-2:]
    if max(before, after) < min(height, width):
        return functional.pad(image, (before, after, before, after), mode="reflect")
    rows = reflect_index(torch.arange(-before, height + after, device=image.device), height)
    columns = reflect_index(torch.arange(-before, width + after, device=image.device), width)
    return image.index_select(-2, rows).index_select(-1, columns)


def reflect_index(index: Int64[Tensor, "*any"], size: int) -> Int64[Tensor, "*any"]:
    """The pixel inside 0 .. size - 1 that an index outside mirrors."""
    period = max(2 * (size - 1), 1)
    folded = index.remainder(period)
    return torch.minimum(folded, period - folded) if size > 1 else torch.zeros_like(index)
