"""The differences of registered frames, after their exposures are matched (appendix B, step S4)."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.functional.filters import is_above
from torchvision_dddas.functional.soft import all_true, is_traced, may_branch


def fit_exposure(
    reference: Float[Tensor, "B C H W"],
    warped: Float[Tensor, "B C H W"],
    inside: Bool[Tensor, "B 1 H W"],
    *,
    floor: float = 3 / 255,
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B"]]:
    """Fit gain and offset by trimmed least squares, so that gain * warped + offset has the reference's exposure.

    The fit starts from the median difference, so that a jump of the exposure is not taken for moving targets. Each
    round fits the pixels whose error is at most max(floor, 3.7 x the median error), until the fit changes by less than
    floor/30, a tenth of a grey level. Without inside pixels, or on a frame of a single grey, the gain stays 1. In the
    second case the offset is the difference of the means.

    >>> warped = torch.rand(1, 1, 32, 32)
    >>> gain, offset = F.fit_exposure(1.2 * warped + 0.1, warped, torch.ones(1, 1, 32, 32, dtype=torch.bool))
    >>> gain.round(decimals=2), offset.round(decimals=2)
    (tensor([1.2000]), tensor([0.1000]))
    """
    wanted, given = reference.flatten(1), warped.flatten(1)
    seen = inside.expand_as(reference).flatten(1)
    gain, offset = torch.ones_like(wanted[:, :1]), masked_median((wanted - given).detach(), seen)
    settled = torch.zeros_like(gain, dtype=torch.bool)
    for _ in range(4):
        error = (wanted - gain * given - offset).abs().detach()
        kept = (seen & (error <= (3.7 * masked_median(error, seen)).clamp(min=floor))).to(wanted.dtype)
        count = kept.sum(1, keepdim=True).clamp(min=1.0)
        given_mean = (kept * given).sum(1, keepdim=True) / count
        wanted_mean = (kept * wanted).sum(1, keepdim=True) / count
        deviation = kept * (given - given_mean)
        spread = deviation.square().sum(1, keepdim=True) / count
        together = (deviation * (wanted - wanted_mean)).sum(1, keepdim=True) / count
        fitted, one = spread > 1e-6, torch.ones_like(spread)
        slope = torch.where(fitted, together / torch.where(fitted, spread, one), one)
        shift = wanted_mean - slope * given_mean
        # White is 85 x floor. `moved` bounds the change of every level.
        moved = (85 * floor * (slope - gain).abs() + (shift - offset).abs()).detach()
        gain, offset = torch.where(settled, gain, slope), torch.where(settled, offset, shift)
        settled = settled | (moved < floor / 30)
        if all_true(settled):
            break
    return gain[:, 0], offset[:, 0]


def absolute_difference(a: UInt8[Tensor, "*any"], b: UInt8[Tensor, "*any"]) -> UInt8[Tensor, "*any"]:
    """Return |a - b| of unsigned bytes."""
    return torch.maximum(a, b).sub_(torch.minimum(a, b))


def match_exposure(
    earlier: Float[Tensor, "B 1 H W"], later: Float[Tensor, "B 1 H W"]
) -> tuple[Float[Tensor, "B 1 H W"], Float[Tensor, "B 1 H W"]]:
    """Return both pictures in whole grey levels, the darker picture in the other's exposure if they differ clearly.

    This is the batched form of `chain.exposure.match_exposure`.

    >>> picture = (torch.rand(1, 1, 64, 64) * 100).round()
    >>> earlier, later = F.match_exposure(picture, 2 * picture)
    >>> bool((earlier - later).abs().max() < 3)
    True
    """
    gain, offset = fit_quantiles(level_quantiles(earlier), level_quantiles(later))
    if all_true((gain == 1) & (offset == 0)):
        return earlier, later
    is_later = (gain * 128 + offset >= 128)[:, None]
    x = torch.arange(256, dtype=torch.float64, device=gain.device)
    gain, offset = gain[:, None], offset[:, None]
    table = torch.where(is_later, gain * x + offset, (x - offset) / gain).round().clamp(0, 255).to(earlier.dtype)
    darker = torch.where(is_later[..., None, None], later, earlier)
    lit = table.gather(1, darker.flatten(1).long()).reshape(darker.shape)
    return torch.where(is_later[..., None, None], earlier, lit), torch.where(is_later[..., None, None], lit, later)


def level_quantiles(levels: Float[Tensor, "B 1 H W"]) -> Float[Tensor, "B 33"]:
    """Return the grey levels below which 2 to 98 % of a picture lie, float64. Pixels of a level are spread over it.

    Use every 3rd pixel of every 5th row; `chain.exposure.measure_level_shares` states why both steps are odd.
    """
    sample = levels[..., ::5, ::3].flatten(1).round().long().clamp(0, 255)
    counts = torch.zeros(len(levels), 257, dtype=torch.float64, device=levels.device)
    counts.scatter_add_(1, sample + 1, torch.ones_like(sample, dtype=torch.float64))
    below = counts.cumsum(1) / sample.shape[1]
    shares = torch.linspace(0.02, 0.98, 33, dtype=torch.float64, device=levels.device).expand(len(levels), -1)
    place = _count_at_most(below, shares).clamp(1, 256)
    low, high = below.gather(1, place - 1), below.gather(1, place)
    return place - 1.5 + (shares - low) / (high - low)


def fit_quantiles(
    wanted: Float[Tensor, "B 33"], given: Float[Tensor, "B 33"]
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B"]]:
    """Fit gain and offset that convert the quantiles `given` to the quantiles `wanted`.

    Return 1 and 0 if they are nearly equal, or if they do not explain the difference. Batched
    `chain.exposure.fit_exposure`.
    """
    one = torch.ones_like(wanted[:, 0])
    kept = (torch.minimum(wanted, given) > 3.0) & (torch.maximum(wanted, given) < 252.0)
    before = _middle((wanted - given).abs(), kept)
    is_clear = (kept.sum(1) >= 8) & (before >= 2.0)
    if all_true(~is_clear):
        return one, torch.zeros_like(one)
    gain, offset = _middle(wanted / given.clamp(min=1e-9), kept), torch.zeros_like(one)
    for _ in range(6):
        miss = (wanted - gain[:, None] * given - offset[:, None]).abs()
        scale = (2 * _middle(miss, kept)).clamp(min=1.0)[:, None]
        weight = kept / (1 + (miss / scale).square())
        total = weight.sum(1).clamp(min=1e-12)
        mean_given, mean_wanted = (weight * given).sum(1) / total, (weight * wanted).sum(1) / total
        apart = given - mean_given[:, None]
        spread = (weight * apart.square()).sum(1)
        together = (weight * apart * (wanted - mean_wanted[:, None])).sum(1)
        gain = torch.where(spread > 1.0, together / spread.clamp(min=1.0), one)
        offset = mean_wanted - gain * mean_given
    left = _middle((wanted - gain[:, None] * given - offset[:, None]).abs(), kept)
    is_exposure = is_clear & (gain > 0.5) & (gain < 2.0) & (left < 0.5 * before)
    return torch.where(is_exposure, gain, one), torch.where(is_exposure, offset, torch.zeros_like(one))


def _middle(values: Float[Tensor, "B N"], kept: Bool[Tensor, "B N"]) -> Float[Tensor, "B"]:
    """Return the median of the kept values, with the mean of the middle two; 0 if no value is kept."""
    # Use topk of a fixed number, because torch 2.6 cannot export its sort.
    size, count = int(values.shape[1]), kept.sum(1, keepdim=True)
    ordered = values.masked_fill(~kept, torch.inf).topk(size, dim=1, largest=False).values
    pair = ordered.gather(1, torch.cat([(count - 1).clamp(min=0) // 2, count // 2], 1).clamp(max=values.shape[1] - 1))
    return torch.where(count[:, 0] > 0, pair.mean(1), torch.zeros_like(values[:, 0]))


def regional_medians(
    values: Float[Tensor, "B 1 H W"],
    mask: Bool[Tensor, "B 1 H W"],
    side: int,
    least: float,
    most: Float[Tensor, "B"],
) -> Float[Tensor, "B 1 R C"]:
    """Return lower medians of regions of `side` pixels, clipped to `least` and `most`.

    A region in which at most a tenth of the mask is set has the value `least`. A median filter removes outliers.
    """
    down, across = (-length % side for length in values.shape[-2:])
    cells = functional.pad(values.masked_fill(~mask, torch.inf), (0, across, 0, down), value=torch.inf)
    cells = cells.unfold(2, side, side).unfold(3, side, side).flatten(4).sort(-1).values
    count = cells.isfinite().sum(-1, keepdim=True)
    middle = cells.gather(-1, (count - 1).clamp(min=0) // 2)
    medians = torch.where(count > 0.1 * side**2, middle, least)[..., 0]
    around = functional.pad(medians, (1, 1, 1, 1), mode="replicate").unfold(2, 3, 1).unfold(3, 3, 1)
    smooth = around.flatten(4).sort(-1).values[..., 4]
    return smooth.clamp(min=least).minimum(most.reshape(-1, 1, 1, 1))


def _count_at_most(rising: Float[Tensor, "B N"], values: Float[Tensor, "B M"]) -> Int64[Tensor, "B M"]:
    """Count the numbers of each rising row that are at most each value."""
    if is_traced():  # an exported graph has no search
        return (rising[:, None] <= values[..., None]).sum(-1)
    return torch.searchsorted(rising, values.contiguous(), right=True)


def masked_median(values: Float[Tensor, "B N"], mask: Bool[Tensor, "B N"]) -> Float[Tensor, "B 1"]:
    """Return the lower median of the values under the mask; 0 if the mask is empty.

    >>> F.masked_median(torch.tensor([[1.0, 5, 9]]), torch.tensor([[True, True, False]]))
    tensor([[1.]])
    """
    if may_branch(values) and not values.requires_grad:
        # NumPy takes a fifth of torch's time.
        rows = zip(values.numpy(), mask.numpy(), strict=True)
        seen = [row[kept] for row, kept in rows]
        found = [np.partition(row, (len(row) - 1) // 2)[(len(row) - 1) // 2] if len(row) else 0.0 for row in seen]
        return torch.tensor(found, dtype=values.dtype)[:, None]
    if not torch.compiler.is_compiling():
        # This is several times faster than sorting, but cannot be exported.
        return values.masked_fill(~mask, torch.nan).nanmedian(1, keepdim=True).values.nan_to_num(0.0)
    middle = (mask.sum(1, keepdim=True) - 1) // 2
    ordered = values.masked_fill(~mask, torch.inf).sort(1).values
    return torch.where(middle >= 0, ordered.gather(1, middle.clamp(min=0)), torch.zeros_like(ordered[:, :1]))


def noise_weight(
    texture: Float[Tensor, "B 1 H W"], noise_levels: float | Tensor, gradient_share: float | Tensor
) -> Float[Tensor, "B 1 H W"]:
    """Return 1 over the expected noise of a pixel in grey levels, from the noise of flat regions and the gradient.

    texture: in 4 x grey levels a pixel, as `mean_gradient` returns it.

    >>> 1 / F.noise_weight(torch.full((1, 1, 1, 1), 40.0), 4.0, 0.12)
    tensor([[[[4.1761]]]])
    """
    # Compute in place where this does not break the gradients of the parameters.
    return (texture.square() * (gradient_share / 4) ** 2).add_(noise_levels**2).rsqrt_()


def noise_units(
    z: UInt8[Tensor, "B 1 H W"], textured: Bool[Tensor, "B 1 H W"], scale: float, least: int = 500
) -> Float[Tensor, "B"]:
    """Return the median of z / scale over textured pixels, at least 1; 1 if at most `least` pixels are textured."""
    level, seen = z.flatten(1), textured.flatten(1)
    total = seen.sum(1, dtype=torch.int32)
    # The mean of the middle two can only be above the scale if the upper value is.
    is_high = (total > least) & ((seen & is_above(level, int(scale))).sum(1, dtype=torch.int32) >= total - total // 2)
    units = torch.ones_like(total, dtype=torch.float64)
    if all_true(~is_high):
        return units
    counts = torch.zeros(len(level), 257, dtype=torch.int64, device=z.device)
    counts.scatter_add_(1, torch.where(seen, level.long(), 256), torch.ones_like(level, dtype=torch.int64))
    ranks = torch.stack([(total - 1).clamp(min=0) // 2, total // 2], 1)
    # Take the mean of the middle two, as NumPy does.
    median = _count_at_most(counts.cumsum(1), ranks).double().mean(1)
    return torch.where(is_high, (median / scale).clamp(min=1.0), units)
