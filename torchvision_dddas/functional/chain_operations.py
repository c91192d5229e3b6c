"""The operations of the detection chain on batches of tensors. With softness above 0, the same steps have gradients.

Without softness everything is computed in bytes, as in OpenCV. Registration, warps and exposure are hard and pass no
gradient. Whole grey levels are rounded straight through. Thresholds and extrema commute, so the morphology is applied
to the margin over the threshold, with hard extrema, and the threshold is softened last. The outline therefore lies
where the hard outline lies, for any softness.
"""

import torch
from torch import Tensor
from torch.nn import functional

from torchvision_dddas.chain import REGION_PX, SAMPLED, Number, Operations
from torchvision_dddas.config import WHITE, exposure_step
from torchvision_dddas.functional.difference import (
    absolute_difference,
    fit_exposure,
    fit_quantiles,
    level_quantiles,
    noise_units,
    noise_weight,
    regional_medians,
)
from torchvision_dddas.functional.filters import gaussian_blur2d, is_above, mean_gradient, to_bytes
from torchvision_dddas.functional.morphology import closing, dilation, erosion, kernel_array
from torchvision_dddas.functional.soft import (
    all_true,
    blend_sizes,
    may_branch,
    round_straight_through,
    straight_through,
)
from torchvision_dddas.functional.warp import seen_by_both, seen_columns, warp_perspective

LEVEL = 255
"""White, in grey levels."""

_EXPOSURE_LEAST = 100  # the exposure is not fitted to fewer pixels

Light = tuple[Tensor, Tensor]
Columns = tuple[Tensor, Tensor]


