"""Families of parameters that are known through and through: where their loss is least, where it is no number."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchvision_dddas.lab.evaluation.studies.records import Task
from torchvision_dddas.lab.tuning.family import Example, Family


@dataclass
class Bowl(Family):
    """Least where the logarithm of the threshold is `place` and more of each example, of the noise 0.

    wrong_above: of the threshold, from which on the loss of the example `wrong` is no number. steep_at: an example
    whose loss is a number and its slope is not. calls: softness of each loss that was asked for.
    """

    place: float = 3.0
    wrong: tuple[str, int] = ("", 0)
    wrong_above: float = 0.0
    steep: tuple[str, int] = ("", 0)
    calls: list[float] = field(default_factory=list)
    name: str = "motion"
    task: Task = "motion"
    measure: str = "motion.pixels.f"
    softness: tuple[float, float] = (1.0, 0.1)

    def clip_examples(self, clip, settings):
        """Two of each clip."""
        return [(frame, torch.tensor(0.0)) for frame in (1, 2)]

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """A bowl, a little deeper for what is soft."""
        self.calls.append(softness)
        threshold = parameters["difference.threshold"]
        found = []
        for example in batch:
            loss = (threshold.log() - self.place - example.content) ** 2 - 0.01 * softness
            if "difference.noise_levels" in parameters:
                loss = loss + parameters["difference.noise_levels"].log() ** 2
            if (example.clip, example.frame) == self.wrong and float(threshold.detach()) > self.wrong_above:
                loss = loss * float("nan")
            if (example.clip, example.frame) == self.steep:
                loss = loss + (threshold - threshold.detach()).sqrt()  # 0, with a slope that is infinite
            found.append(loss)
        return torch.stack(found)


def pieces(clips: Sequence[str] = ("one", "two"), frames: int = 8, spread: float = 0.1) -> list[Example]:
    """Examples whose own least places lie about 0."""
    noise = torch.Generator().manual_seed(1)
    return [
        Example(clip, frame, spread * torch.randn((), generator=noise, dtype=torch.float64))
        for clip in clips
        for frame in range(1, frames + 1)
    ]
