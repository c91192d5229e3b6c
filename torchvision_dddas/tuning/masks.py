"""The knobs of motion: masks of labelled frames, and how far soft ones are from them."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.datasets.record import Clip
from torchvision_dddas.errors import InputError
from torchvision_dddas.metrics.truth import labels_of
from torchvision_dddas.modules.motion import Differences, SoftMotion, Values
from torchvision_dddas.ops.relax.passing import through
from torchvision_dddas.settings import Settings
from torchvision_dddas.studies.record import Task
from torchvision_dddas.tuning.family import Example, Tick
from torchvision_dddas.tuning.labelling import regions_of
from torchvision_dddas.tuning.overlap import f_loss
from torchvision_dddas.tuning.recorded import differences_of, recorded

Loss = Callable[[Tensor, Tensor, Tensor], Tensor]

# A soft mask reaches this many softnesses below the threshold: there it is 0.05.
_REACH = 3.0


@dataclass(frozen=True)
class Labelled:
    """A batch of labelled frames of one size. truth, known: where something moves, and where it is known.

    away, added: what the hard steps after the hulls took from the mask, and gave to it, at the settings that the frames
    were prepared with: persistence, outlines by motion and colour, shadows, small and weak targets.
    """

    differences: Differences
    truth: Bool[Tensor, "B 1 H W"]
    known: Bool[Tensor, "B 1 H W"]
    away: Bool[Tensor, "B 1 H W"]
    added: Bool[Tensor, "B 1 H W"]
    settings: Settings


class Masks:
    """Implements `Family` for the knobs of motion. passing: masks are hard, their gradient soft."""

    name = "motion"
    task: Task = "motion"
    measure = "motion.pixels.f"
    softness = (0.5, 0.1)

    def __init__(self, wrong: Loss = f_loss, passing: bool = False) -> None:
        self.wrong, self.passing = wrong, passing

    def examples(self, clips: Sequence[Clip], settings: Settings, tick: Tick = lambda: None) -> list[Example]:
        """The frames with masks. Raises InputError for a clip without any."""
        if settings.difference.halved:
            raise InputError("difference.halved = true cannot be tuned by gradient; set it to false")
        return [example for clip in clips for example in _examples(clip, settings, tick)]

    def loss(self, knobs: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """(B,) 1 - F of each frame."""
        groups: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for place, example in enumerate(batch):
            groups[cast(Labelled, example.content).differences.least.shape].append(place)
        device = next(iter(knobs.values())).device
        losses: list[Tensor] = [torch.empty(0)] * len(batch)
        for places in groups.values():
            frames = together([batch[place].content for place in places], device)
            mask = masks_of(frames, knobs, softness)
            if self.passing and softness > 0:
                with torch.no_grad():
                    hard = masks_of(frames, knobs, 0.0)
                mask = through(hard, mask)
            for place, wrong in zip(places, self.wrong(mask, frames.truth, frames.known), strict=True):
                losses[place] = wrong
        return torch.stack(losses)


def masks_of(frames: Labelled, values: Values, softness: float) -> Float[Tensor, "B 1 H W"]:
    """The soft masks of a batch of frames. softness: a share of each threshold; 0.0 gives hard masks."""
    motion = SoftMotion(frames.settings)
    core = motion(frames.differences, values, softness)
    tuned = values.get("difference.threshold")
    threshold = frames.settings.difference.threshold if tuned is None else float(tuned.detach())
    found = regions_of(core, frames.settings.morphology.hull, _REACH * softness * threshold)
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


def _examples(clip: Clip, settings: Settings, tick: Tick) -> list[Example]:
    truth = clip.truth
    if truth is None or not truth.masks:
        raise InputError(f"{clip.name} has no masks of what moves, which tuning the knobs of motion needs")
    found = []
    for one in recorded(clip, settings, set(truth.masks)):
        labels = labels_of(truth, one.frame)
        if labels.shape != one.mask.shape:
            raise InputError(f"{truth.masks[one.frame]} is {_size(labels)}, the frame itself {_size(one.mask)}")
        # A frame without a window shows nothing, whatever the knobs.
        if one.window is not None and (labels >= 0).any():
            differences = differences_of(one.window, settings)
            found.append(Example(clip.name, one.frame, _labelled(differences, labels, one.mask, settings)))
        tick()
    if not found:
        raise InputError(f"no labelled frame of {clip.name} hangs together with its neighbours: nothing to tune on")
    return found


def _labelled(differences: Differences, labels: np.ndarray, mask: np.ndarray, settings: Settings) -> Labelled:
    """A frame with its truth; what comes after the hulls is what the soft steps, made hard, lack of the mask."""
    truth, known, final = (torch.from_numpy(map_)[None, None] for map_ in (labels > 0, labels >= 0, mask))
    none = torch.zeros_like(final)
    frame = Labelled(differences, truth, known, none, none, settings)
    with torch.no_grad():
        drawn = masks_of(together([frame], torch.device("cpu")), {}, 0.0) > 0.5
    return replace(frame, away=drawn & ~final, added=final & ~drawn)


def _size(picture: np.ndarray) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}"


def family() -> Masks:
    """As `tuning.family` asks for it."""
    return Masks()
