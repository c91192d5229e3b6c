"""`dddas sweep`: a study with many values of parameters, and which of them measure best."""

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchvision_dddas.cli.options import (
    CacheFolder,
    Clips,
    Config,
    Jobs,
    Overrides,
    Quiet,
    Scheduler,
    StudyBackend,
    check_jobs,
    report_errors,
    split_patterns,
)
from torchvision_dddas.cli.progress import EVERY_S
from torchvision_dddas.cli.study import change_spec, open_console
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.evaluation.studies.sweep import SweepRecord

MOST_SHOWN = 20  # rows of the table
MOST_PROPOSED = 10_000


@report_errors
def sweep(
    dataset: Annotated[Path, typer.Option(metavar="FILE", help="The TOML of a study, as of dddas evaluate.")],
    measure: Annotated[
        str, typer.Option(metavar="TASK.GROUP.MEASURE", help="What to optimise, such as motion.pixels.f.")
    ],
    grid: Annotated[
        list[str] | None,
        typer.Option("--grid", metavar="PARAMETER=A,B,C", help="Values of a parameter; if repeated, all combinations."),
    ] = None,
    optuna: Annotated[
        int | None, typer.Option(metavar="N", help="Try N points within --range that Optuna proposes.")
    ] = None,
    range_: Annotated[
        list[str] | None,
        typer.Option(
            "--range", metavar="PARAMETER=LOW:HIGH", help="For --optuna; also PARAMETER=LOW:HIGH:log, PARAMETER=A,B,C."
        ),
    ] = None,
    by: Annotated[
        str,
        typer.Option(metavar="pooled|mean|worst", help="Judge by all clips' pooled counts, their mean, or the worst."),
    ] = "pooled",
    holdout: Annotated[
        str | None,
        typer.Option(
            metavar="PATTERN,...", help="Clips that do not choose the best; it is measured on them afterwards."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed of Optuna.")] = 0,
    clips: Clips = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    cache: CacheFolder = None,
    config: Config = None,
    set_: Overrides = None,
    backend: StudyBackend = None,
    out: Annotated[Path, typer.Option(help="Folder for sweep.json and best.toml.")] = Path("dddas-sweep"),
    quiet: Quiet = False,
) -> None:
    """Try parameters on whole data sets, all points of a grid or as Optuna proposes; writes sweep.json and best.toml.

    Results are kept as those of dddas evaluate --dataset: a repeated sweep continues where it stopped.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.evaluation.studies import search_space
    from torchvision_dddas.evaluation.studies.goals import parse_goal
    from torchvision_dddas.evaluation.studies.sweep import (
        StudyMeasure,
        SweepRecord,
        best,
        check_optuna,
        format_value,
        search_grid,
        search_ranges,
        split_clips,
    )
    from torchvision_dddas.evaluation.studies.workers import Workers

    check_jobs(jobs, scheduler)
    _check_search(grid, optuna, range_)
    goal, spec = parse_goal(measure, by), change_spec(dataset, config, set_ or [], backend and backend.value)
    spec = replace(spec, tasks=(goal.task,))
    settings = load_config(spec.config, spec.overrides)
    points = search_space.parse_grid(grid or [], settings)
    ranges = search_space.parse_ranges(range_ or [], settings)
    count = optuna or search_space.count_points(points)
    if optuna is not None:
        check_optuna()
    tuned, held = split_clips(
        spec, dataset.parent, split_patterns(clips, "--clips"), split_patterns(holdout, "--holdout")
    )
    asked_for: dict[str, Any] = {"grid": grid} if optuna is None else {"optuna": optuna, "range": range_, "seed": seed}
    record = SweepRecord(out, settings, goal, asked_for, tuned, held)
    with Workers(jobs, scheduler) as workers:
        study = StudyMeasure(spec, dataset.parent, goal, workers, cache, _progress(quiet))
        on_tuned, prepare = partial(study.measure, clips=tuned), partial(study.prepare, clips=tuned)
        if optuna is None:
            trials = search_grid(points, settings, on_tuned, prepare)
        else:
            trials = search_ranges(ranges, settings, on_tuned, optuna, seed, goal.minimize)
        for trial in trials:
            record.add(trial)
            if not quiet:
                point, value = _format_point(trial.parameters), trial.cause or format_value(trial.value)
                print(f"{trial.number} of {count}: {point}: {value}", file=sys.stderr, flush=True)
        if (found := best(record.trials, goal.minimize)) is None:
            raise InputError(f"no setting has a {goal.name}: {record.trials[0].cause}")
        on_held = None
        if held:
            study.prepare([{}, found.parameters], held)
            on_held = (study.measure({}, held), study.measure(found.parameters, held))
    record.finish(found, on_held)
    if not quiet:
        _show(record)


def _progress(quiet: bool) -> Callable[[int, int], None]:
    """Print every few seconds, on stderr, how many clips of the next points are done."""
    printed = time.monotonic()

    def advance(done: int, of: int) -> None:
        nonlocal printed
        if not quiet and time.monotonic() - printed >= EVERY_S:
            printed = time.monotonic()
            print(f"{done} of {of} clips of the next points", file=sys.stderr, flush=True)

    return advance


def _check_search(grid: list[str] | None, optuna: int | None, ranges: list[str] | None) -> None:
    if optuna is None and ranges:
        raise InputError("--range is for Optuna; give --optuna N too, or --grid parameter=value,value")
    if optuna is not None and grid:
        raise InputError(
            "--grid and --optuna were both given; give only one (--range takes values too: parameter=a,b,c)"
        )
    if optuna is None and not grid:
        raise InputError("nothing to try; give --grid parameter=value,value or --optuna N --range parameter=low:high")
    if optuna is not None and not ranges:
        raise InputError("--optuna has nothing to propose; give --range parameter=low:high")
    if optuna is not None and not 1 <= optuna <= MOST_PROPOSED:
        raise InputError(f"--optuna must be 1 to {MOST_PROPOSED} points, got {optuna}")


def _show(swept: "SweepRecord") -> None:
    """Print the best trials, the measures on held-out clips, and where the rest is."""
    from rich.table import Table

    from torchvision_dddas.evaluation.studies.sweep import format_value, ranked

    console = open_console()
    parameters = list(dict.fromkeys(parameter for trial in swept.trials for parameter in trial.parameters))
    table = Table(title=f"{swept.heading}, {'least' if swept.goal.minimize else 'most'} first")
    for column in ("trial", *parameters, swept.goal.measure):
        table.add_column(column, justify="left" if column in parameters else "right")
    ordered = ranked(swept.trials, swept.goal.minimize)
    shown = ordered[:MOST_SHOWN]
    if swept.trials[0] not in shown:
        shown.append(swept.trials[0])
    for trial in shown:
        cells = [_value(trial.parameters[k]) if k in trial.parameters else "unchanged" for k in parameters]
        table.add_row(str(trial.number), *cells, format_value(trial.value))
    console.print(table)
    if len(ordered) > len(shown):
        console.print(f"{len(ordered) - len(shown)} more in {swept.folder / 'sweep.json'}", highlight=False)
    for trial in ordered:
        if trial.cause:
            console.print(f"trial {trial.number} has no value: {trial.cause}", markup=False, highlight=False)
    if swept.on_held is not None:
        before, after = (format_value(value) for value, _ in swept.on_held)
        names = ", ".join(swept.held)
        console.print(f"Held out ({names}): {after} with the best, {before} before.", markup=False, highlight=False)
    typer.echo(f"{swept.folder}: sweep.json, best.toml (for --config)")


def _format_point(parameters: Mapping[str, object]) -> str:
    return ", ".join(f"{name}={_value(value)}" for name, value in parameters.items()) or "unchanged"


def _value(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(list(value) if isinstance(value, tuple) else value)
