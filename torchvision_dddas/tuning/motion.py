"""The family of motion segmentation: masks of labelled frames against soft masks."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import repeat
from typing import cast

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
    View,
    Window,
    fill_hull,
    load_engine,
)
from torchvision_dddas.detection.torch_engine import (
    TEXTURED,
    TorchEngine,
    compare_to_reference,
    find_seen_by_both,
    smaller_difference,
)
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.functional.soft import straight_through
from torchvision_dddas.nn import Core, Differences, MotionSegmenter, Regions, Values
from torchvision_dddas.tuning.examples import check_masks, labels_at
from torchvision_dddas.tuning.family import Example, Tick
from torchvision_dddas.types import Registration, Scene

Loss = Callable[[Tensor, Tensor, Tensor], Tensor]

# A soft mask reaches this many softnesses below the threshold: there it is 0.05.
_REACH = 3.0
# Of a clip in which nothing moves: so many frames are enough to tell what is false.
_STILL = 12
# Of the threshold: where it is tried what the hard steps after the hulls do with more than is drawn at the settings'.
_FREER = 0.6


@dataclass(frozen=True)
class Labelled:
    """A batch of labelled frames of one size. truth, known: where something moves, and where it is known.

    away, added: what the hard steps after the hulls took from the mask, and gave to it, at the settings that the frames
    were prepared with: persistence, outlines by motion and colour, shadows, small and weak targets. away holds as well
    what they take from what only a lower threshold draws.
    """

    differences: Differences
    truth: Bool[Tensor, "B 1 H W"]
    known: Bool[Tensor, "B 1 H W"]
    away: Bool[Tensor, "B 1 H W"]
    added: Bool[Tensor, "B 1 H W"]
    settings: Settings


def f_loss(
    mask: Float[Tensor, "B 1 H W"], truth: Bool[Tensor, "B 1 H W"], known: Bool[Tensor, "B 1 H W"]
) -> Float[Tensor, "B"]:
    """1 - F, with sums of soft masks for counts of pixels (appendix B, eq. 11)."""
    right, found, true = _sums(mask, truth, known)
    return 1 - (2 * right + _SPARE_PX) / (found + true + _SPARE_PX)


class Masks:
    """Implements `Family` for the parameters of motion.

    wrong: the loss, one of `overlap`. passing: masks are hard, their gradient that of soft ones. after: what the hard
    steps after the hulls do near the settings that examples are prepared with is kept (see `Labelled`); without it
    tuning does better where it begins far from what is right. softness: above a tenth of the threshold, background just
    below it adds up, and the least loss lies at a higher threshold than that of hard masks.
    """

    name = "motion"
    task: Task = "motion"
    measure = "motion.pixels.f"
    softness = (0.1, 0.02)

    def __init__(self, wrong: Loss = f_loss, passing: bool = False, after: bool = True) -> None:
        self.wrong, self.passing, self.after = wrong, passing, after

    @property
    def losses(self) -> tuple[str, ...]:
        """See `family.Choosing`."""
        return tuple(LOSSES)

    @property
    def loss_name(self) -> str:
        """See `family.Choosing`; of a loss of one's own, what it is called."""
        named = (name for name, loss in LOSSES.items() if loss is self.wrong)
        return next(named, getattr(self.wrong, "__name__", "its own"))

    def by(self, loss_name: str) -> "Masks":
        """See `family.Choosing`."""
        return Masks(LOSSES[loss_name], self.passing, self.after)

    def examples(self, clips: Sequence[Clip], settings: Settings, tick: Tick = lambda: None) -> list[Example]:
        """The frames with masks, and some of clips in which nothing moves. Raises InputError for other clips."""
        if settings.difference.halved:
            raise InputError("difference.halved = true cannot be tuned by gradient; set it to false")
        check_masks(clips, still=True)
        return [example for clip in clips for example in _examples(clip, settings, self.after, tick)]

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """(B,) 1 - F of each frame."""
        groups: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for place, example in enumerate(batch):
            groups[cast(Labelled, example.content).differences.least.shape].append(place)
        device = next(iter(parameters.values())).device
        losses: list[Tensor] = [torch.empty(0)] * len(batch)
        for places in groups.values():
            frames = together([batch[place].content for place in places], device)
            mask = masks_of(frames, parameters, softness)
            if self.passing and softness > 0:
                with torch.no_grad():
                    hard = masks_of(frames, parameters, 0.0)
                mask = straight_through(hard, mask)
            for place, wrong in zip(places, self.wrong(mask, frames.truth, frames.known), strict=True):
                losses[place] = wrong
        return torch.stack(losses)


