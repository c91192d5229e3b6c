"""The family of motion segmentation: soft masks are compared with the masks of labelled frames."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, fields, replace
from itertools import repeat
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import (
    Foreground,
    MotionDetector,
    TorchEngine,
    Window,
    fill_hull,
)
from torchvision_dddas.detection.opencv_engine import OpenCVEngine, OpenCVView
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.studies.records import Task
from torchvision_dddas.lab.evaluation.studies.stages import open_clip
from torchvision_dddas.lab.tuning.examples import check_masks, labels_at
from torchvision_dddas.lab.tuning.family import Example, Family
from torchvision_dddas.nn import Core, Differences, MotionSegmenter, Regions, Values, check_softness, differences_of
from torchvision_dddas.types import Scene

# A soft mask falls to 0.05 at this many softnesses below the threshold, and ends there.
_REACH = 3.0
# Number of frames that are taken from a clip without motion.
_STILL_FRAMES = 12
# A second run at this share of the threshold shows how the hard steps after the hulls treat a larger mask.
_FREER = 0.6
# Count this many extra pixels as right in every frame. A frame without motion and without targets is then right.
_SPARE_PX = 1.0
# Pixels further than this from every region do not join a region when the core grows a little.
_FAR_PX = 40.0

Masks = Float[Tensor, "B 1 H W"]
Labels = Bool[Tensor, "B 1 H W"]


def overlap_loss(mask: Masks, truth: Labels, known: Labels) -> Float[Tensor, "B"]:
    """Return 1 - F, with sums of soft masks for pixel counts (appendix B, eq. 11). known: where the truth is known."""
    seen, axes = mask * known, (1, 2, 3)
    found, true = seen.sum(axes), (truth & known).sum(axes).to(mask.dtype)
    return 1 - (2 * (seen * truth).sum(axes) + _SPARE_PX) / (found + true + _SPARE_PX)


@dataclass(frozen=True)
class LabelledFrames:
    """A batch of labelled frames of one size. truth: where something moves. known: where the truth is known.

    removed, added: pixels that the hard steps after the hulls (tracklets, outlines, shadows, small targets) removed
    from the mask and added to it, at the settings that the frames were prepared with. removed also holds the pixels
    that these steps remove from the mask of a lower threshold.
    """

    differences: Differences
    truth: Bool[Tensor, "B 1 H W"]
    known: Bool[Tensor, "B 1 H W"]
    removed: Bool[Tensor, "B 1 H W"]
    added: Bool[Tensor, "B 1 H W"]


@dataclass(frozen=True)
class MotionFamily(Family):
    """The family `motion`.

    with_later_steps: keep the effect of the hard steps after the hulls near the original settings (see
    `LabelledFrames`). Without it, tuning works better from a bad start. softness: a share of each threshold. Above a
    tenth, background just below the threshold adds up, and the loss is least at a higher threshold than for hard masks.
    """

    with_later_steps: bool = True
    name: str = "motion"
    task: Task = "motion"
    measure: str = "motion.pixels.f"
    softness: tuple[float, float] = (0.1, 0.02)
    empty = "no labelled frame was compared with its neighbours, so that there is nothing to tune on"

    def check_clips(self, clips: Sequence[Clip], settings: Settings) -> None:
        """Raise InputError for clips with motion but without masks, and for halved frames."""
        if settings.difference.halved:
            raise InputError("difference.halved = true cannot be tuned by gradient; set it to false")
        check_softness(settings)
        check_masks(clips, still=True)

    def clip_examples(self, clip: Clip, settings: Settings) -> Iterator[tuple[int, LabelledFrames]]:
        """Yield the frames with masks, and some frames of a clip without motion."""
        truth = clip.truth if clip.truth is not None and clip.truth.masks else None
        pitch = max((clip.frames or len(clip.pictures)) // _STILL_FRAMES, 1)
        wanted = set(truth.masks) if truth else set(range(1, _STILL_FRAMES * pitch + 1, pitch))
        freer = with_parameters(settings, {"difference.threshold": max(_FREER * settings.difference.threshold, 0.1)})
        freer_frames: Iterable[tuple[int, Window[OpenCVView] | None, np.ndarray | None]] = repeat((0, None, None))
        if self.with_later_steps:
            freer_frames = record_frames(clip, freer, wanted)
        recorded = zip(record_frames(clip, settings, wanted), freer_frames, strict=False)
        for (number, window, mask), (_, _, freer_mask) in recorded:
            labels = labels_at(truth, number, mask.shape) if truth else np.zeros(mask.shape, np.int32)
            # A frame without a window has no mask, for any values of the parameters.
            if window is None or not (labels >= 0).any():
                continue
            pictures = labels > 0, labels >= 0, mask, mask if freer_mask is None else freer_mask
            moves, known, final, freer_final = (torch.from_numpy(picture)[None, None] for picture in pictures)
            none = torch.zeros_like(moves)
            frame = LabelledFrames(prepare_differences(window, settings), moves, known, none, none)
            if freer_mask is not None:
                batch = stack_frames([frame], torch.device("cpu"))
                with torch.no_grad():
                    hull, freer_hull = (soft_masks(batch, one, {}, 0.0) > 0.5 for one in (settings, freer))
                # Without the run with the larger mask, all pixels that a lower threshold adds would seem to stay.
                removed = (hull & ~final) | (freer_hull & ~hull & ~freer_final)
                frame = replace(frame, removed=removed, added=final & ~hull)
            yield number, frame

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """Return the loss of each frame, (B,). Frames of one size are computed together. See `Family.loss`."""
        groups: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for place, example in enumerate(batch):
            groups[example.content.differences.least.shape].append(place)
        device = next(iter(parameters.values())).device
        losses: list[Tensor] = [torch.empty(0)] * len(batch)
        for places in groups.values():
            frames = stack_frames([batch[place].content for place in places], device)
            mask = soft_masks(frames, batch[0].settings, parameters, softness)
            for place, loss in zip(places, overlap_loss(mask, frames.truth, frames.known), strict=True):
                losses[place] = loss
        return torch.stack(losses)


def soft_masks(frames: LabelledFrames, settings: Settings, values: Values, softness: float) -> Float[Tensor, "B 1 H W"]:
    """Return the masks of a batch of frames. softness: a share of each threshold; 0.0 gives hard masks."""
    motion = MotionSegmenter(settings, tuned=())
    core = motion.segment(frames.differences, values=values, softness=softness)
    reach = _REACH * softness * settings.difference.threshold
    mask = motion.outlined(core, label_regions(core, settings.morphology.hull, reach), values=values, softness=softness)
    return torch.where(frames.added, 1.0, torch.where(frames.removed, 0.0, mask))


def stack_frames(frames: Sequence[LabelledFrames], device: torch.device) -> LabelledFrames:
    """Stack frames of one size into one batch on a device."""

    def stack(parts: Sequence[object], *names: str) -> dict[str, Any]:
        return {name: torch.cat([getattr(part, name) for part in parts]).to(device) for name in names}

    columns = stack([frame.differences for frame in frames], *(field.name for field in fields(Differences)))
    columns["texture"] = columns["texture"].float()
    return LabelledFrames(Differences(**columns), **stack(frames, "truth", "known", "removed", "added"))


def label_regions(core: Core, hull: bool, reach: float = 0.0) -> Regions:
    """Label the connected regions (8 neighbours) of each mask of a batch, before any gate.

    hull: fill convex hulls. reach: in the unit of the margin; pixels that are below the threshold by less than this
    belong to the nearest region, or form a region if none is near.
    """
    margins = core.margin.detach()[:, 0].cpu().numpy()
    maps = np.zeros((2, *margins.shape), np.int64)
    counts = [_label_picture(margin, hull, reach, *maps[:, k]) for k, margin in enumerate(margins)]
    near, filled = torch.from_numpy(maps)[:, :, None].to(core.mask.device)
    return Regions(near, filled, max(counts))


def _label_picture(margin: np.ndarray, hull: bool, reach: float, near: np.ndarray, filled: np.ndarray) -> int:
    """Write the labels of one picture into near and filled; return the number of regions."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats((margin > 0).astype(np.uint8), ltype=cv2.CV_32S)
    near[:] = parts
    # Fill large regions last: a small region within a large hull belongs to that hull.
    for label in 1 + np.argsort(stats[1:, cv2.CC_STAT_AREA], kind="stable"):
        x, y, width, height = (int(v) for v in stats[label, :4])
        window = np.s_[y : y + height, x : x + width]
        region = parts[window] == label
        filled[window][fill_hull(region) if hull else region] = label
    if reach <= 0:
        return count - 1
    weak, weak_parts = cv2.connectedComponents((margin > -reach).astype(np.uint8), ltype=cv2.CV_32S)
    holds_region = np.zeros(weak, bool)
    holds_region[weak_parts[parts > 0]] = True
    holds_region[0] = False
    if count > 1:
        away, nearest = cv2.distanceTransformWithLabels(
            (parts == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        of_place = np.zeros(int(nearest.max()) + 1, np.int64)
        of_place[nearest[parts > 0]] = parts[parts > 0]
        joins = holds_region[weak_parts] & (parts == 0) & (away < _FAR_PX)
        near[joins] = of_place[nearest[joins]]
    alone = np.flatnonzero(~holds_region[1:]) + 1
    numbers = np.zeros(weak, np.int64)
    numbers[alone] = count + np.arange(len(alone))
    near[:] = np.where(numbers[weak_parts] > 0, numbers[weak_parts], near)
    return count - 1 + len(alone)


class _RecordingEngine(OpenCVEngine):
    """An engine that keeps the windows of wanted frames. number: number of the frame that is being prepared."""

    def __init__(self, settings: Settings, wanted: Set[int]) -> None:
        super().__init__(settings)
        self.number, self.numbers, self.wanted = 0, dict[int, int](), wanted
        self.windows = dict[int, Window[OpenCVView]]()

    def prepare(self, image: np.ndarray) -> OpenCVView:
        view = super().prepare(image)
        self.numbers[id(view)] = self.number
        return view

    def foreground(self, windows: Sequence[Window[OpenCVView]]) -> list[Foreground]:
        by_number = {self.numbers[id(window.reference)]: window for window in windows}
        self.windows |= {number: window for number, window in by_number.items() if number in self.wanted}
        return super().foreground(windows)


def record_frames(
    clip: Clip, settings: Settings, wanted: Set[int]
) -> Iterator[tuple[int, Window[OpenCVView] | None, Bool[np.ndarray, "H W"]]]:
    """Yield the wanted frames of a clip, in order: number, window if there is one, and mask by the hard pipeline.

    Raise InputError as `dddas detect` does.
    """
    source, engine = open_clip(clip), _RecordingEngine(settings, wanted)
    loop = MotionDetector(settings, backend=engine, rate_hz=source.rate_hz)

    def scenes() -> Iterator[Scene]:
        for frame in source:
            engine.number = frame.number
            yield from loop.update(frame)
        yield from loop.flush(source.last)

    for scene in scenes():
        number = scene.frame.number
        if number in wanted:
            yield number, engine.windows.pop(number, None), scene.mask > 0


@torch.inference_mode()
def prepare_differences(window: Window[Any], settings: Settings) -> Differences:
    """Compute the part of a window that depends on no tunable parameter, on the CPU, as a batch of one."""
    engine = TorchEngine(settings, "cpu")
    views = [engine.prepare(view.grey) for view in (window.reference, *window.neighbours)]
    batch = engine.batch_of([replace(window, reference=views[0], neighbours=tuple(views[1:]))])
    found = differences_of(engine.segmenter.chain(), batch)
    return replace(found, least=found.least.clone(), texture=found.texture.to(torch.uint8))
