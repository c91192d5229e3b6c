"""The parameters of motion: masks of labelled frames, and how far soft ones are from them."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import repeat
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.record import Task
from torchvision_dddas.functional.soft.straight_through import through
from torchvision_dddas.nn.motion_segmenter import Differences, SoftMotion, Values
from torchvision_dddas.tuning.clip_masks import check_masks, labels_at
from torchvision_dddas.tuning.family import Example, Tick
from torchvision_dddas.tuning.labelling import regions_of
from torchvision_dddas.tuning.overlap import LOSSES, f_loss
from torchvision_dddas.tuning.recorded_clips import Recorded, differences_of, recorded

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
                mask = through(hard, mask)
            for place, wrong in zip(places, self.wrong(mask, frames.truth, frames.known), strict=True):
                losses[place] = wrong
        return torch.stack(losses)


def masks_of(frames: Labelled, values: Values, softness: float) -> Float[Tensor, "B 1 H W"]:
    """The soft masks of a batch of frames. softness: a share of each threshold; 0.0 gives hard masks."""
    motion = SoftMotion(frames.settings)
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
