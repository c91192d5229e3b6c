"""Sweeps: run one study with other parameters, on a grid or as Optuna proposes, and rank the results.

All random numbers have a seed, and every study takes earlier results from the cache. An interrupted sweep that is
started again measures the same points, and soon continues at the point where it stopped.
"""

import glob
import itertools
import json
import math
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchvision_dddas.config import (
    Settings,
    all_parameters,
    changes,
    format_toml,
    is_set,
    nearest,
    uses_tracklets,
    with_parameters,
)
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import save_file
from torchvision_dddas.lab.evaluation.report.sweep import save_sweep
from torchvision_dddas.lab.evaluation.studies.cache import Cache, cache_folder
from torchvision_dddas.lab.evaluation.studies.jobs import JobEvent, Workers
from torchvision_dddas.lab.evaluation.studies.records import Spec
from torchvision_dddas.lab.evaluation.studies.runner import plan_study, run_jobs, run_study
from torchvision_dddas.lab.evaluation.studies.summary import Goal, goal_value

MAX_POINTS = 10_000
AHEAD = 12  # number of grid points whose clips the workers share

_RANGE = re.compile(r"\s*([^\s:,\[\]]+)\s*:\s*([^\s:,\[\]]+)\s*(?::\s*(\w+)\s*)?")

Measured = tuple[float, str]
"""The measure and "", or NaN and the reason."""

Measure = Callable[[Mapping[str, object]], Measured]
"""A function from changed parameters to the measure of a study with them."""


@dataclass(frozen=True)
class ParameterAxis:
    """A parameter and its values; without values the range from low to high, both included.

    step: step of whole numbers; 0: continuous. log: sample on a logarithmic scale.
    """

    parameter: str
    values: tuple[object, ...] = ()
    low: float = 0
    high: float = 0
    step: int = 0
    log: bool = False


def parse_grid(texts: Sequence[str], settings: Settings) -> list[ParameterAxis]:
    """Return axes from texts such as `difference.threshold=10,20,30`.

    Raise InputError for an unknown parameter, a repeated parameter, no values, a bad value, or too many points.
    """
    axes: list[ParameterAxis] = []
    for text in texts:
        parameter, values = _split(text, "group.parameter=value,value", axes)
        axes.append(_choice(parameter, values, text, settings))
    if (count := count_points(axes)) > MAX_POINTS:
        raise InputError(f"the grid may have {MAX_POINTS} points, got {count}; give fewer values, or take --optuna")
    return axes


def parse_ranges(texts: Sequence[str], settings: Settings) -> list[ParameterAxis]:
    """Return axes from texts such as `difference.threshold=8:30`, `small.gap_frames=2:20:log`, `difference.kind=a,b`.

    Raise InputError as `parse_grid` does, and for bad ends of a range.
    """
    axes: list[ParameterAxis] = []
    for text in texts:
        parameter, values = _split(text, "group.parameter=low:high", axes)
        found = _RANGE.fullmatch(values)
        axes.append(_range(parameter, found, text, settings) if found else _choice(parameter, values, text, settings))
    return axes


def parameter_notes(axes: Sequence[ParameterAxis], settings: Settings) -> list[str]:
    """Return notes on parameters whose meaning with these settings differs from the default, or that have no effect."""
    tried = {axis.parameter: axis for axis in axes}
    kinds = tried["difference.kind"].values if "difference.kind" in tried else (settings.difference.kind,)
    others = ", ".join(str(kind) for kind in kinds if kind != "normalized")
    notes = [
        f"{parameter} is in grey levels with difference.kind = {others}, and in units of noise with normalized, the "
        "default: a value for one unit cannot be used for the other"
        for parameter in ("difference.threshold", "difference.peak")
        if parameter in tried and others
    ]
    for parameter in tried:
        group = parameter.split(".")[0]
        if getattr(getattr(settings, group), "on", True) is False and f"{group}.on" not in tried:
            notes.append(f"{parameter} has no effect: {group}.on is false")
        elif group == "history" and uses_tracklets(settings) and not {"tracklets.on", "difference.kind"} & set(tried):
            notes.append(f"{parameter} has no effect: tracklets replace the motion history; set tracklets.on=false")
    return notes


def count_points(axes: Sequence[ParameterAxis]) -> int:
    """Return the number of points of a grid."""
    return math.prod(len(axis.values) for axis in axes)


