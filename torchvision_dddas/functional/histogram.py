"""Colour histograms of boxes: 3 × 256 bins, red, green, blue one after the other (appendix C, eq. 3)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

BINS = 256


def rgb(
    image: Float[Tensor, "B 3 H W"],
    box_px: Float[Tensor, "B N 4"],
    valid: Bool[Tensor, "B N"],
    softness: float = 0.0,
    normalize: bool = True,
    largest: tuple[int, int] | None = None,
) -> tuple[Float[Tensor, "B N 768"], Bool[Tensor, "B N"]]:
    """The histograms of the boxes and which of them exist: given as valid, and not empty inside the picture.

    image: red, green, blue in [0, 1]. box_px: x, y of the top left pixel, width, height; edges are rounded to whole
    pixels and cut at the picture. Missing boxes have zeros; gradients reach the image where softness is above 0.
    softness: at 0 each pixel counts in the nearest level, exactly so for 8-bit pictures; at 1 it is shared between the
    two nearest levels by distance; between, the ramp from one level to the next is that share of a level wide.
    normalize: each channel adds up to 1; False leaves the counts, and a box of 100 pixels 300 in all.
    largest: (height, width) in pixels that no box exceeds: then only so much is read for each of them, and a larger box
    does not count as valid. None: the whole picture, N times.
    """
    height, width = image.shape[-2:]
    rows, columns = largest or (height, width)
    low, high = box_px[..., :2].round(), (box_px[..., :2] + box_px[..., 2:]).round()
    edge = torch.tensor([width, height], dtype=box_px.dtype, device=box_px.device)
    low, high = low.clamp(min=0).minimum(edge), high.clamp(min=0).minimum(edge)
    side = high - low
    valid = valid & (side > 0).all(-1) & (side[..., 0] <= columns) & (side[..., 1] <= rows)
    # NaN boxes fail the comparisons above; their indices must still be numbers.
    left, top = torch.where(valid[..., None], low, torch.zeros_like(low)).long().unbind(-1)
    wide, tall = torch.where(valid[..., None], side, torch.zeros_like(side)).long().unbind(-1)

    down, across = torch.arange(rows, device=image.device), torch.arange(columns, device=image.device)
    v = (top[..., None] + down).clamp(max=height - 1)
    u = (left[..., None] + across).clamp(max=width - 1)
    inside = (down < tall[..., None])[..., :, None] & (across < wide[..., None])[..., None, :]
    place = (v[..., :, None] * width + u[..., None, :]).flatten(1)
    pixels = image.flatten(2).gather(2, place[:, None].expand(-1, 3, -1))
    counts = _counts(pixels, inside.flatten(1), box_px.shape[1], softness)
    if normalize:
        counts = counts / counts.sum(-1, keepdim=True).clamp(min=1)
    return counts.flatten(2), valid


def _counts(
    pixels: Float[Tensor, "B 3 NP"], inside: Bool[Tensor, "B NP"], boxes: int, softness: float
) -> Float[Tensor, "B N 3 256"]:
    """Add every pixel to the level, or the two levels, that it is nearest to in its box's histogram."""
    batch, _, many = pixels.shape
    level = pixels.clamp(0, 1) * (BINS - 1)
    weight = inside[:, None].to(pixels.dtype).expand(-1, 3, -1)
    owner = torch.arange(boxes, device=pixels.device).repeat_interleave(many // max(boxes, 1)) * BINS
    total = torch.zeros(batch, 3, boxes * BINS, dtype=pixels.dtype, device=pixels.device)
    if softness > 0:
        below = level.detach().floor().clamp(max=BINS - 2)
        upper = ((level - below - 0.5) / softness + 0.5).clamp(0, 1)
        at = below.long() + owner
        total = total.scatter_add(2, at, weight * (1 - upper)).scatter_add(2, at + 1, weight * upper)
    else:
        total = total.scatter_add(2, level.round().long() + owner, weight)
    return total.view(batch, 3, boxes, BINS).transpose(1, 2)
