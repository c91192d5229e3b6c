"""`dddas evaluate`: results against the truth."""

import json
import math
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from torchvision_dddas.cli.options import Backend, Config, Overrides, Quiet, check_jobs, report_errors
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

COLUMNS = {
    "pixels": ("f", "precision", "recall", "specificity", "accuracy", "gmean"),
    "boxes": ("f1", "precision", "recall"),
    "target": ("hit", "iou_0.3", "other_blobs_per_frame"),
    "tracks": ("hota", "deta", "assa", "mota", "idf1", "n_switches", "ar_3"),
    "target_track": ("found", "same_identity", "n_switches", "n_fragmentations"),
}

TITLES = {
    "pixels": "Pixels",
    "boxes": "Boxes, IoU ≥ 0.5",
    "target": "One labelled target",
    "tracks": "Tracks",
    "target_track": "The labelled target's track, IoU ≥ 0.3",
}

# Headings that fit a terminal of 80 columns beside the clips' names.
SHORT = {
    "f": "F",
    "f1": "F1",
    "precision": "prec.",
    "specificity": "spec.",
    "accuracy": "acc.",
    "gmean": "Gmean",
    "iou_0.3": "IoU ≥ 0.3",
    "other_blobs_per_frame": "other blobs",
    "hota": "HOTA",
    "deta": "DetA",
    "assa": "AssA",
    "mota": "MOTA",
    "idf1": "IDF1",
    "ar_3": "AR_3",
    "same_identity": "same identity",
    "n_switches": "IDsw",
    "n_fragmentations": "frag.",
}


class Ignored(StrEnum):
    """What becomes of true boxes marked 0."""

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
        typer.Option(metavar="FILE", help="In place of TRUTH RESULT: the TOML of a study, whose clips are run too."),
    ] = None,
    clips: Annotated[
        str | None, typer.Option(metavar="PATTERN,...", help="Of a study: these clips alone, such as 'bms_*'.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(metavar="N", help="Of a study: processes of one thread each. [default: one a core]")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Of a study: a Dask scheduler, such as tcp://host:8786.")
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Of a study: where results are kept. [default: in the user's cache folder]"),
    ] = None,
    prune_cache: Annotated[
        float | None,
        typer.Option(metavar="DAYS", min=0, help="Of a study: afterwards remove kept results unused for so long."),
    ] = None,
    config: Config = None,
    set_: Overrides = None,
    backend: Annotated[Backend | None, typer.Option(help="Of a study: the engine. [default: as FILE says]")] = None,
    first_frame: Annotated[
        int | None,
        typer.Option(help="Number in a mask's name that is the clip's first frame. [default: 0 if there, else 1]"),
    ] = None,
    interval: Annotated[
        int | None, typer.Option(help="Score frames 1, 1 + INTERVAL, ... alone. [default: 1, or as FILE says]")
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
        typer.Option(help="Folder for metrics.json. [default: RESULT, or that file's folder; of a study dddas-study]"),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Score results: the six pixel measures, boxes, tracks (HOTA, MOTA, IDF1); per clip, pooled, and the mean.

    With --dataset the clips of whole data sets are run and scored; metrics.json, report.html and run.json are written.
    """
    study: dict[str, object] = {"--clips": clips, "--jobs": jobs, "--scheduler": scheduler, "--cache": cache}
    study["--prune-cache"] = prune_cache
    study |= {"--config": config, "--set": set_ or None, "--backend": backend}
    if dataset is not None:
        _refuse({"TRUTH": truth, "--first-frame": first_frame, "--ignored": ignored}, "is of no use with --dataset")
        from torchvision_dddas.cli import study as whole

        check_jobs(jobs, scheduler)
        if interval is not None and not 1 <= interval <= 1000:
            raise InputError(f"--interval is {interval}; wanted a whole number of frames, 1 to 1000")
        folder = out or Path("dddas-study")
        spec = whole.asked(dataset, config, set_ or [], backend and backend.value, interval)
        results, measures = whole.study_into(
            folder, spec, dataset.parent, jobs, scheduler, cache, whole.patterns(clips, "--clips"), quiet
        )
        if not quiet:
            whole.show(results, measures, folder)
        if prune_cache is not None:
            whole.prune_cache(cache, prune_cache, quiet)
        whole.refuse_nothing(results)
        return
    _refuse(study, "is for a study; give --dataset FILE too")
    if truth is None or result is None:
        raise InputError(
            "evaluate needs TRUTH and RESULT, or --dataset FILE, the TOML of a study; see dddas evaluate --help"
        )
    folder = out or (result.parent if result.is_file() else result)
    report = score(
        truth, result, first_frame, folder, 1 if interval is None else interval, (ignored or Ignored.dropped).value
    )
    if not quiet:
        show(report)
        typer.echo(f"{folder / 'metrics.json'}: the same with its counts")


def _refuse(options: dict[str, object], why: str) -> None:
    """Raises InputError for the first option that was given."""
    for option, given in options.items():
        if given is not None:
            raise InputError(f"{option} {why}")


def score(
    truth: Path,
    result: Path,
    first_frame: int | None,
    out: Path,
    interval: int = 1,
    ignoring: Literal["dropped", "removed"] = "dropped",
) -> dict[str, Any]:
    """Evaluate, and write metrics.json into a folder. Raises InputError."""
    from torchvision_dddas.evaluation.evaluate import evaluate as compare
    from torchvision_dddas.io.atomic_files import cannot_write, write_whole
    from torchvision_dddas.io.output.run_record import finite

    report = compare(truth, result, first_frame, interval, ignoring)
    path = out / "metrics.json"
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_whole(path, (json.dumps(finite(report), indent=2) + "\n").encode())
    except OSError as error:
        raise cannot_write(path, error) from error
    return report


def show(report: dict[str, Any]) -> None:
    """Print a table for each kind of measure, and the notes."""
    from rich.console import Console

    console = Console() if sys.stdout.isatty() else Console(width=120)
    for group in COLUMNS:
        if any(group in clip for clip in report["clips"].values()):
            console.print(_table(report, group))
    for note in report["notes"]:
        console.print(f"note: {note}", markup=False, highlight=False)


def _table(report: dict[str, Any], group: str) -> "Table":
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=TITLES[group])
    table.add_column("clip", no_wrap=True)
    for column in ("frames", *COLUMNS[group]):
        table.add_column(SHORT.get(column, column), justify="right", no_wrap=True)
    rows = {name: (str(clip["frames"]), clip[group]) for name, clip in report["clips"].items() if group in clip}
    for name, (frames, clip) in rows.items():
        table.add_row(escape(name), frames, *(_cell(clip[c]) for c in COLUMNS[group]))
    if len(rows) > 1:
        table.add_section()
        for name in ("pooled", "mean"):
            table.add_row(name, "", *(_cell(report[name].get(group, {}).get(c, math.nan)) for c in COLUMNS[group]))
    return table


def _cell(value: float) -> str:
    if isinstance(value, int):
        return str(value)
    return "–" if math.isnan(value) else f"{value:.3f}"
