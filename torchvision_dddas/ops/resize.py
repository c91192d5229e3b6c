"""Resizing as OpenCV's INTER_LINEAR_EXACT does on 8-bit levels, bit for bit: the pyramid of a HOG detector is made so.

Its weights are rounded to 1/256, which moves a trained detector's scores by up to 0.15 against plain interpolation.
"""

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor

_UNITS = 256  # weights are whole numbers of 1/256


def resize(
    levels: Float[Tensor, "B C H W"],
    size: tuple[int, int],
    rows: Int64[Tensor, "h"] | None = None,
    columns: Int64[Tensor, "w"] | None = None,
    rounded: bool = True,
) -> Float[Tensor, "B C h w"]:
    """The pictures in another size: (height, width).

    levels: 0 .. 255. rows, columns: those of the result that are wanted, in any order and number; all by default.
    rounded: to whole levels, halves up. Whole levels make every sum a whole number below 2^24, which float32 holds
    exactly: the result is OpenCV's on every device. Gradients go to the levels, and pass the rounding as if it were
    not there; not rounded, the result is linear in the levels.
    """
    height, width = levels.shape[-2:]
    found = _along(levels, -2, *_taps(height, size[0]), rows)
    found = _along(found, -1, *_taps(width, size[1]), columns) / _UNITS**2
    if not rounded:
        return found
    return found + ((found.detach() + 0.5).floor() - found.detach()) if found.requires_grad else (found + 0.5).floor()


def _taps(have: int, wanted: int) -> tuple[list[int], list[int]]:
    """Of every place of the result the first of its two sources, and the weight of the second, in 1/256.

    Computed as OpenCV does in doubles: 1 / (wanted / have), which is not have / wanted to the last bit.
    """
    scale = 1.0 / (wanted / have)
    first, weight = [], []
    for place in range(wanted):
        at = scale * (place + 0.5) - 0.5
        left = math.floor(at)
        inside = 0 <= left < have - 1
        first.append(min(max(left, 0), have - 1))
        weight.append(round((at - left) * _UNITS) if inside else 0)
    return first, weight


def _along(levels: Tensor, axis: int, first: list[int], weight: list[int], places: Tensor | None) -> Tensor:
    """256 times the interpolated levels along one axis."""
    device = levels.device
    left, share = torch.tensor(first, device=device), torch.tensor(weight, dtype=levels.dtype, device=device)
    if places is not None:
        left, share = left[places], share[places]
    right = (left + 1).clamp(max=levels.shape[axis] - 1)
    share = share.view(-1, *[1] * (-1 - axis))
    return levels.index_select(axis, left) * (_UNITS - share) + levels.index_select(axis, right) * share


def reflected(first: int, last: int, length: int, device: torch.device | None = None) -> Int64[Tensor, "n"]:
    """The places first .. last - 1 of a line that is reflected (101) at both ends, as often as it takes."""
    place = torch.arange(first, last, device=device)
    if length == 1:
        return torch.zeros_like(place)
    place = place.remainder(2 * length - 2)
    return torch.minimum(place, 2 * length - 2 - place)
