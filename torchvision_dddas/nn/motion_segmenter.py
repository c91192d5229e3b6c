"""Motion segmentation: the torch engine's chain, the model that is tuned, and the graph that is exported, in one.

    warp -> light -> difference -> noise units -> blur -> largest over the pairs -> threshold -> cleaning

The cleaning erodes, dilates and closes; with `difference.blur_of = "silhouette"` the blur stands at its beginning.

Without softness all is computed in bytes, as the OpenCV engine does. With softness, a share of each threshold, the same
steps have gradients in the parameters. None that can be tuned acts before the differences: registration, warps and
exposure are hard and pass no gradient. Whole grey levels are rounded straight through. Thresholds and extrema commute,
so the margin over the threshold goes through the morphology, whose extrema stay hard, and the threshold is softened
last: the outline lies where the hard one does, whatever the softness. Regions are labelled hard and gated softly; a
hull is the hard one of a region, and counts as far as its region does.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from kornia.color import rgb_to_grayscale
from torch import Tensor, nn

import torchvision_dddas.functional as F
from torchvision_dddas.config import EVIDENCE_CAP, EVIDENCE_SCALE, HALF, WHITE, Settings, check_settings, exposure_step
from torchvision_dddas.errors import InputError
from torchvision_dddas.functional.difference import absolute_difference
from torchvision_dddas.functional.filters import is_above, to_bytes
from torchvision_dddas.geometry import later_pair, near_gaps, near_pairs, next_pair
from torchvision_dddas.nn.registration import LEVEL, Registration

Values = Mapping[str, float | Tensor]
Pair = tuple[int, int]

TUNED = ("difference.threshold", "difference.noise_levels", "difference.gradient_share")
"""Parameters that are learned unless others are named."""

TUNABLE = (
    *TUNED,
    *("difference.blur_px", "difference.peak", "gates.min_area_px"),
    *("morphology.erode_px", "morphology.dilate_px", "morphology.close_px"),
)
"""Parameters that can be learned or given with a call; `peak` and `min_area_px` act in `outlined` alone."""

# Pixels of more gradient, 4 x grey levels each, have texture: they show how well the registration fits.
_TEXTURED = 16
# The exposure is not judged by fewer pixels.
_EXPOSURE_LEAST = 100
_GREY_OF_RGB = tuple(share / 2**15 for share in (9798, 19235, 3735))  # OpenCV's


class Segmentation(NamedTuple):
    """What moves in the frames of a batch of clips.

    mask: 0 to 1; all 0 where a frame has no two neighbours. evidence: the largest difference, in noise units or grey
    levels. later_from_earlier: the background's motion from each frame to the next, float64; inliers: how many
    keypoints agree with it. margin: above 0 where the mask is above one half; see `Core`.
    """

    mask: Float[Tensor, "B T 1 H W"]
    evidence: Float[Tensor, "B T 1 H W"]
    later_from_earlier: Float[Tensor, "B T-1 3 3"]
    inliers: Int64[Tensor, "B T-1"]
    margin: Float[Tensor, "B T 1 H W"]


@dataclass(frozen=True)
class Differences:
    """A batch of windows, before any tunable parameter acts.

    least: the difference that both neighbours of each near pair show, grey levels. both: where both are seen. texture:
    4 x grey levels a pixel.
    """

    least: UInt8[Tensor, "B P H W"]
    both: Bool[Tensor, "B P H W"]
    texture: Float[Tensor, "B 1 H W"]


class Core(NamedTuple):
    """Where targets are certain.

    mask: 0 to 1. margin: above 0 where the mask is above one half; with softness by how much evidence is above the
    threshold, cleaned. evidence: the largest over the near pairs. Both in noise units, or grey levels.
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


