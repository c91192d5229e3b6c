"""`dddas evaluate`: results against the truth."""

import json
import math
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from torchvision_dddas.cli.mistakes import explained

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


@explained
def evaluate(
    truth: Annotated[
        Path,
        typer.Argument(help="Masks (a folder of numbered PNGs), a file of boxes or tracks, or a folder of such clips."),
    ],
    result: Annotated[
        Path,
        typer.Argument(help="What dddas detect or track wrote, MOTChallenge text, or a folder of such by clip name."),
    ],
    first_frame: Annotated[
        int | None,
        typer.Option(help="Number in a mask's name that is the clip's first frame. [default: 0 if there, else 1]"),
    ] = None,
    interval: Annotated[int, typer.Option(help="Score frames 1, 1 + INTERVAL, ... alone.")] = 1,
    ignored: Annotated[
        Ignored,
        typer.Option(
            help="True boxes marked 0: dropped as if not labelled (TrackEval, MOT15), "
            "or removed together with the tracks' boxes that match them."
        ),
    ] = Ignored.dropped,
    out: Annotated[
        Path | None, typer.Option(help="Folder for metrics.json. [default: RESULT, or the folder of that file]")
    ] = None,
) -> None:
    """Score results: the six pixel measures, boxes, tracks (HOTA, MOTA, IDF1); per clip, pooled, and the mean."""
    folder = out or (result.parent if result.is_file() else result)
    report = score(truth, result, first_frame, folder, interval, ignored.value)
    show(report)
    typer.echo(f"{folder / 'metrics.json'}: the same with its counts")


def score(
    truth: Path,
    result: Path,
    first_frame: int | None,
    out: Path,
    interval: int = 1,
    ignoring: Literal["dropped", "removed"] = "dropped",
) -> dict[str, Any]:
    """Evaluate, and write metrics.json into a folder. Raises InputError."""
    from torchvision_dddas.evaluate import evaluate as compare
    from torchvision_dddas.sinks.journal import finite
    from torchvision_dddas.sinks.whole import cannot_write, write_whole

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
    from rich.table import Table

    table = Table(title=TITLES[group])
    table.add_column("clip", no_wrap=True)
    for column in ("frames", *COLUMNS[group]):
        table.add_column(SHORT.get(column, column), justify="right", no_wrap=True)
    rows = {name: (str(clip["frames"]), clip[group]) for name, clip in report["clips"].items() if group in clip}
    for name, (frames, clip) in rows.items():
        table.add_row(name, frames, *(_cell(clip[c]) for c in COLUMNS[group]))
    if len(rows) > 1:
        table.add_section()
        for name in ("pooled", "mean"):
            table.add_row(name, "", *(_cell(report[name].get(group, {}).get(c, math.nan)) for c in COLUMNS[group]))
    return table


def _cell(value: float) -> str:
    if isinstance(value, int):
        return str(value)
    return "–" if math.isnan(value) else f"{value:.3f}"
