"""`dddas confirm`: which blobs seen from the air are people, by those recognized from the ground."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Config, Overrides, Quiet, Rate, check_rate
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.io.output.run_record import ConfirmationRecord
    from torchvision_dddas.people.confirmation import Vehicle
    from torchvision_dddas.types import Confirmation


@explained
def confirm(
    blobs: Annotated[
        Path, typer.Argument(metavar="BLOBS", help="positions.csv of the blobs; or their boxes, of one camera's clip.")
    ],
    people: Annotated[
        list[Path], typer.Argument(metavar="PEOPLE...", help="The same of people: a table for each ground vehicle.")
    ],
    camera: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE", help="The TOML of each table's camera, or of all of one fused table's: what they could see."
        ),
    ] = None,
    poses: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="A CSV of each moving camera's poses, in their order.")
    ] = None,
    interval: Annotated[
        int, typer.Option(metavar="D", help="People were looked for at every D-th frame: 1, 1+D, 1+2D, ...")
    ] = 1,
    identities: Annotated[
        bool | None,
        typer.Option(
            "--identities/--no-identities",
            help="Whether target numbers last, so that looks add up. [default: identities of boxes do, positions' not]",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("dddas-confirmed"),
    config: Config = None,
    set_: Overrides = None,
    rate: Rate = None,
    quiet: Quiet = False,
) -> None:
    """Tell which blobs are people: human, not human, or unseen, by the people recognized near them.

    Without cameras nothing is known of what the ground vehicles could see: blobs are then human or unseen.
    Writes confirmed.csv (the blobs' rows with kind, probability and evidence) and run.json under --out.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.io.tables import LAST_FRAME

    settings = load_config(config, set_ or [])
    if not 1 <= interval <= LAST_FRAME:
        raise InputError(f"--interval is {interval}; wanted 1 to {LAST_FRAME} frames")
    journal = confirm_into(out, blobs, people, camera or [], poses or [], settings, interval, identities, rate, quiet)
    if not quiet:
        for line in summary(journal, out):
            typer.echo(line)


def confirm_into(
    folder: Path,
    blobs: Path,
    people: Sequence[Path],
    cameras: Sequence[Path],
    poses: Sequence[Path],
    settings: "Settings",
    interval: int = 1,
    identities: bool | None = None,
    rate_hz: float | None = None,
    quiet: bool = False,
) -> "ConfirmationRecord":
    """Confirm and write under a folder; returns the record of the run. Raises InputError for bad input."""
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.detection_tables import read_header
    from torchvision_dddas.io.output import ConfirmationRecorder

    check_rate(rate_hz)
    written = [folder / name for name in ConfirmationRecorder.files]
    refuse_own_input([blobs, *people, *cameras, *poses], written, "folder with --out")
    headers = {path: read_header(path) for path in (blobs, *people)}
    places = {path: "east_m" in header for path, header in headers.items()}
    for path, of_places in places.items():
        if of_places != places[blobs]:
            if empty := [name for name in (blobs, path) if not headers[name]]:
                raise InputError(f"{empty[0]} is empty; wanted a first line that names frame,target,east_m,north_m")
            raise InputError(
                f"{blobs} has {_KIND[places[blobs]]}, {path} has {_KIND[of_places]}; give positions.csv for all "
                "(dddas locate), or boxes of the same pictures for all"
            )
    with ConfirmationRecorder(folder) as output:
        facts = {
            "blobs": blobs,
            "people": list(people),
            "cameras": list(cameras),
            "poses": list(poses),
            "interval_frames": interval,
            "settings": settings.model_dump(),
        }
        notes: list[str] = []
        if places[blobs]:
            header, rows, found = _on_the_ground(
                blobs, people, cameras, poses, settings, interval, identities, rate_hz, notes
            )
        else:
            if cameras or poses:
                raise InputError(f"{blobs} has boxes: --camera and --poses are for positions on the ground")
            header, rows, found = _in_pictures(blobs, people, settings, interval, identities)
        journal = output.begin(facts, header, rows)
        journal.notes += notes
        if not rows:
            journal.notes.append(f"{blobs} has no rows: nothing to confirm")
        with progress("confirm", None, quiet) as tick:
            for frame in found:
                output.write(frame)
                tick()
    return journal


_KIND = {True: "positions (east_m, north_m)", False: "boxes"}
_Found = tuple[list[str], list[list[str]], "Iterator[Confirmation]"]


def _on_the_ground(
    blobs: Path,
    people: Sequence[Path],
    cameras: Sequence[Path],
    poses: Sequence[Path],
    settings: "Settings",
    interval: int,
    identities: bool | None,
    rate_hz: float | None,
    notes: list[str],
) -> _Found:
    from torchvision_dddas.io.detection_tables import read_rows
    from torchvision_dddas.io.ground_tables import read_positions
    from torchvision_dddas.io.output import CONFIRMATION_NAMES
    from torchvision_dddas.people.confirmation import confirm_positions

    given = read_positions(blobs)
    vehicles = _vehicles(people, cameras, poses, notes)
    if not cameras:
        notes.append("without --camera nothing is known of what was seen: no blob can be found not human")
    if identities is None:  # a table of positions does not say it, and looks at different blobs must not add up
        notes.append("every row is judged alone; where target numbers last, --identities adds up the looks at each")
    rows = read_rows(blobs, CONFIRMATION_NAMES)
    return *rows, confirm_positions(given, vehicles, settings, interval, bool(identities), rate_hz)


def _vehicles(
    people: Sequence[Path], cameras: Sequence[Path], poses: Sequence[Path], notes: list[str]
) -> "list[Vehicle]":
    """The tables with their cameras: one each, or all of them to a single table. Raises InputError otherwise."""
    from torchvision_dddas.io.camera_files import describe_missing, read_camera, read_poses
    from torchvision_dddas.io.ground_tables import read_positions
    from torchvision_dddas.people.confirmation import Vehicle

    if len(people) > 1 and cameras and len(cameras) != len(people):
        raise InputError(
            f"{len(people)} tables of people and {len(cameras)} cameras; wanted one --camera for each table, or none"
        )
    if poses and len(poses) != len(cameras):
        raise InputError(
            f"{len(cameras)} cameras and {len(poses)} files of poses; wanted one --poses for each, or none"
        )
    kinds = [read_camera(path) for path in cameras]
    where = [read_poses(path) for path in poses] if poses else [None] * len(kinds)
    notes += [note for path, pose in zip(cameras, where, strict=True) if (note := describe_missing(path, pose))]
    tables = [read_positions(path) for path in people]
    names = _names(people)
    if len(people) == 1:
        return [Vehicle(names[0], tables[0], tuple(kinds), tuple(where))]
    if not cameras:
        return [Vehicle(name, table) for name, table in zip(names, tables, strict=True)]
    return [
        Vehicle(name, table, (camera,), (pose,))
        for name, table, camera, pose in zip(names, tables, kinds, where, strict=True)
    ]


def _in_pictures(
    blobs: Path, people: Sequence[Path], settings: "Settings", interval: int, identities: bool | None
) -> _Found:
    from dataclasses import replace

    from torchvision_dddas.io.detection_tables import read_detections, read_rows
    from torchvision_dddas.io.output import CONFIRMATION_NAMES
    from torchvision_dddas.people.confirmation import confirm_pictures

    given = read_detections(blobs)
    if identities is False:
        given = replace(given, identity=None)
    tables = [read_detections(path) for path in people]
    return *read_rows(blobs, CONFIRMATION_NAMES), confirm_pictures(given, tables, _names(people), settings, interval)


def _names(people: Sequence[Path]) -> list[str]:
    """A name for each table, no two alike: its folder's where all files have one name, as positions.csv has."""
    names = [path.stem for path in people]
    if len(set(names)) < len(names):
        names = [path.resolve().parent.name for path in people]
    if len(set(names)) < len(names):
        names = [f"{name}-{k}" for k, name in enumerate(names, 1)]
    return [name.replace(";", "-") for name in names]


def summary(journal: "ConfirmationRecord", folder: Path) -> list[str]:
    """What to tell the user at the end."""
    kinds = journal.kinds
    told = f"{kinds['human']} human, {kinds['not_human']} not human, {kinds['unseen']} unseen"
    return [
        f"{journal.frames} frames, {journal.targets} blobs: {told}",
        *(f"note: {note}" for note in journal.notes),
        f"{folder}: confirmed.csv, run.json",
    ]
