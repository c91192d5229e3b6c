"""`dddas evaluate`: results against the truth, of files or of the whole study that `--dataset` names."""

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

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
    check_interval,
    check_jobs,
    report_errors,
    split_patterns,
)
from torchvision_dddas.cli.study import change_spec, open_console, print_measures, print_study, show_progress
from torchvision_dddas.errors import InputError


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
        Path | None,
        typer.Argument(help="What dddas detect or track wrote, MOTChallenge text, or a folder of such by clip name."),
    ] = None,
    dataset: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Instead of TRUTH RESULT: the TOML of a study, whose clips are run and scored."
        ),
    ] = None,
    clips: Clips = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    cache: CacheFolder = None,
    prune_cache: Annotated[
        float | None, typer.Option(metavar="DAYS", min=0, help="Afterwards remove kept results unused for so long.")
    ] = None,
    config: Config = None,
    set_: Overrides = None,
    backend: StudyBackend = None,
    first_frame: Annotated[
        int | None,
        typer.Option(help="Number in a mask's name that is the clip's first frame. [default: 0 if there, else 1]"),
    ] = None,
    interval: Annotated[
        int | None, typer.Option(help="Score only frames 1, 1 + INTERVAL, ... [default: 1, or as FILE says]")
    ] = None,
    ignored: Annotated[
        Ignored | None,
        typer.Option(
            help="True boxes marked 0: dropped as if not labelled (TrackEval, MOT15), "
            "or removed together with the tracks' boxes that match them. [default: dropped]"
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for metrics.json. [default: RESULT or its folder; dddas-study with --dataset]"),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Score results: the six pixel measures, boxes, tracks (HOTA, MOTA, IDF1); per clip, pooled, and the mean.

    With --dataset, the clips of whole data sets are run and scored, and metrics.json, report.html and run.json are
    written. --clips, --jobs, --scheduler, --cache, --prune-cache, --config, --set and --backend are for --dataset only.
    """
    if dataset is None:
        study: dict[str, object] = {"--clips": clips, "--jobs": jobs, "--scheduler": scheduler, "--cache": cache}
        study |= {"--prune-cache": prune_cache, "--config": config, "--set": set_ or None, "--backend": backend}
        _refuse(study, "is for a study; give --dataset FILE too")
        if truth is None or result is None:
            raise InputError(
                "evaluate needs TRUTH and RESULT, or --dataset FILE, the TOML of a study; see dddas evaluate --help"
            )
        check_interval(interval)
        folder = out or (result.parent if result.is_file() else result)
        report = score(truth, result, first_frame, folder, interval or 1, (ignored or Ignored.dropped).value)
        if not quiet:
            show(report)
            typer.echo(f"{folder / 'metrics.json'}: the same with its counts")
        return
    from torchvision_dddas.evaluation.studies.output import write_study
    from torchvision_dddas.evaluation.studies.runner import cache_folder
    from torchvision_dddas.evaluation.studies.storage import Cache
    from torchvision_dddas.evaluation.studies.workers import Workers

    _refuse({"TRUTH": truth, "--first-frame": first_frame, "--ignored": ignored}, "is of no use with --dataset")
    check_jobs(jobs, scheduler)
    check_interval(interval, 1000)
    folder, base, used = out or Path("dddas-study"), dataset.parent, split_patterns(clips, "--clips")
    spec = change_spec(dataset, config, set_ or [], backend and backend.value, interval)
    with Workers(jobs, scheduler) as workers, show_progress(quiet) as (begin, advance):
        results, measures = write_study(folder, spec, base, workers, cache, used, advance, begin)
    if not quiet:
        print_study(results, measures, folder)
    if prune_cache is not None:
        place = cache or cache_folder()
        count, size = Cache(place).prune(prune_cache)
        if not quiet:
            typer.echo(f"{place}: {count} results unused for {prune_cache:g} days were removed, {size / 1e6:.1f} MB")
    if all(case.cause for case in results.cases):
        case = results.cases[0]
        raise InputError(f"nothing could be scored; {case.clip.name}, {case.task}: {case.cause}")


def _refuse(options: dict[str, object], why: str) -> None:
    """Raise InputError for the first option that was given."""
    for option, given in options.items():
        if given is not None:
            raise InputError(f"{option} {why}")


def score(
    truth: Path,
    result: Path,
    first_frame: int | None,
    out: Path,
    interval: int = 1,
    ignored: Literal["dropped", "removed"] = "dropped",
) -> dict[str, Any]:
    """Evaluate, and write metrics.json into a folder. Raises InputError."""
    from torchvision_dddas.evaluation.evaluate import evaluate
    from torchvision_dddas.io.atomic_files import save_file
    from torchvision_dddas.io.output import finite

    report = evaluate(truth, result, first_frame, interval, ignored)
    save_file(out / "metrics.json", (json.dumps(finite(report), indent=2) + "\n").encode())
    return report


def show(report: dict[str, Any]) -> None:
    """Print a table for each group of measures, and the notes."""
    console = open_console()
    print_measures(console, report)
    for note in report["notes"]:
        console.print(f"note: {note}", markup=False, highlight=False)
