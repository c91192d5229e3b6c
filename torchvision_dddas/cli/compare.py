"""`dddas compare`: compare two studies of the same clips, and test whether changes exceed the noise."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchvision_dddas.cli.evaluate import MOST_CLIPS, format_figure
from torchvision_dddas.cli.options import echo, print_lines, report_errors
from torchvision_dddas.cli.progress import open_console

if TYPE_CHECKING:
    from rich.table import Table


@report_errors
def compare(
    first: Annotated[
        Path, typer.Argument(metavar="A", help="The folder of a study, written by dddas evaluate --dataset.")
    ],
    second: Annotated[Path, typer.Argument(metavar="B", help="The folder of another study of the same clips.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Also write an HTML page, such as compare.html, with its tables and figures."
        ),
    ] = None,
) -> None:
    """Compare two studies: which clips changed, by how much, and whether the change exceeds the noise."""
    from torchvision_dddas.io.atomic_files import refuse_folder, save_file
    from torchvision_dddas.io.output import finite, read_run_record
    from torchvision_dddas.io.report.figure_files import save_figures
    from torchvision_dddas.io.report.table_files import save_tables
    from torchvision_dddas.lab.evaluation.studies.cache import read_scores
    from torchvision_dddas.lab.evaluation.studies.comparison import (
        compare_studies,
        comparison_report,
        differing_settings,
        pooled_changes,
        settings_lines,
    )

    named = [(read_scores(folder), folder) for folder in (first, second)]
    studies = [replace(study, name=f"{study.name} ({folder})") for study, folder in named]
    mine, other = ((read_run_record(folder) or {}).get("settings") for folder in (first, second))
    differing = differing_settings(mine, other) if isinstance(mine, dict) and isinstance(other, dict) else None
    found = compare_studies(*studies) | {"settings": differing}
    if out is not None:
        refuse_folder(out)
        page = comparison_report(finite(found))
        save_file(out, page.encode())
        save_figures(out.parent / f"{out.stem}-figures", page)
        pooled = {task: pooled_changes(changes, "A", "B") for task, changes in finite(found)["tasks"].items()}
        save_tables(out.parent / f"{out.stem}-tables", pooled)
    if as_json:
        echo(json.dumps(finite(found), indent=2))
        return
    print_lines(settings_lines(found["settings"]))
    show_comparison(found)
    print_lines([f"note: {note}" for note in found["notes"]])


def show_comparison(found: Mapping[str, Any], pooled_only: bool = False) -> None:
    """Print the tables of a comparison. pooled_only: leave out single clips and the meaning of the verdicts."""
    from torchvision_dddas.lab.evaluation.studies.comparison import MEANING, entries_of

    print_lines([f"A: {found['first']}", f"B: {found['second']}"])
    console = open_console()
    for task, changes in found["tasks"].items():
        pooled = [(f"{group} {name}", entry) for group, name, entry in entries_of(changes["pooled"])]
        count = len(changes["clips"]) + len(changes["same"])
        console.print(_table(f"{task}, {count} clip{'s' * (count != 1)} together", pooled))
        clips = [
            (f"{clip}: {group} {name}", entry)
            for clip, groups in changes["clips"].items()
            for group, name, entry in entries_of(groups)
            if entry["change"] and not pooled_only
        ]
        clips.sort(key=lambda row: row[1]["over_frames"]["p_holm"] if row[1]["over_frames"] else 2.0)
        if clips:
            console.print(_table(f"{task}, single clips", clips[:MOST_CLIPS]))
        if len(clips) > MOST_CLIPS:
            echo(f"{len(clips) - MOST_CLIPS} more rows with --json")
        if changes["same"]:
            echo(f"identical in both studies: {', '.join(changes['same'])}")
    if not pooled_only:
        console.print(MEANING, highlight=False)


def _table(title: str, rows: Sequence[tuple[str, Mapping[str, Any]]]) -> "Table":
    from rich.table import Table

    table = Table(title=title)
    table.add_column("measure", overflow="fold")
    pooled = any("over_clips" in entry for _, entry in rows)
    tests = (
        ("clips:\np, corrected", "frames:\np, corrected", "effect\nsize", "clips\nneeded")
        if pooled
        else ("p, corrected",)
    )
    for column in ("A", "B", "change", "95 % interval", *tests):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("says")
    for name, entry in rows:
        ways = [entry[way] or {} for way in (("over_clips", "over_frames") if pooled else ("over_frames",))]
        span = next((way["interval"] for way in ways if way.get("interval")), None)
        table.add_row(
            name,
            format_figure(entry["first"]),
            format_figure(entry["second"]),
            format_figure(entry["change"], "+"),
            "–" if span is None else f"{span[0]:+.3f} to {span[1]:+.3f}",
            *(f"{way['p']:.3f}, {way['p_holm']:.3f}" if way else "–" for way in ways),
            *((format_figure(entry["effect_size"]), format_figure(entry["clips_needed"])) if pooled else ()),
            entry["says"],
        )
    return table
