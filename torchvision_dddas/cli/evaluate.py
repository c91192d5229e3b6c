"""`dddas evaluate`: score files against the truth, or run and score the study that `--dataset` names."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
    WorkerSilent,
    check_interval,
    check_jobs,
    echo,
    print_lines,
    refuse_options,
    report_errors,
    split_patterns,
)
from torchvision_dddas.cli.progress import open_console, show_progress
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from torchvision_dddas.lab.evaluation.studies.records import Results, Spec

MOST_NOTES, MOST_CLIPS = 12, 20  # largest numbers of notes, and of the worst clips, that are shown


class Ignored(StrEnum):
    """How true boxes marked 0 are treated."""

    dropped = "dropped"
    removed = "removed"


@report_errors
def evaluate(
    truth: Annotated[
        Path | None,
        typer.Argument(help="Masks (a folder of numbered PNGs), a file of boxes or tracks, or a folder of such clips."),
    ] = None,
    result: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Output of dddas detect or track, a file that dddas convert reads, or a folder of these by clip name. "
            "Results of several methods are compared with the first."
        ),
    ] = None,
    names: Annotated[
        str | None,
        typer.Option(metavar="NAME,...", help="Names of the methods, one per RESULT. [default: by their files]"),
    ] = None,
    dataset: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Instead of TRUTH RESULT: the TOML of a study. Its clips are run and scored."
        ),
    ] = None,
    clips: Clips = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    worker_silent: WorkerSilent = None,
    cache: CacheFolder = None,
    prune_cache: Annotated[
        float | None, typer.Option(metavar="DAYS", min=0, help="Afterwards remove cached results unused for this time.")
    ] = None,
    keep: Annotated[
        str | None,
        typer.Option(metavar="KIND,...", help="Also write results into kept/: tracks, detections, masks."),
    ] = None,
    config: Config = None,
    set_: Overrides = None,
    backend: StudyBackend = None,
    first_frame: Annotated[
        int | None,
        typer.Option(help="Number in the name of the first frame's mask. [default: 0 if there is one, else 1]"),
    ] = None,
    interval: Annotated[
        int | None, typer.Option(help="Score only frames 1, 1 + INTERVAL, ... [default: 1, or as in FILE]")
    ] = None,
    ignored: Annotated[
        Ignored | None,
        typer.Option(
            help="True boxes marked 0: dropped as if not labelled (TrackEval, MOT15), "
            "or removed together with the tracks' boxes that match them. [default: dropped]"
        ),
    ] = None,
    iou: Annotated[
        float | None,
        typer.Option(help="The overlap from which a box counts as found; lower it for tiny targets. [default: 0.5]"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the files. [default: RESULT or its folder; dddas-study with --dataset or several RESULT]"
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Score results by pixels, boxes and tracks (HOTA, MOTA, IDF1): for each clip, pooled, and as mean.

    Several results of the same clips become one study each, for dddas compare. A report, tables and figures show all
    of them, with intervals, and with tests of each against the first.
    With --dataset, the clips of whole data sets are run and scored, and metrics.json, report.html and run.json are
    written. --clips, --jobs, --scheduler, --worker-silent, --cache, --prune-cache, --keep, --config, --set and
    --backend are for --dataset only.
    """
    if dataset is None:
        study: dict[str, object] = {"--clips": clips, "--jobs": jobs, "--scheduler": scheduler, "--cache": cache}
        study |= {"--worker-silent": worker_silent, "--keep": keep}
        study |= {"--prune-cache": prune_cache, "--config": config, "--set": set_ or None, "--backend": backend}
        refuse_options(study, "is for a study; give --dataset FILE too")
        if truth is None or not result:
            raise InputError(
                "evaluate needs TRUTH and RESULT, or --dataset FILE, the TOML of a study; see dddas evaluate --help"
            )
        check_interval(interval)
        how: dict[str, Any] = {"first_frame": first_frame, "interval": interval or 1}
        how |= {"ignoring": (ignored or Ignored.dropped).value, "least": 0.5 if iou is None else iou}
        if len(result) > 1 or names is not None:
            _evaluate_methods(out or Path("dddas-study"), truth, result, _split(names), how, quiet)
            return
        folder = out or (result[0].parent if result[0].is_file() else result[0])
        report = score(truth, result[0], folder, **how)
        if not quiet:
            show(report)
            echo(f"{folder / 'metrics.json'}: these figures and their counts")
        return
    from torchvision_dddas.lab.evaluation.studies.cache import Cache, cache_folder
    from torchvision_dddas.lab.evaluation.studies.jobs import SILENT_S, Workers
    from torchvision_dddas.lab.evaluation.studies.kept import check_kinds, keep_found
    from torchvision_dddas.lab.evaluation.studies.runner import write_study

    kinds = _split(keep)
    check_kinds(kinds)
    refuse_options(
        {"TRUTH": truth, "--names": names, "--first-frame": first_frame, "--ignored": ignored, "--iou": iou},
        "is of no use with --dataset",
    )
    check_jobs(jobs, scheduler)
    check_interval(interval, 1000)
    folder, base, used = out or Path("dddas-study"), dataset.parent, split_patterns(clips, "--clips")
    spec = change_spec(dataset, config, set_ or [], backend and backend.value, interval)
    with Workers(jobs, scheduler, worker_silent or SILENT_S) as workers, show_progress(quiet) as (begin, advance):
        results, measures = write_study(folder, spec, base, workers, cache, used, advance, begin)
    lacking = keep_found(folder / "kept", results, kinds)
    if not quiet:
        _show_study(results, measures, folder)
    print_lines([f"note: {line}" for line in lacking], quiet)
    if prune_cache is not None:
        place = cache or cache_folder()
        count, size = Cache(place).prune(prune_cache)
        text = f"{place}: {count} results unused for {prune_cache:g} days were removed, {size / 1e6:.1f} MB"
        print_lines([text], quiet)
    if all(case.cause for case in results.cases):
        case = results.cases[0]
        raise InputError(f"nothing could be scored; {case.clip.name}, {case.task}: {case.cause}")


