"""Erosion and dilation by Kornia's names, bit-exact with OpenCV (appendix B, step S5), hard or soft.

Kernels are flat, about their middle.

On a CPU kornia.morphology takes 7 to 34 times as long (`python eval/speed.py operations`) and does not take bytes;
here a running maximum doubles its span over flat shifts. Integer and Boolean masks keep their type; floats work too and
pass gradients.
Outside the picture nothing decides: this is Kornia's border `geodesic`. As in OpenCV the kernel is not mirrored, which
differs only where it is not symmetric.

With softness above 0, log-sum-exp takes the place of the extremum: that of N numbers is above their largest by
softness x ln N at most. Thresholds and extrema commute, so the morphology of a mask is that of the margin by which its
threshold is passed: soften the threshold last, and the outline is where the hard one is. At softness 0 the gradient of
float32 pictures goes to the pixel that decides; values within a 500,000th of the picture's span then count as equal.
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
"""The pixels that count are those where a kernel is not 0. A trace knows no values of tensors: it needs an array."""
Run = tuple[int, int, int]
"""Of a kernel's row the columns [first, last) that are set."""

# Outside the picture nothing is set. Not infinite: the gradient of a log-sum-exp of nothing but infinities is none.
_NOTHING = -1e4
# Places are numbered within tiles of this side; with them, 32 bits leave so many steps for the value.
_TILE = 64
_STEPS = (1 << 19) - 2
_SHAPES = {"rectangle": cv2.MORPH_RECT, "ellipse": cv2.MORPH_ELLIPSE}


@cache
def kernel_array(shape: Literal["rectangle", "ellipse"], size_px: int | tuple[int, int]) -> Shaped[np.ndarray, "h w"]:
    """cv2.getStructuringElement, uint8, made once. size_px: (width, height), or one number for both."""
    size = (size_px, size_px) if isinstance(size_px, int) else size_px
    return cv2.getStructuringElement(_SHAPES[shape], size)


def structuring_element(
    shape: Literal["rectangle", "ellipse"], size_px: int | tuple[int, int]
) -> Shaped[Tensor, "h w"]:
    """`kernel_array` as a tensor on the CPU.

    >>> F.structuring_element("ellipse", 5).int()
    tensor([[0, 0, 1, 0, 0],
            [1, 1, 1, 1, 1],
            [1, 1, 1, 1, 1],
            [1, 1, 1, 1, 1],
            [0, 0, 1, 0, 0]], dtype=torch.int32)
    """
    return torch.from_numpy(kernel_array(shape, size_px))


def dilation(tensor: Shaped[Tensor, "B C H W"], kernel: Kernel, *, softness: float = 0.0) -> Shaped[Tensor, "B C H W"]:
    """Maximum where the kernel is not 0, around its middle (h // 2, w // 2).

    softness: above 0, in the units of the mask, gives softness x log-sum-exp(mask / softness). Values below -1e4 then
    count as -1e4, as in Kornia.

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
    """Minimum where the kernel is not 0. softness: as in `dilation`.

    >>> row = torch.tensor([0.0, 1, 1, 1, 0]).reshape(1, 1, 1, 5)
    >>> F.erosion(row, torch.ones(1, 3)).flatten()
    tensor([0., 0., 1., 0., 0.])
    """
    if softness == 0.0:
        return _extremum(tensor, kernel, highest=True)
    return -dilation(-tensor, kernel, softness=softness)


def opening(tensor: Shaped[Tensor, "B C H W"], kernel: Kernel, *, softness: float = 0.0) -> Shaped[Tensor, "B C H W"]:
    """Erosion, then dilation: takes away what is smaller than the kernel.

    >>> row = torch.tensor([0.0, 1, 0, 1, 1, 1]).reshape(1, 1, 1, 6)
    >>> F.opening(row, torch.ones(1, 3)).flatten()
    tensor([0., 0., 0., 1., 1., 1.])
    """
    return dilation(erosion(tensor, kernel, softness=softness), kernel, softness=softness)


def closing(tensor: Shaped[Tensor, "B C H W"], kernel: Kernel, *, softness: float = 0.0) -> Shaped[Tensor, "B C H W"]:
    """Dilation, then erosion: fills what is smaller than the kernel.

    >>> row = torch.tensor([0.0, 1, 0, 1, 0]).reshape(1, 1, 1, 5)
    >>> F.closing(row, torch.ones(1, 3)).flatten()
    tensor([1., 1., 1., 1., 1.])
    """
    return erosion(dilation(tensor, kernel, softness=softness), kernel, softness=softness)


def _runs(kernel: Kernel) -> list[Run]:
    """The kernel as runs (row, first, last) of columns [first, last)."""
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
    """Minimum (highest = True: outside counts as the highest value) or maximum under the kernel."""
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
    # One flat row of memory: a shift by k columns is a shift by k, one by a row a shift by `pitch`. What runs over a
    # row's end lands in the padding of the next, which is cut away.
    flat = padded.reshape(-1)
    size = flat.numel() - (height - 1) * pitch - (width - 1)
    if runs == [(row, 0, width) for row in range(height)]:
        result = _running(_running(flat, [width], 1, better)[width], [height], pitch, better)[height]
    else:
        # One running extremum per distinct run length, shifted into its rows.
        spans = _running(flat, [last - first for _, first, last in runs], 1, better)
        parts = [spans[last - first].narrow(0, row * pitch + first, size) for row, first, last in runs]
        result = reduce(better, parts)
    result = functional.pad(result, (0, flat.numel() - size)).reshape(padded.shape)
    return result[..., : mask.shape[-2], : mask.shape[-1]].contiguous()


def _running(flat: Tensor, lengths: Sequence[int], stride: int, better: Extremum) -> dict[int, Tensor]:
    """Extrema over so many entries `stride` apart, starting at each; spans double, so a span of 25 takes 5 steps."""
    span, found = 1, {}
    for length in sorted(set(lengths)):
        while 2 * span <= length:
            flat = better(flat[: flat.numel() - span * stride], flat[span * stride :])
            span *= 2
        rest = (length - span) * stride
        found[length] = better(flat[: flat.numel() - rest], flat[rest:]) if rest else flat
    return found


def _gather_extremum(x: Tensor, kernel: Kernel, highest: bool) -> Tensor:
    """As `_extremum`, by finding the pixel that decides, to which the gradient goes.

    A chain of maxima would keep every step of itself for the gradient: hundreds of pictures for a large ellipse. Here
    one whole number of 32 bits a pixel goes through the chain, the value in the high bits, the place in the low ones.
    """
    sign = -1.0 if highest else 1.0
    rows = torch.arange(x.shape[-2], device=x.device, dtype=torch.int32)[:, None]
    columns = torch.arange(x.shape[-1], device=x.device, dtype=torch.int32)
    low, high = (sign * x.detach()).aminmax()
    # Values as whole numbers whose lowest bits are free for a place within a tile.
    value = ((sign * x.detach() - low) / ((high - low).clamp(min=1e-30) / _STEPS)).round_().int() * _TILE**2
    numbered = value | (rows % _TILE * _TILE + columns % _TILE)
    decided = _extremum(numbered, kernel, highest=False)
    # The kernel is smaller than a tile, so that the place within one identifies the pixel.
    row = rows + (decided // _TILE - rows + _TILE // 2) % _TILE - _TILE // 2
    column = columns + (decided - columns + _TILE // 2) % _TILE - _TILE // 2
    place = row * x.shape[-1] + column
    return x.flatten(-2).gather(-1, place.long().flatten(-2)).reshape(x.shape)
