"""Sweeps: the same study with other parameters, on a grid or as Optuna proposes, and which of them measure best.

Nothing random is left open and every study takes from the cache what it has computed before: a sweep that was broken
off and is asked for again goes the same way, and is soon where it was.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from torchvision_dddas.config import Settings, changes, format_toml
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies.axes import Axis, Choice, points, possible

if TYPE_CHECKING:
    from optuna.study import Study as Optuna
    from optuna.trial import Trial as Proposal

Measured = tuple[float, str]
"""The measure, NaN where there is none, and then why."""

Measure = Callable[[Mapping[str, object]], Measured]
"""What a study measures with some parameters changed."""

Ahead = Callable[[Sequence[Mapping[str, object]]], None]

AHEAD = 12  # points of a grid whose clips the workers share


@dataclass(frozen=True)
class Trial:
    """One point. number: 0 for the settings as they were. cause: why it has no value."""

    number: int
    parameters: Mapping[str, object]
    value: float
    cause: str = ""


def on_grid(axes: Sequence[Choice], settings: Settings, measure: Measure, ahead: Ahead) -> Iterator[Trial]:
    """The settings as they are, then all points of a grid. Raises InputError where it has too many or no possible one.

    A point whose parameters cannot have their values together has a cause and no value. ahead: is told the points that
    will be measured next.
    """
    wanted = list(points(axes))
    causes = [possible(settings, parameters) for parameters in wanted]
    if all(causes):
        raise InputError(f"no point of the grid is possible; the first: {causes[0]}")
    todo: list[tuple[Mapping[str, object], str]] = [({}, ""), *zip(wanted, causes, strict=True)]
    for first in range(0, len(todo), AHEAD):
        part = todo[first : first + AHEAD]
        ahead([parameters for parameters, cause in part if not cause])
        for number, (parameters, cause) in enumerate(part, first):
            yield (
                Trial(number, parameters, math.nan, cause) if cause else Trial(number, parameters, *measure(parameters))
            )


def proposed(
    axes: Sequence[Axis], settings: Settings, measure: Measure, count: int, seed: int, least: bool
) -> Iterator[Trial]:
    """The settings as they are, then `count` points that Optuna's tree-structured Parzen estimator proposes.

    least: less is better. Raises InputError where Optuna is not installed.
    """
    need_optuna()
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.TPESampler(seed=seed)
    study = optuna.create_study(direction="minimize" if least else "maximize", sampler=sampler)
    yield Trial(0, {}, *measure({}))
    for number in range(1, count + 1):
        proposal = study.ask()
        parameters = {axis.parameter: _suggested(proposal, axis) for axis in axes}
        cause = possible(settings, parameters)
        trial = Trial(number, parameters, math.nan, cause) if cause else Trial(number, parameters, *measure(parameters))
        _tell(study, proposal, trial)
        yield trial


def need_optuna() -> None:
    """Raises InputError where Optuna is not installed."""
    if find_spec("optuna") is None:
        raise InputError("--optuna needs optuna; pip install 'torchvision-dddas[tune]', or take --grid")


def best(trials: Sequence[Trial], least: bool) -> Trial | None:
    """The trial of the best value, of equal ones the first; None where none has a value."""
    return next((trial for trial in ranked(trials, least) if not math.isnan(trial.value)), None)


def ranked(trials: Sequence[Trial], least: bool) -> list[Trial]:
    """The best first, equal ones in their order, those without a value last."""
    sign = 1 if least else -1
    return sorted(trials, key=lambda t: (math.isnan(t.value), 0 if math.isnan(t.value) else sign * t.value, t.number))


def written(value: object) -> str:
    """A parameter's value as TOML has it, and as `--set` takes it."""
    return format_toml({"value": value}).removeprefix("value = ").rstrip()


def as_toml(settings: Settings, heading: Sequence[str]) -> str:
    """What differs from the defaults, as `--config` takes it, under some lines of comment."""
    groups: dict[str, dict[str, object]] = {}
    for name, value in changes(settings).items():
        group, parameter = name.split(".")
        groups.setdefault(group, {})[parameter] = value
    return format_toml(groups, heading)


def told(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """The trials as JSON has them."""
    return [
        {
            "number": t.number,
            "knobs": dict(t.parameters),
            "value": None if math.isnan(t.value) else t.value,
            "cause": t.cause,
        }
        for t in trials
    ]


def _suggested(proposal: "Proposal", axis: Axis) -> object:
    if isinstance(axis, Choice):
        # By their places: a list is no choice that Optuna knows.
        return axis.values[proposal.suggest_categorical(axis.parameter, range(len(axis.values)))]
    if axis.step:
        return proposal.suggest_int(axis.parameter, int(axis.low), int(axis.high), step=axis.step, log=axis.log)
    return proposal.suggest_float(axis.parameter, axis.low, axis.high, log=axis.log)


def _tell(study: "Optuna", proposal: "Proposal", trial: Trial) -> None:
    import optuna

    if math.isnan(trial.value):
        study.tell(proposal, state=optuna.trial.TrialState.FAIL)
    else:
        study.tell(proposal, trial.value)
