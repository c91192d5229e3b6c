"""Sweeps: the same study with other parameters, on a grid or as Optuna proposes, and which of them measure best.

Everything random has a seed, and every study takes from the cache what was computed before: an interrupted sweep
measures the same points when it is started again, and soon continues where it was.
"""

import glob
import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchvision_dddas.config import Settings, changes, format_toml, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies.goals import Goal, goal_value
from torchvision_dddas.evaluation.studies.jobs import Event
from torchvision_dddas.evaluation.studies.runner import cache_folder, plan_study, run_jobs, run_study
from torchvision_dddas.evaluation.studies.search_space import Axis, Choice, why_impossible
from torchvision_dddas.evaluation.studies.spec import Spec
from torchvision_dddas.evaluation.studies.storage import Cache
from torchvision_dddas.evaluation.studies.workers import Workers
from torchvision_dddas.io.atomic_files import cannot_write, write_whole

if TYPE_CHECKING:
    from optuna.trial import Trial as Proposal

Measured = tuple[float, str]
"""The measure, NaN if there is none, and then why."""

Measure = Callable[[Mapping[str, object]], Measured]
"""What a study measures with some parameters changed."""

AHEAD = 12  # points of a grid whose clips the workers share


@dataclass(frozen=True)
class Trial:
    """One point. number: 0 for the settings as they were. cause: why it has no value."""

    number: int
    parameters: Mapping[str, object]
    value: float
    cause: str = ""


def search_grid(
    axes: Sequence[Choice],
    settings: Settings,
    measure: Measure,
    prepare: Callable[[Sequence[Mapping[str, object]]], None] = lambda points: None,
) -> Iterator[Trial]:
    """Measure the settings as they are, then every point of a grid, the last axis the quickest.

    prepare: called with the next points before they are measured. A point whose values exclude each other has a cause
    and no value. Raises InputError if no point is possible.
    """
    points: list[tuple[dict[str, object], str]] = [({}, "")]
    for values in itertools.product(*(axis.values for axis in axes)):
        parameters = {axis.parameter: value for axis, value in zip(axes, values, strict=True)}
        points.append((parameters, why_impossible(settings, parameters)))
    if all(cause for _, cause in points[1:]):
        raise InputError(f"no point of the grid is possible; the first: {points[1][1]}")
    for first in range(0, len(points), AHEAD):
        part = points[first : first + AHEAD]
        prepare([parameters for parameters, cause in part if not cause])
        for number, (parameters, cause) in enumerate(part, first):
            yield Trial(number, parameters, *((math.nan, cause) if cause else measure(parameters)))


def check_optuna() -> None:
    """Raises InputError if Optuna is not installed."""
    if find_spec("optuna") is None:
        raise InputError("--optuna needs optuna; pip install 'torchvision-dddas[tune]', or take --grid")


def search_ranges(
    axes: Sequence[Axis], settings: Settings, measure: Measure, count: int, seed: int = 0, minimize: bool = False
) -> Iterator[Trial]:
    """Measure the settings as they are, then `count` points that Optuna's TPESampler proposes.

    Raises InputError if Optuna is not installed.
    """
    check_optuna()
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.TPESampler(seed=seed)
    study = optuna.create_study(direction="minimize" if minimize else "maximize", sampler=sampler)
    yield Trial(0, {}, *measure({}))
    for number in range(1, count + 1):
        proposal = study.ask()
        parameters = {axis.parameter: _suggest(proposal, axis) for axis in axes}
        cause = why_impossible(settings, parameters)
        trial = Trial(number, parameters, *((math.nan, cause) if cause else measure(parameters)))
        if math.isnan(trial.value):
            study.tell(proposal, state=optuna.trial.TrialState.FAIL)
        else:
            study.tell(proposal, trial.value)
        yield trial


def _suggest(proposal: "Proposal", axis: Axis) -> object:
    if isinstance(axis, Choice):
        # By their places: Optuna takes no lists as values.
        return axis.values[proposal.suggest_categorical(axis.parameter, range(len(axis.values)))]
    if axis.step:
        return proposal.suggest_int(axis.parameter, int(axis.low), int(axis.high), step=axis.step, log=axis.log)
    return proposal.suggest_float(axis.parameter, axis.low, axis.high, log=axis.log)


def best(trials: Sequence[Trial], minimize: bool) -> Trial | None:
    """The trial with the best value, of equal ones the first; None if none has a value."""
    return next((trial for trial in ranked(trials, minimize) if not math.isnan(trial.value)), None)


def ranked(trials: Sequence[Trial], minimize: bool) -> list[Trial]:
    """The best first, equal ones in their order, those without a value last."""
    sign = 1 if minimize else -1
    return sorted(trials, key=lambda t: (math.isnan(t.value), 0 if math.isnan(t.value) else sign * t.value, t.number))