@dataclass
class WarpedWindows:
    """A batch of references and what their neighbours show of them.

    grey: (B, 1, H, W) uint8; warped: the same for each neighbour; seen: for each the first and last column of every row
    that it shows (see `functional.seen_columns`); texture: (B, 1, H, W) float, 4 x grey levels a pixel. between_later:
    compare the neighbours of a pair with each other, not with the reference.
    """

    grey: Tensor
    warped: list[Tensor]
    seen: list[tuple[Tensor, Tensor]]
    texture: Tensor
    between_later: bool
    _distance: dict[int, Tensor] = field(default_factory=dict)

    def both(self, pair: Pair) -> Tensor:
        """Where both neighbours of a pair are seen."""
        return F.seen_by_both(self.seen[pair[0]], self.seen[pair[1]], self.grey.shape[-1])

    def least(self, pair: Pair) -> Tensor:
        """What the settings compare of a pair."""
        if self.between_later:
            return absolute_difference(self.warped[pair[0]], self.warped[pair[1]])
        return self.smaller(pair)

    def smaller(self, pair: Pair) -> Tensor:
        """The difference from the reference that both neighbours of a pair show."""
        for k in pair:
            if k not in self._distance:
                self._distance[k] = absolute_difference(self.grey, self.warped[k])
        return torch.minimum(self._distance[pair[0]], self._distance[pair[1]])

    def differences(self, pairs: Sequence[Pair]) -> Differences:
        """What `MotionSegmenter.segment` takes."""
        least, both = (torch.cat([of(pair) for pair in pairs], 1) for of in (self.least, self.both))
        return Differences(least, both, self.texture)


