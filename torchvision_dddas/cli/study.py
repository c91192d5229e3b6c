"""Studies on the command line: how their files are changed by options, their progress, and tables of measures."""

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from torchvision_dddas.cli.progress import EVERY_S
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from torchvision_dddas.evaluation.studies.jobs import Event
    from torchvision_dddas.evaluation.studies.results import Results
    from torchvision_dddas.evaluation.studies.runner import Plan
    from torchvision_dddas.evaluation.studies.spec import Spec

    Hooks = tuple[Callable[[Plan], None], Callable[[Event], None]]

MOST_NOTES, MOST_CLIPS = 12, 20  # of a study; of more clips the worst are shown


def change_spec(
    file: Path, config: str | None, overrides: Sequence[str], backend: str | None, interval: int | None = None
) -> "Spec":
    """Read a study's file and change it by what the command line says. Raises InputError for bad input."""
    from torchvision_dddas.evaluation.studies.spec import read_spec

    spec = read_spec(file)
    spec = replace(spec, config=config or spec.config, overrides=(*spec.overrides, *overrides))
    return replace(spec, backend=backend or spec.backend, interval=spec.interval if interval is None else interval)


@contextmanager
def show_progress(quiet: bool) -> "Iterator[Hooks]":
    """How far a study is, on stderr: a bar on a terminal, elsewhere a line for each clip and every few seconds."""
    if quiet:
        yield lambda plan: None, lambda event: None
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("clips, {task.fields[frames]} frames"),
            TimeElapsedColumn(),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            yield _bar_hooks(bar)
    else:
        yield _line_hooks()


def _bar_hooks(bar: Any) -> "Hooks":
    task, frames = bar.add_task("study", total=None, frames=0), 0

    def begin(plan: "Plan") -> None:
        bar.update(task, total=len(plan.jobs))

    def advance(event: "Event") -> None:
        nonlocal frames
        frames += event.frames
        bar.update(task, advance=event.done is not None, frames=frames, description=event.job.clip.name)
        if event.note:
            bar.console.print(event.note, markup=False, highlight=False, soft_wrap=True)

    return begin, advance


def _line_hooks() -> "Hooks":
    total = done = frames = 0
    start = printed = time.monotonic()

    def say(text: str) -> None:
        nonlocal printed
        printed = time.monotonic()
        print(text, file=sys.stderr, flush=True)

    def begin(plan: "Plan") -> None:
        nonlocal total
        total = len(plan.jobs)
        say(f"{total} clip{'s' * (total != 1)}, {plan.frames} frames to process over all tasks")

    def advance(event: "Event") -> None:
        nonlocal done, frames
        frames += event.frames
        if event.note:
            say(event.note)
        if event.done is not None:
            done += 1
            words = [
                f"{d.task} left out" if d.cause else d.task if d.computed else f"{d.task} kept" for d in event.done
            ]
            say(f"{done} of {total}: {event.job.clip.name} ({', '.join(words)})")
        elif time.monotonic() - printed >= EVERY_S:
            say(f"{done} of {total} clips, {frames} frames, {frames / (time.monotonic() - start):.1f} frames/s")

    return begin, advance


def print_study(results: "Results", measures: Mapping[str, Any], folder: Path) -> None:
    """Print the main measures of each task, what was left out, and where the rest is."""
    from torchvision_dddas.evaluation.studies.output import FILES

    console = open_console()
    for task, found in measures["tasks"].items():
        print_measures(console, found, f"{task}: ", MOST_CLIPS)
    for line in results.left_out:
        console.print(f"left out: {line}", markup=False, highlight=False, soft_wrap=True)
    notes = list(dict.fromkeys(results.facts["notes"]))
    for line in notes[:MOST_NOTES]:
        console.print(f"note: {line}", markup=False, highlight=False, soft_wrap=True)
    if len(notes) > MOST_NOTES:
        typer.echo(f"note: {len(notes) - MOST_NOTES} more in run.json")
    kept = sum(1 for case in results.cases if not case.cause)
    typer.echo(f"{kept} of {len(results.cases)} cases scored, {results.facts['computed']} stages computed")
    typer.echo(f"{folder}: {', '.join(name for name in FILES if (folder / name).is_file())}")


def open_console() -> "Console":
    """Standard output; 120 columns wide if it is no terminal."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=120)


def print_measures(console: "Console", measures: Mapping[str, Any], prefix: str = "", most: int | None = None) -> None:
    """Print a table for each group of measures: "clips" by name, "pooled" (with "intervals" in a study) and "mean".

    prefix: of titles. most: clips in a table, the worst of them if there are more.
    """
    from torchvision_dddas.evaluation.metrics.registry import GROUPS

    for group in GROUPS:
        if clips := {name: clip for name, clip in measures["clips"].items() if group in clip}:
            console.print(_table(group, clips, measures, prefix, most or len(clips)))


def _table(group: str, clips: Mapping[str, Any], measures: Mapping[str, Any], prefix: str, most: int) -> "Table":
    from rich.markup import escape
    from rich.table import Table

    from torchvision_dddas.evaluation.metrics.registry import GROUPS, describe

    columns, shown, more = GROUPS[group].columns, list(clips), ""
    if len(clips) > most:
        shown = sorted(clips, key=lambda name: _rank(clips[name][group][columns[0]], columns[0]))[:most]
        more = f"; the {most} worst of {len(clips)} clips"
    table = Table(title=f"{prefix}{GROUPS[group].title[0].upper()}{GROUPS[group].title[1:]}{more}")
    table.add_column("clip", no_wrap=True)
    for heading in ("frames", *(describe(column).short or describe(column).title for column in columns)):
        table.add_column(heading, justify="right", no_wrap=True)
    for name in shown:
        cells = (format_figure(clips[name][group][c]) for c in columns)
        table.add_row(escape(str(InputError(name))), str(clips[name]["frames"]), *cells)
    if len(clips) > 1:
        pooled, mean = measures["pooled"], measures["mean"].get(group, {})
        table.add_section()
        table.add_row("pooled", "", *(format_figure(pooled.get(group, {}).get(c)) for c in columns))
        if "intervals" in pooled:
            intervals = pooled["intervals"].get(group, {})
            table.add_row("95 % interval", "", *(_format_interval(intervals.get(c)) for c in columns))
        table.add_row("mean", "", *(format_figure(mean.get(c)) for c in columns))
    return table


def _rank(value: float | None, measure: str) -> float:
    """Lowest for the worst clip."""
    from torchvision_dddas.evaluation.metrics.registry import is_lower_better

    if value is None or math.isnan(value):
        return math.inf
    return -value if is_lower_better(measure) else value


def format_figure(value: float | int | None, sign: str = "") -> str:
    """A measure or a count for a table."""
    if type(value) is int:
        return f"{value:{sign}d}"
    return "–" if value is None or math.isnan(value) else f"{value:{sign}.3f}"


def _format_interval(interval: Sequence[float] | None) -> str:
    if interval is None:
        return "–"
    low, high = interval
    return f"{low:.2f} to {high:.2f}" if abs(high) < 100 else f"{low:.0f} to {high:.0f}"
