"""Colours: HSV, the pixels within a colour's range (appendix A, IV-A), and histograms of boxes (appendix C, eq. 3)."""

import math

import torch
from jaxtyping import Bool, Float
from kornia.color import rgb_to_hsv
from torch import Tensor

from torchvision_dddas.functional.soft import step

TURN = 180.0  # one turn of the hue
FULL = 255.0  # largest saturation and value
BINS = 256  # number of bins in the histogram of a channel


def bgr_to_hsv(image: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
    """Convert blue, green, red in [0, 1] to hue, 0 to 180, saturation and value, 0 to 255.

    Hue and saturation of grey are 0. They are OpenCV's for 8-bit pictures before rounding.

    >>> F.bgr_to_hsv(torch.tensor([1.0, 0, 0]).reshape(1, 3, 1, 1)).flatten()
    tensor([120.0000, 255.0000, 255.0000])
    """
    hsv = rgb_to_hsv(image.flip(1))
    return hsv * hsv.new_tensor([TURN / (2 * math.pi), FULL, FULL])[:, None, None]


def within_ranges(
    hsv: Float[Tensor, "B 3 H W"], low: Float[Tensor, "K 3"], high: Float[Tensor, "K 3"], *, softness: float = 0.0
) -> Float[Tensor, "B K H W"]:
    """Return how far each pixel is in each range of colours: 0 or 1 with softness 0. softness: in units of hsv.

    A range whose lowest hue is above its highest hue wraps around 0. The bounds are whole 8-bit levels. A number that
    rounds to a bound is inside: each range extends by half a level, and the worst of the three numbers decides.

    >>> red = F.bgr_to_hsv(torch.tensor([0, 0, 1.0]).reshape(1, 3, 1, 1))
    >>> F.within_ranges(red, torch.tensor([[170.0, 80, 80]]), torch.tensor([[10.0, 255, 255]])).flatten()
    tensor([1.])
    """
    hue, saturation, value = hsv.unbind(1)
    middle, half = (low + high) / 2, (high - low) / 2
    # On a circle, a range that wraps around 0 is like any other. Its middle is half a turn from the mean of its bounds.
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
    """Return 3 x 256 bins (red, green, blue) of each box, and which boxes are valid and have pixels in the picture.

    Kornia's image_histogram2d has a triangular kernel, as softness 1 has, but takes whole pictures of one size. It
    compares every pixel with every bin, which takes 80 to 300 times as long (`python eval/speed.py operations`).
    image: red, green, blue in [0, 1]. box_px: x, y of the top left pixel, width, height; edges are rounded to whole
    pixels and cut at the picture. Missing boxes have zeros. Gradients reach the image if softness is above 0.
    softness: at 0 each pixel counts in the nearest level, which is exact for 8-bit pictures. At 1 it is shared between
    the two nearest levels by distance. In between, softness is the width of the ramp from one level to the next.
    normalize: let each channel add up to 1; False returns counts, 300 in all for a box of 100 pixels.
    largest: (height, width) in pixels that no box exceeds. At most this number of pixels is then read for each box, and
    a larger box is not valid. None: the whole picture is read for each box.

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
    # NaN boxes fail the comparisons above, but their indices must still be numbers.
    left, top = torch.where(valid[..., None], low, torch.zeros_like(low)).long().unbind(-1)
    wide, tall = torch.where(valid[..., None], side, torch.zeros_like(side)).long().unbind(-1)

    down, across = torch.arange(rows, device=image.device), torch.arange(columns, device=image.device)
    v = (top[..., None] + down).clamp(max=height - 1)
    u = (left[..., None] + across).clamp(max=width - 1)
    inside = (down < tall[..., None])[..., :, None] & (across < wide[..., None])[..., None, :]
    place = (v[..., :, None] * width + u[..., None, :]).flatten(1)
    pixels = image.flatten(2).gather(2, place[:, None].expand(-1, 3, -1))
    # Every pixel is counted in the histogram of its box: in the nearest level, or in the two nearest levels.
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
