"""`dddas evaluate --dataset`: a study of whole data sets, its tables, its report and what it cost."""

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from torchvision_dddas.cli.progress import EVERY_S
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.evaluation.studies.jobs import Event
    from torchvision_dddas.evaluation.studies.record import Results, Spec
    from torchvision_dddas.evaluation.studies.running import Plan

FILES = ("metrics.json", "metrics.csv", "metrics.parquet", "frames.parquet", "scores.bin", "report.html", "run.json")
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
) -> tuple["Results", dict[str, Any]]:
    """Run a study and write it under a folder; returns its results and its measures. Raises InputError."""
    from torchvision_dddas.evaluation.report import report
    from torchvision_dddas.evaluation.studies.running import cache_folder, run_study
    from torchvision_dddas.evaluation.studies.summary import summary
    from torchvision_dddas.io.atomic_files import cannot_write, write_whole
    from torchvision_dddas.io.output.run_record import finite

    began, place = time.perf_counter(), cache or cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        running = False

        def begin(planned: "Plan") -> None:
            nonlocal running
            _write(folder, "run.json", {"state": "running", "study": spec.name})
            running = True
            begun(planned)

        try:
            with shown(quiet) as (begun, tell):
                results = run_study(spec, base, jobs, scheduler, place, clips, tell, begin)
            measures = summary(results)
            _write(folder, "metrics.json", measures)
            _write_tables(folder, measures, results)
            write_whole(folder / "report.html", report(finite(measures), results).encode())
            _write(folder, "run.json", _record(results, time.perf_counter() - began, place))
        except BaseException:
            if running:  # else nothing of an earlier study in this folder has been touched
                with suppress(OSError):
                    _write(folder, "run.json", {"state": "interrupted", "study": spec.name, "cache": place})
            raise
    except OSError as error:
        raise cannot_write(folder / "run.json", error) from error
    return results, measures


def _write(folder: Path, name: str, content: Any) -> None:
    from torchvision_dddas.io.atomic_files import write_whole
    from torchvision_dddas.io.output.run_record import finite

    write_whole(folder / name, (json.dumps(finite(content), indent=2) + "\n").encode())


def _write_tables(folder: Path, measures: dict[str, Any], results: "Results") -> None:
    """The figures as tables, and what `dddas compare` needs."""
    from torchvision_dddas.evaluation.studies.scored import ScoredCase, write_scores
    from torchvision_dddas.evaluation.studies.tables import write_csv, write_parquet

    write_csv(folder / "metrics.csv", measures)
    write_parquet(folder, measures, results)
    kept = [ScoredCase(case.task, case.clip.name, case.scored) for case in results.cases if case.scored is not None]
    write_scores(folder, results.spec.name, kept)


def _record(results: "Results", wall_s: float, cache: Path) -> dict[str, Any]:
    """What run.json says of a study."""
    from torchvision_dddas.evaluation.studies.costs import costs
    from torchvision_dddas.io.output.run_record import versions

    spec = results.spec
    return {
        "state": "complete",
        "versions": versions(),
        "study": {
            "name": spec.name,
            "tasks": spec.tasks,
            "config": spec.config,
            "set": spec.overrides,
            "backend": spec.backend,
            "interval": spec.interval,
        },
        **results.facts,
        "left_out": results.left_out,
        "cache": cache,
        "settings": results.settings.model_dump(),
        "seconds": {"wall": round(wall_s, 3)},
        "costs": costs(results),
    }


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
