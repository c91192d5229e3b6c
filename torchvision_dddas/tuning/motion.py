"""The family of motion segmentation: masks of labelled frames against soft masks."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import (
    EVIDENCE_CAP,
    EVIDENCE_SCALE,
    Engine,
    Foreground,
    MotionDetector,
    TorchEngine,
    View,
    Window,
    fill_hull,
    load_engine,
)
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.records import Task
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.functional.soft import straight_through
from torchvision_dddas.nn import Core, Differences, MotionSegmenter, Regions, Values
from torchvision_dddas.tuning.examples import check_masks, labels_at
from torchvision_dddas.tuning.family import Example, Family
from torchvision_dddas.types import Registration, Scene

Loss = Callable[[Tensor, Tensor, Tensor], Tensor]

# Soft masks reach this many softnesses below the threshold, where they are 0.05.
_REACH = 3.0
# Frames of a clip in which nothing moves.
_STILL_FRAMES = 12
# Share of the threshold at which a second run shows what the hard steps after the hulls do with a freer mask.
_FREER = 0.6
# This many pixels are right in every frame, so that a frame in which nothing moves and nothing is found is right.
_SPARE_PX = 1.0
# Pixels further from any region than this do not join it when the core grows a little.
_FAR_PX = 40.0
_NUMBER = "number of the frame"


@dataclass(frozen=True)
class LabelledFrames:
    """A batch of labelled frames of one size. truth: where something moves. known: where the truth is known.

    removed, added: what the hard steps after the hulls (persistence, outlines, shadows, small and weak targets) took
    from the mask and added to it, at the settings that the frames were prepared with. removed also holds what they take
    from a mask with a lower threshold.
    """

    differences: Differences
    truth: Bool[Tensor, "B 1 H W"]
    known: Bool[Tensor, "B 1 H W"]
    removed: Bool[Tensor, "B 1 H W"]
    added: Bool[Tensor, "B 1 H W"]
    settings: Settings


def f_loss(
    mask: Float[Tensor, "B 1 H W"], truth: Bool[Tensor, "B 1 H W"], known: Bool[Tensor, "B 1 H W"]
) -> Float[Tensor, "B"]:
    """1 - F, with sums of soft masks for counts of pixels (appendix B, eq. 11)."""
    right, found, true = _sums(mask, truth, known)
    return 1 - (2 * right + _SPARE_PX) / (found + true + _SPARE_PX)


def dice_loss(
    mask: Float[Tensor, "B 1 H W"], truth: Bool[Tensor, "B 1 H W"], known: Bool[Tensor, "B 1 H W"]
) -> Float[Tensor, "B"]:
    """As `f_loss` with squares of the found mask, so that doubtful pixels cost less (Milletari et al. 2016)."""
    right, found, true = _sums(mask, truth, known, power=2)
    return 1 - (2 * right + _SPARE_PX) / (found + true + _SPARE_PX)


def focal_loss(
    mask: Float[Tensor, "B 1 H W"],
    truth: Bool[Tensor, "B 1 H W"],
    known: Bool[Tensor, "B 1 H W"],
    focus: float = 2.0,
    movers: float = 0.75,
) -> Float[Tensor, "B"]:
    """Mean of -(1 - p)^focus ln p, where p is the mask's value for the truth (Lin et al. 2017). movers: weight."""
    right = torch.where(truth, mask, 1 - mask).clamp(min=1e-6)
    weight = torch.where(truth, movers, 1 - movers) * known
    return (-((1 - right) ** focus) * right.log() * weight).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp(min=1e-6)


