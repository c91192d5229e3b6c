"""Soft erosion and dilation: log-sum-exp in place of the extremum, over the elements of `ops.morphology`.

The log-sum-exp of N numbers is above their largest by softness x ln N at most. Thresholds and extrema commute, so a
mask's morphology is that of the margin by which its threshold is passed: soften the threshold last, and the outline is
where the hard one is. At softness 0.0 the gradient goes to the pixel that decides; where a gradient is wanted, values
within a 500,000th of the picture's span are alike.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.functional.morphology import Shape, Size, element_rows
from torchvision_dddas.functional.morphology import dilate as hard_dilate
from torchvision_dddas.functional.morphology import erode as hard_erode

# Outside the picture nothing is set. Not infinite: the gradient of a log-sum-exp of nothing but infinities is none.
_NOTHING = -1e4
# Places are told within tiles of this side; with them, 32 bits leave so many steps for the value.
_TILE = 64
_STEPS = (1 << 19) - 2


def dilate(
    x: Float[Tensor, "B C H W"], size_px: Size, shape: Shape = "rectangle", softness: float = 0.0
) -> Float[Tensor, "B C H W"]:
    """Maximum under the element; with softness above 0, in the units of x, softness x log-sum-exp(x / softness)."""
    if softness == 0.0:
        return _hard(x, size_px, shape, highest=True)
    width, height = (size_px, size_px) if isinstance(size_px, int) else size_px
    rows = element_rows(width, height, shape)
    left, above = width // 2, height // 2
    margins = (left, width - 1 - left, above, height - 1 - above)
    padded = functional.pad(x / softness, margins, value=_NOTHING / softness)
    runs = {last - first: _run(padded, last - first) for first, last in rows if last > first}
    result: Tensor | None = None
    for number, (first, last) in enumerate(rows):
        if last > first:
            part = runs[last - first][..., number : number + x.shape[-2], first : first + x.shape[-1]]
            result = part if result is None else torch.logaddexp(result, part)
    assert result is not None, "every element has its middle row"
    return result * softness


def erode(
    x: Float[Tensor, "B C H W"], size_px: Size, shape: Shape = "rectangle", softness: float = 0.0
) -> Float[Tensor, "B C H W"]:
    """Minimum under the element; with softness above 0, -softness x log-sum-exp(-x / softness)."""
    if softness == 0.0:
        return _hard(x, size_px, shape, highest=False)
    return -dilate(-x, size_px, shape, softness)


def opening(
    x: Float[Tensor, "B C H W"], size_px: Size, shape: Shape = "rectangle", softness: float = 0.0
) -> Float[Tensor, "B C H W"]:
    """Erosion, then dilation."""
    return dilate(erode(x, size_px, shape, softness), size_px, shape, softness)


def closing(
    x: Float[Tensor, "B C H W"], size_px: Size, shape: Shape = "rectangle", softness: float = 0.0
) -> Float[Tensor, "B C H W"]:
    """Dilation, then erosion."""
    return erode(dilate(x, size_px, shape, softness), size_px, shape, softness)


def _run(x: Tensor, length: int) -> Tensor:
    """Log-sum-exp over `length` columns from each on; spans double, and the binary digits of the length are joined.

    Spans must not overlap, as those of a running maximum may: a number that counts twice is a larger sum.
    """
    result: Tensor | None = None
    taken, span, spans = 0, 1, x
    while True:
        if length & span:
            part = spans[..., taken:]
            result = part if result is None else torch.logaddexp(result[..., : part.shape[-1]], part)
            taken += span
        if taken == length:
            assert result is not None, "a length is at least 1"
            return result
        spans = torch.logaddexp(spans[..., : spans.shape[-1] - span], spans[..., span:])
        span *= 2


def _hard(x: Tensor, size_px: Size, shape: Shape, highest: bool) -> Tensor:
    """The hard extremum; where a gradient is wanted, by finding the pixel that decides.

    A chain of maxima would keep every step of itself for the gradient: hundreds of pictures for a large ellipse. Here
    one whole number of 32 bits a pixel goes through the chain, the value above, the place below.
    """
    largest = size_px if isinstance(size_px, int) else max(size_px)
    if not (x.requires_grad and torch.is_grad_enabled() and x.dtype == torch.float32) or largest >= _TILE:
        return hard_dilate(x, size_px, shape) if highest else hard_erode(x, size_px, shape)
    sign = 1.0 if highest else -1.0
    rows = torch.arange(x.shape[-2], device=x.device, dtype=torch.int32)[:, None]
    columns = torch.arange(x.shape[-1], device=x.device, dtype=torch.int32)
    decided = hard_dilate(_in_steps(sign * x.detach()) | (rows % _TILE * _TILE + columns % _TILE), size_px, shape)
    # The element is smaller than a tile, so that a place within one tells the pixel.
    row = rows + (decided // _TILE - rows + _TILE // 2) % _TILE - _TILE // 2
    column = columns + (decided - columns + _TILE // 2) % _TILE - _TILE // 2
    place = row * x.shape[-1] + column
    return x.flatten(-2).gather(-1, place.long().flatten(-2)).reshape(x.shape)


def _in_steps(x: Tensor) -> Tensor:
    """Values as whole numbers whose lowest bits are free for a place within a tile."""
    low, high = x.aminmax()
    step = (high - low).clamp(min=1e-30) / _STEPS
    return ((x - low) / step).round_().int() * _TILE**2
