"""How wrong a soft mask is, one number a mask: 0 is right, 1 is wrong. What nobody labelled does not count."""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# A frame in which nothing moves and nothing is found is right: this many pixels are right in any.
_SPARE_PX = 1.0


def f_loss(
    mask: Float[Tensor, "B 1 H W"], truth: Bool[Tensor, "B 1 H W"], known: Bool[Tensor, "B 1 H W"]
) -> Float[Tensor, "B"]:
    """1 - F, with sums of soft masks for counts of pixels (appendix B, eq. 11)."""
    right, found, true = _sums(mask, truth, known)
    return 1 - (2 * right + _SPARE_PX) / (found + true + _SPARE_PX)


def dice_loss(
    mask: Float[Tensor, "B 1 H W"], truth: Bool[Tensor, "B 1 H W"], known: Bool[Tensor, "B 1 H W"]
) -> Float[Tensor, "B"]:
    """As `f_loss` with squares of the found mask (Milletari et al. 2016): doubtful pixels cost less."""
    right, found, true = _sums(mask, truth, known, power=2)
    return 1 - (2 * right + _SPARE_PX) / (found + true + _SPARE_PX)


def focal_loss(
    mask: Float[Tensor, "B 1 H W"],
    truth: Bool[Tensor, "B 1 H W"],
    known: Bool[Tensor, "B 1 H W"],
    focus: float = 2.0,
    movers: float = 0.75,
) -> Float[Tensor, "B"]:
    """Mean of -(1 - p)^focus ln p, p what the mask gives the truth (Lin et al. 2017). movers: their weight."""
    right = torch.where(truth, mask, 1 - mask).clamp(min=1e-6)
    weight = torch.where(truth, movers, 1 - movers) * known
    return (-((1 - right) ** focus) * right.log() * weight).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp(min=1e-6)


LOSSES: Mapping[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "f": f_loss,
    "dice": dice_loss,
    "focal": focal_loss,
}
"""By the names that `dddas tune --loss` takes; the first one unless said."""


def _sums(mask: Tensor, truth: Tensor, known: Tensor, power: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Per mask: what is found and true, what is found, what is true."""
    seen = mask * known
    right = (seen * truth).sum((1, 2, 3))
    return right, (seen**power).sum((1, 2, 3)), (truth & known).sum((1, 2, 3)).to(mask.dtype)
