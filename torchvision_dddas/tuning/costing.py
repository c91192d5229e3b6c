"""What a frame's time is expected to be, knob by knob: measured once by the hard pipeline, then a term of the loss."""

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
from torchvision_dddas.evaluation.studies.results import Found
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.evaluation.studies.stages import find, upstream_task
from torchvision_dddas.io.atomic_files import save_file
from torchvision_dddas.tuning.parameters import TUNABLE

FACTORS = (0.5, 2.0)
"""A parameter is measured at its value, and at these parts and multiples of it, within its range."""

REPEATS = 3
NOISE = 2.0
"""A change of the time that is no larger than so many times what repeats differ by is none."""


@dataclass(frozen=True)
class Curve:
    """How many times as long a frame takes at some values of a parameter, which ascend; 1 at the value that it has."""

    parameter: str
    values: tuple[float, ...]
    times: tuple[float, ...]

    def factor(self, value: Tensor) -> Tensor:
        """Between the values in straight lines over the knob's scale, beyond them as at the last."""
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
    """A loss of `weight` for every more time of the seconds that a frame takes with the settings as they are."""

    weight: float
    seconds: float
    curves: tuple[Curve, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain numbers and texts, as `read` takes them."""
        curves = [{"knob": c.parameter, "values": list(c.values), "times": list(c.times)} for c in self.curves]
        return {"weight": self.weight, "seconds": self.seconds, "curves": curves}

    def term(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Weight × (expected seconds / seconds with the settings as they are − 1)."""
        return self.weight * (self.expected(parameters) / self.seconds - 1)

    def expected(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Seconds a frame: the knobs' factors multiplied, as if none changed what another costs."""
        found = torch.tensor(self.seconds, dtype=torch.float64)
        for curve in self.curves:
            if curve.parameter in parameters:
                found = found * curve.factor(parameters[curve.parameter])
        return found


def measured(
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
    """Time a task on a clip with each knob in turn at other values, in turns. timed: in place of the hard pipeline.

    tick: called after each of `points` × repeats. Raises InputError as the task does.
    """
    timed = timed or _timer(clip, task, settings, backend)
    todo = points(settings, names)
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
        start = _value(settings, name)
        known = {value: median(ts) / base for (of, value), ts in took.items() if of == name}
        if any(abs(math.log(factor)) > NOISE * spread for factor in known.values()):
            both = sorted({**known, start: 1.0}.items())
            curves.append(Curve(name, tuple(v for v, _ in both), tuple(f for _, f in both)))
    return TimeCost(weight, base, tuple(curves))


def points(settings: Settings, names: Sequence[str]) -> list[tuple[str, float]]:
    """What is timed: a parameter and its value, and first no parameter at all."""
    found = [("", 0.0)]
    for name in names:
        tunable, start = TUNABLE[name], _value(settings, name)
        for factor in FACTORS:
            value = tunable.rounded((start + tunable.offset) * factor - tunable.offset)
            point = (name, float(value))
            if value != start and point not in found and _possible(settings, point):
                found.append(point)
    return found


def write(place: Path, cost: TimeCost) -> None:
    """Keep what was measured: another time it would be a little other. Raises InputError where the disk refuses."""
    save_file(place, (json.dumps(cost.as_json(), indent=2) + "\n").encode())


def read(place: Path) -> TimeCost:
    """Read it back. Raises InputError where it is damaged."""
    try:
        told = json.loads(place.read_text(encoding="utf-8"))
        curves = [
            Curve(TUNABLE[c["knob"]].name, tuple(map(float, c["values"])), tuple(map(float, c["times"])))
            for c in told["curves"]
        ]
        if any(len(curve.values) != len(curve.times) for curve in curves):
            raise ValueError
        return TimeCost(float(told["weight"]), float(told["seconds"]), tuple(curves))
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        raise InputError(f"{place} does not tell the cost of the parameters; begin again without --resume") from None


def _timer(clip: Clip, task: Task, settings: Settings, backend: str) -> Callable[[Settings], float]:
    need = upstream_task(clip, task)
    before: Found | None = None if need is None else find(clip, need, settings, backend)

    def timed(changed: Settings) -> float:
        found = find(clip, task, changed, backend, before=before)
        return sum(found.seconds.values()) / max(len(found.looked), 1)

    timed(settings)  # what is only slow the first time
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


def _value(settings: Settings, name: str) -> float:
    group, key = name.split(".")
    return float(getattr(getattr(settings, group), key))
