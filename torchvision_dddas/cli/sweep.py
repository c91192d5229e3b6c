"""`dddas sweep`: run a study with many values of parameters, and find the best values."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchvision_dddas.cli.evaluate import change_spec
from torchvision_dddas.cli.exits import noting
from torchvision_dddas.cli.options import (
    CacheFolder,
    Clips,
    Config,
    Jobs,
    Overrides,
    Quiet,
    Scheduler,
    StudyBackend,
    WorkerSilent,
    check_jobs,
    print_lines,
    report_errors,
    split_patterns,
)
from torchvision_dddas.cli.progress import EVERY_S, open_console, print_now
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.lab.evaluation.studies.sweep import SweepRecord

MOST_SHOWN = 20  # largest number of rows of the table
MOST_PROPOSED = 10_000


@report_errors
def sweep(
    dataset: Annotated[Path, typer.Option(metavar="FILE", help="The TOML of a study, as for dddas evaluate.")],
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
        typer.Option(metavar="PATTERN,...", help="Held-out clips: not used for the choice, and measured afterwards."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed of Optuna.")] = 0,
    clips: Clips = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    worker_silent: WorkerSilent = None,
    cache: CacheFolder = None,
    config: Config = None,
    set_: Overrides = None,
    backend: StudyBackend = None,
    out: Annotated[Path, typer.Option(help="Folder for report.html, sweep.json and best.toml.")] = Path("dddas-sweep"),
    quiet: Quiet = False,
) -> None:
    """Try parameters on whole data sets: all points of a grid, or points that Optuna proposes.

    Writes report.html, sweep.json and best.toml. Results are cached as by dddas evaluate --dataset, so that a
    repeated sweep continues where it stopped.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.io.atomic_files import claimed
    from torchvision_dddas.lab.evaluation.studies import sweep as sweeps
    from torchvision_dddas.lab.evaluation.studies.cache import Cache, cache_folder
    from torchvision_dddas.lab.evaluation.studies.jobs import SILENT_S, Workers
    from torchvision_dddas.lab.evaluation.studies.summary import parse_goal

    check_jobs(jobs, scheduler)
    _check_search(grid, optuna, range_)
    goal, spec = parse_goal(measure, by), change_spec(dataset, config, set_ or [], backend and backend.value)
    spec = replace(spec, tasks=(goal.task,))
    settings = load_config(spec.config, spec.overrides)
    points, ranges = sweeps.parse_grid(grid or [], settings), sweeps.parse_ranges(range_ or [], settings)
    count = optuna or sweeps.count_points(points)
    if optuna is not None:
        sweeps.check_optuna()
    used, left = split_patterns(clips, "--clips"), split_patterns(holdout, "--holdout")
    tuned, held = sweeps.split_clips(spec, dataset.parent, used, left)
    search: dict[str, Any] = {"grid": grid} if optuna is None else {"optuna": optuna, "range": range_, "seed": seed}
    notes = sweeps.parameter_notes([*points, *ranges], settings)
    print_lines([f"note: {note}" for note in notes], quiet)
    record = sweeps.SweepRecord(out, settings, goal, search, tuned, held, notes=notes)
    printed = time.monotonic()

    def on_progress(done: int, total: int) -> None:
        nonlocal printed
        if not quiet and time.monotonic() - printed >= EVERY_S:
            printed = time.monotonic()
            print_now(f"{done} of {total} clips of the next points")

    place, begun_s = cache or cache_folder(), time.time()

    def describe_kept() -> str:
        trials = f"{len(record.trials)} trials are kept in {out}" if record.trials else ""
        has_more = Cache(place).has_newer(begun_s)
        stages = f"finished stages are kept in {place}; the same command goes on from there" if has_more else ""
        return ", ".join(filter(None, [trials, stages]))

    kept = noting(describe_kept, describe_kept)
    with claimed(out), kept, Workers(jobs, scheduler, worker_silent or SILENT_S) as workers:
        study = sweeps.StudyMeasure(spec, dataset.parent, goal, workers, cache, on_progress)
        on_tuned, prepare = partial(study.measure, clips=tuned), partial(study.prepare, clips=tuned)
        if optuna is None:
            trials = sweeps.search_grid(points, settings, on_tuned, prepare)
        else:
            trials = sweeps.search_ranges(ranges, settings, on_tuned, optuna, seed, goal.minimize)
        for trial in trials:
            record.add(trial)
            if not quiet:
                point = ", ".join(f"{name}={_format(value)}" for name, value in trial.parameters.items())
                text = trial.cause or sweeps.format_value(trial.value)
                print_now(f"{trial.number} of {count}: {point or 'unchanged'}: {text}")
        if (found := sweeps.best(record.trials, goal.minimize)) is None:
            raise InputError(f"no setting has a {goal.name}: {record.trials[0].cause}")
        on_held = None
        if held:
            study.prepare([{}, found.parameters], held)
            on_held = (study.measure({}, held), study.measure(found.parameters, held))
        record.finish(found, on_held)
    if not quiet:
        _show(record)


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


def _show(record: "SweepRecord") -> None:
    """Print the best trials, the measures on held-out clips, and where further results are."""
    from rich.table import Table

    from torchvision_dddas.lab.evaluation.studies.sweep import format_value, ranked

    minimize = record.goal.minimize
    parameters = list(dict.fromkeys(parameter for trial in record.trials for parameter in trial.parameters))
    table = Table(title=f"{record.heading}, {'least' if minimize else 'most'} first")
    for column in ("trial", *parameters, record.goal.measure):
        default = f"\ndefault {_format(record.defaults[column])}" if column in parameters else ""
        table.add_column(f"{column}{default}", justify="left" if column in parameters else "right")
    ordered = ranked(record.trials, minimize)
    shown = ordered[:MOST_SHOWN]
    if record.trials[0] not in shown:
        shown.append(record.trials[0])
    for trial in shown:
        cells = [
            _format(value := record.value_of(trial, name)) + " (default)" * (value == record.defaults[name])
            for name in parameters
        ]
        table.add_row(str(trial.number), *cells, format_value(trial.value))
    open_console().print(table)
    lines = [f"trial {trial.number} has no value: {trial.cause}" for trial in ordered if trial.cause]
    if len(ordered) > len(shown):
        lines.insert(0, f"{len(ordered) - len(shown)} more in {record.folder / 'sweep.json'}")
    if record.on_held is not None:
        before, after = (format_value(value) for value, _ in record.on_held)
        lines.append(f"Held out ({', '.join(record.held)}): {after} with the best, {before} before.")
    print_lines([*lines, f"{record.folder}: report.html, sweep.json, best.toml (for --config), tables/, figures/"])


def _format(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(list(value) if isinstance(value, tuple) else value)