def masks_of(frames: Labelled, values: Values, softness: float) -> Float[Tensor, "B 1 H W"]:
    """The soft masks of a batch of frames. softness: a share of each threshold; 0.0 gives hard masks."""
    motion = MotionSegmenter(frames.settings)
    core = motion(frames.differences, values, softness)
    reach = _REACH * softness * frames.settings.difference.threshold
    found = regions_of(core, frames.settings.morphology.hull, reach)
    mask = motion.outlined(core, found, values, softness)
    return torch.where(frames.added, 1.0, torch.where(frames.away, 0.0, mask))


def together(frames: Sequence[Labelled], device: torch.device) -> Labelled:
    """One batch of frames of one structure, on a device."""

    def joined(maps: Iterable[Tensor]) -> Tensor:
        return torch.cat(list(maps)).to(device)

    parts = [frame.differences for frame in frames]
    differences = Differences(
        joined(part.least for part in parts),
        joined(part.both for part in parts),
        joined(part.texture for part in parts).float(),
        joined(part.textured for part in parts),
        parts[0].steps,
        parts[0].highest,
    )
    return Labelled(
        differences,
        joined(frame.truth for frame in frames),
        joined(frame.known for frame in frames),
        joined(frame.away for frame in frames),
        joined(frame.added for frame in frames),
        frames[0].settings,
    )


def _examples(clip: Clip, settings: Settings, after: bool, tick: Tick) -> list[Example]:
    wanted, true = _true(clip)
    found = []
    # What would become of more than is drawn now: without it, whatever a lower threshold adds would seem to stay.
    freer = with_parameters(settings, {"difference.threshold": max(_FREER * settings.difference.threshold, 0.1)})
    probes: Iterable[Recorded | None] = recorded(clip, freer, wanted) if after else repeat(None)
    for one, probe in zip(recorded(clip, settings, wanted), probes, strict=False):
        labels = true(one)
        # A frame without a window shows nothing, whatever the parameters.
        if one.window is not None and (labels >= 0).any():
            differences = differences_of(one.window, settings)
            frame = _labelled(differences, labels, settings)
            if probe is not None:
                frame = _as_drawn(frame, one.mask, probe.mask, freer)
            found.append(Example(clip.name, one.frame, frame))
        tick()
    if not found:
        raise InputError(f"no labelled frame of {clip.name} hangs together with its neighbours: nothing to tune on")
    return found


@dataclass(frozen=True)
class Recorded:
    """A frame and what the hard pipeline made of it. window: None where it had none. mask: (H, W) bool, its targets."""

    frame: int
    window: Window | None
    mask: np.ndarray


