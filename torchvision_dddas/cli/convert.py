"""`dddas convert`: convert tables of detections, tracks and positions from one format to another."""

from pathlib import Path
from typing import Annotated

import typer

from torchvision_dddas.cli.options import BoxFormat, Quiet, echo, report_errors


@report_errors
def convert(
    table: Annotated[Path, typer.Argument(metavar="IN", help="A table of boxes or positions, in any known format.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The file to write, or a folder for yolo and davis.")],
    to: Annotated[
        str | None,
        typer.Option(
            metavar="FORMAT",
            help="csv, mot, visdrone, coco, yolo, cvat, davis, parquet, gpkg. [default: by the ending of OUT]",
        ),
    ] = None,
    clip: Annotated[
        str | None, typer.Option(metavar="CLIP", help="The clip, for the size and the names of the pictures.")
    ] = None,
    box_format: BoxFormat = None,
    quiet: Quiet = False,
) -> None:
    """Convert detections, tracks or positions to COCO, YOLO, CVAT, Parquet, GeoPackage and others."""
    from torchvision_dddas import open_video
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.detection_tables import read_for_clip, read_header
    from torchvision_dddas.io.ground_tables import POSITION_COLUMNS
    from torchvision_dddas.io.track_files import convert_positions, write_tracks

    refuse_own_input([table], [out], "OUT")
    source = None if clip is None else open_video(clip)
    names = [file.name for file in getattr(source, "files", ())]
    is_text = table.suffix.lower() in (".csv", ".parquet")
    notes: tuple[str, ...] = ()
    if is_text and set(POSITION_COLUMNS) <= set(read_header(table)):
        count, what = convert_positions(table, out, to), "positions"
    else:
        count, what = len(boxes := read_for_clip(table, box_format, source)), "boxes"
        size = None if source is None else source.size
        notes = (*boxes.notes, *write_tracks(boxes, out, to=to, size=size, pictures=names))
    if not quiet:
        echo(f"{count} {what} -> {out}")
        for note in notes:
            echo(f"note: {note}")
