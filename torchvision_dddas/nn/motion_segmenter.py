"""Motion segmentation: the detection chain on tensors, for the torch engine, tuning and the exported graphs.

With softness, a share of each threshold, the chain has gradients in its parameters (see `functional.TensorOperations`).
Regions are labelled hard and gated softly. The hull of a region is hard, and counts as far as its region passes.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from kornia.color import rgb_to_grayscale
from torch import Tensor, nn

import torchvision_dddas.functional as F
from torchvision_dddas.chain import (
    DetectionChain,
    Pair,
    Reference,
    Window,
    evidence_scale,
    later_pair,
    near_gaps,
    near_pairs,
    next_pair,
)
from torchvision_dddas.config import Settings, check_settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.nn.registration import LEVEL, FrameRegistration

Values = Mapping[str, float | Tensor]
TensorChain = DetectionChain[Tensor, Tensor, tuple[Tensor, Tensor]]

TUNED = ("difference.threshold", "difference.noise_levels", "difference.gradient_share")
"""Parameters that are learned by default."""

TUNABLE = (
    *TUNED,
    *("difference.blur_px", "difference.peak", "gates.min_area_px"),
    *("morphology.erode_px", "morphology.dilate_px", "morphology.close_px"),
)
"""Parameters that can be learned or given in a call. `peak` and `min_area_px` act only in `outlined`."""

_GREY_OF_RGB = tuple(share / 2**15 for share in (9798, 19235, 3735))  # the weights that OpenCV uses


class Segmentation(NamedTuple):
    """The moving targets in the frames of a batch of clips.

    mask: 0 to 1; all 0 if a frame has no two neighbours. evidence: the largest difference, in noise units or grey
    levels. later_from_earlier: the background's motion from each frame to the next, float64. inliers: number of
    keypoints that agree with the motion. margin: above 0 where the mask is above one half; see `Core`.
    """

    mask: Float[Tensor, "B T 1 H W"]
    evidence: Float[Tensor, "B T 1 H W"]
    later_from_earlier: Float[Tensor, "B T-1 3 3"]
    inliers: Int64[Tensor, "B T-1"]
    margin: Float[Tensor, "B T 1 H W"]


@dataclass(frozen=True)
class Differences:
    """A batch of windows, before any tunable parameter acts.

    least: the difference of each near pair, by `difference.kind`, in grey levels. both: the pixels that both neighbours
    show. texture: texture of the reference, in 4 x grey levels a pixel. grey: its grey levels.

    >>> least = torch.zeros(1, 2, 64, 64, dtype=torch.uint8)
    >>> least[..., 20:40, 20:40] = 90
    >>> nothing = torch.zeros(1, 1, 64, 64)
    >>> found = nn.Differences(least, torch.ones(1, 2, 64, 64, dtype=torch.bool), nothing, nothing.byte())
    >>> core = nn.MotionSegmenter().segment(found)
    >>> core.mask[0, 0, [10, 30], 30].tolist()
    [0.0, 1.0]
    """

    least: UInt8[Tensor, "B P H W"]
    both: Bool[Tensor, "B P H W"]
    texture: Float[Tensor, "B 1 H W"]
    grey: UInt8[Tensor, "B 1 H W"]


class Core(NamedTuple):
    """The masks of the certain parts of targets.

    mask: 0 to 1. margin: above 0 where the mask is above one half; with softness, the cleaned excess of the evidence
    over the threshold. evidence: the largest over the near pairs. Both are in noise units or grey levels.

    >>> maps = torch.zeros(1, 1, 64, 64)
    >>> core = nn.Core(mask=maps, margin=maps - 3.5, evidence=maps)
    >>> bool((core.mask == (core.margin > 0)).all())
    True
    """

    mask: Float[Tensor, "B 1 H W"]
    margin: Float[Tensor, "B 1 H W"]
    evidence: Float[Tensor, "B 1 H W"]


@dataclass(frozen=True)
class Regions:
    """Label maps of the connected regions of a hard core: 0 is background, others 1 to `count`.

    near: the regions, and the pixels around them that may join them. filled: the hulls of the regions, or the regions.

    >>> labels = torch.zeros(1, 1, 64, 64, dtype=torch.int64)
    >>> labels[..., 20:40, 20:40] = 1
    >>> mask = (labels > 0).float()
    >>> core = nn.Core(mask, margin=mask - 0.5, evidence=20 * mask)
    >>> outlined = nn.MotionSegmenter().outlined(core, nn.Regions(near=labels, filled=labels, count=1))
    >>> outlined[0, 0, [10, 30], 30].tolist()
    [0.0, 1.0]
    """

    near: Int64[Tensor, "B 1 H W"]
    filled: Int64[Tensor, "B 1 H W"]
    count: int


class MotionSegmenter(nn.Module):
    """Masks of moving targets in clips of a moving camera, up to the cleaned mask.

    `detection.detect_masks` adds the detector's later steps: hulls, tracklets, outlines, small targets.

    Parameters that are named in `tuned` are nn.Parameters, float64 like the numbers of the settings. All others come
    from the settings, or are given in a call. whole: round where the engines do, straight through; False never
    rounds, for gradient checks.

    On a GPU the host waits for the device in only two cases. A size in pixels that is a tensor (blur_px, erode_px,
    dilate_px, close_px) is read to build kernels. Corners of the whole frame (`registration.corners`) are chosen in
    rounds, and the host asks whether they have ended.

    >>> model = nn.MotionSegmenter(td.load_settings("fast"))
    >>> found = model(torch.rand(1, 3, 1, 64, 64))
    >>> found.mask.shape, found.later_from_earlier.shape
    (torch.Size([1, 3, 1, 64, 64]), torch.Size([1, 2, 3, 3]))
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        softness: float = 0.0,
        tuned: Sequence[str] = TUNED,
        whole: bool = True,
    ) -> None:
        """softness: a share of each threshold; 0 is the engine's hard chain. tuned: names of TUNABLE.

        Raise InputError for a negative softness and for other names.
        """
        super().__init__()
        if softness < 0:
            raise InputError(f"softness must be 0 or more, got {softness}")
        _check_names(tuned)
        self.settings, self.softness, self.whole = check_settings(settings), softness, whole
        self.registration = FrameRegistration(self.settings.registration)
        self.tuned = {name: name.replace(".", "_") for name in tuned}
        chain = DetectionChain(self.settings, F.TensorOperations())
        for name, attribute in self.tuned.items():
            start = torch.tensor(float(chain.value(name)), dtype=torch.float64)
            self.register_parameter(attribute, nn.Parameter(start))

    def tuned_settings(self) -> Settings:
        """Return the settings with the learned numbers, sizes rounded, for a detector that equals this module.

        >>> detector = td.MotionDetector(model.tuned_settings(), "torch")
        """
        learned: dict[str, object] = {}
        for name, attribute in self.tuned.items():
            number = float(getattr(self, attribute).detach())
            is_whole = isinstance(DetectionChain(self.settings, F.TensorOperations()).value(name), int)
            learned[name] = round(number) if is_whole else number
        return with_parameters(self.settings, learned)

    def forward(
        self,
        clip: Float[Tensor, "B T C H W"],
        later_from_earlier: Float[Tensor, "B T-1 3 3"] | None = None,
        *,
        values: Values | None = None,
    ) -> Segmentation:
        """Segment every frame of clips of RGB or grey pictures in [0, 1].

        later_from_earlier: px; estimated by default. values: parameters by name, which override the settings
        and the module. A frame is compared with the neighbours of `difference.near_frames` on both sides; at the ends
        of a clip, with the two nearest on one side.

        Raise InputError for clips or motions of another shape or type, and for unknown names.
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
                differences = self._differences(levels, later_from_earlier, places, pairs)
            core = self.segment(differences, values=values)
            for maps, found in ((mask, core.mask), (evidence, core.evidence), (margin, core.margin)):
                for place, of_frame in zip(places, found.unflatten(0, (batch, -1)).unbind(1), strict=True):
                    maps[place] = of_frame
        masks, evidences, margins = (torch.stack(frames_of, 1) for frames_of in (mask, evidence, margin))
        return Segmentation(masks, evidences, later_from_earlier, inliers, margins)

    def segment(self, differences: Differences, *, values: Values | None = None, softness: float | None = None) -> Core:
        """Return the core of windows of known differences. softness: replaces the module's own.

        Raise InputError for soft masks of a smoothed silhouette.
        """
        softness, texture = self.softness if softness is None else softness, differences.texture
        chain = self.chain(values, softness=softness, dtype=texture.dtype)
        least, both = differences.least, differences.both
        pairs = [(least[:, k : k + 1], both[:, k : k + 1]) for k in range(least.shape[1])]  # graphs have no split
        largest = chain.find_evidence(pairs, Reference(differences.grey, texture))
        margin, unit = chain.find_core(largest), evidence_scale(self.settings)
        evidence = largest.to(texture.dtype) / unit
        if margin.dtype == torch.uint8:
            mask = (margin > 0).to(evidence.dtype)
            return Core(mask, mask, evidence)
        margin = margin / unit
        return Core(F.step(margin, softness=softness * self.settings.difference.threshold), margin, evidence)

    def chain(
        self, values: Values | None = None, *, softness: float = 0.0, dtype: torch.dtype = torch.float32
    ) -> TensorChain:
        """Return the detection chain on tensors, with the module's parameters. values: replace some of them.

        Raise InputError for soft masks of a smoothed silhouette.
        """
        is_soft = softness > 0 or not self.whole
        if is_soft:
            check_softness(self.settings)
        own = {name: getattr(self, attribute) for name, attribute in self.tuned.items()}
        return DetectionChain(
            self.settings, F.TensorOperations(softness, whole=self.whole, dtype=dtype), {**own, **(values or {})}
        )

    def outlined(
        self, core: Core, found: Regions, *, values: Values | None = None, softness: float | None = None
    ) -> Float[Tensor, "B 1 H W"]:
        """Return the mask of the regions that pass the gates, with filled hulls. softness: a share of each gate."""
        value = self.chain(values).value
        gate = F.gate_regions(
            core.mask,
            core.evidence,
            found.near,
            found.count,
            value("gates.min_area_px"),
            value("difference.peak"),
            softness=self.softness if softness is None else softness,
        )
        drawn = core.mask * F.gates_of_pixels(gate, found.near)
        # In the hull of a region, a hole or a speck is foreground as far as the region is, whatever its own evidence.
        carried = (core.margin <= 0) | (found.filled != found.near)
        return torch.maximum(drawn, F.gates_of_pixels(gate, found.filled) * carried)

    def _levels(self, clip: Tensor) -> Float[Tensor, "B T 1 H W"]:
        """Return whole grey levels, rounded as in OpenCV."""
        levels = (clip.detach() * LEVEL).round_()
        if clip.shape[2] == 3:
            weights = torch.tensor(_GREY_OF_RGB, dtype=clip.dtype, device=clip.device)
            levels = rgb_to_grayscale(levels, weights).add_(0.5).floor_()
        return levels

    def _pairs(self, at: int, frames: int) -> list[Pair]:
        """Return the pairs of frames with which a frame is compared."""
        if self.settings.difference.kind == "between_later":
            return later_pair(at, self.settings.interval.frames, 0, frames - 1)
        if self.settings.difference.kind == "to_next":
            return next_pair(at, self.settings.interval.frames, 0, frames - 1)
        difference = self.settings.difference
        gaps = near_gaps(difference.near_frames, difference.wide_frames, self.settings.interval.frames)
        return near_pairs(at, gaps, 0, frames - 1)

    def _differences(
        self, levels: Tensor, later_from_earlier: Tensor, places: list[int], pairs: tuple[Pair, ...]
    ) -> Differences:
        """Return the differences of the windows at the places in all clips, clip by clip."""
        offsets = sorted({offset for pair in pairs for offset in pair})
        reference = levels[:, places].flatten(0, 1)
        neighbours = [levels[:, [place + offset for place in places]].flatten(0, 1) for offset in offsets]
        chained = [[chain_motion(later_from_earlier, at, at + offset) for at in places] for offset in offsets]
        matrices = torch.stack([torch.stack(row, 1).flatten(0, 1) for row in chained], 1)
        near = tuple((offsets.index(a), offsets.index(b)) for a, b in pairs)
        return differences_of(self.chain(), Window(reference, tuple(neighbours), matrices, tuple(offsets), near))


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
    elif clip.numel() and F.may_branch(clip):  # values on a GPU are not read
        low, high = (float(end) for end in clip.aminmax())
        if not (low >= 0 and high <= 1):
            code = "clip.nan_to_num()" if low != low else "clip / 255" if low >= 0 and high > 2 else "clip.clamp(0, 1)"
    if code:
        what = str(clip.dtype) if clip.dtype not in (torch.float32, torch.float64) else f"{low:g} to {high:g}"
        raise InputError(f"a clip must be float32 or float64 in [0, 1], got {what}; convert it: {code}")
    if later_from_earlier is not None and tuple(later_from_earlier.shape) != (shape[0], shape[1] - 1, 3, 3):
        wanted, got = (shape[0], shape[1] - 1, 3, 3), tuple(later_from_earlier.shape)
        raise InputError(f"later_from_earlier must be {wanted}, one matrix a step, got {got}")


def differences_of(chain: TensorChain, window: Window[Tensor]) -> Differences:
    """Compute the part of a batch of windows that depends on no tunable parameter.

    >>> from torchvision_dddas.chain import DetectionChain, Window
    >>> levels = (255 * torch.rand(3, 1, 64, 64)).round()
    >>> still = torch.eye(3).expand(1, 2, 3, 3)
    >>> window = Window(levels[1:2], (levels[:1], levels[2:]), still, offsets=(-1, 1), near=((0, 1),))
    >>> nn.differences_of(DetectionChain(td.Settings(), F.TensorOperations()), window).least.shape
    torch.Size([1, 1, 64, 64])
    """
    neighbours = chain.neighbours(window)
    least, both = (torch.cat([of(pair) for pair in window.near], 1) for of in (neighbours.compared, neighbours.both))
    reference = neighbours.reference()
    return Differences(least, both, reference.texture, reference.grey)


def check_softness(settings: Settings) -> None:
    """Raise InputError for a smoothed silhouette, whose outline at one half is no threshold of evidence.

    >>> nn.check_softness(td.load_settings("source"))
    Traceback (most recent call last):
        ...
    torchvision_dddas.errors.InputError: difference.blur_of = silhouette has no s...
    """
    if settings.difference.blur_of == "silhouette":
        raise InputError(
            "difference.blur_of = silhouette has no soft masks and cannot be tuned by gradient; "
            "set difference.blur_of=difference"
        )


def chain_motion(later_from_earlier: Float[Tensor, "B S 3 3"], start: int, end: int) -> Float[Tensor, "B 3 3"]:
    """Return the motion from frame `start` to frame `end` of each clip, with h33 = 1."""
    low, high = min(start, end), max(start, end)
    matrix = torch.eye(3, dtype=later_from_earlier.dtype, device=later_from_earlier.device).expand(
        len(later_from_earlier), 3, 3
    )
    for step in range(low, high):
        matrix = later_from_earlier[:, step] @ matrix
    matrix = matrix if end >= start else F.invert_map(matrix)
    return matrix / matrix[:, 2:, 2:]