def _split(text: str, wanted: str, axes: Sequence[ParameterAxis]) -> tuple[str, str]:
    parameter, equals, values = (part.strip() for part in text.partition("="))
    if not equals or not parameter or not values:
        raise InputError(f"'{text}' is not an axis of a sweep; wanted {wanted}, such as difference.threshold=10,20")
    names = [known.name for known in all_parameters()]
    if parameter not in names:
        raise InputError(f"unknown parameter '{parameter}'; {nearest(parameter, names)}")
    if any(axis.parameter == parameter for axis in axes):
        raise InputError(f"{parameter} is given twice; give all its values in one place")
    return parameter, values


def _choice(parameter: str, listed: str, text: str, settings: Settings) -> ParameterAxis:
    """Return values between commas, as in TOML; words need no quotes."""
    try:
        values = list(tomllib.loads(f"values = [{listed}]")["values"])
    except (ValueError, RecursionError):
        values = []
        for word in filter(None, (part.strip() for part in listed.split(","))):
            try:
                values.append(tomllib.loads(f"value = {word}")["value"])
            except (ValueError, RecursionError):
                values.append(word)
    if not values:
        raise InputError(f"'{text}' has no values; wanted some, such as difference.threshold=10,20")
    values = [tuple(value) if isinstance(value, list) else value for value in values]
    for value in values:
        _check(parameter, value, settings)
    if isinstance(_current(settings, parameter), float):
        values = [float(value) if isinstance(value, int) else value for value in values]
    return ParameterAxis(parameter, tuple(dict.fromkeys(values)))


def _range(parameter: str, found: re.Match[str], text: str, settings: Settings) -> ParameterAxis:
    current = _current(settings, parameter)
    if isinstance(current, bool) or not isinstance(current, int | float):
        raise InputError(f"{parameter} is not a number and has no range; give its values, as {parameter}=first,second")
    try:
        low, high = float(found[1]), float(found[2])
    except ValueError:
        raise InputError(f"'{text}': the ends of a range must be numbers, low:high") from None
    if not low < high:
        raise InputError(f"'{text}': the lower end must come first, got {low:g}:{high:g}")
    log = found[3] is not None
    if log and found[3] != "log":
        raise InputError(f"'{text}' ends in '{found[3]}'; wanted low:high, or low:high:log")
    if log and low <= 0:
        raise InputError(f"'{text}': the lower end of a logarithmic range must be above 0, got {low:g}")
    odd = next(known.range for known in all_parameters() if known.name == parameter).endswith(", odd")
    if isinstance(current, int):
        if fractions := [end for end in (low, high) if end != int(end)]:
            raise InputError(f"{parameter} takes whole numbers, got {fractions[0]:g}")
        low, high = int(low), int(high)
    for end in (low, high):
        _check(parameter, end, settings)
    if log and odd:
        raise InputError(f"{parameter} takes odd numbers, which have no logarithmic range; leave out :log")
    return ParameterAxis(parameter, (), low, high, 0 if isinstance(current, float) else 2 if odd else 1, log)


def _check(parameter: str, value: object, settings: Settings) -> None:
    """Raise InputError for a bad value. Rules over several parameters are checked at each point."""
    cause = _why_impossible(settings, {parameter: value})
    if cause.startswith((f"{parameter} = ", f"{parameter} must ")):
        raise InputError(cause)


def _why_impossible(settings: Settings, parameters: Mapping[str, object]) -> str:
    """Return the reason why parameters cannot have these values together; empty if they can."""
    try:
        with_parameters(settings, parameters)
    except InputError as error:
        return str(error)
    return ""


def _current(settings: Settings, parameter: str) -> object:
    group, name = parameter.split(".")
    return getattr(getattr(settings, group), name)


@dataclass(frozen=True)
class Trial:
    """One point. number: 0 for the original settings. cause: why it has no value."""

    number: int
    parameters: Mapping[str, object]
    value: float
    cause: str = ""


def search_grid(
    axes: Sequence[ParameterAxis],
    settings: Settings,
    measure: Measure,
    prepare: Callable[[Sequence[Mapping[str, object]]], None] = lambda points: None,
) -> Iterator[Trial]:
    """Measure the original settings, then every point of a grid; the last axis varies fastest.

    prepare: called with the next points before they are measured. A point whose values exclude each other has a cause
    and no value. Raise InputError if no point is possible.
    """
    points: list[tuple[dict[str, object], str]] = [({}, "")]
    for values in itertools.product(*(axis.values for axis in axes)):
        parameters = {axis.parameter: value for axis, value in zip(axes, values, strict=True)}
        points.append((parameters, _why_impossible(settings, parameters)))
    if all(cause for _, cause in points[1:]):
        raise InputError(f"no point of the grid is possible; the first: {points[1][1]}")
    for first in range(0, len(points), AHEAD):
        part = points[first : first + AHEAD]
        prepare([parameters for parameters, cause in part if not cause])
        for number, (parameters, cause) in enumerate(part, first):
            yield Trial(number, parameters, *((math.nan, cause) if cause else measure(parameters)))


