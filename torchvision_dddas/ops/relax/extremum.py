"""Soft erosion and dilation: log-sum-exp in place of the extremum, over the elements of `ops.morphology`.

The log-sum-exp of N numbers is above their largest by softness x ln N at most. Thresholds and extrema commute, so a
mask's morphology is that of the margin by which its threshold is passed: soften the threshold last, and the outline is
where the hard one is. At softness 0.0 the gradient goes to the pixel that decides.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from ..morphology import Shape, Size, element_rows
from ..morphology import dilate as hard_dilate
from ..morphology import erode as hard_erode

# Outside the picture nothing is set. Not infinite: the gradient of a log-sum-exp of nothing but infinities is none.
_NOTHING = -1e4


def dilate(
    x: Float[Tensor, "B C H W"], size_px: Size, shape: Shape = "rectangle", softness: float = 0.0
) -> Float[Tensor, "B C H W"]:
    """Maximum under the element; with softness above 0, in the units of x, softness x log-sum-exp(x / softness)."""
    if softness == 0.0:
        return _decided(x, hard_dilate(_ordered(x), size_px, shape)) if _routed(x) else hard_dilate(x, size_px, shape)
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
        return _decided(x, hard_erode(_ordered(x), size_px, shape)) if _routed(x) else hard_erode(x, size_px, shape)
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


def _routed(x: Tensor) -> bool:
    """Whether the pixel that decides is worth noting: a chain of maxima would keep every step of itself."""
    return x.requires_grad and torch.is_grad_enabled() and x.dtype == torch.float32 and x.numel() < 1 << 31


def _ordered(x: Tensor) -> Tensor:
    """One whole number of 64 bits a pixel, in the order of the values, whose lower half tells where it came from."""
    bits = x.detach().contiguous().view(torch.int32)
    # Floats order as whole numbers do, but for negative ones, which run backwards. (-0.0 and 0.0 differ by one.)
    order = torch.where(bits < 0, bits ^ 0x7FFFFFFF, bits).long()
    place = torch.arange(x.numel(), device=x.device).reshape(x.shape)
    return order.bitwise_left_shift(32) | place


def _decided(x: Tensor, ordered: Tensor) -> Tensor:
    """The values at the pixels that decided, which take the gradient. Outside the picture nothing ever decides."""
    return x.reshape(-1)[(ordered & 0xFFFFFFFF).reshape(-1)].reshape(ordered.shape)