class MotionSegmenter(nn.Module):
    """Masks of what moves in clips of a moving camera.

    Parameters that are named in `tuned` are nn.Parameters, float64 as the settings' numbers; others are those of the
    settings, or given with a call. whole: round where the engines do, straight through; False rounds nowhere, for
    gradient checks.

    Nothing is asked of the host on a GPU, with two exceptions: a size in pixels that is a tensor (blur_px, erode_px,
    dilate_px, close_px) decides which kernels are built, and is read; and corners of the whole frame
    (`registration.corners`) are chosen in rounds whose end the host asks for.
    """

    def __init__(
        self,
        settings: Settings | None = None,
        softness: float = 0.0,
        tuned: Sequence[str] = TUNED,
        whole: bool = True,
    ) -> None:
        """softness: a share of each threshold; 0 is the engine's hard chain. tuned: names of TUNABLE.

        Raises InputError for a negative softness and other names.
        """
        super().__init__()
        if softness < 0:
            raise InputError(f"softness must be 0 or more, got {softness}")
        _check_names(tuned)
        self.settings, self.softness, self.whole = check_settings(settings), softness, whole
        self.registration = Registration(self.settings.registration)
        self.tuned = {name: name.replace(".", "_") for name in tuned}
        for name, attribute in self.tuned.items():
            start = torch.tensor(self._setting(name), dtype=torch.float64)
            self.register_parameter(attribute, nn.Parameter(start))

    @property
    def is_normalized(self) -> bool:
        """Whether differences are in units of local noise."""
        return self.settings.difference.kind == "normalized"

    @property
    def _unit(self) -> float:
        """The step of evidence maps for one unit of the thresholds."""
        return EVIDENCE_SCALE if self.is_normalized else 1.0

    def forward(
        self,
        clip: Float[Tensor, "B T C H W"],
        later_from_earlier: Float[Tensor, "B T-1 3 3"] | None = None,
        values: Values | None = None,
    ) -> Segmentation:
        """Segment every frame of clips of RGB or grey pictures in [0, 1].

        later_from_earlier: px; estimated by default. values: parameters by name, in place of the settings' and the
        module's own. A frame is compared with the neighbours of `difference.near_frames` on both sides; at the ends of
        a clip with the two nearest on one side.

        Raises InputError for clips or motions of another shape or type, and unknown names.
        """
        _check_clip(clip, later_from_earlier)
        _check_names(values or ())
        levels = self._levels(clip)
        batch, frames = levels.shape[:2]
        with torch.no_grad():
            inliers = torch.zeros(batch, frames - 1, dtype=torch.int64, device=clip.device)
            if later_from_earlier is None and not batch * (frames - 1):
                later_from_earlier = torch.zeros(batch, frames - 1, 3, 3, dtype=torch.float64, device=clip.device)
            elif later_from_earlier is None:
                earlier, later = (levels[:, part].flatten(0, 1) / LEVEL for part in (slice(-1), slice(1, None)))
                motion = self.registration(earlier, later)
                later_from_earlier = motion.later_from_earlier.unflatten(0, (batch, frames - 1))
                inliers = motion.inliers.sum(1).unflatten(0, (batch, frames - 1))
        groups: dict[tuple[Pair, ...], list[int]] = defaultdict(list)
        for at in range(frames):
            groups[tuple((a - at, b - at) for a, b in self._pairs(at, frames))].append(at)
        mask = [levels.new_zeros(batch, 1, *levels.shape[3:])] * frames
        evidence, margin = list(mask), list(mask)
        for pairs, places in groups.items():
            if not pairs or not batch:
                continue
            with torch.no_grad():
                windows, near = self._windows(levels, later_from_earlier, places, pairs)
            core = self.segment(windows.differences(near), values)
            for maps, found in ((mask, core.mask), (evidence, core.evidence), (margin, core.margin)):
                for place, of_frame in zip(places, found.unflatten(0, (batch, -1)).unbind(1), strict=True):
                    maps[place] = of_frame
        masks, evidences, margins = (torch.stack(frames_of, 1) for frames_of in (mask, evidence, margin))
        return Segmentation(masks, evidences, later_from_earlier, inliers, margins)

    def segment(self, differences: Differences, values: Values | None = None, softness: float | None = None) -> Core:
        """The core of windows of known differences. softness: in place of the module's own."""
        softness = self.softness if softness is None else softness
        weight = self.noise_weight(differences.texture, values)
        largest: Tensor | None = None
        for k in range(differences.least.shape[1]):
            least, both = differences.least[:, k : k + 1], differences.both[:, k : k + 1]
            z = self.pair_evidence(least, both, differences.texture, weight, values, softness)
            largest = z if largest is None else torch.maximum(largest, z)
        assert largest is not None, "a window has a pair"
        margin = self.core(largest, values)
        evidence, unit = largest.to(differences.texture.dtype) / self._unit, self._unit
        if largest.dtype == torch.uint8:
            mask = (margin > 0).to(evidence.dtype)
            return Core(mask, mask, evidence)
        margin = margin / unit
        return Core(F.step(margin, softness * self.settings.difference.threshold), margin, evidence)

    def warp(
        self,
        levels: Float[Tensor, "B 1 H W"],
        neighbours: Iterable[Float[Tensor, "B 1 h w"]],
        neighbour_from_reference: Float[Tensor, "B K 3 3"],
        light: tuple[Tensor, Tensor] | None = None,
    ) -> WarpedWindows:
        """K neighbours warped to their references, in the references' light. levels, neighbours: whole grey levels.

        light: (B, K) gains and offsets that take the neighbours' levels to the reference's, used for `to_reference`
        alone; `normalized` fits them to what both show.
        """
        parameters, size = self.settings.difference, (levels.shape[-2], levels.shape[-1])
        warped: list[Tensor] = []
        frame_sizes: list[tuple[int, int]] = []
        for k, neighbour in enumerate(neighbours):
            matrix = neighbour_from_reference[:, k]
            warp = partial(F.warp_perspective, dsize=size, padding_mode="border", inverse_map=True, subpixels=32)
            warped.append(warp(neighbour, matrix, whole=True))
            frame_sizes.append((neighbour.shape[-2], neighbour.shape[-1]))
        seen = _seen(neighbour_from_reference, size, frame_sizes, parameters.border_px)
        if self.is_normalized and warped:
            light = _fit_light(levels, warped, seen)
        if light is not None and parameters.kind in ("normalized", "to_reference"):
            gains, offsets = (part.to(levels) for part in light)
            lit = zip(warped, gains.unbind(1), offsets.unbind(1), strict=True)
            warped = [_apply_light(levels, picture, gain, offset) for picture, gain, offset in lit]
        # Needed for neither otherwise.
        wanted = self.is_normalized or self.settings.refine.on
        texture = F.mean_gradient(levels) if wanted else torch.zeros_like(levels)
        return WarpedWindows(to_bytes(levels), warped, seen, texture, parameters.kind == "between_later")

    def noise_weight(self, texture: Tensor, values: Values | None = None) -> Tensor | None:
        """(B, 1, H, W) steps of evidence a grey level; None unless differences are in units of local noise."""
        if not self.is_normalized:
            return None
        names = ("difference.noise_levels", "difference.gradient_share")
        return F.noise_weight(texture, *(self._value(name, values) for name in names)) * EVIDENCE_SCALE

    def pair_evidence(
        self,
        least: UInt8[Tensor, "B 1 H W"],
        both: Bool[Tensor, "B 1 H W"],
        texture: Float[Tensor, "B 1 H W"],
        weight: Tensor | None,
        values: Values | None = None,
        softness: float = 0.0,
    ) -> Tensor:
        """(B, 1, H, W) evidence of a pair in steps: bytes without softness, else of the texture's type.

        least, both: of `WarpedWindows`. weight: of `noise_weight`.
        """
        is_hard = softness == 0.0 and self.whole
        if weight is None:
            return self._blurred(least if is_hard else least.to(texture.dtype), values) * both
        z = self._rounded((least * both * weight).clamp_(max=EVIDENCE_CAP), is_hard)
        z = self._blurred(z, values)
        # Divided by its median over textured pixels, where that is above one noise unit.
        textured = (texture > _TEXTURED) & both
        units = F.noise_units(z if is_hard else z.detach().round().to(torch.uint8), textured, EVIDENCE_SCALE)
        if F.all_true(units == 1.0):
            return z
        per_unit = units.reciprocal().to(weight.dtype)
        if not is_hard:
            # Computed in whole numbers, as in the hard chain; the gradient is that of the pixel in the middle.
            median = F.masked_median(z.flatten(1), textured.flatten(1))[:, 0] / EVIDENCE_SCALE
            slope = torch.where(units > 1.0, median.clamp(min=0.5).reciprocal(), per_unit)
            per_unit = F.straight_through(per_unit, slope) if self.whole else slope
        return self._rounded(z * per_unit.reshape(-1, 1, 1, 1), is_hard)

    def core(self, evidence: Tensor, values: Values | None = None, close_px: int = 0) -> Tensor:
        """Evidence above the threshold, cleaned: bytes of 0 and 255, or a margin in steps where it is soft.

        close_px: in place of the parameter. Raises InputError for a soft margin of a smoothed silhouette.
        """
        threshold = self._value("difference.threshold", values)
        limit = threshold if self._unit == 1.0 else threshold * self._unit
        if evidence.dtype == torch.uint8:
            above = evidence > limit if isinstance(limit, Tensor) else is_above(evidence, int(limit))
            margin = above.to(torch.uint8) * 255
            if self.settings.difference.blur_of == "silhouette":
                margin = is_above(self._smooth(margin, values), HALF).to(torch.uint8) * 255
        else:
            check_softness(self.settings)
            margin = evidence - limit
        erode, dilate, close = (self._value(f"morphology.{name}_px", values) for name in ("erode", "dilate", "close"))
        eroded = F.blend_sizes(erode, lambda side: F.erosion(margin, F.kernel_array("ellipse", side)))

        def dilated(side: int) -> Tensor:
            return eroded if side == 1 else F.dilation(eroded, F.kernel_array("ellipse", side))

        wide = F.blend_sizes(dilate, dilated)
        return F.blend_sizes(close_px or close, lambda side: close_masks(wide, side))

    def outlined(
        self, core: Core, found: Regions, values: Values | None = None, softness: float | None = None
    ) -> Float[Tensor, "B 1 H W"]:
        """The mask of the regions that pass the gates, their hulls filled. softness: of the gates, a share of each."""
        gate = F.gate_regions(
            core.mask,
            core.evidence,
            found.near,
            found.count,
            self._value("gates.min_area_px", values),
            self._value("difference.peak", values),
            self.softness if softness is None else softness,
        )
        drawn = core.mask * F.gates_of_pixels(gate, found.near)
        # In the hull of a region, a hole or a speck is foreground as far as that region is, whatever its evidence.
        carried = (core.margin <= 0) | (found.filled != found.near)
        return torch.maximum(drawn, F.gates_of_pixels(gate, found.filled) * carried)

    def _levels(self, clip: Tensor) -> Float[Tensor, "B T 1 H W"]:
        """Whole grey levels, rounded as OpenCV rounds them."""
        levels = (clip.detach() * LEVEL).round_()
        if clip.shape[2] == 3:
            weights = torch.tensor(_GREY_OF_RGB, dtype=clip.dtype, device=clip.device)
            levels = rgb_to_grayscale(levels, weights).add_(0.5).floor_()
        return levels

    def _pairs(self, at: int, frames: int) -> list[Pair]:
        """The pairs of frames that a frame is compared with."""
        if self.settings.difference.kind == "between_later":
            return later_pair(at, self.settings.interval.frames, 0, frames - 1)
        if self.settings.difference.kind == "to_next":
            return next_pair(at, self.settings.interval.frames, 0, frames - 1)
        difference = self.settings.difference
        gaps = near_gaps(difference.near_frames, difference.wide_frames, self.settings.interval.frames)
        return near_pairs(at, gaps, 0, frames - 1)

    def _windows(
        self, levels: Tensor, later_from_earlier: Tensor, places: list[int], pairs: tuple[Pair, ...]
    ) -> tuple[WarpedWindows, list[Pair]]:
        """The windows of the places of all clips, clip by clip, and the pairs of their neighbours."""
        offsets = sorted({offset for pair in pairs for offset in pair})
        reference = levels[:, places].flatten(0, 1)
        neighbours = [levels[:, [place + offset for place in places]].flatten(0, 1) for offset in offsets]
        chained = [[chain_motion(later_from_earlier, at, at + offset) for at in places] for offset in offsets]
        matrices = torch.stack([torch.stack(row, 1).flatten(0, 1) for row in chained], 1)
        light = None
        if self.settings.difference.kind == "to_reference":
            wanted = F.level_quantiles(reference)
            fits = [F.fit_quantiles(wanted, F.level_quantiles(neighbour)) for neighbour in neighbours]
            light = torch.stack([gain for gain, _ in fits], 1), torch.stack([offset for _, offset in fits], 1)
        near = [(offsets.index(a), offsets.index(b)) for a, b in pairs]
        return self.warp(reference, neighbours, matrices, light), near

    def _setting(self, name: str) -> float:
        group, key = name.split(".")
        return float(getattr(getattr(self.settings, group), key))

    def _value(self, name: str, values: Values | None) -> float | Tensor:
        if values is not None and name in values:
            return values[name]
        if name in self.tuned:
            own: Tensor = getattr(self, self.tuned[name])
            return own
        return self._setting(name)

    def _blurred(self, levels: Tensor, values: Values | None) -> Tensor:
        """The difference smoothed, where that is what is smoothed."""
        return levels if self.settings.difference.blur_of == "silhouette" else self._smooth(levels, values)

    def _smooth(self, levels: Tensor, values: Values | None) -> Tensor:
        def of_size(side: int) -> Tensor:
            smooth = F.gaussian_blur2d(levels, side)
            if levels.dtype == torch.uint8 or not self.whole:
                return smooth
            return F.straight_through((smooth.detach() + 0.5).floor(), smooth)

        return F.blend_sizes(self._value("difference.blur_px", values), of_size, pitch=2)

    def _rounded(self, x: Tensor, is_hard: bool) -> Tensor:
        if is_hard:
            return to_bytes(x.round_())
        return F.round_straight_through(x) if self.whole else x


