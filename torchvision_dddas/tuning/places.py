"""Places on the ground: how surprising their errors are under their ellipses, which calibrates these.

The loss is the negative log-likelihood of the true places, in nats a target: smaller ellipses gain, until errors fall
outside of them more often than they should. Frames stand alone: what the registrar remembers from frame to frame
(aerial.correlation_s) makes its ellipses smaller than those tuned here, and is judged by the study's figures.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.geo.pose_estimation import EXACT_M
from torchvision_dddas.tuning.aerial_examples import GroundFit, Look, Seen, fit_ground, joined, looks_of, of_settings
from torchvision_dddas.tuning.family import Example, Tick
from torchvision_dddas.tuning.ground_examples import person_lost, sightings_of
from torchvision_dddas.tuning.soft_places import Linear, gauss_newton_step, gaussian_nll, project_to_ground

UNPLACED = 25.0
"""Nats that a picture costs which no pose of the camera explains, or whose rays miss the ground: no slope, no NaN."""


@dataclass(frozen=True)
class Places:
    """The family `location`."""

    name: str = "location"
    task: Task = "location"
    measure: str = "location.metres.mean_m"
    softness: tuple[float, float] = (1.0, 1.0)
    """Without effect: nothing here is hard."""

    def examples(self, clips: Sequence[Clip], settings: Settings, tick: Tick = lambda: None) -> list[Example]:
        """Looks from the air of clips with landmarks, sightings of those with a camera on the ground alone.

        See `family.Family`.
        """
        found: list[Example] = []
        for clip in clips:
            mine = sightings_of(clip, settings) if clip.landmarks is None else looks_of(clip, settings)
            before = len(found)
            for example in mine:
                found.append(example)
                tick()
            if len(found) == before:
                raise InputError(f"{clip.name}: no target was located whose true place is known; nothing can be tuned")
        return found

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """(B,) nats a target. See `family.Family`.

        Computed on the CPU, where the fits are, whatever the knobs' device.
        """
        device = next(iter(parameters.values())).device if parameters else torch.device("cpu")
        parameters = {name: value.cpu() for name, value in parameters.items()}
        found: list[Tensor] = [torch.zeros(0)] * len(batch)
        groups: dict[tuple[int, int], list[tuple[int, Look, dict[str, Tensor], GroundFit]]] = defaultdict(list)
        for row, example in enumerate(batch):
            if not isinstance(example.content, Seen):
                seen, settings = example.content
                found[row] = person_lost(seen, settings, parameters, UNPLACED)
                continue
            look = example.content.look
            values = {**of_settings(example.content.settings), **parameters}
            here = example.content.fit or fit_ground(look, values)
            if here is None:
                found[row] = torch.full((), UNPLACED, dtype=torch.float64) + 0 * sum(parameters.values())
            else:
                groups[len(look.marks), len(look.true_m)].append((row, look, values, here))
        for members in groups.values():
            lost = _lost([look for _, look, _, _ in members], members[0][2], [here for *_, here in members])
            for (row, *_), value in zip(members, lost, strict=True):
                found[row] = value
        return torch.stack(found).to(device)


def family() -> Places:
    """See `family.family_of`."""
    return Places()


def _lost(looks: Sequence[Look], parameters: dict[str, Tensor], here: Sequence[GroundFit]) -> Tensor:
    """(B,) of looks with as many landmarks and targets each."""
    parts = ("missing", "slopes", "correction", "by_turn", "known")
    problem = Linear(*(torch.stack([getattr(one.problem, part) for one in here]) for part in parts))
    places = joined([look.places for look in looks]).variance(parameters).clamp(min=EXACT_M**2)
    pixels = joined([look.pixels for look in looks]).variance(parameters)
    prior = joined([look.prior for look in looks]).variance(parameters)
    variance = torch.cat([prior, places.repeat_interleave(2, dim=1)], dim=1)
    step, covariance = gauss_newton_step(problem, pixels.repeat_interleave(2, dim=1), variance)
    off_m, by_pose, by_pixel = (
        torch.stack([getattr(one, part) for one in here]) for part in ("off_m", "by_pose", "by_pixel")
    )
    spot = joined([look.spot for look in looks]).variance(parameters)
    off_m, spread = project_to_ground(off_m, by_pose, by_pixel, step, covariance, spot)
    shared = parameters["landmarks.common_sigma_m"] ** 2 * torch.eye(2, dtype=spread.dtype)
    return gaussian_nll(off_m, spread + shared).mean(dim=1)
