"""Hue, saturation and value in OpenCV's 8-bit units, and which pixels are of a colour (appendix A, IV-A)."""

import math

import torch
from jaxtyping import Float
from kornia.color import rgb_to_hsv
from torch import Tensor

from torchvision_dddas.functional.threshold import step

TURN = 180.0  # of the hue
FULL = 255.0  # saturation, value


def from_bgr(image: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
    """Hue 0 to 180, saturation and value 0 to 255, of blue, green, red in [0, 1]; grey has hue 0 and saturation 0.

    OpenCV's for 8-bit pictures, before it rounds.
    """
    hue, saturation, value = rgb_to_hsv(image.flip(1)).unbind(1)
    return torch.stack([hue * (TURN / (2 * math.pi)), saturation * FULL, value * FULL], 1)


def within(
    hsv: Float[Tensor, "B 3 H W"], low: Float[Tensor, "K 3"], high: Float[Tensor, "K 3"], softness: float = 0.0
) -> Float[Tensor, "B K H W"]:
    """How much each pixel belongs to each range of colours: 0 or 1 where softness, in the units of hsv, is 0.

    A range whose lowest hue is above its highest goes over 0. The bounds are whole 8-bit levels, and what rounds to
    one of them is inside: it is judged by how far the worst of the three numbers is from half a level beyond.
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
    return step(torch.stack(found, 1) + 0.5, softness)
