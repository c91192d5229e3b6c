"""Soft motion segmentation: from differences of registered pictures to a mask with a gradient in the parameters.

No parameter that can be tuned acts before the differences: registration, warps and exposure are done once, hard. After
them every step is that of the hard pipeline, by the same functions of `functional`:

    noise units -> blur -> largest over the pairs -> margin over the threshold -> erode -> close -> soft threshold

Thresholds and extrema commute, so the margin goes through the morphology, whose extrema stay hard, and the threshold is
softened last: the outline lies where the hard one does, whatever the softness. Whole grey levels are rounded straight
through. Regions are labelled hard and gated softly; a hull is the hard one of a region, and counts as far as its region
does. What then acts on single blobs (persistence, outlines by colour, shadows, small targets) has no useful gradient
and is given as two masks: what it takes away, and what it adds.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor, nn

import torchvision_dddas.functional as F
from torchvision_dddas.config import Settings

Values = Mapping[str, Tensor]


@dataclass(frozen=True)
class Differences:
    """A batch of windows, before any tunable parameter acts.

    least: (B, P, H, W) uint8, the difference that both neighbours of each near pair show, grey levels. both: where both
    are seen. texture: (B, 1, H, W), 4 x grey levels a pixel; textured: where it is enough to show how well the
    registration fits. steps: evidence is kept in so many steps a noise unit, up to `highest` of them.
    """

    least: UInt8[Tensor, "B P H W"]
    both: Bool[Tensor, "B P H W"]
    texture: Float[Tensor, "B 1 H W"]
    textured: Bool[Tensor, "B 1 H W"]
    steps: float
    highest: float


class Core(NamedTuple):
    """Where targets are certain.

    mask: 0 to 1. margin: by how much evidence is above the threshold, cleaned; noise units, or grey levels. evidence:
    the largest over the near pairs, same unit.
    """

    mask: Float[Tensor, "B 1 H W"]
    margin: Float[Tensor, "B 1 H W"]
    evidence: Float[Tensor, "B 1 H W"]


@dataclass(frozen=True)
class Regions:
    """Label maps of the connected regions of a hard core: 0 is background, others 1 to `count`.

    near: the regions, and the pixels around them that may join them. filled: their hulls, or themselves.
    """

    near: Int64[Tensor, "B 1 H W"]
    filled: Int64[Tensor, "B 1 H W"]
    count: int


class MotionSegmenter(nn.Module):
    """The steps from differences to a mask; some parameters are given as tensors, the others are those of the settings.

    whole: round where the engines do, straight through; False rounds nowhere, for gradient checks.
    """

    def __init__(self, settings: Settings, whole: bool = True) -> None:
        super().__init__()
        self.settings = settings
        self.whole = whole

    def forward(self, differences: Differences, values: Values, softness: float = 0.0) -> Core:
        """The core mask. values: the tuned parameters by name. softness: a share of the settings' threshold."""
        evidence = self.evidence(differences, values)
        above = evidence - self._parameter("difference.threshold", values)
        erode_px, close_px = (self._parameter(f"morphology.{name}_px", values) for name in ("erode", "close"))
        eroded = F.blend_sizes(erode_px, lambda side: F.erosion(above, F.structuring_element("ellipse", side)))
        margin = F.blend_sizes(close_px, lambda side: F.closing(eroded, F.structuring_element("ellipse", side)))
        return Core(F.step(margin, softness * self.settings.difference.threshold), margin, evidence)

    def evidence(self, differences: Differences, values: Values) -> Float[Tensor, "B 1 H W"]:
        """The largest difference over the near pairs, in noise units or grey levels."""
        normalized = self.settings.difference.kind == "normalized"
        weight: Tensor | None = None
        if normalized:
            noise_levels = self._parameter("difference.noise_levels", values)
            gradient_share = self._parameter("difference.gradient_share", values)
            weight = F.noise_weight(differences.texture, noise_levels, gradient_share) * differences.steps
        largest: Tensor | None = None
        for k in range(differences.least.shape[1]):
            least, both = differences.least[:, k : k + 1], differences.both[:, k : k + 1]
            if weight is None:
                z = self._blurred(least.to(differences.texture.dtype), values) * both
            else:
                z = self._rounded(least * both * weight).clamp(max=differences.highest)
                z = self._in_units(self._blurred(z, values), differences.textured & both, differences.steps)
            largest = z if largest is None else torch.maximum(largest, z)
        assert largest is not None, "a window has a pair"
        return largest / differences.steps if normalized else largest

    def outlined(self, core: Core, found: Regions, values: Values, softness: float = 0.0) -> Float[Tensor, "B 1 H W"]:
        """The mask of the regions that pass the gates, their hulls filled. softness: of the gates, a share of each."""
        gate = F.gate_regions(
            core.mask,
            core.evidence,
            found.near,
            found.count,
            self._parameter("gates.min_area_px", values),
            self._parameter("difference.peak", values),
            softness,
        )
        drawn = core.mask * F.gates_of_pixels(gate, found.near)
        # In the hull of a region, a hole or a speck is foreground as far as that region is, whatever its evidence.
        carried = (core.margin <= 0) | (found.filled != found.near)
        return torch.maximum(drawn, F.gates_of_pixels(gate, found.filled) * carried)

    def _parameter(self, name: str, values: Values) -> float | Tensor:
        if name in values:
            return values[name]
        group, key = name.split(".")
        return float(getattr(getattr(self.settings, group), key))

    def _blurred(self, levels: Tensor, values: Values) -> Tensor:
        def of_size(side: int) -> Tensor:
            smooth = F.gaussian_blur2d(levels, side)
            return F.straight_through((smooth.detach() + 0.5).floor(), smooth) if self.whole else smooth

        return F.blend_sizes(self._parameter("difference.blur_px", values), of_size, pitch=2)

    def _in_units(self, z: Tensor, textured: Tensor, steps: float) -> Tensor:
        """Evidence by its median over textured pixels, where that is above one noise unit."""
        units = F.noise_units(z.detach().round().to(torch.uint8), textured, steps)
        if bool((units == 1.0).all()):
            return z
        # Computed in whole numbers, as in the hard pipeline; the gradient is that of the pixel in the middle.
        median = F.masked_median(z.flatten(1), textured.flatten(1))[:, 0] / steps
        per_unit = units.reciprocal().to(z.dtype)
        slope = torch.where(units > 1.0, median.clamp(min=0.5).reciprocal(), per_unit)
        per_unit = F.straight_through(per_unit, slope) if self.whole else slope
        return self._rounded(z * per_unit.reshape(-1, 1, 1, 1))

    def _rounded(self, x: Tensor) -> Tensor:
        return F.round_straight_through(x) if self.whole else x
