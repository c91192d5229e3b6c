"""`dddas locate`: where targets stand on the ground."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.aerial import aerial
from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Config, Overrides, Quiet, Rate, check_rate
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.io.output.run_record import GroundRecord

locate = typer.Typer(help="Find where targets stand on the ground.", no_args_is_help=True)
locate.command()(aerial)


@locate.command()
@explained
def ground(
    tables: Annotated[
        list[Path],
        typer.Argument(metavar="TABLE...", help="Tables of people or tracks, CSV or MOTChallenge text, one a camera."),
    ],
    camera: Annotated[list[Path], typer.Option(metavar="FILE", help="The TOML of each table's camera.")],
    poses: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="A CSV of each moving camera's poses, in their order.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("dddas-positions"),
    config: Config = None,
    set_: Overrides = None,
    rate: Rate = None,
    quiet: Quiet = False,
) -> None:
    """Locate people seen by cameras on the ground, by their height and their feet; several cameras are fused.

    Writes positions.csv, sightings.csv (what each camera alone says), tracks.geojson and tracks.kml where longitudes
    are known, and run.json under --out.
    """
    from torchvision_dddas.config import load_config

    journal = ground_into(out, tables, camera, poses or [], load_config(config, set_ or []), rate, quiet)
    if not quiet:
        for line in summary(journal, out):
            typer.echo(line)


def ground_into(
    folder: Path,
    tables: Sequence[Path],
    cameras: Sequence[Path],
    poses: Sequence[Path],
    settings: "Settings",
    rate_hz: float | None = None,
    quiet: bool = False,
) -> "GroundRecord":
    """Locate and write under a folder; returns the record of the run. Raises InputError for bad input."""
    from torchvision_dddas.geo.ground_locator import GroundLocator
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.camera_files import describe_missing, read_camera, read_poses
    from torchvision_dddas.io.detection_tables import read_detections
    from torchvision_dddas.io.output import GroundRecorder

    if len(cameras) != len(tables):
        raise InputError(f"{len(tables)} tables and {len(cameras)} cameras; wanted one --camera for each table")
    check_rate(rate_hz)
    if poses and len(poses) != len(tables):
        raise InputError(f"{len(tables)} tables and {len(poses)} files of poses; wanted one --poses for each, or none")
    written = [folder / name for name in GroundRecorder.files]
    refuse_own_input([*tables, *cameras, *poses], written, "folder with --out")
    with GroundRecorder(folder) as output:
        read = [read_detections(table) for table in tables]
        kinds = [read_camera(camera) for camera in cameras]
        where = [read_poses(file) for file in poses] if poses else [None] * len(tables)
        locator = GroundLocator(kinds, settings, poses=where, rate_hz=rate_hz)
        frames = locator.locate_tables(read)
        facts = {
            "input": list(tables),
            "cameras": list(cameras),
            "poses": list(poses),
            "rows": [len(table) for table in read],
            "settings": settings.model_dump(),
        }
        journal = output.begin(facts, _told_apart([kind.name for kind in kinds]), locator.origin_deg is not None)
        journal.notes += [
            note for file, pose in zip(cameras, where, strict=True) if (note := describe_missing(file, pose))
        ]
        with progress("locate", None, quiet) as tick:
            for frame in frames:
                output.write(frame)
                tick()
        if not any(len(table) for table in read):
            journal.notes.append("the tables have no rows: nobody to locate")
    return journal


def _told_apart(names: list[str]) -> tuple[str, ...]:
    """The cameras' names, those that are alike numbered."""
    return tuple(f"{name}-{n}" if names.count(name) > 1 else name for n, name in enumerate(names, 1))


def summary(journal: "GroundRecord", folder: Path) -> list[str]:
    """What to tell the user at the end."""
    by = journal.by
    told = f"{by['both']} by height and feet, {by['height']} by height, {by['feet']} by feet alone"
    lines = [f"{journal.frames} frames, {journal.targets} sightings ({told}), {journal.people} positions"]
    if by["bearing"]:
        lines.append(f"note: {by['bearing']} sightings have a bearing but no distance (see sightings.csv)")
    made = [
        name for name in ("positions.csv", "sightings.csv", "tracks.geojson", "tracks.kml") if (folder / name).exists()
    ]
    return [*lines, *(f"note: {note}" for note in journal.notes), f"{folder}: {', '.join([*made, 'run.json'])}"]