class TensorOperations(Operations[Tensor, Tensor, Columns]):
    """Implement `Operations` for a batch: views are (B, 1, H, W) floats of whole levels, pictures are bytes.

    >>> operations = F.TensorOperations(softness=0.1)
    >>> operations.grey(torch.tensor([[[[17.0, 18.0]]]])).dtype, operations.is_hard
    (torch.uint8, False)
    """

    def __init__(self, softness: float = 0.0, *, whole: bool = True, dtype: torch.dtype = torch.float32) -> None:
        """softness: if above 0, evidence consists of floats of `dtype`, which have gradients.

        whole: round where OpenCV does.
        """
        self.whole, self.is_hard, self.dtype = whole, softness == 0.0 and whole, dtype

    def grey(self, view: Tensor) -> Tensor:
        """See `Operations`, also for all other methods."""
        return to_bytes(view)

    def texture(self, view: Tensor) -> Tensor:
        return mean_gradient(view)

    def no_texture(self, view: Tensor) -> Tensor:
        return torch.zeros_like(view)

    def warp(self, view: Tensor, reference: Tensor, view_from_reference: Tensor) -> Tensor:
        size = (reference.shape[-2], reference.shape[-1])
        return warp_perspective(
            view, view_from_reference, size, padding_mode="border", inverse_map=True, subpixels=32, whole=True
        )

    def seen(self, view: Tensor, reference: Tensor, view_from_reference: Tensor, border_px: int) -> Columns:
        size, frame_size = ((picture.shape[-2], picture.shape[-1]) for picture in (reference, view))
        return seen_columns(view_from_reference, size, frame_size, border_px=border_px)

    def seen_by_both(self, one: Columns, other: Columns, reference: Tensor) -> Tensor:
        return seen_by_both(one, other, reference.shape[-1])

    def fit_light(self, reference: Tensor, warped: Tensor, seen: Columns) -> Light:
        pitch = exposure_step(reference.shape[-2:])
        first, last = (edge[:, ::pitch, None] for edge in seen)
        columns = torch.arange(0, reference.shape[-1], pitch, device=reference.device)
        inside = ((columns >= first) & (columns <= last))[:, None]
        wanted, given = (picture[..., ::pitch, ::pitch].to(reference) / LEVEL for picture in (reference, warped))
        gain, offset = fit_exposure(wanted, given, inside)
        enough = inside.sum((1, 2, 3)) >= _EXPOSURE_LEAST
        return torch.where(enough, gain, 1.0), torch.where(enough, offset * LEVEL, 0.0)

    def fit_level_shares(self, reference: Tensor, neighbour: Tensor) -> Light:
        return fit_quantiles(level_quantiles(reference), level_quantiles(neighbour))

    def apply_light(self, reference: Tensor, warped: Tensor, light: Light) -> Tensor:
        gain, offset = (part.to(reference).reshape(-1, 1, 1, 1) for part in light)
        levels = torch.arange(LEVEL + 1, dtype=gain.dtype, device=gain.device)
        if all_true((gain * levels + offset).round() == levels):
            return warped
        darkened = (gain * LEVEL + offset).round() < WHITE
        # The true brightness of a clipped pixel is unknown; it is only at least as high.
        cut = None if all_true(~darkened) else (warped >= WHITE) & darkened
        through = to_bytes(warped.to(gain.dtype).mul_(gain).add_(offset).round_().clamp_(0.0, float(LEVEL)))
        return through if cut is None else torch.where(cut, torch.maximum(through, to_bytes(reference)), through)

    def difference(self, one: Tensor, other: Tensor) -> Tensor:
        return absolute_difference(one, other)

    def smaller(self, one: Tensor, other: Tensor) -> Tensor:
        return torch.minimum(one, other)

    def larger(self, one: Tensor, other: Tensor) -> Tensor:
        return torch.maximum(one, other)

    def inside(self, picture: Tensor, mask: Tensor) -> Tensor:
        return picture * mask

    def outside(self, picture: Tensor, mask: Tensor) -> Tensor:
        return picture * ~mask

    def exceeds(self, picture: Tensor, level: float) -> Tensor:
        return is_above(picture, int(level)) if picture.dtype == torch.uint8 else picture > level

    def stands_out(self, picture: Tensor, least: float, ratio: float) -> Tensor:
        mean = picture.to(torch.float64).mean(dim=(1, 2, 3), keepdim=True)
        return (picture > (ratio * mean).clamp(min=least).floor()).to(torch.uint8) * LEVEL

    def noise_weight(self, texture: Tensor, noise_levels: Number, gradient_share: Number, scale: float) -> Tensor:
        return noise_weight(texture, noise_levels, gradient_share) * scale

    def weigh(self, picture: Tensor, weight: Tensor, most: float) -> Tensor:
        return self._rounded((picture * weight).clamp_(max=most))

    def blur(self, picture: Tensor, side: Number) -> Tensor:
        levels = picture if self.is_hard or picture.is_floating_point() else picture.to(self.dtype)

        def of_size(side: int) -> Tensor:
            smooth = gaussian_blur2d(levels, side)
            if levels.dtype == torch.uint8 or not self.whole:
                return smooth
            return straight_through((smooth.detach() + 0.5).floor(), smooth)

        return blend_sizes(side, of_size, pitch=2)

    def in_units_of_median(self, picture: Tensor, mask: Tensor, least: float) -> Tensor:
        bytes_of = picture if picture.dtype == torch.uint8 else picture.detach().round().to(torch.uint8)
        units = noise_units(bytes_of, mask, least)
        if all_true(units == 1.0):
            return picture
        height, width = picture.shape[-2:]
        sampled = picture[..., ::SAMPLED, ::SAMPLED].to(self.dtype), mask[..., ::SAMPLED, ::SAMPLED]
        cells = regional_medians(*sampled, REGION_PX // SAMPLED, least, (least * units).to(self.dtype)) / least
        unit = functional.interpolate(cells, scale_factor=REGION_PX, mode="bilinear")[..., :height, :width]
        return self._rounded(picture / unit)

    def above(self, evidence: Tensor, limit: Number) -> Tensor:
        if evidence.dtype != torch.uint8:
            margin: Tensor = evidence - limit
            return margin
        mask = evidence > limit if isinstance(limit, Tensor) else is_above(evidence, int(limit))
        return mask.to(torch.uint8) * LEVEL

    def erode(self, mask: Tensor, side: Number) -> Tensor:
        return blend_sizes(side, lambda side: erosion(mask, kernel_array("ellipse", side)))

    def dilate(self, mask: Tensor, side: Number) -> Tensor:
        return blend_sizes(side, lambda side: mask if side == 1 else dilation(mask, kernel_array("ellipse", side)))

    def close(self, mask: Tensor, side: Number) -> Tensor:
        return blend_sizes(side, lambda side: close_masks(mask, side))

    def halve(self, picture: Tensor) -> Tensor:
        return functional.avg_pool2d(picture.float(), 2).add_(0.5).to(torch.uint8)

    def _rounded(self, x: Tensor) -> Tensor:
        if self.is_hard:
            return to_bytes(x.round_())
        return round_straight_through(x) if self.whole else x


def close_masks(mask: Tensor, side: int) -> Tensor:
    """Return the mask closed with an ellipse. Bytes on a CPU are closed only around pixels that a picture sets.

    >>> mask = torch.zeros(1, 1, 9, 9)
    >>> mask[..., 3:6, [2, 3, 5, 6]] = 1
    >>> F.close_masks(mask, 3)[0, 0, 4]
    tensor([0., 0., 1., 1., 1., 1., 1., 0., 0.])
    """
    kernel = kernel_array("ellipse", side)
    if mask.dtype != torch.uint8 or not may_branch(mask):
        return closing(mask, kernel)
    spans = []
    for dim in (-1, -2):
        places = mask.amax((0, 1, dim)).nonzero()
        if not len(places):
            return mask
        # The closing of a pixel depends only on pixels less than 2 x side away.
        spans.append(slice(max(int(places[0]) - 2 * side, 0), int(places[-1]) + 2 * side + 1))
    out = torch.zeros_like(mask)
    out[..., spans[0], spans[1]] = closing(mask[..., spans[0], spans[1]], kernel)
    return out
