"""`dddas people`: find people by their shape, whether they move or not."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.exits import noting
from torchvision_dddas.cli.options import (
    CLIP,
    Backend,
    Config,
    EngineOption,
    OutPerInput,
    Overrides,
    Quiet,
    Rate,
    print_lines,
    report_errors,
)
from torchvision_dddas.cli.progress import closing_lines, folders_for, record_results
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.io.output import RunRecord
    from torchvision_dddas.people import WindowScorer
    from torchvision_dddas.types import DetectionTable, Source


@report_errors
def people(
    inputs: Annotated[list[str], typer.Argument(metavar="INPUT...", help=f"A picture. {CLIP}")],
    around: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Search only around these boxes, unless people.search=regions; CSV or MOTChallenge text.",
        ),
    ] = None,
    out: OutPerInput = Path("dddas-people"),
    config: Config = None,
    set_: Overrides = None,
    backend: EngineOption = Backend.auto,
    save: Annotated[
        str, typer.Option(metavar="NAMES", help="overlay, all or none; the tables are always written.")
    ] = "all",
    rate: Rate = None,
    quiet: Quiet = False,
) -> None:
    """Recognize people by their shape (HOG and a linear SVM) in pictures and clips, whether they move or not.

    Writes detections.txt (MOTChallenge), detections.csv with the feet, overlay.mp4 (.png for a picture) and run.json.
    """
    from torchvision_dddas import open_video
    from torchvision_dddas.config import load_config
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.detection_tables import check_within_clip, read_for_clip
    from torchvision_dddas.io.output import PeopleRecorder, clip_facts, parse_save
    from torchvision_dddas.people import detect_in_clip, levels, load_scorer

    settings, names = load_config(config, set_ or []), parse_save(save, PeopleRecorder.saved)
    if around is not None and len(inputs) > 1:
        raise InputError(f"--around is the table of one clip, and {len(inputs)} were given; run them one after another")
    scorer: WindowScorer | None = None
    done: list[str] = []
    with noting(lambda: f"all of {', '.join(done)} is kept", lambda: done):
        for clip, folder in zip(inputs, folders_for(inputs, out), strict=True):
            given = [Path(clip), *([] if around is None else [around])]
            refuse_own_input(given, [folder / name for name in PeopleRecorder.files], "folder with --out")
            with PeopleRecorder(folder, names) as output:
                source = open_video(clip, rate_hz=rate, full_scale=settings.levels.given, single=True)
                table = read_for_clip(around, None, source) if around is not None else None
                if table is not None:
                    check_within_clip(table, source)
                try:
                    levels(source.size, settings.people)  # refuse pictures that are too small before the engine loads
                except InputError as error:
                    raise InputError(f"{source.name}: {error}") from None
                scorer = scorer or load_scorer(settings.people, backend.value)
                facts = {
                    "input": clip,
                    "around": around,
                    "clip": clip_facts(source),
                    "backend": scorer.name,
                    "settings": settings.model_dump(),
                }
                is_single = source.exact and source.count == 1
                overlay = "overlay.png" if is_single else "overlay.mp4"
                record = output.begin(facts, source.rate_hz, is_single)
                frames = detect_in_clip(source, scorer, settings, table)
                record_results(output, record, frames, source.name, source.count, quiet, source)
                record.notes += [] if table is None else [*table.notes, *_notes(record, str(around), table, source)]
            files = ["detections.csv", "detections.txt", *(overlay for _ in names), "run.json"]
            print_lines(closing_lines(_counts(record), record, folder, files), quiet)
            done.append(folder.name)


def _notes(record: "RunRecord", name: str, table: "DetectionTable", source: "Source") -> list[str]:
    """Return notes for the user on the table that selected the searched areas."""
    if table.last > source.last:
        return [f"the clip ended after frame {source.last}, {name} goes on to {table.last}"]
    if nowhere := record.counts["searched"]["frames_nowhere"]:
        what = f"{name} has no box of a suitable size there" if len(table) else f"{name} holds no rows"
        return [f"{nowhere} of {record.frames} frames were not searched: {what}"]
    return []


def _counts(record: "RunRecord") -> str:
    found = f"{record.targets} {'person' if record.targets == 1 else 'people'}"
    line = f"{record.frames} frame{'s' * (record.frames != 1)}, {found}"
    if unlikely := record.counts["unlikely"]:
        line += f", {unlikely} of them unlikely"
    if cut := record.counts["cut"]:
        line += f", {cut} of them cut by the border"
    share = record.counts["searched"]["share_of_windows"]
    return line if share >= 1 else f"{line}; {share:.0%} of the windows searched"
