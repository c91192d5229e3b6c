"""What pictures are taken to be outside their edges: mirrored without repeating the edge, as OpenCV does."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional


def reflected(image: Float[Tensor, "B C H W"], before: int, after: int) -> Tensor:
    """The picture with `before` pixels above and to the left and `after` below and to the right, mirrored at the edges.

    Also where a side is smaller than what is asked for: then the mirror repeats.
    """
    height, width = image.shape[-2:]
    if max(before, after) < min(height, width):
        return functional.pad(image, (before, after, before, after), mode="reflect")
    rows = reflected_index(torch.arange(-before, height + after, device=image.device), height)
    columns = reflected_index(torch.arange(-before, width + after, device=image.device), width)
    return image.index_select(-2, rows).index_select(-1, columns)


def reflected_index(index: Int64[Tensor, "*any"], size: int) -> Int64[Tensor, "*any"]:
    """The pixel inside 0 .. size - 1 that an index outside mirrors."""
    period = max(2 * (size - 1), 1)
    folded = index.remainder(period)
    return torch.minimum(folded, period - folded) if size > 1 else torch.zeros_like(index)
