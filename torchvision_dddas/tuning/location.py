"""The family of locating: how likely the true positions are under their ellipses, which calibrates these.

The loss is the negative log-likelihood of the true positions, in nats a target: smaller ellipses gain until errors fall
outside of them too often. Frames are independent: what the georeferencer keeps from frame to frame
(aerial.correlation_s) makes its ellipses smaller than those tuned here, and is judged by the study's figures.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.records import Task
from torchvision_dddas.tuning.aerial_examples import aerial_examples
from torchvision_dddas.tuning.aerial_location import AerialExample, aerial_losses, default_values, fit_ground
from torchvision_dddas.tuning.family import Family
from torchvision_dddas.tuning.ground_location import ground_examples, ground_loss

UNPLACED = 25.0
"""The loss in nats, without a gradient, of a picture that no pose explains or whose rays miss the ground."""


@dataclass(frozen=True)
class LocationFamily(Family):
    """The family `location`. softness has no effect, as nothing here is hard."""

    name: str = "location"
    task: Task = "location"
    measure: str = "location.metres.mean_m"
    softness: tuple[float, float] = (1.0, 1.0)
    empty = "no target was located whose true position is known; nothing to tune on"

    def clip_examples(self, clip: Clip, settings: Settings) -> Iterator[tuple[int, Any]]:
        """Views from the air of a clip with landmarks; of one with a camera on the ground only, views from there."""
        if clip.truth is None or clip.truth.positions is None:
            raise InputError(f"{clip.name} has no true positions, which tuning of ellipses needs; leave it out")
        yield from ground_examples(clip, settings) if clip.landmarks is None else aerial_examples(clip, settings)

    def _losses(self, contents: Sequence[Any], values: dict[str, Tensor], softness: float) -> list[Tensor]:
        """Nats a target; views from the air of equal shapes are computed together."""
        found: list[Tensor] = [torch.zeros(0)] * len(contents)
        groups = defaultdict(list)
        for row, content in enumerate(contents):
            if not isinstance(content, AerialExample):
                found[row] = ground_loss(content[0], content[1], values, UNPLACED)
                continue
            view, known = content.view, {**default_values(content.settings), **values}
            fit = content.fit or fit_ground(view, known)
            if fit is None:
                found[row] = torch.full((), UNPLACED, dtype=torch.float64) + 0 * sum(values.values())
            else:
                groups[len(view.marks), len(view.true_m)].append((row, view, known, fit))
        for members in groups.values():
            rows, views, known_values, fits = zip(*members, strict=True)
            for row, loss in zip(rows, aerial_losses(views, known_values[0], fits), strict=True):
                found[row] = loss
        return found