def _check_names(names: Iterable[str]) -> None:
    if unknown := [name for name in names if name not in TUNABLE]:
        raise InputError(f"MotionSegmenter has no parameter {', '.join(unknown)}; wanted some of {', '.join(TUNABLE)}")


def _check_clip(clip: Tensor, later_from_earlier: Tensor | None) -> None:
    shape = tuple(getattr(clip, "shape", ()))
    if not isinstance(clip, Tensor) or len(shape) != 5 or shape[1] < 1 or shape[2] not in (1, 3):
        what = f"{getattr(clip, 'dtype', type(clip).__name__)} {shape}"
        raise InputError(f"a clip must be floats (batch, frames, 1 or 3, height, width) in [0, 1], got {what}")
    code = ""
    if clip.dtype not in (torch.float32, torch.float64):
        code = "clip.float()" if clip.is_floating_point() else "clip.float() / 255"
    elif clip.numel() and F.may_branch(clip):  # what lies on a GPU is not read
        low, high = (float(end) for end in clip.aminmax())
        if not (low >= 0 and high <= 1):
            code = "clip.nan_to_num()" if low != low else "clip / 255" if low >= 0 and high > 2 else "clip.clamp(0, 1)"
    if code:
        what = str(clip.dtype) if clip.dtype not in (torch.float32, torch.float64) else f"{low:g} to {high:g}"
        raise InputError(f"a clip must be float32 or float64 in [0, 1], got {what}; convert it: {code}")
    if later_from_earlier is not None and tuple(later_from_earlier.shape) != (shape[0], shape[1] - 1, 3, 3):
        wanted, got = (shape[0], shape[1] - 1, 3, 3), tuple(later_from_earlier.shape)
        raise InputError(f"later_from_earlier must be {wanted}, one matrix a step, got {got}")