def check_optuna() -> None:
    """Raise InputError if Optuna is not installed."""
    if find_spec("optuna") is None:
        raise InputError("--optuna needs optuna; pip install 'torchvision-dddas[tune]', or take --grid")


def search_ranges(
    axes: Sequence[ParameterAxis],
    settings: Settings,
    measure: Measure,
    count: int,
    seed: int = 0,
    minimize: bool = False,
) -> Iterator[Trial]:
    """Measure the original settings, then `count` points that Optuna's TPESampler proposes.

    Raise InputError if Optuna is not installed.
    """
    check_optuna()
    import optuna

    def suggest(axis: ParameterAxis) -> object:
        if axis.values:  # values are given by index, because Optuna takes no lists as values
            return axis.values[proposal.suggest_categorical(axis.parameter, range(len(axis.values)))]
        if axis.step:
            return proposal.suggest_int(axis.parameter, int(axis.low), int(axis.high), step=axis.step, log=axis.log)
        return proposal.suggest_float(axis.parameter, axis.low, axis.high, log=axis.log)

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.TPESampler(seed=seed)
    study = optuna.create_study(direction="minimize" if minimize else "maximize", sampler=sampler)
    yield Trial(0, {}, *measure({}))
    for number in range(1, count + 1):
        proposal = study.ask()
        parameters = {axis.parameter: suggest(axis) for axis in axes}
        cause = _why_impossible(settings, parameters)
        trial = Trial(number, parameters, *((math.nan, cause) if cause else measure(parameters)))
        if math.isnan(trial.value):
            study.tell(proposal, state=optuna.trial.TrialState.FAIL)
        else:
            study.tell(proposal, trial.value)
        yield trial


def ranked(trials: Sequence[Trial], minimize: bool) -> list[Trial]:
    """Return the trials, best first, equal trials in their order, trials without a value last."""
    sign = 1 if minimize else -1
    return sorted(trials, key=lambda t: (math.isnan(t.value), 0 if math.isnan(t.value) else sign * t.value, t.number))


def best(trials: Sequence[Trial], minimize: bool) -> Trial | None:
    """Return the trial with the best value, the first of equal trials; None if none has a value."""
    return next((trial for trial in ranked(trials, minimize) if not math.isnan(trial.value)), None)


@dataclass
class StudyMeasure:
    """Run the studies of a sweep. on_progress: called with the number of finished clips, and of all clips."""

    spec: Spec
    base: Path
    goal: Goal
    workers: Workers
    cache: Path | None
    on_progress: Callable[[int, int], object]

    def measure(self, parameters: Mapping[str, object], clips: Sequence[str]) -> Measured:
        """Return the goal's value over clips of these names, or the reason if it has none."""
        changed = tuple(f"{name}={toml_value(value)}" for name, value in parameters.items())
        spec = replace(self.spec, overrides=(*self.spec.overrides, *changed))
        names = [glob.escape(name) for name in clips]
        results = run_study(spec, self.base, self.workers, self.cache, names, self._counter(len(clips)))
        return goal_value(self.goal, results.cases)

    def prepare(self, points: Sequence[Mapping[str, object]], clips: Sequence[str]) -> None:
        """Compute the results that the studies of several points need, so that no worker has to wait between them."""
        planned = plan_study(self.spec, self.base, [glob.escape(name) for name in clips])
        pairs = enumerate(itertools.product(points, planned.jobs))
        jobs = [replace(j, number=k, settings=with_parameters(j.settings, point)) for k, (point, j) in pairs]
        run_jobs(jobs, self.workers, Cache(self.cache or cache_folder()), self._counter(len(jobs)))

    def _counter(self, total: int) -> Callable[[JobEvent], None]:
        done = 0

        def count(event: JobEvent) -> None:
            nonlocal done
            done += event.done is not None
            self.on_progress(done, total)

        return count


