"""The time of a frame as a term of the loss: measured once for each parameter with the hard pipeline."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median, stdev
from typing import Any

import torch
from torch import Tensor

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.records import Task
from torchvision_dddas.evaluation.studies.stages import find, upstream_task
from torchvision_dddas.tuning.parameters import TUNABLE, value_of

FACTORS = (0.5, 2.0)
"""A parameter is measured at its value and at these multiples of it, within its range."""

REPEATS = 3
NOISE = 2.0
"""A change of the time counts where it is larger than this many times the spread of repeats."""


@dataclass(frozen=True)
class Curve:
    """times: the factor on a frame's time at each of `values`, which ascend; 1 at the parameter's own value."""

    parameter: str
    values: tuple[float, ...]
    times: tuple[float, ...]

    def factor(self, value: Tensor) -> Tensor:
        """The factor: linear between the values on the parameter's scale, constant beyond them."""
        tunable = TUNABLE[self.parameter]
        values = torch.tensor(self.values, dtype=value.dtype, device=value.device)
        places, here = (((x + tunable.offset).log() if tunable.log else x) for x in (values, value))
        found = value.new_tensor(self.times[0]) + 0 * value
        for k in range(1, len(self.values)):
            share = ((here - places[k - 1]) / (places[k] - places[k - 1])).clamp(0, 1)
            found = found + share * (self.times[k] - self.times[k - 1])
        return found


@dataclass(frozen=True)
class TimeCost:
    """Charges a loss of `weight` where a frame takes twice the `seconds` that it takes with the original settings."""

    weight: float
    seconds: float
    curves: tuple[Curve, ...]

    def as_json(self) -> dict[str, Any]:
        """The content of cost.json, as `read_cost` takes it."""
        curves = [{"knob": c.parameter, "values": list(c.values), "times": list(c.times)} for c in self.curves]
        return {"weight": self.weight, "seconds": self.seconds, "curves": curves}

    def term(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Weight × (expected / seconds − 1), to be added to a loss."""
        return self.weight * (self.expected(parameters) / self.seconds - 1)

    def expected(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Seconds a frame: the factors of all parameters multiplied, as if they did not interact."""
        found = torch.tensor(self.seconds, dtype=torch.float64)
        for curve in self.curves:
            if curve.parameter in parameters:
                found = found * curve.factor(parameters[curve.parameter])
        return found


def measure_cost(
    timed: Callable[[Settings], float],
    settings: Settings,
    names: Sequence[str],
    weight: float,
    tick: Callable[[], object] = lambda: None,
) -> TimeCost:
    """Time the settings with each parameter at other values, REPEATS times in interleaved turns.

    timed: seconds a frame for some settings, such as of `frame_timer`. tick: called after each of `timed_points` ×
    REPEATS.
    """
    points = timed_points(settings, names)
    took: dict[tuple[str, float], list[float]] = {point: [] for point in points}
    for turn in range(REPEATS):
        for point, changed in points.items() if turn % 2 == 0 else reversed(points.items()):
            took[point].append(timed(changed))
            tick()
    base = median(took["", 0.0])
    # Logarithms, as times differ by factors; what repeats of the same settings differ by is noise.
    spread = median(stdev(map(math.log, ts)) for ts in took.values())
    curves = []
    for name in names:
        known = {value: median(ts) / base for (of, value), ts in took.items() if of == name}
        if any(abs(math.log(factor)) > NOISE * spread for factor in known.values()):
            values, times = zip(*sorted({**known, value_of(settings, name): 1.0}.items()), strict=True)
            curves.append(Curve(name, values, times))
    return TimeCost(weight, base, tuple(curves))


def timed_points(settings: Settings, names: Sequence[str]) -> dict[tuple[str, float], Settings]:
    """The settings that are timed, by parameter and value; first ("", 0.0), the settings as they are."""
    found = {("", 0.0): settings}
    for name in names:
        tunable, start = TUNABLE[name], value_of(settings, name)
        for factor in FACTORS:
            value = tunable.rounded((start + tunable.offset) * factor - tunable.offset)
            if value != start:
                try:
                    found.setdefault((name, float(value)), with_parameters(settings, {name: value}))
                except InputError:  # the value and another parameter exclude each other
                    continue
    return found


def frame_timer(clip: Clip, task: Task, settings: Settings, backend: str) -> Callable[[Settings], float]:
    """Seconds a frame of a task on a clip, as a function of the settings. Raises InputError as the task does."""
    need = upstream_task(clip, task)
    before = None if need is None else find(clip, need, settings, backend)

    def timed(changed: Settings) -> float:
        found = find(clip, task, changed, backend, before=before)
        return sum(found.seconds.values()) / max(len(found.looked), 1)

    timed(settings)  # warm up
    return timed


def read_cost(place: Path) -> TimeCost:
    """Read a cost.json, the JSON of `TimeCost.as_json`. Raises InputError where it is damaged."""
    try:
        content = json.loads(place.read_text(encoding="utf-8"))
        curves = [
            Curve(TUNABLE[c["knob"]].name, tuple(map(float, c["values"])), tuple(map(float, c["times"])))
            for c in content["curves"]
        ]
        if any(len(curve.values) != len(curve.times) for curve in curves):
            raise ValueError
        return TimeCost(float(content["weight"]), float(content["seconds"]), tuple(curves))
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        raise InputError(f"{place} does not hold the cost of parameters; begin again without --resume") from None