def _true(clip: Clip) -> tuple[Set[int], Callable[[Recorded], np.ndarray]]:
    """Which frames of a clip are learned from, and their labels: 0 nothing moves, -1 unknown."""
    truth = clip.truth
    if truth is None or not truth.masks:
        assert clip.still, "other clips are refused before"
        every = max((clip.frames or len(clip.pictures)) // _STILL, 1)
        return set(range(1, _STILL * every + 1, every)), lambda one: np.zeros(one.mask.shape, np.int32)
    return set(truth.masks), lambda one: labels_at(truth, one.frame, one.mask.shape)


def _labelled(differences: Differences, labels: np.ndarray, settings: Settings) -> Labelled:
    truth, known = (torch.from_numpy(picture)[None, None] for picture in (labels > 0, labels >= 0))
    none = torch.zeros_like(truth)
    return Labelled(differences, truth, known, none, none, settings)


def _as_drawn(frame: Labelled, mask: np.ndarray, freer_mask: np.ndarray, freer: Settings) -> Labelled:
    """A frame with what comes after the hulls: what the soft steps, made hard, lack of the mask that was drawn."""
    final, freer_final = (torch.from_numpy(drawn)[None, None] for drawn in (mask, freer_mask))
    batch = together([frame], torch.device("cpu"))
    with torch.no_grad():
        hull = masks_of(batch, {}, 0.0) > 0.5
        freer_hull = masks_of(replace(batch, settings=freer), {}, 0.0) > 0.5
    return replace(frame, away=(hull & ~final) | (freer_hull & ~hull & ~freer_final), added=final & ~hull)


def family() -> Masks:
    """As `tuning.family` asks for it."""
    return Masks()


# What is further from any region than this makes no part of it when the core grows a little, px.
_FAR_PX = 40.0


def regions_of(core: Core, hull: bool, reach: float = 0.0) -> Regions:
    """What hangs together (8 neighbours) in each mask of a batch, whether it passes any gate or not.

    hull: fill convex hulls. reach: pixels that miss the threshold by less belong to the nearest region, or where there
    is none make one of their own; in the unit of the margin.
    """
    margins = core.margin.detach()[:, 0].cpu().numpy()
    near, filled = np.zeros((2, *margins.shape), np.int64)
    counts = [_label_regions(margin, hull, reach, *maps) for margin, *maps in zip(margins, near, filled, strict=True)]
    device = core.mask.device
    return Regions(
        torch.from_numpy(near)[:, None].to(device), torch.from_numpy(filled)[:, None].to(device), max(counts)
    )


def _label_regions(margin: np.ndarray, hull: bool, reach: float, near: np.ndarray, filled: np.ndarray) -> int:
    """Writes the labels of one picture; returns how many there are."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats((margin > 0).astype(np.uint8), ltype=cv2.CV_32S)
    near[:] = parts
    # Large ones last: what lies in a large hull is there with it, though it be a speck of its own.
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


# A frame in which nothing moves and nothing is found is right: this many pixels are right in any.
_SPARE_PX = 1.0


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


def _sums(mask: Tensor, truth: Tensor, known: Tensor, power: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Per mask: what is found and true, what is found, what is true."""
    seen = mask * known
    right = (seen * truth).sum((1, 2, 3))
    return right, (seen**power).sum((1, 2, 3)), (truth & known).sum((1, 2, 3)).to(mask.dtype)


LOSSES: Mapping[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "f": f_loss,
    "dice": dice_loss,
    "focal": focal_loss,
}
"""By the names that `dddas tune --loss` takes; the first one unless said."""


_NUMBER = "number of the frame"


def recorded(clip: Clip, settings: Settings, wanted: Set[int]) -> Iterator[Recorded]:
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
            yield Recorded(number, engine.windows.pop(number, None), scene.mask > 0)


class _Recorder:
    """A back end that remembers the windows of wanted frames."""

    def __init__(self, engine: Engine, wanted: Set[int]) -> None:
        self.name, self.number = engine.name, 0
        self.windows: dict[int, Window] = {}
        self._vision, self._wanted = engine, wanted

    @property
    def parameters(self) -> Settings:
        return self._vision.parameters

    @parameters.setter
    def parameters(self, settings: Settings) -> None:
        self._vision.parameters = settings

    def prepare(self, image: np.ndarray) -> View:
        view = self._vision.prepare(image)
        view.kept[_NUMBER] = self.number
        return view

    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        return self._vision.register(pairs)

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        for window in windows:
            if (number := window.reference.kept[_NUMBER]) in self._wanted:
                self.windows[number] = window
        return self._vision.foreground(windows)


@torch.inference_mode()
def differences_of(window: Window, settings: Settings) -> Differences:
    """A window as far as no tunable parameter has a say, on the CPU; a batch of one."""
    grey, warped, seen, texture = TorchEngine(settings, "cpu").warp_neighbours([window])
    parameters = settings.difference
    distance = compare_to_reference(window, grey, warped, parameters)
    least = [smaller_difference(pair, distance, warped) for pair in window.near]
    both = [find_seen_by_both(seen[a], seen[b], grey.shape[-1]) for a, b in window.near]
    return Differences(
        torch.cat(least, 1).clone(),
        torch.cat(both, 1),
        texture.to(torch.uint8),
        texture > TEXTURED,
        EVIDENCE_SCALE,
        EVIDENCE_CAP,
    )
