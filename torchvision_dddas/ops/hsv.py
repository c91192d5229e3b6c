"""Hue, saturation and value in OpenCV's 8-bit units, and which pixels are of a colour (appendix A, IV-A)."""

import torch
from jaxtyping import Float
from torch import Tensor

from .threshold import step

TURN = 180.0  # a full turn of the hue


def from_bgr(image: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
    """Hue 0 to 180 (a full turn), saturation and value 0 to 255, of blue, green, red in [0, 1]. Grey has hue 0."""
    blue, green, red = (image * 255).unbind(1)
    value, least = image.amax(1) * 255, image.amin(1) * 255
    chroma = value - least
    safe = torch.where(chroma > 0, chroma, torch.ones_like(chroma))
    hue = torch.where(
        value == red,
        (green - blue) / safe,
        torch.where(value == green, 2 + (blue - red) / safe, 4 + (red - green) / safe),
    )
    hue = torch.where(chroma > 0, hue * (TURN / 6), torch.zeros_like(hue))
    saturation = 255 * chroma / torch.where(value > 0, value, torch.ones_like(value))
    return torch.stack([torch.where(hue < 0, hue + TURN, hue), saturation, value], 1)


def within(
    hsv: Float[Tensor, "B 3 H W"], low: Float[Tensor, "K 3"], high: Float[Tensor, "K 3"], softness: float = 0.0
) -> Float[Tensor, "B K H W"]:
    """How much each pixel belongs to each range, 0 or 1 where softness is 0.

    A range whose lowest hue is above its highest goes over 0.
    """
    value = hsv[:, None]
    lowest, highest = low[:, :, None, None], high[:, :, None, None]
    above, below = step(value - lowest + 0.5, softness), step(highest + 0.5 - value, softness)
    hue = torch.where(
        (low[:, 0] > high[:, 0])[:, None, None],
        torch.maximum(above[:, :, 0], below[:, :, 0]),
        torch.minimum(above[:, :, 0], below[:, :, 0]),
    )
    rest = torch.minimum(above[:, :, 1:], below[:, :, 1:]).amin(2)
    return torch.minimum(hue, rest)
