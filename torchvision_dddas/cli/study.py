"""`dddas evaluate --dataset`: how a study is asked for and shown."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from torchvision_dddas.cli.progress import EVERY_S
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.evaluation.studies.jobs import Event
    from torchvision_dddas.evaluation.studies.results import Results
    from torchvision_dddas.evaluation.studies.runner import Plan
    from torchvision_dddas.evaluation.studies.spec import Spec

MOST_NOTES = 12


def asked(
    file: Path, config: str | None, overrides: Sequence[str], backend: str | None, interval: int | None
) -> "Spec":
    """A study's file, changed by what the command line says. Raises InputError for bad input."""
    from torchvision_dddas.evaluation.studies.spec import read_spec

    spec = read_spec(file)
    spec = replace(spec, config=config or spec.config, overrides=(*spec.overrides, *overrides))
    return replace(spec, backend=backend or spec.backend, interval=spec.interval if interval is None else interval)


def patterns(text: str | None, option: str, what: str = "clip") -> list[str]:
    """The patterns of names that an option gives between commas. Raises InputError where it was given without any."""
    words = [word.strip() for word in (text or "").split(",") if word.strip()]
    if text is not None and not words:
        example = "'bms_*'" if what == "clip" else "'difference.*'"
        raise InputError(f"{option} '{text}' names no {what}; wanted patterns of names, such as {example}")
    return words


def study_into(
    folder: Path,
    spec: "Spec",
    base: Path,
    jobs: int | None = None,
    scheduler: str | None = None,
    cache: Path | None = None,
    clips: Sequence[str] = (),
    quiet: bool = False,
) -> "tuple[Results, dict[str, Any]]":
    """Run a study, write it into a folder and show how far it is; its results and measures. Raises InputError."""
    from torchvision_dddas.evaluation.studies.output import write_study
    from torchvision_dddas.evaluation.studies.workers import Workers

    with Workers(jobs, scheduler) as workers, shown(quiet) as (begun, tell):
        return write_study(folder, spec, base, workers, cache, clips, tell, begun)


@contextmanager
def shown(quiet: bool) -> "Iterator[tuple[Callable[[Plan], None], Callable[[Event], None]]]":
    """How far a study is, on stderr: a bar on a terminal, elsewhere a line for each clip and every few seconds."""
    if quiet:
        yield lambda planned: None, lambda event: None
        return
    if sys.stderr.isatty():
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
            yield _on(bar)
        return
    yield _in_lines()


def _on(bar: Any) -> "tuple[Callable[[Plan], None], Callable[[Event], None]]":
    task, frames = bar.add_task("study", total=None, frames=0), 0

    def begun(planned: "Plan") -> None:
        bar.update(task, total=len(planned.jobs))

    def tell(event: "Event") -> None:
        nonlocal frames
        frames += event.frames
        bar.update(task, advance=event.done is not None, frames=frames, description=event.job.clip.name)
        if event.note:
            bar.console.print(event.note, markup=False, highlight=False, soft_wrap=True)

    return begun, tell


def _in_lines() -> "tuple[Callable[[Plan], None], Callable[[Event], None]]":
    total = done = frames = 0
    start = told = time.monotonic()

    def say(text: str) -> None:
        nonlocal told
        told = time.monotonic()
        print(text, file=sys.stderr, flush=True)

    def begun(planned: "Plan") -> None:
        nonlocal total
        total = len(planned.jobs)
        say(f"{total} clip{'s' * (total != 1)}, {planned.frames} frames to look at over all tasks")

    def tell(event: "Event") -> None:
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
        elif time.monotonic() - told >= EVERY_S:
            say(f"{done} of {total} clips, {frames} frames, {frames / (time.monotonic() - start):.1f} frames/s")

    return begun, tell


def show(results: "Results", measures: dict[str, Any], folder: Path) -> None:
    """Print the measures of each task in short, what was left out, and where the rest is."""
    from rich.console import Console

    from torchvision_dddas.cli.study_tables import tables
    from torchvision_dddas.evaluation.studies.output import FILES

    console = Console() if sys.stdout.isatty() else Console(width=120)
    for table in tables(measures):
        console.print(table)
    for line in results.left_out:
        console.print(f"left out: {line}", markup=False, highlight=False, soft_wrap=True)
    notes = list(dict.fromkeys(results.facts["notes"]))
    for line in notes[:MOST_NOTES]:
        console.print(f"note: {line}", markup=False, highlight=False, soft_wrap=True)
    if len(notes) > MOST_NOTES:
        typer.echo(f"note: {len(notes) - MOST_NOTES} more in run.json")
    kept = sum(1 for case in results.cases if not case.cause)
    typer.echo(f"{kept} of {len(results.cases)} cases scored, {results.facts['computed']} stages computed")
    made = [name for name in FILES if (folder / name).is_file()]
    typer.echo(f"{folder}: {', '.join(made)}")


def refuse_nothing(results: "Results") -> None:
    """Raises InputError where no case was scored."""
    if all(case.cause for case in results.cases):
        case = results.cases[0]
        raise InputError(f"nothing could be scored; {case.clip.name}, {case.task}: {case.cause}")


def prune_cache(cache: Path | None, days: float, quiet: bool) -> None:
    """Remove kept results that nobody has used for so many days."""
    from torchvision_dddas.evaluation.studies.runner import cache_folder
    from torchvision_dddas.evaluation.studies.storage import Cache

    folder = cache or cache_folder()
    count, size = Cache(folder).prune(days)
    if not quiet:
        typer.echo(f"{folder}: {count} results removed that were not used for {days:g} days, {size / 1e6:.1f} MB")
