"""`dddas confirm`: classify blobs seen from the air with people recognized from the ground."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.options import (
    Config,
    Out,
    Overrides,
    Poses,
    Quiet,
    Rate,
    check_interval,
    check_rate,
    print_lines,
    report_errors,
)
from torchvision_dddas.cli.progress import closing_lines, record_results
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.control import Vehicle

KINDS = {True: "positions (east_m, north_m)", False: "boxes"}


@report_errors
def confirm(
    blobs: Annotated[
        Path, typer.Argument(metavar="BLOBS", help="positions.csv of the blobs, or their boxes in one camera's clip.")
    ],
    people: Annotated[
        list[Path],
        typer.Argument(metavar="PEOPLE...", help="Positions or boxes of people: a table per ground vehicle."),
    ],
    camera: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="The TOML of each table's camera, or of all cameras of one fused table."),
    ] = None,
    poses: Poses = None,
    interval: Annotated[
        int, typer.Option(metavar="D", help="People were searched for at every D-th frame: 1, 1+D, 1+2D, ...")
    ] = 1,
    identities: Annotated[
        bool | None,
        typer.Option(
            "--identities/--no-identities",
            help="Whether target numbers persist, so that evidence adds up over frames. "
            "[default: yes for boxes with identities, no for positions]",
        ),
    ] = None,
    out: Out = Path("dddas-confirmed"),
    config: Config = None,
    set_: Overrides = None,
    rate: Rate = None,
    quiet: Quiet = False,
) -> None:
    """Classify blobs as human, not human, or unseen, by the people recognized near them.

    Without cameras, the views of the ground vehicles are unknown, and blobs are human or unseen.
    Writes confirmed.csv (the blobs' rows with kind, probability and evidence) and run.json under --out.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.control import confirm_pictures, confirm_positions
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.detection_tables import read_detections, read_rows
    from torchvision_dddas.io.ground_tables import read_positions
    from torchvision_dddas.io.output import CONFIRMATION_NAMES, ConfirmationRecorder
    from torchvision_dddas.io.tables import LAST_FRAME

    settings, cameras, poses = load_config(config, set_ or []), camera or [], poses or []
    check_interval(interval, LAST_FRAME)
    check_rate(rate)
    written = [out / name for name in ConfirmationRecorder.files]
    refuse_own_input([blobs, *people, *cameras, *poses], written, "folder with --out")
    has_positions = _has_positions(blobs, people)
    with ConfirmationRecorder(out) as output:
        facts = {
            "blobs": blobs,
            "people": list(people),
            "cameras": list(cameras),
            "poses": list(poses),
            "interval_frames": interval,
            "settings": settings.model_dump(),
        }
        notes: list[str] = []
        if has_positions:
            table = read_positions(blobs)
            vehicles = _read_vehicles(people, cameras, poses, notes)
            if not cameras:
                notes.append("without --camera the vehicles' views are unknown, so no blob can be judged not human")
            if identities is None:  # do not add up evidence of two blobs if identities are unknown
                notes.append("rows are judged alone; if target numbers persist, --identities adds up evidence")
            found = confirm_positions(table, vehicles, settings, interval, bool(identities), rate)
        elif cameras or poses:
            raise InputError(f"{blobs} has boxes: --camera and --poses are for positions on the ground")
        else:
            boxes = read_detections(blobs)
            boxes = replace(boxes, identity=None) if identities is False else boxes
            found = confirm_pictures(boxes, [read_detections(p) for p in people], _names(people), settings, interval)
        header, rows = read_rows(blobs, CONFIRMATION_NAMES)
        record = output.begin(facts, header, rows)
        record.notes += notes if rows else [*notes, f"{blobs} has no rows: nothing to confirm"]
        record_results(output, record, found, "confirm", quiet=quiet)
    kinds = {"human": 0, "not_human": 0, "unseen": 0, **record.counts["kinds"]}
    counts = f"{kinds['human']} human, {kinds['not_human']} not human, {kinds['unseen']} unseen"
    first = f"{record.frames} frames, {record.targets} blobs: {counts}"
    print_lines(closing_lines(first, record, out, ["confirmed.csv", "run.json"]), quiet)


def _has_positions(blobs: Path, people: Sequence[Path]) -> bool:
    """Return whether all tables hold positions; False if all hold boxes. Raise InputError if they differ."""
    from torchvision_dddas.io.detection_tables import read_header

    headers = {path: read_header(path) for path in (blobs, *people)}
    is_ground = {path: "east_m" in header for path, header in headers.items()}
    for path, here in is_ground.items():
        if here != is_ground[blobs]:
            if empty := [name for name in (blobs, path) if not headers[name]]:
                raise InputError(f"{empty[0]} is empty; its first line must be frame,target,east_m,north_m")
            raise InputError(
                f"{blobs} has {KINDS[is_ground[blobs]]}, {path} has {KINDS[here]}; give positions.csv for all "
                "(dddas locate), or boxes of the same pictures for all"
            )
    return is_ground[blobs]


def _read_vehicles(
    people: Sequence[Path], cameras: Sequence[Path], poses: Sequence[Path], notes: list[str]
) -> "list[Vehicle]":
    """Read the tables with one camera per table, or all cameras for a single table. Raise InputError otherwise."""
    from torchvision_dddas.control import Vehicle
    from torchvision_dddas.io.camera_files import describe_missing, read_camera, read_poses
    from torchvision_dddas.io.ground_tables import read_positions

    if len(people) > 1 and cameras and len(cameras) != len(people):
        raise InputError(
            f"{len(people)} tables of people and {len(cameras)} cameras; give one --camera for each table, or none"
        )
    if poses and len(poses) != len(cameras):
        raise InputError(f"{len(cameras)} cameras and {len(poses)} files of poses; give one --poses for each, or none")
    views = [read_camera(path) for path in cameras]
    where = [read_poses(path) for path in poses] if poses else [None] * len(views)
    notes += [note for path, pose in zip(cameras, where, strict=True) if (note := describe_missing(path, pose))]
    tables = [(name, read_positions(path)) for name, path in zip(_names(people), people, strict=True)]
    if len(people) == 1:
        return [Vehicle(*tables[0], tuple(views), tuple(where))]
    if not cameras:
        return [Vehicle(*table) for table in tables]
    return [Vehicle(*table, (view,), (pose,)) for table, view, pose in zip(tables, views, where, strict=True)]


def _names(people: Sequence[Path]) -> list[str]:
    """Return a unique name for each table: the name of its file, or of its folder if all files have the same name."""
    names = [path.stem for path in people]
    if len(set(names)) < len(names):
        names = [path.resolve().parent.name for path in people]
    if len(set(names)) < len(names):
        names = [f"{name}-{k}" for k, name in enumerate(names, 1)]
    return [name.replace(";", "-") for name in names]