def change_spec(
    file: Path, config: str | None, overrides: Sequence[str], backend: str | None, interval: int | None = None
) -> "Spec":
    """Read a study's file, and apply the options of the command line. Raise InputError for bad input."""
    from torchvision_dddas.lab.evaluation.studies.runner import read_spec

    spec = read_spec(file)
    spec = replace(spec, config=config or spec.config, overrides=(*spec.overrides, *overrides))
    return replace(spec, backend=backend or spec.backend, interval=spec.interval if interval is None else interval)


def score(
    truth: Path,
    result: Path,
    out: Path,
    *,
    first_frame: int | None = None,
    interval: int = 1,
    ignoring: Literal["dropped", "removed"] = "dropped",
    least: float = 0.5,
) -> dict[str, Any]:
    """Score a result, and write metrics.json into a folder. Raise InputError for bad input."""
    from torchvision_dddas.io.atomic_files import save_file
    from torchvision_dddas.io.output import finite
    from torchvision_dddas.lab.evaluation.evaluate import evaluate

    report = evaluate(truth, result, first_frame, interval, ignoring, least)
    save_file(out / "metrics.json", (json.dumps(finite(report), indent=2) + "\n").encode())
    return report


def _split(text: str | None) -> list[str]:
    return [] if text is None else [word.strip() for word in text.split(",")]


def _evaluate_methods(
    folder: Path, truth: Path, results: Sequence[Path], names: Sequence[str], how: Mapping[str, Any], quiet: bool
) -> None:
    """Write studies of several methods and their comparison, and print the measures of all clips together."""
    from torchvision_dddas.cli.compare import show_comparison
    from torchvision_dddas.lab.evaluation.studies.methods import name_results, write_methods

    found = write_methods(folder, truth, name_results(results, names), **how)
    if quiet:
        return
    if len(results) == 1:
        for task, measures in next(iter(found["methods"].values()))["tasks"].items():
            show(measures, f"{task}: ", MOST_CLIPS)
    for comparison in found["comparisons"]:
        show_comparison(comparison, pooled_only=True)
    print_lines([f"note: {note}" for note in found["notes"]])
    echo(f"{folder}: report.html, comparison.json, tables/, figures/, and a study of each method")


def show(measures: Mapping[str, Any], prefix: str = "", most: int | None = None) -> None:
    """Print a table for each group of measures: "clips" by name, "pooled" (with "intervals" in a study) and "mean".

    prefix: put before each title. most: largest number of clips in a table, which then shows the worst clips. None:
    show all clips, and the notes.
    """
    from torchvision_dddas.lab.evaluation.metrics.registry import GROUPS

    console = open_console()
    for group in GROUPS:
        if clips := {name: clip for name, clip in measures["clips"].items() if group in clip}:
            console.print(_table(group, clips, measures, prefix, most or len(clips)))
    print_lines([f"note: {note}" for note in measures["notes"]], quiet=most is not None)


def _show_study(results: "Results", measures: Mapping[str, Any], folder: Path) -> None:
    """Print the main measures of each task, clips left out, notes, and where further results are."""
    from torchvision_dddas.lab.evaluation.studies.runner import FILES

    for task, found in measures["tasks"].items():
        show(found, f"{task}: ", MOST_CLIPS)
    lines = [f"left out: {line}" for line in results.left_out]
    notes = results.facts["notes"]
    lines += [f"note: {line}" for line in notes[:MOST_NOTES]]
    if len(notes) > MOST_NOTES:
        lines.append(f"note: {len(notes) - MOST_NOTES} more in run.json")
    scored, facts = sum(1 for case in results.cases if not case.cause), results.facts
    kept = f"{facts['computed']} stages computed, {facts['kept']} cases taken from the cache"
    lines.append(f"{scored} of {len(results.cases)} cases scored: {kept}")
    print_lines([*lines, f"{folder}: {', '.join(name for name in FILES if (folder / name).is_file())}"])


def _table(group: str, clips: Mapping[str, Any], measures: Mapping[str, Any], prefix: str, most: int) -> "Table":
    from rich.markup import escape
    from rich.table import Table

    from torchvision_dddas.lab.evaluation.metrics.registry import GROUPS, describe, is_lower_better

    columns, title = GROUPS[group].columns, GROUPS[group].title

    def rank(name: str) -> float:  # the worst clip has the lowest rank
        value = clips[name][group][columns[0]]
        if value is None or math.isnan(value):
            return math.inf
        return -value if is_lower_better(columns[0]) else value

    shown = list(clips) if len(clips) <= most else sorted(clips, key=rank)[:most]
    more = f"; the {most} worst of {len(clips)} clips" if len(clips) > most else ""
    table = Table(title=f"{prefix}{title[0].upper()}{title[1:]}{more}")
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


def format_figure(value: float | int | None, sign: str = "") -> str:
    """Format a measure or a count for a table."""
    if type(value) is int:
        return f"{value:{sign}d}"
    return "–" if value is None or math.isnan(value) else f"{value:{sign}.3f}"


def _format_interval(interval: Sequence[float] | None) -> str:
    if interval is None:
        return "–"
    low, high = interval
    return f"{low:.2f} to {high:.2f}" if abs(high) < 100 else f"{low:.0f} to {high:.0f}"
