"""Ranges of colour as parameters: learned from pictures in which it is known what wears which colour."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from torchvision_dddas.errors import InputError
from torchvision_dddas.functional.hsv import FULL, TURN, from_bgr, within

LEAST_HALF = 1.0
"""No range is narrower than this either way, in levels: a range of nothing has no slope back."""

_START_HALF = (12.0, 60.0, 70.0)  # of hue, saturation, value, about the patch's own colour


class SoftColours(nn.Module):
    """K ranges of hue, saturation and value, as their middles and half widths; the hue goes round.

    Ends that come out beyond 0 or 255 of saturation and value are the ends of what there is.
    """

    def __init__(self, low: Float[Tensor, "K 3"], high: Float[Tensor, "K 3"]) -> None:
        """low, high: as `ops.hsv.within` takes them; a lowest hue above the highest goes over 0."""
        super().__init__()
        if low.shape != high.shape or low.ndim != 2 or low.shape[-1] != 3:
            raise InputError(
                f"ranges of colour of shapes {tuple(low.shape)} and {tuple(high.shape)}; wanted lowest and highest "
                "hue, saturation and value, (K, 3) each"
            )
        low, high = low.double(), high.double()
        high = high + torch.where(low > high, TURN, 0.0) * torch.tensor([1.0, 0.0, 0.0])
        half = ((high - low) / 2 - LEAST_HALF).clamp(min=1e-3)
        self.middle = nn.Parameter((low + high) / 2)
        self.free = nn.Parameter(half + torch.log(-torch.expm1(-half)))  # softplus, undone

    def ends(self) -> tuple[Float[Tensor, "K 3"], Float[Tensor, "K 3"]]:
        """Lowest and highest, with gradients; a lowest hue below 0 or a highest above 180 is one that goes over 0."""
        half = LEAST_HALF + functional.softplus(self.free)
        return self.middle - half, self.middle + half

    def forward(self, bgr: Float[Tensor, "B 3 H W"], softness: float) -> Float[Tensor, "B K H W"]:
        """How much each pixel of pictures in [0, 1] is of each colour; softness in levels, hard at 0."""
        low, high = self.ends()
        return within(from_bgr(bgr), low.to(bgr), high.to(bgr), softness)

    def ranges(self) -> tuple[Int[Tensor, "K 3"], Int[Tensor, "K 3"]]:
        """Lowest and highest in whole levels, as `Colours` has them: hues from 0 to 180."""
        low, high = (end.detach().round().long() for end in self.ends())
        whole = high[:, 0] - low[:, 0] >= int(TURN)
        low[:, 0], high[:, 0] = torch.remainder(low[:, 0], int(TURN)), torch.remainder(high[:, 0], int(TURN))
        low[whole, 0], high[whole, 0] = 0, int(TURN)
        low[:, 1:], high[:, 1:] = low[:, 1:].clamp(0, int(FULL)), high[:, 1:].clamp(0, int(FULL))
        return low, high


def about(bgr: Float[Tensor, "B 3 H W"], worn: Float[Tensor, "B K H W"]) -> SoftColours:
    """Ranges to begin with: about the mean colour of what wears each. Raises InputError where nothing wears one."""
    hsv = from_bgr(bgr)
    angle = hsv[:, 0] * (2 * torch.pi / TURN)
    middles = []
    for k in range(worn.shape[1]):
        weight = worn[:, k]
        total = weight.sum()
        if not float(total):
            raise InputError(f"no pixel is labelled with colour {k + 1}; wanted a patch of each")
        hue = torch.atan2((weight * angle.sin()).sum(), (weight * angle.cos()).sum()) * (TURN / (2 * torch.pi))
        rest = [(weight * hsv[:, channel]).sum() / total for channel in (1, 2)]
        middles.append(torch.stack([torch.remainder(hue, TURN), *rest]))
    middle, half = torch.stack(middles).double(), torch.tensor(_START_HALF, dtype=torch.float64)
    found = SoftColours(torch.zeros_like(middle), torch.ones_like(middle))
    with torch.no_grad():
        found.middle.copy_(middle)
        found.free.copy_((half - LEAST_HALF).expand_as(middle))
    return found


def confusion(found: Float[Tensor, "B K H W"], worn: Float[Tensor, "B K H W"]) -> Float[Tensor, " K"]:
    """1 - F of each colour's pixels over all pictures, as soft as these: ground and others' paint are wrong."""
    axes = (0, 2, 3)
    return 1 - 2 * (found * worn).sum(axes) / (found.sum(axes) + worn.sum(axes)).clamp(min=1e-6)
