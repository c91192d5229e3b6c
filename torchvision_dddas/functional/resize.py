"""Resizing as OpenCV's INTER_LINEAR_EXACT does on 8-bit levels, bit for bit: the pyramid of a HOG detector is made so.

Its weights are rounded to 1/256, which moves a trained detector's scores by up to 0.15 against plain interpolation.
"""

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor


def resize(
    levels: Float[Tensor, "B C H W"],
    size: tuple[int, int],
    rows: Int64[Tensor, "h"] | None = None,
    columns: Int64[Tensor, "w"] | None = None,
    rounded: bool = True,
) -> Float[Tensor, "B C h w"]:
    """The pictures in another size: (height, width).

    levels: 0 .. 255. rows, columns: those of the result that are wanted, in any order and number; all by default.
    rounded: to whole levels, halves up. Of whole levels every sum is a whole number of 1/65536 below 256, which float32
    holds exactly: the result is OpenCV's on every device. Gradients go to the levels, and pass the rounding as if it
    were not there; not rounded, the result is linear in the levels.
    """
    height, width = levels.shape[-2:]
    found = _rows(levels, *_taps(height, size[0]), rows)
    # Rows are copied as they lie in memory; columns one by one would take twice the time.
    found = _rows(found.transpose(-1, -2).contiguous(), *_taps(width, size[1]), columns).transpose(-1, -2)
    if not rounded:
        return found.contiguous()
    whole = (found.detach() + 0.5).floor_()
    return found + (whole - found.detach()) if found.requires_grad else whole.contiguous()


def _taps(have: int, wanted: int) -> tuple[Int64[Tensor, "n"], Float64[Tensor, "n"]]:
    """Of every place of the result the first of its two sources, and the share of the second, a multiple of 1/256.

    Computed as OpenCV does in doubles: 1 / (wanted / have), which is not have / wanted to the last bit.
    """
    at = (torch.arange(wanted, dtype=torch.float64) + 0.5) * (1.0 / (wanted / have)) - 0.5
    left = at.floor()
    inside = (left >= 0) & (left < have - 1)
    share = torch.where(inside, ((at - left) * 256).round() / 256, torch.zeros_like(at))
    return left.clamp(0, have - 1).long(), share


def _rows(levels: Tensor, first: Tensor, share: Tensor, places: Tensor | None) -> Tensor:
    """Interpolated rows: all, or those at the places."""
    first, share = first.to(levels.device), share.to(levels)
    if places is not None:
        first, share = first[places], share[places]
    second = (first + 1).clamp(max=levels.shape[-2] - 1)
    return torch.lerp(levels.index_select(-2, first), levels.index_select(-2, second), share[:, None])


def reflected(first: int, last: int, length: int, device: torch.device | None = None) -> Int64[Tensor, "n"]:
    """The places first .. last - 1 of a line that is reflected (101) at both ends, as often as it takes."""
    place = torch.arange(first, last, device=device)
    if length == 1:
        return torch.zeros_like(place)
    place = place.remainder(2 * length - 2)
    return torch.minimum(place, 2 * length - 2 - place)