def check_softness(settings: Settings) -> None:
    """Raises InputError for a smoothed silhouette, whose outline at one half is no threshold of evidence."""
    if settings.difference.blur_of == "silhouette":
        raise InputError(
            "difference.blur_of = silhouette has no soft masks and cannot be tuned by gradient; "
            "set difference.blur_of=difference"
        )


def chain_motion(later_from_earlier: Float[Tensor, "B S 3 3"], start: int, end: int) -> Float[Tensor, "B 3 3"]:
    """The motion from frame `start` to frame `end` of each clip, h33 = 1."""
    low, high = min(start, end), max(start, end)
    matrix = torch.eye(3, dtype=later_from_earlier.dtype, device=later_from_earlier.device).expand(
        len(later_from_earlier), 3, 3
    )
    for step in range(low, high):
        matrix = later_from_earlier[:, step] @ matrix
    matrix = matrix if end >= start else F.invert_map(matrix)
    return matrix / matrix[:, 2:, 2:]


def close_masks(mask: Tensor, side: int) -> Tensor:
    """The mask closed with an ellipse; of bytes on a CPU only around where any of the pictures is set at all."""
    kernel = F.kernel_array("ellipse", side)
    if mask.dtype != torch.uint8 or not F.may_branch(mask):
        return F.closing(mask, kernel)
    spans = []
    for dim in (-1, -2):
        places = mask.amax((0, 1, dim)).nonzero()
        if not len(places):
            return mask
        # A pixel's closing depends on what lies less than 2 x side away.
        spans.append(slice(max(int(places[0]) - 2 * side, 0), int(places[-1]) + 2 * side + 1))
    out = torch.zeros_like(mask)
    out[..., spans[0], spans[1]] = F.closing(mask[..., spans[0], spans[1]], kernel)
    return out