def _sums(mask: Tensor, truth: Tensor, known: Tensor, power: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Sums for each mask: found and true, found, true."""
    seen = mask * known
    right = (seen * truth).sum((1, 2, 3))
    return right, (seen**power).sum((1, 2, 3)), (truth & known).sum((1, 2, 3)).to(mask.dtype)


LOSSES: Mapping[str, Loss] = {"f": f_loss, "dice": dice_loss, "focal": focal_loss}
"""By the names that `dddas tune --loss` takes; the first is the default."""


@dataclass(frozen=True)
class MotionFamily(Family):
    """The family `motion`. hard: masks are hard, with the gradients of soft ones.

    with_later_steps: keep what the hard steps after the hulls do near the original settings (see `LabelledFrames`);
    without it tuning works better from a bad start. softness: a share of each threshold; above a tenth, background just
    below the threshold adds up, and the least loss lies at a higher threshold than with hard masks.
    """

    loss_name: str = "f"
    hard: bool = False
    with_later_steps: bool = True
    name: str = "motion"
    task: Task = "motion"
    measure: str = "motion.pixels.f"
    softness: tuple[float, float] = (0.1, 0.02)
    losses: tuple[str, ...] = tuple(LOSSES)
    empty = "no labelled frame was compared with its neighbours; nothing to tune on"

    def check_clips(self, clips: Sequence[Clip], settings: Settings) -> None:
        """Raises InputError for clips without masks in which something moves, and for halved frames."""
        if settings.difference.halved:
            raise InputError("difference.halved = true cannot be tuned by gradient; set it to false")
        check_masks(clips, still=True)

    def clip_examples(self, clip: Clip, settings: Settings) -> Iterator[tuple[int, LabelledFrames]]:
        """The frames with masks, and some of a clip in which nothing moves."""
        truth = clip.truth
        if truth is not None and truth.masks:
            wanted = set(truth.masks)
        else:
            pitch = max((clip.frames or len(clip.pictures)) // _STILL_FRAMES, 1)
            wanted = set(range(1, _STILL_FRAMES * pitch + 1, pitch))
        freer = with_parameters(settings, {"difference.threshold": max(_FREER * settings.difference.threshold, 0.1)})
        later: Iterable[RecordedFrame | None] = repeat(None)
        if self.with_later_steps:
            later = record_frames(clip, freer, wanted)
        for frame, freer_frame in zip(record_frames(clip, settings, wanted), later, strict=False):
            if truth is not None and truth.masks:
                labels = labels_at(truth, frame.number, frame.mask.shape)
            else:
                labels = np.zeros(frame.mask.shape, np.int32)
            # A frame without a window has no mask, whatever the parameters.
            if frame.window is not None and (labels >= 0).any():
                example = _label(differences_of(frame.window, settings), labels, settings)
                if freer_frame is not None:
                    example = _with_later_steps(example, frame.mask, freer_frame.mask, freer)
                yield frame.number, example

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """(B,) one loss a frame; frames of one size are computed together. See `Family.loss`."""
        groups: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for place, example in enumerate(batch):
            groups[example.content.differences.least.shape].append(place)
        device = next(iter(parameters.values())).device
        losses: list[Tensor] = [torch.empty(0)] * len(batch)
        for places in groups.values():
            frames = stack_frames([batch[place].content for place in places], device)
            mask = soft_masks(frames, parameters, softness)
            if self.hard and softness > 0:
                with torch.no_grad():
                    hard = soft_masks(frames, parameters, 0.0)
                mask = straight_through(hard, mask)
            for place, loss in zip(places, LOSSES[self.loss_name](mask, frames.truth, frames.known), strict=True):
                losses[place] = loss
        return torch.stack(losses)


def soft_masks(frames: LabelledFrames, values: Values, softness: float) -> Float[Tensor, "B 1 H W"]:
    """The masks of a batch of frames. softness: a share of each threshold; 0.0 gives hard masks."""
    motion = MotionSegmenter(frames.settings)
    core = motion(frames.differences, values, softness)
    reach = _REACH * softness * frames.settings.difference.threshold
    found = label_regions(core, frames.settings.morphology.hull, reach)
    mask = motion.outlined(core, found, values, softness)
    return torch.where(frames.added, 1.0, torch.where(frames.removed, 0.0, mask))


def stack_frames(frames: Sequence[LabelledFrames], device: torch.device) -> LabelledFrames:
    """One batch of frames of one size, on a device."""

    def stack(records: Sequence[Any]) -> dict[str, Any]:
        columns = {name: [vars(record)[name] for record in records] for name in vars(records[0])}
        tensors = {name: column for name, column in columns.items() if isinstance(column[0], Tensor)}
        return {name: torch.cat(column).to(device) for name, column in tensors.items()}

    differences = replace(frames[0].differences, **stack([frame.differences for frame in frames]))
    differences = replace(differences, texture=differences.texture.float())
    return replace(frames[0], differences=differences, **stack(frames))


@dataclass(frozen=True)
class RecordedFrame:
    """A frame and what the hard pipeline made of it. window: None where it had none. mask: (H, W) bool, its targets."""

    number: int
    window: Window | None
    mask: np.ndarray


def _label(differences: Differences, labels: np.ndarray, settings: Settings) -> LabelledFrames:
    truth, known = (torch.from_numpy(picture)[None, None] for picture in (labels > 0, labels >= 0))
    none = torch.zeros_like(truth)
    return LabelledFrames(differences, truth, known, none, none, settings)


def _with_later_steps(
    frame: LabelledFrames, mask: np.ndarray, freer_mask: np.ndarray, freer: Settings
) -> LabelledFrames:
    """A frame with the differences between the hulls and the final masks of the hard pipeline."""
    final, freer_final = (torch.from_numpy(drawn)[None, None] for drawn in (mask, freer_mask))
    batch = stack_frames([frame], torch.device("cpu"))
    with torch.no_grad():
        hull = soft_masks(batch, {}, 0.0) > 0.5
        freer_hull = soft_masks(replace(batch, settings=freer), {}, 0.0) > 0.5
    # Without the freer run, whatever a lower threshold adds would seem to stay.
    return replace(frame, removed=(hull & ~final) | (freer_hull & ~hull & ~freer_final), added=final & ~hull)


def label_regions(core: Core, hull: bool, reach: float = 0.0) -> Regions:
    """The connected regions (8 neighbours) of each mask of a batch, before any gate.

    hull: fill convex hulls. reach: pixels below the threshold by less than this, in the unit of the margin, belong to
    the nearest region, or make one of their own where there is none.
    """
    margins = core.margin.detach()[:, 0].cpu().numpy()
    near, filled = np.zeros((2, *margins.shape), np.int64)
    counts = [_label_picture(margin, hull, reach, *maps) for margin, *maps in zip(margins, near, filled, strict=True)]
    device = core.mask.device
    return Regions(
        torch.from_numpy(near)[:, None].to(device), torch.from_numpy(filled)[:, None].to(device), max(counts)
    )


def _label_picture(margin: np.ndarray, hull: bool, reach: float, near: np.ndarray, filled: np.ndarray) -> int:
    """Write the labels of one picture into near and filled; return the number of regions."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats((margin > 0).astype(np.uint8), ltype=cv2.CV_32S)
    near[:] = parts
    # Large regions last: a small one within a large hull belongs to it.
    for label in 1 + np.argsort(stats[1:, cv2.CC_STAT_AREA], kind="stable"):
        x, y, width, height = (int(v) for v in stats[label, :4])
        window = np.s_[y : y + height, x : x + width]
        region = parts[window] == label
        filled[window][fill_hull(region) if hull else region] = label
    if reach <= 0:
        return count - 1
    weak, weak_parts = cv2.connectedComponents((margin > -reach).astype(np.uint8), ltype=cv2.CV_32S)
    strong = np.zeros(weak, bool)
    strong[weak_parts[parts > 0]] = True
    strong[0] = False
    if count > 1:
        away, nearest = cv2.distanceTransformWithLabels(
            (parts == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        of_place = np.zeros(int(nearest.max()) + 1, np.int64)
        of_place[nearest[parts > 0]] = parts[parts > 0]
        joins = strong[weak_parts] & (parts == 0) & (away < _FAR_PX)
        near[joins] = of_place[nearest[joins]]
    numbers = np.zeros(weak, np.int64)
    alone = np.flatnonzero(~strong[1:]) + 1
    numbers[alone] = count + np.arange(len(alone))
    lone = numbers[weak_parts]
    near[lone > 0] = lone[lone > 0]
    return count - 1 + len(alone)


def record_frames(clip: Clip, settings: Settings, wanted: Set[int]) -> Iterator[RecordedFrame]:
    """The wanted frames of a clip, in order. Raises InputError as `dddas detect` does."""
    source = open_clip(clip)
    engine = _Recorder(load_engine("onboard", settings), wanted)
    loop = MotionDetector(settings, engine, source.rate_hz)

    def scenes() -> Iterator[Scene]:
        for frame in source:
            engine.number = frame.number
            yield from loop.update(frame)
        yield from loop.flush(source.last)

    for scene in scenes():
        number = scene.frame.number
        if number in wanted:
            yield RecordedFrame(number, engine.windows.pop(number, None), scene.mask > 0)


class _Recorder:
    """An engine that keeps the windows of wanted frames."""

    def __init__(self, engine: Engine, wanted: Set[int]) -> None:
        self.name, self.number = engine.name, 0
        self.windows: dict[int, Window] = {}
        self._engine, self._wanted = engine, wanted

    @property
    def parameters(self) -> Settings:
        return self._engine.parameters

    @parameters.setter
    def parameters(self, settings: Settings) -> None:
        self._engine.parameters = settings

    def prepare(self, image: np.ndarray) -> View:
        view = self._engine.prepare(image)
        view.kept[_NUMBER] = self.number
        return view

    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        return self._engine.register(pairs)

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        for window in windows:
            if (number := window.reference.kept[_NUMBER]) in self._wanted:
                self.windows[number] = window
        return self._engine.foreground(windows)


@torch.inference_mode()
def differences_of(window: Window, settings: Settings) -> Differences:
    """The part of a window that depends on no tunable parameter, on the CPU; a batch of one."""
    views = TorchEngine(settings, "cpu").warp_neighbours([window])
    return Differences(
        torch.cat([views.least(pair) for pair in window.near], 1).clone(),
        torch.cat([views.both(pair) for pair in window.near], 1),
        views.texture.to(torch.uint8),
        views.textured,
        EVIDENCE_SCALE,
        EVIDENCE_CAP,
    )
