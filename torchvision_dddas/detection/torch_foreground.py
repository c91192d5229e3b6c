"""Pixel steps of the batched back end, on whole grey levels."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchvision_dddas.config import DifferenceParameters, SmallParameters
from torchvision_dddas.detection.engine import EVIDENCE_CAP, EVIDENCE_SCALE, WHITE, View, Window
from torchvision_dddas.functional import blur, difference, morphology, warp

LEVEL = 255.0
# Pixels of more gradient, 4 x grey levels each, have texture: they tell how well the registration fits.
TEXTURED = 16


def levels_of(view: View, device: torch.device) -> Tensor:
    """(1, 1, H, W) float32 grey levels, made once."""
    if "levels" not in view.kept:
        view.kept["levels"] = torch.from_numpy(view.grey)[None, None].to(device).float()
    levels: Tensor = view.kept["levels"]
    return levels


def joined(pictures: Sequence[Tensor]) -> Tensor:
    """One batch; a single picture is not copied."""
    return pictures[0] if len(pictures) == 1 else torch.cat(list(pictures))


def evidence(
    window: Window,
    grey: Tensor,
    warped: list[Tensor],
    seen: list[tuple[Tensor, Tensor]],
    texture: Tensor,
    parameters: DifferenceParameters,
) -> tuple[Tensor, Tensor]:
    """The largest evidence over the near pairs, and that of the wide pair, uint8."""
    width = grey.shape[-1]
    if parameters.kind == "normalized":
        weight = difference.noise_weight(texture, parameters.noise_levels, parameters.gradient_share).mul_(
            EVIDENCE_SCALE
        )
        textured = texture > TEXTURED
    distance = distances(window, grey, warped, parameters)

    def of(pair: tuple[int, int]) -> Tensor:
        both = seen_by_both(seen[pair[0]], seen[pair[1]], width)
        least = least_of(pair, distance, warped)
        if parameters.kind != "normalized":
            return blur.gaussian_levels(least, parameters.blur_px) * both
        z = least.mul_(both).float().mul_(weight).round_().clamp_(max=EVIDENCE_CAP).to(torch.uint8)
        z = blur.gaussian_levels(z, parameters.blur_px)
        return _in_units(z, textured & both)

    near = of(window.near[0])
    for pair in window.near[1:]:
        near = torch.maximum(near, of(pair))
    return near, near if window.wide is None else of(window.wide)


def small_movers(
    window: Window, grey: Tensor, warped: list[Tensor], seen: list[tuple[Tensor, Tensor]], parameters: SmallParameters
) -> Tensor | None:
    """255 where something small may move, uint8; None where nobody looks for it."""
    if window.small is None:
        return None
    a, b = window.small
    least = torch.minimum(apart(grey, warped[a]), apart(grey, warped[b]))
    least = blur.gaussian_levels(least, 5) * seen_by_both(seen[a], seen[b], grey.shape[-1])
    mean = least.to(torch.float64).mean(dim=(1, 2, 3), keepdim=True)
    level = (parameters.noise_ratio * mean).clamp(min=parameters.threshold).floor()
    return closed((least > level).to(torch.uint8) * 255, parameters.close_px)


def closed(mask: Tensor, side: int) -> Tensor:
    """The mask closed with an ellipse; on a CPU only around where it is set at all in any of the pictures."""
    if mask.device.type != "cpu":
        return morphology.closing(mask, side, "ellipse")
    spans = []
    for dim in (-1, -2):
        places = mask.amax((0, 1, dim)).nonzero()
        if not len(places):
            return mask
        # A pixel's closing depends on what lies less than 2 x side away.
        spans.append(slice(max(int(places[0]) - 2 * side, 0), int(places[-1]) + 2 * side + 1))
    out = torch.zeros_like(mask)
    out[..., spans[0], spans[1]] = morphology.closing(mask[..., spans[0], spans[1]], side, "ellipse")
    return out


def _used(window: Window) -> set[int]:
    return {k for pair in (*window.near, *([window.wide] if window.wide else [])) for k in pair}


def distances(
    window: Window, grey: Tensor, warped: list[Tensor], parameters: DifferenceParameters
) -> dict[int, Tensor]:
    """How far each neighbour that counts is from the reference; none where neighbours are compared to each other."""
    return {k: apart(grey, warped[k]) for k in _used(window)} if parameters.kind != "between_later" else {}


def least_of(pair: tuple[int, int], distance: dict[int, Tensor], warped: list[Tensor]) -> Tensor:
    """The difference that both neighbours of a pair show."""
    a, b = pair
    return apart(warped[a], warped[b]) if not distance else torch.minimum(distance[a], distance[b])


def _in_units(z: Tensor, textured: Tensor) -> Tensor:
    """Evidence divided by its median over textured pixels, where that is above one noise unit."""
    units = difference.noise_units(z, textured, EVIDENCE_SCALE)
    if bool((units == 1.0).all()):
        return z
    return z.float().mul_(units.reciprocal().to(torch.float32).reshape(-1, 1, 1, 1)).round_().to(torch.uint8)


def exposed(reference: Tensor, warped: Tensor, seen: tuple[Tensor, Tensor]) -> Tensor:
    """The warped pictures in their references' exposure, in whole levels."""
    first, last = (edge[:, ::4] for edge in seen)
    columns = torch.arange(0, reference.shape[-1], 4, device=reference.device)
    inside = (columns >= first[..., None]) & (columns <= last[..., None])
    wanted, given = (picture[..., ::4, ::4] / LEVEL for picture in (reference, warped))
    gain, offset = difference.exposure(wanted, given, inside[:, None], stride=1)
    enough = inside.sum((1, 2)) >= 100
    return lit(reference, warped, torch.where(enough, gain, 1.0), torch.where(enough, offset * LEVEL, 0.0))


def lit(reference: Tensor, warped: Tensor, gain: Tensor, offset: Tensor) -> Tensor:
    """The warped pictures through their gains and offsets, (B,) each, in whole levels.

    What they have cut off at white agrees with anything brighter.
    """
    gain, offset = gain.reshape(-1, 1, 1, 1), offset.reshape(-1, 1, 1, 1)
    darkened = (gain * LEVEL + offset).round() < WHITE
    # Cut off at white, a pixel only tells that the place was at least so bright.
    cut = (warped >= WHITE) & darkened if bool(darkened.any()) else None
    through = warped.mul_(gain).add_(offset).round_().clamp_(0.0, LEVEL)
    return through if cut is None else torch.where(cut, torch.maximum(through, reference), through)


def apart(a: Tensor, b: Tensor) -> Tensor:
    """|a - b| of unsigned bytes."""
    return torch.maximum(a, b).sub_(torch.minimum(a, b))


def seen_by_both(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor], width: int) -> Tensor:
    """Where both neighbours are seen, as a Boolean mask."""
    return warp.between(torch.maximum(one[0], other[0]), torch.minimum(one[1], other[1]), width)