def _seen(
    neighbour_from_reference: Tensor, size: tuple[int, int], frame_sizes: Sequence[tuple[int, int]], border_px: int
) -> list[tuple[Tensor, Tensor]]:
    """`seen_columns` of every neighbour; all of one size at once."""
    seen: dict[int, tuple[Tensor, Tensor]] = {}
    for frame_size in dict.fromkeys(frame_sizes):
        places = [k for k, other in enumerate(frame_sizes) if other == frame_size]
        matrices = neighbour_from_reference[:, places].flatten(0, 1)
        edges = F.seen_columns(matrices, size, frame_size, border_px)
        first, last = (edge.unflatten(0, (-1, len(places))).unbind(1) for edge in edges)
        seen |= zip(places, zip(first, last, strict=True), strict=True)
    return [seen[k] for k in range(len(frame_sizes))]


def _fit_light(
    reference: Tensor, warped: Sequence[Tensor], seen: Sequence[tuple[Tensor, Tensor]]
) -> tuple[Tensor, Tensor]:
    """Gains and offsets, (B, K) each, that give K warped pictures their references' exposure."""
    pitch = exposure_step(reference.shape[-2:])
    first, last = (torch.stack([edge[:, ::pitch] for edge in edges], 1)[..., None] for edges in zip(*seen, strict=True))
    columns = torch.arange(0, reference.shape[-1], pitch, device=reference.device)
    inside = ((columns >= first) & (columns <= last)).flatten(0, 1)[:, None]
    given = torch.stack([picture[..., ::pitch, ::pitch] for picture in warped], 1) / LEVEL
    wanted = (reference[..., ::pitch, ::pitch] / LEVEL)[:, None].expand(given.shape)
    gain, offset = F.fit_exposure(wanted.flatten(0, 1), given.flatten(0, 1).to(reference.dtype), inside)
    enough = inside.sum((1, 2, 3)) >= _EXPOSURE_LEAST
    gain, offset = torch.where(enough, gain, 1.0), torch.where(enough, offset * LEVEL, 0.0)
    return gain.unflatten(0, (-1, len(warped))), offset.unflatten(0, (-1, len(warped)))


def _apply_light(reference: Tensor, warped: Tensor, gain: Tensor, offset: Tensor) -> Tensor:
    """The warped pictures, bytes, through their gains and offsets, (B,) each.

    Where they are clipped at white they agree with anything brighter.
    """
    gain, offset = gain.reshape(-1, 1, 1, 1), offset.reshape(-1, 1, 1, 1)
    levels = torch.arange(LEVEL + 1, dtype=gain.dtype, device=gain.device)
    if F.all_true((gain * levels + offset).round() == levels):
        return warped
    darkened = (gain * LEVEL + offset).round() < WHITE
    # A clipped pixel only says that the place was at least so bright.
    cut = None if F.all_true(~darkened) else (warped >= WHITE) & darkened
    through = warped.to(gain.dtype).mul_(gain).add_(offset).round_().clamp_(0.0, LEVEL)
    through = to_bytes(through)
    return through if cut is None else torch.where(cut, torch.maximum(through, to_bytes(reference)), through)