@dataclass
class StudyMeasure:
    """Runs the studies of a sweep. on_progress: called with the number of clips that are done, and of all."""

    spec: Spec
    base: Path
    goal: Goal
    workers: Workers = field(default_factory=lambda: Workers(1))
    cache: Path | None = None
    on_progress: Callable[[int, int], object] = lambda done, of: None

    def measure(self, parameters: Mapping[str, object], clips: Sequence[str]) -> Measured:
        """The goal's value over clips of these names; if it has none, why."""
        changed = tuple(f"{name}={toml_value(value)}" for name, value in parameters.items())
        spec = replace(self.spec, overrides=(*self.spec.overrides, *changed))
        names = [glob.escape(name) for name in clips]
        results = run_study(spec, self.base, self.workers, self.cache, names, self._counter(len(clips)))
        return goal_value(self.goal, results.cases)

    def prepare(self, points: Sequence[Mapping[str, object]], clips: Sequence[str]) -> None:
        """Compute what the studies of several points need, so that no worker has to wait between them."""
        planned = plan_study(self.spec, self.base, [glob.escape(name) for name in clips])
        each = [
            replace(job, settings=with_parameters(job.settings, parameters))
            for parameters in points
            for job in planned.jobs
        ]
        jobs = [replace(job, number=number) for number, job in enumerate(each)]
        run_jobs(jobs, self.workers, Cache(self.cache or cache_folder()), self._counter(len(jobs)))

    def _counter(self, total: int) -> Callable[[Event], None]:
        done = 0

        def count(event: Event) -> None:
            nonlocal done
            done += event.done is not None
            self.on_progress(done, total)

        return count


def split_clips(
    spec: Spec, base: Path, clips: Sequence[str], holdout: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of the clips that are tuned on, and of those held out. Raises InputError if either is empty."""
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
    """What a sweep has found so far: sweep.json after every trial, best.toml at the end.

    tuned, held: names of clips. on_held: the measure on those held out, with the settings as they were and the best.
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

    def add(self, trial: Trial) -> None:
        """Record a trial. Raises InputError if it cannot be written."""
        self.trials.append(trial)
        self._write_json()

    def finish(self, best: Trial, on_held: tuple[Measured, Measured] | None) -> None:
        """Record the best trial. Raises InputError if it cannot be written."""
        self.best, self.on_held = best, on_held
        before = format_value(self.trials[0].value)
        about = [f"dddas sweep: {self.heading}: {format_value(best.value)}, with the settings as they were {before}."]
        about += [f"{parameter}: {value}" for parameter, value in best.parameters.items()]
        if on_held is not None:
            about.append(f"On the clips held out: {format_value(on_held[1][0])}, before {format_value(on_held[0][0])}.")
        self._write_json()
        self._write("best.toml", settings_toml(with_parameters(self.settings, best.parameters), about))

    @property
    def heading(self) -> str:
        """What is measured, in words."""
        return f"{self.goal.name}, {self.goal.by} over {len(self.tuned)} clip{'s' * (len(self.tuned) != 1)}"

    def _write_json(self) -> None:
        trials = [
            {"number": t.number, "knobs": dict(t.parameters), "value": _null_if_nan(t.value), "cause": t.cause}
            for t in self.trials
        ]
        held = None
        if self.on_held is not None:
            held = {"before": _null_if_nan(self.on_held[0][0]), "best": _null_if_nan(self.on_held[1][0])}
        content = {
            "format": 1,
            "measure": self.goal.name,
            "by": self.goal.by,
            "better": "less" if self.goal.minimize else "more",
            "search": self.search,
            "settings": changes(self.settings),
            "clips": self.tuned,
            "held_out": self.held,
            "trials": trials,
            "best": None if self.best is None else self.best.number,
            "on_held_out": held,
        }
        self._write("sweep.json", json.dumps(content, indent=2) + "\n")

    def _write(self, name: str, text: str) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_whole(self.folder / name, text.encode())
        except OSError as error:
            raise cannot_write(self.folder / name, error) from error


def settings_toml(settings: Settings, heading: Sequence[str]) -> str:
    """What differs from the defaults, as `--config` takes it, below some lines of comment."""
    groups: dict[str, dict[str, object]] = {}
    for name, value in changes(settings).items():
        group, parameter = name.split(".")
        groups.setdefault(group, {})[parameter] = value
    return format_toml(groups, heading)


def toml_value(value: object) -> str:
    """A parameter's value as `--set` takes it."""
    return format_toml({"value": value}).removeprefix("value = ").rstrip()


def format_value(value: float) -> str:
    """A measure to four digits; a dash if there is none."""
    return "–" if math.isnan(value) else f"{value:.4f}"


def _null_if_nan(value: float) -> float | None:
    return None if math.isnan(value) else value
