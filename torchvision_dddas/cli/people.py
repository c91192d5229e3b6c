"""`dddas people`: people, by their shape, moving or not."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.clips import clip_facts, folders_for, last_lines
from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Backend, Config, EngineOption, Overrides, Quiet, Rate
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.io.output.run_record import PeopleRecord
    from torchvision_dddas.people.detector import WindowScorer


@explained
def people(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUT...", help="A picture, a video file, a folder or glob of images, camera:0 or rtsp://..."
        ),
    ],
    around: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Search around these boxes, and nowhere else unless people.search=regions; CSV or MOTChallenge text.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results; several inputs get a folder each in it.")] = Path(
        "dddas-people"
    ),
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
    from torchvision_dddas.config import load_config
    from torchvision_dddas.io.output import PeopleRecorder, parse_save
    from torchvision_dddas.people.detector import load_scorer

    settings, names = load_config(config, set_ or []), parse_save(save, PeopleRecorder.saved)
    if around is not None and len(inputs) > 1:
        raise InputError(f"--around is the table of one clip, and {len(inputs)} were given; run them one after another")
    recognizer = cache(lambda: load_scorer(settings.people, backend.value))
    for clip, folder in zip(inputs, folders_for(inputs, out), strict=True):
        journal = people_into(folder, clip, recognizer, settings, names, around, rate, quiet)
        if not quiet:
            for line in summary(journal, folder, names):
                typer.echo(line)


def people_into(
    folder: Path,
    clip: str,
    recognizer: Callable[[], "WindowScorer"],
    settings: "Settings",
    save: Sequence[str] = (),
    around: Path | None = None,
    rate_hz: float | None = None,
    quiet: bool = False,
) -> "PeopleRecord":
    """Recognize the people of one clip or picture and write under a folder; returns the record of the run.

    Raises InputError for bad input, and KeyboardInterrupt after the outputs up to the last whole frame are in place.
    """
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.output import PeopleRecorder

    given = [Path(clip), *([] if around is None else [around])]
    refuse_own_input(given, [folder / name for name in PeopleRecorder.files], "folder with --out")
    with PeopleRecorder(folder, save) as output:
        from torchvision_dddas import open_video
        from torchvision_dddas.io.detection_tables import check_within_clip, read_detections
        from torchvision_dddas.people.detector import detect_in_clip
        from torchvision_dddas.people.pyramid import levels

        table = read_detections(around) if around is not None else None
        source = open_video(clip, rate_hz=rate_hz, single=True)
        if table is not None:
            check_within_clip(table, source)
        try:
            levels(source.size, settings.people)  # whether one fits is better said before the engine is loaded
        except InputError as error:
            raise InputError(f"{source.name}: {error}") from None
        engine = recognizer()
        facts = {
            "input": clip,
            "around": around,
            "clip": clip_facts(source),
            "backend": engine.name,
            "settings": settings.model_dump(),
        }
        journal = output.begin(facts, source.rate_hz, source.exact and source.count == 1)
        try:
            with progress(source.name, source.count, quiet) as tick:
                for recognized in detect_in_clip(source, engine, settings, table):
                    output.write(recognized)
                    tick()
            if table is not None:
                journal.notes += _notes(journal, str(around), len(table), table.last, source.last)
        finally:
            journal.problems += [str(problem) for problem in source.problems]
    return journal


def _notes(journal: "PeopleRecord", name: str, rows: int, last: int, frames: int) -> list[str]:
    """What the user should know of a table that said where to search."""
    if last > frames:
        return [f"the clip ended after frame {frames}, {name} goes on to {last}"]
    if journal.nowhere:
        what = f"{name} holds no rows" if rows == 0 else f"{name} has no box there that a window fits"
        return [f"{journal.nowhere} of {journal.frames} frames were not searched: {what}"]
    return []


def summary(journal: "PeopleRecord", folder: Path, save: Sequence[str]) -> list[str]:
    """What to tell the user at the end."""
    made = ["detections.csv", "detections.txt", *(journal.overlay for _ in save), "run.json"]
    found = f"{journal.targets} {'person' if journal.targets == 1 else 'people'}"
    first = f"{journal.frames} frame{'s' * (journal.frames != 1)}, {found}"
    if journal.unlikely:
        first += f", {journal.unlikely} of them unlikely"
    if journal.cut:
        first += f", {journal.cut} of them cut by the border"
    if journal.share < 1:
        first += f"; {journal.share:.0%} of the windows searched"
    return last_lines(first, journal, folder, made, journal.notes)
