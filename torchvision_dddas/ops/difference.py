"""What changed between registered frames, apart from the light (appendix B, step S4)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def three_frame(warped_1: Float[Tensor, "B C H W"], warped_2: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
    """|I(t+2dt -> t) - I(t+dt -> t)|: both warped frames, never one against the raw reference (appendix B, eq. 9)."""
    return (warped_2 - warped_1).abs()


def pair(
    reference: Float[Tensor, "B C H W"], warped_a: Float[Tensor, "B C H W"], warped_b: Float[Tensor, "B C H W"]
) -> Float[Tensor, "B C H W"]:
    """min(|I - A|, |I - B|): marks a mover once, where it stands in the reference (departs from eq. 9)."""
    return torch.minimum((reference - warped_a).abs(), (reference - warped_b).abs())


def exposure(
    reference: Float[Tensor, "B C H W"],
    warped: Float[Tensor, "B C H W"],
    inside: Bool[Tensor, "B 1 H W"],
    rounds: int = 4,
    floor: float = 3 / 255,
    stride: int | None = None,
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B"]]:
    """Gain and offset such that gain * warped + offset has the reference's light: trimmed least squares.

    Each round keeps the pixels whose error is at most max(floor, 3.7 x the median error) and fits them anew. Every
    `stride`-th pixel is looked at (default: about 80 rows of them). Without inside pixels, or on a frame of one single
    grey, the gain stays 1 (and the offset what the mean asks for).
    """
    if stride is None:
        stride = max(1, min(reference.shape[-2:]) // 80)
    wanted = reference[..., ::stride, ::stride].flatten(1)
    given = warped[..., ::stride, ::stride].flatten(1)
    seen = inside[..., ::stride, ::stride].expand(-1, reference.shape[1], -1, -1).flatten(1)
    middle = ((seen.sum(1, keepdim=True) - 1) // 2).clamp(min=0)
    gain, offset = torch.ones_like(wanted[:, :1]), torch.zeros_like(wanted[:, :1])
    for _ in range(rounds):
        error = (wanted - gain * given - offset).abs().detach()
        # A median over the inside pixels alone: sort the others to the end.
        median = error.masked_fill(~seen, torch.inf).sort(1).values.gather(1, middle)
        kept = (seen & (error <= (3.7 * median).clamp(min=floor))).to(wanted.dtype)
        count = kept.sum(1, keepdim=True).clamp(min=1.0)
        given_mean = (kept * given).sum(1, keepdim=True) / count
        wanted_mean = (kept * wanted).sum(1, keepdim=True) / count
        deviation = kept * (given - given_mean)
        spread = deviation.square().sum(1, keepdim=True) / count
        together = (deviation * (wanted - wanted_mean)).sum(1, keepdim=True) / count
        fitted, one = spread > 1e-6, torch.ones_like(spread)
        gain = torch.where(fitted, together / torch.where(fitted, spread, one), one)
        offset = wanted_mean - gain * given_mean
    return gain[:, 0], offset[:, 0]