def split_clips(
    spec: Spec, base: Path, clips: Sequence[str], holdout: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the clips to tune on, and of the held-out clips. Raise InputError if either is empty."""
    names = [job.clip.name for job in plan_study(spec, base, clips).jobs]
    held = tuple(name for name in names if any(fnmatchcase(name, pattern) for pattern in holdout))
    tuned = tuple(name for name in names if name not in held)
    if holdout and not held:
        raise InputError(f"--holdout {','.join(holdout)} fits no clip; there are {', '.join(names)}")
    if not tuned:
        raise InputError(f"--holdout {','.join(holdout)} leaves no clip to measure; there are {', '.join(names)}")
    return tuned, held


@dataclass
class SweepRecord:
    """The results of a sweep so far: sweep.json after every trial; best.toml and the report at the end.

    tuned, held: names of clips. notes: result of `parameter_notes`.
    on_held: the measure on held-out clips, with the original and with the best settings.
    """

    folder: Path
    settings: Settings
    goal: Goal
    search: dict[str, Any]
    tuned: tuple[str, ...]
    held: tuple[str, ...]
    trials: list[Trial] = field(default_factory=list)
    best: Trial | None = None
    on_held: tuple[Measured, Measured] | None = None
    notes: Sequence[str] = ()

    def add(self, trial: Trial) -> None:
        """Record a trial. Raise InputError if it cannot be written."""
        self.trials.append(trial)
        self._write_json()

    def finish(self, best: Trial, on_held: tuple[Measured, Measured] | None) -> None:
        """Record the best trial. Raise InputError if it cannot be written."""
        self.best, self.on_held = best, on_held
        before = format_value(self.trials[0].value)
        about = [f"dddas sweep: {self.heading}: {format_value(best.value)}, with the original settings {before}."]
        about += [f"{name}: {value} (default {self.defaults[name]})" for name, value in best.parameters.items()]
        if on_held is not None:
            about.append(f"On the clips held out: {format_value(on_held[1][0])}, before {format_value(on_held[0][0])}.")
        self._write_json()
        text = settings_toml(with_parameters(self.settings, best.parameters), about)
        save_file(self.folder / "best.toml", text.encode())
        save_sweep(self)

    @property
    def heading(self) -> str:
        """The measure, in words."""
        return f"{self.goal.name}, {self.goal.by} over {len(self.tuned)} clip{'s' * (len(self.tuned) != 1)}"

    @property
    def defaults(self) -> dict[str, object]:
        """The default of each parameter that is tried."""
        tried = {name for trial in self.trials for name in trial.parameters}
        return {known.name: known.default for known in all_parameters() if known.name in tried}

    def value_of(self, trial: Trial, parameter: str) -> object:
        """Return a parameter in a trial: the tried value, else the settings' value."""
        return trial.parameters.get(parameter, _current(self.settings, parameter))

    def _write_json(self) -> None:
        def null_if_nan(value: float) -> float | None:
            return None if math.isnan(value) else value

        held = self.on_held and {"before": null_if_nan(self.on_held[0][0]), "best": null_if_nan(self.on_held[1][0])}
        content = {
            "format": 1,
            "measure": self.goal.name,
            "by": self.goal.by,
            "better": "less" if self.goal.minimize else "more",
            "search": self.search,
            "settings": changes(self.settings),
            "defaults": self.defaults,
            "clips": self.tuned,
            "held_out": self.held,
            "trials": [
                {"number": t.number, "knobs": dict(t.parameters), "value": null_if_nan(t.value), "cause": t.cause}
                for t in self.trials
            ],
            "best": None if self.best is None else self.best.number,
            "on_held_out": held,
            "notes": self.notes,
        }
        save_file(self.folder / "sweep.json", (json.dumps(content, indent=2) + "\n").encode())


def settings_toml(settings: Settings, heading: Sequence[str]) -> str:
    """Return the settings that are set, even to their defaults, as `--config` reads them, below lines of comment."""
    groups: dict[str, dict[str, object]] = {}
    for known in all_parameters():
        if is_set(settings, known.name):
            group, parameter = known.name.split(".")
            groups.setdefault(group, {})[parameter] = getattr(getattr(settings, group), parameter)
    return format_toml(groups, heading)


def toml_value(value: object) -> str:
    """Return a parameter's value as `--set` reads it."""
    return format_toml({"value": value}).removeprefix("value = ").rstrip()


def format_value(value: float) -> str:
    """Return a measure to four digits; a dash if there is none."""
    return "–" if math.isnan(value) else f"{value:.4f}"
