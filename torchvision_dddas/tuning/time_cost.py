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
from torchvision_dddas.evaluation.studies.records import Found, Task
from torchvision_dddas.evaluation.studies.stages import find, upstream_task
from torchvision_dddas.io.atomic_files import save_file
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
    clip: Clip,
    task: Task,
    settings: Settings,
    names: Sequence[str],
    weight: float,
    backend: str = "auto",
    repeats: int = REPEATS,
    timed: Callable[[Settings], float] | None = None,
    tick: Callable[[], object] = lambda: None,
) -> TimeCost:
    """Time a task on a clip with each parameter at other values, in interleaved turns.

    timed: seconds a frame for some settings, in place of the hard pipeline. tick: called after each of `timed_points` ×
    repeats. Raises InputError as the task does.
    """
    timed = timed or _timer(clip, task, settings, backend)
    todo = timed_points(settings, names)
    took: dict[tuple[str, float], list[float]] = {point: [] for point in todo}
    for turn in range(repeats):
        for point in todo if turn % 2 == 0 else reversed(todo):
            took[point].append(timed(_at(settings, point)))
            tick()
    base = median(took["", 0.0])
    # Logarithms, as times differ by factors; what repeats of the same settings differ by is noise.
    spread = median(stdev(map(math.log, ts)) for ts in took.values()) if repeats > 1 else 0.0
    curves = []
    for name in names:
        start = value_of(settings, name)
        known = {value: median(ts) / base for (of, value), ts in took.items() if of == name}
        if any(abs(math.log(factor)) > NOISE * spread for factor in known.values()):
            both = sorted({**known, start: 1.0}.items())
            curves.append(Curve(name, tuple(v for v, _ in both), tuple(f for _, f in both)))
    return TimeCost(weight, base, tuple(curves))


def timed_points(settings: Settings, names: Sequence[str]) -> list[tuple[str, float]]:
    """The parameters and values that are timed; first ("", 0.0), the settings as they are."""
    found = [("", 0.0)]
    for name in names:
        tunable, start = TUNABLE[name], value_of(settings, name)
        for factor in FACTORS:
            value = tunable.rounded((start + tunable.offset) * factor - tunable.offset)
            point = (name, float(value))
            if value != start and point not in found and _possible(settings, point):
                found.append(point)
    return found


def write_cost(place: Path, cost: TimeCost) -> None:
    """Keep the measured times for a resumed run. Raises InputError where the disk refuses."""
    save_file(place, (json.dumps(cost.as_json(), indent=2) + "\n").encode())


def read_cost(place: Path) -> TimeCost:
    """Read what `write_cost` wrote. Raises InputError where it is damaged."""
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


def _timer(clip: Clip, task: Task, settings: Settings, backend: str) -> Callable[[Settings], float]:
    need = upstream_task(clip, task)
    before: Found | None = None if need is None else find(clip, need, settings, backend)

    def timed(changed: Settings) -> float:
        found = find(clip, task, changed, backend, before=before)
        return sum(found.seconds.values()) / max(len(found.looked), 1)

    timed(settings)  # warm up
    return timed


def _at(settings: Settings, point: tuple[str, float]) -> Settings:
    name, value = point
    return with_parameters(settings, {name: TUNABLE[name].rounded(value)}) if name else settings


def _possible(settings: Settings, point: tuple[str, float]) -> bool:
    try:
        _at(settings, point)
    except InputError:
        return False
    return True
