"""Colours: HSV, which pixels are of a colour (appendix A, IV-A), and histograms of boxes (appendix C, eq. 3)."""

import math

import torch
from jaxtyping import Bool, Float
from kornia.color import rgb_to_hsv
from torch import Tensor

from torchvision_dddas.functional.soft import step

TURN = 180.0  # of the hue
FULL = 255.0  # saturation, value
BINS = 256  # of a channel's histogram


def bgr_to_hsv(image: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
    """Hue 0 to 180, saturation and value 0 to 255, of blue, green, red in [0, 1]; grey has hue 0 and saturation 0.

    OpenCV's for 8-bit pictures, before it rounds; by Kornia's rgb_to_hsv.

    >>> F.bgr_to_hsv(torch.tensor([1.0, 0, 0]).reshape(1, 3, 1, 1)).flatten()
    tensor([120.0000, 255.0000, 255.0000])
    """
    hsv = rgb_to_hsv(image.flip(1))
    return hsv * hsv.new_tensor([TURN / (2 * math.pi), FULL, FULL])[:, None, None]


def within_ranges(
    hsv: Float[Tensor, "B 3 H W"], low: Float[Tensor, "K 3"], high: Float[Tensor, "K 3"], *, softness: float = 0.0
) -> Float[Tensor, "B K H W"]:
    """How much each pixel belongs to each range of colours: 0 or 1 where softness, in the units of hsv, is 0.

    A range whose lowest hue is above its highest goes over 0. The bounds are whole 8-bit levels, and what rounds to
    one of them is inside: it is judged by how far the worst of the three numbers is from half a level beyond.

    >>> red = F.bgr_to_hsv(torch.tensor([0, 0, 1.0]).reshape(1, 3, 1, 1))
    >>> F.within_ranges(red, torch.tensor([[170.0, 80, 80]]), torch.tensor([[10.0, 255, 255]])).flatten()
    tensor([1.])
    """
    hue, saturation, value = hsv.unbind(1)
    middle, half = (low + high) / 2, (high - low) / 2
    # On a circle what goes over 0 is a range as any other, half a turn from the middle of its bounds.
    over_zero = (half[:, 0] < 0).to(low.dtype) * (TURN / 2)
    middle_hue, half_hue = torch.remainder(middle[:, 0] + over_zero, TURN), half[:, 0] + over_zero
    found = []
    for k in range(low.shape[0]):
        apart = (hue - middle_hue[k]).abs()
        margin = half_hue[k] - torch.minimum(apart, TURN - apart)
        margin = torch.minimum(margin, half[k, 1] - (saturation - middle[k, 1]).abs())
        found.append(torch.minimum(margin, half[k, 2] - (value - middle[k, 2]).abs()))
    if not found:
        return hsv.new_zeros(hsv.shape[0], 0, *hsv.shape[2:])
    return step(torch.stack(found, 1) + 0.5, softness=softness)


def rgb_histogram(
    image: Float[Tensor, "B 3 H W"],
    box_px: Float[Tensor, "B N 4"],
    valid: Bool[Tensor, "B N"],
    *,
    softness: float = 0.0,
    normalize: bool = True,
    largest: tuple[int, int] | None = None,
) -> tuple[Float[Tensor, "B N 768"], Bool[Tensor, "B N"]]:
    """256 bins each of red, green and blue for every box, and which boxes are valid and not empty inside the picture.

    Kornia's image_histogram2d is the triangular kernel of softness 1, of whole pictures of one size; it compares every
    pixel with every bin, in 80 to 300 times the time (`python eval/speed.py operations`).
    image: red, green, blue in [0, 1]. box_px: x, y of the top left pixel, width, height; edges are rounded to whole
    pixels and cut at the picture. Missing boxes have zeros; gradients reach the image where softness is above 0.
    softness: at 0 each pixel counts in the nearest level, exactly so for 8-bit pictures; at 1 it is shared between the
    two nearest levels by distance; between, the ramp from one level to the next is that share of a level wide.
    normalize: each channel adds up to 1; False leaves the counts, and a box of 100 pixels 300 in all.
    largest: (height, width) in pixels that no box exceeds: then only so much is read for each of them, and a larger box
    does not count as valid. None: the whole picture, N times.

    >>> box_px, valid = torch.tensor([[[1.0, 1, 4, 4]]]), torch.ones(1, 1, dtype=torch.bool)
    >>> histogram, there = F.rgb_histogram(torch.zeros(1, 3, 8, 8), box_px, valid)
    >>> histogram.shape, histogram[0, 0, [0, 256, 512]], there
    (torch.Size([1, 1, 768]), tensor([1., 1., 1.]), tensor([[True]]))
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
    # Every pixel counts in the level, or the two levels, that it is nearest to, of its box's histogram.
    level = pixels.clamp(0, 1) * (BINS - 1)
    weight = inside.flatten(1)[:, None].to(pixels.dtype).expand_as(level)
    batch, boxes = valid.shape
    owner = torch.arange(boxes, device=image.device).repeat_interleave(rows * columns) * BINS
    counts = torch.zeros(batch, 3, boxes * BINS, dtype=image.dtype, device=image.device)
    if softness > 0:
        below = level.detach().floor().clamp(max=BINS - 2)
        upper = ((level - below - 0.5) / softness + 0.5).clamp(0, 1)
        at = below.long() + owner
        counts = counts.scatter_add(2, at, weight * (1 - upper)).scatter_add(2, at + 1, weight * upper)
    else:
        counts = counts.scatter_add(2, level.round().long() + owner, weight)
    counts = counts.view(batch, 3, boxes, BINS).transpose(1, 2)
    if normalize:
        counts = counts / counts.sum(-1, keepdim=True).clamp(min=1)
    return counts.flatten(2), valid
