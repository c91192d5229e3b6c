"""Erosion and dilation with Kornia's names, bit-exact with OpenCV (appendix B, step S5), hard or soft.

Kernels are flat and centred. On a CPU kornia.morphology takes 7 to 34 times as long (`python eval/speed.py operations`)
and does not take bytes. Here a running maximum doubles its length with each flat shift. Integer and Boolean masks keep
their type; floats pass gradients.
Pixels outside the picture have no effect: this is Kornia's border `geodesic`. As in OpenCV the kernel is not mirrored,
which matters only if it is not symmetric.

With softness above 0, log-sum-exp replaces the extremum. For N numbers it exceeds their maximum by at most softness x
ln N. Thresholds and extrema commute, so apply the morphology to the margin over a threshold and soften the threshold
last: the outline then lies where the hard outline lies. At softness 0 the gradient of float32 pictures goes to the
pixel that decides; values within a 500,000th of the picture's range count as equal.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache, reduce
from itertools import groupby
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor
from torch.nn import functional

Extremum = Callable[[Tensor, Tensor], Tensor]
Kernel = Shaped[Tensor, "h w"] | Shaped[np.ndarray, "h w"]
"""The pixels that count are those where a kernel is not 0. A trace cannot read values of tensors and needs an array."""
Run = tuple[int, int, int]
"""A run of set columns [first, last) in a row of the kernel."""

# Pixels outside the picture are not set. Not -inf, because the log-sum-exp of only infinities has no gradient.
_NOTHING = -1e4
# Pixels are numbered within tiles of this side. The other bits of 32 resolve this number of steps of the value.
_TILE = 64
_STEPS = (1 << 19) - 2
_SHAPES = {"rectangle": cv2.MORPH_RECT, "ellipse": cv2.MORPH_ELLIPSE}


@cache
def kernel_array(shape: Literal["rectangle", "ellipse"], size_px: int | tuple[int, int]) -> Shaped[np.ndarray, "h w"]:
    """Return cv2.getStructuringElement, uint8, made once. size_px: (width, height), or one number for both."""
    size = (size_px, size_px) if isinstance(size_px, int) else size_px
    return cv2.getStructuringElement(_SHAPES[shape], size)


def structuring_element(
    shape: Literal["rectangle", "ellipse"], size_px: int | tuple[int, int]
) -> Shaped[Tensor, "h w"]:
    """Return `kernel_array` as a tensor on the CPU.

    >>> F.structuring_element("ellipse", 5).int()
    tensor([[0, 0, 1, 0, 0],
            [1, 1, 1, 1, 1],
            [1, 1, 1, 1, 1],
            [1, 1, 1, 1, 1],
            [0, 0, 1, 0, 0]], dtype=torch.int32)
    """
    return torch.from_numpy(kernel_array(shape, size_px))


def dilation(tensor: Shaped[Tensor, "B C H W"], kernel: Kernel, *, softness: float = 0.0) -> Shaped[Tensor, "B C H W"]:
    """Return the maximum where the kernel is not 0, around its middle (h // 2, w // 2).

    softness: if above 0, in the units of the mask, return softness x log-sum-exp(mask / softness). Values below -1e4
    then count as -1e4, as in Kornia.

    >>> row = torch.tensor([0.0, 0, 1, 0, 0]).reshape(1, 1, 1, 5)
    >>> F.dilation(row, torch.ones(1, 3)).flatten()
    tensor([0., 1., 1., 1., 0.])
    """
    if softness == 0.0:
        return _extremum(tensor, kernel, highest=False)
    rows, columns = tensor.shape[-2:]
    padded = functional.pad(tensor / softness, _margins(kernel), value=_NOTHING / softness)
    shifted = [padded[..., row : row + rows, at : at + columns] for row, at in np.argwhere(np.asarray(kernel)).tolist()]
    return torch.stack(shifted).logsumexp(0) * softness


def erosion(tensor: Shaped[Tensor, "B C H W"], kernel: Kernel, *, softness: float = 0.0) -> Shaped[Tensor, "B C H W"]:
    """Return the minimum where the kernel is not 0. softness: as in `dilation`.

    >>> row = torch.tensor([0.0, 1, 1, 1, 0]).reshape(1, 1, 1, 5)
    >>> F.erosion(row, torch.ones(1, 3)).flatten()
    tensor([0., 0., 1., 0., 0.])
    """
    if softness == 0.0:
        return _extremum(tensor, kernel, highest=True)
    return -dilation(-tensor, kernel, softness=softness)


def opening(tensor: Shaped[Tensor, "B C H W"], kernel: Kernel, *, softness: float = 0.0) -> Shaped[Tensor, "B C H W"]:
    """Erode, then dilate. This removes parts that are smaller than the kernel.

    >>> row = torch.tensor([0.0, 1, 0, 1, 1, 1]).reshape(1, 1, 1, 6)
    >>> F.opening(row, torch.ones(1, 3)).flatten()
    tensor([0., 0., 0., 1., 1., 1.])
    """
    return dilation(erosion(tensor, kernel, softness=softness), kernel, softness=softness)


def closing(tensor: Shaped[Tensor, "B C H W"], kernel: Kernel, *, softness: float = 0.0) -> Shaped[Tensor, "B C H W"]:
    """Dilate, then erode. This fills gaps that are smaller than the kernel.

    >>> row = torch.tensor([0.0, 1, 0, 1, 0]).reshape(1, 1, 1, 5)
    >>> F.closing(row, torch.ones(1, 3)).flatten()
    tensor([1., 1., 1., 1., 1.])
    """
    return erosion(dilation(tensor, kernel, softness=softness), kernel, softness=softness)


def _runs(kernel: Kernel) -> list[Run]:
    """Return the kernel as runs (row, first, last) of columns [first, last)."""
    runs = []
    for row, line in enumerate(kernel.tolist()):
        column = 0
        for is_set, run in groupby(line, key=bool):
            first, column = column, column + len(list(run))
            if is_set:
                runs.append((row, first, column))
    return runs


def _margins(kernel: Kernel) -> tuple[int, int, int, int]:
    height, width = kernel.shape
    left, above = width // 2, height // 2
    return left, width - 1 - left, above, height - 1 - above


def _extremum(mask: Tensor, kernel: Kernel, highest: bool) -> Tensor:
    """Return the maximum under the kernel, or the minimum if `highest` (pixels outside then have the highest value)."""
    height, width = kernel.shape
    better = torch.minimum if highest else torch.maximum
    if mask.dtype == torch.bool:
        return _extremum(mask.to(torch.uint8), kernel, highest).bool()
    if mask.requires_grad and torch.is_grad_enabled() and mask.dtype == torch.float32 and max(width, height) < _TILE:
        return _gather_extremum(mask, kernel, highest)
    runs = _runs(kernel)
    is_float = mask.dtype.is_floating_point
    ends = (-math.inf, math.inf) if is_float else (torch.iinfo(mask.dtype).min, torch.iinfo(mask.dtype).max)
    padded = functional.pad(mask, _margins(kernel), value=ends[highest])
    pitch = padded.shape[-1]
    # The picture is one flat row of memory: a shift by a column is a shift by 1, a shift by a row is a shift by
    # `pitch`. Shifts beyond the end of a row end in the padding of the next row, which is cut off.
    flat = padded.reshape(-1)
    size = flat.numel() - (height - 1) * pitch - (width - 1)
    if runs == [(row, 0, width) for row in range(height)]:
        result = _running(_running(flat, [width], 1, better)[width], [height], pitch, better)[height]
    else:
        # Compute one running extremum for each run length, and shift it into the rows of the kernel.
        spans = _running(flat, [last - first for _, first, last in runs], 1, better)
        parts = [spans[last - first].narrow(0, row * pitch + first, size) for row, first, last in runs]
        result = reduce(better, parts)
    result = functional.pad(result, (0, flat.numel() - size)).reshape(padded.shape)
    return result[..., : mask.shape[-2], : mask.shape[-1]].contiguous()


def _running(flat: Tensor, lengths: Sequence[int], stride: int, better: Extremum) -> dict[int, Tensor]:
    """Return extrema over `lengths` entries, `stride` apart, from each entry on. Lengths double: 25 take 5 steps."""
    span, found = 1, {}
    for length in sorted(set(lengths)):
        while 2 * span <= length:
            flat = better(flat[: flat.numel() - span * stride], flat[span * stride :])
            span *= 2
        rest = (length - span) * stride
        found[length] = better(flat[: flat.numel() - rest], flat[rest:]) if rest else flat
    return found


def _gather_extremum(x: Tensor, kernel: Kernel, highest: bool) -> Tensor:
    """Return `_extremum` by finding the pixel that decides, so that the gradient goes to this pixel.

    A chain of maxima would keep each of its steps for the gradient: hundreds of pictures for a large ellipse. Here one
    32-bit number for each pixel passes the chain, with the value in its high bits and the place in its low bits.
    """
    sign = -1.0 if highest else 1.0
    rows = torch.arange(x.shape[-2], device=x.device, dtype=torch.int32)[:, None]
    columns = torch.arange(x.shape[-1], device=x.device, dtype=torch.int32)
    low, high = (sign * x.detach()).aminmax()
    # Values become whole numbers whose lowest bits are free for a place within a tile.
    value = ((sign * x.detach() - low) / ((high - low).clamp(min=1e-30) / _STEPS)).round_().int() * _TILE**2
    numbered = value | (rows % _TILE * _TILE + columns % _TILE)
    decided = _extremum(numbered, kernel, highest=False)
    # The kernel is smaller than a tile, so the place within a tile identifies the pixel.
    row = rows + (decided // _TILE - rows + _TILE // 2) % _TILE - _TILE // 2
    column = columns + (decided - columns + _TILE // 2) % _TILE - _TILE // 2
    place = row * x.shape[-1] + column
    return x.flatten(-2).gather(-1, place.long().flatten(-2)).reshape(x.shape)
