"""`dddas views`: find identities that the tables of several cameras share."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.options import Out, Quiet, check_rate, print_lines, report_errors
from torchvision_dddas.cli.progress import closing_lines, record_results
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.types import DetectionTable, Positions


@report_errors
def views(
    tables: Annotated[
        list[Path], typer.Argument(metavar="TABLE TABLE...", help="Tracks of each camera: boxes, or positions.csv.")
    ],
    rate: Annotated[
        list[float] | None,
        typer.Option(metavar="HZ", help="Frames per second of each table, in order, if they differ."),
    ] = None,
    out: Out = Path("dddas-views"),
    quiet: Quiet = False,
) -> None:
    """Give each target that several cameras see one shared identity, from the tracks of each camera.

    The cameras may move, and their views may overlap only in part. Writes view1.csv, view2.csv, ... (the rows of each
    table with the shared identity), pairs.csv, maps.csv and run.json under --out.
    """
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.detection_tables import read_header, read_rows
    from torchvision_dddas.io.output import ViewsRecorder
    from torchvision_dddas.tracking import share_identities

    rates = rate or []
    for rate_hz in rates:
        check_rate(rate_hz)
    if len(tables) < 2:
        raise InputError("views needs the tables of two cameras or more, got one; give the other view too")
    if rates and len(rates) != len(tables):
        raise InputError(f"{len(rates)} rates and {len(tables)} tables; give --rate once for each table, in order")
    has_places = ["east_m" in read_header(path) for path in tables]
    if len(set(has_places)) > 1:
        raise InputError("some tables have positions and others boxes; give one kind for all")
    with ViewsRecorder(out) as output:
        written = [*out.glob("view*.csv"), *(out / name for name in ("pairs.csv", "maps.csv", "run.json"))]
        refuse_own_input(tables, written, "folder with --out")
        notes: list[str] = []
        given = [_read(path, has_places[0], notes) for path in tables]
        ends = [int(table.frame.max(initial=0)) for table in given]
        if not rates and min(ends) < 0.7 * max(ends):
            numbers = ", ".join(map(str, ends))
            notes.append(f"the tables end at frames {numbers}: give --rate for each if their frame rates differ")
        facts = {"tables": list(tables), "rates_hz": rates or None}
        own = "target" if has_places[0] else "identity"
        cells = [read_rows(path) for path in tables]
        record = output.begin(facts, own, cells)
        record.notes += notes
        record_results(output, record, share_identities(given, rates), "views", None, quiet)
        output.note_overlap()
    counts = record.counts
    first = f"{record.frames} moments, {counts['identities']} identities, {counts['shared']} of them in several views"
    files = [*(f"view{k}.csv" for k in range(1, len(tables) + 1)), "pairs.csv", "maps.csv", "run.json"]
    print_lines(closing_lines(first, record, out, files), quiet)


def _read(path: Path, has_places: bool, notes: list[str]) -> "DetectionTable | Positions":
    """Read the table of a view. Raise InputError for boxes without identities."""
    from torchvision_dddas.io.detection_tables import read_detections
    from torchvision_dddas.io.ground_tables import read_positions

    table: DetectionTable | Positions = read_positions(path) if has_places else read_detections(path)
    if not len(table):
        notes.append(f"{path} has no rows, so it shares no target with the other views")
    elif not has_places:
        identity = getattr(table, "identity", None)
        if identity is None or (identity < 1).all():
            raise InputError(f"{path} has no identities; track its boxes first: dddas track --detections {path}")
        if loose := int((identity < 1).sum()):
            notes.append(f"{loose} of {len(table)} rows of {path} have no identity: each counts as a target of its own")
    return table
