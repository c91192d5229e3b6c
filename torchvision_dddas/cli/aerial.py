"""`dddas locate aerial`: from the picture to the ground, seen from the air."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Backend, Config, EngineOption, Overrides, Quiet, Rate, check_rate
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.io.run_inputs import AerialInput, read_locator

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.geo import AerialLocator
    from torchvision_dddas.io.output import Site
    from torchvision_dddas.io.output.run_record import AerialRecord, RunRecord

Marked = Annotated[
    Path, typer.Option("--landmarks", metavar="FILE", help="A CSV of landmarks: where they were, and where they show.")
]
Flown = Annotated[
    Path | None,
    typer.Option("--telemetry", metavar="FILE", help="What the vehicle reports: CSV, .SRT, .tlog, .ulg, KLV, NMEA."),
]
Lens = Annotated[Path | None, typer.Option("--camera", metavar="FILE", help="The TOML of the camera.")]
Heights = Annotated[
    Path | None, typer.Option("--dem", metavar="FILE", help="Heights of the ground, a GeoTIFF. [default: it is level]")
]
Background = Annotated[
    Path | None, typer.Option("--background", metavar="FILE", help="An ortho-photo under the map, a GeoTIFF.")
]


@explained
def aerial(
    table: Annotated[
        Path, typer.Argument(metavar="TABLE", help="Detections or tracks, CSV or MOTChallenge text, of the clip.")
    ],
    landmarks: Marked,
    telemetry: Flown = None,
    camera: Lens = None,
    dem: Heights = None,
    clip: Annotated[
        str | None, typer.Option(metavar="CLIP", help="The clip itself: for its rate and the size of its pictures.")
    ] = None,
    background: Background = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("dddas-positions"),
    config: Config = None,
    set_: Overrides = None,
    backend: EngineOption = Backend.auto,
    save: Annotated[
        str | None, typer.Option(metavar="NAMES", help="cot,map,report, all or none; tables are always written.")
    ] = None,
    rate: Rate = None,
    quiet: Quiet = False,
) -> None:
    """Locate what a clip shows from the air, by landmarks of known place and by what the vehicle reports.

    Writes positions.csv, fixes.csv (how each picture lies on the ground), maps, a report and run.json under --out.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.io.output import AerialRecorder, parse_save

    given = AerialInput(landmarks, telemetry, camera, dem, background)
    settings, names = load_config(config, set_ or []), parse_save(save, AerialRecorder.saved)
    journal = aerial_into(out, table, given, settings, clip, backend.value, names, rate, quiet)
    if not quiet:
        for line in summary(journal, out):
            typer.echo(line)


def aerial_into(
    folder: Path,
    table: Path,
    given: AerialInput,
    settings: "Settings",
    clip: str | None = None,
    backend: str = "auto",
    save: Sequence[str] = (),
    rate_hz: float | None = None,
    quiet: bool = False,
) -> "AerialRecord":
    """Locate and write under a folder; returns the record of the run. Raises InputError for bad input."""
    from torchvision_dddas import open_video
    from torchvision_dddas.geo import check_table, frames_to_locate, is_outside
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.detection_tables import check_within_clip, read_detections
    from torchvision_dddas.io.output import AerialRecorder

    check_rate(rate_hz)
    inputs = [table, *given.files, *([Path(clip)] if clip else [])]
    refuse_own_input(inputs, [folder / name for name in AerialRecorder.files], "folder with --out")
    with AerialRecorder(folder, save) as output:
        read = read_detections(table)
        source = open_video(clip, rate_hz=rate_hz) if clip else None
        rate = source.rate_hz if source is not None else rate_hz
        if source is not None:
            check_within_clip(read, source)
        size = source.size if source is not None else None
        locator, notes = read_locator(
            given, settings, size, rate, backend, (read.first, read.last), "table", clip, extent=read.extent
        )
        check_table(read, locator)
        facts = {"input": table, **given.facts, "rows": len(read), **about(locator), "settings": settings.model_dump()}
        journal = output.begin(facts, map_site(locator, given.background))
        journal.notes += notes
        if not len(read):
            journal.notes.append("the table has no rows: nothing to locate")
        elif read.identity is None or (read.identity < 1).all():
            journal.notes.append(
                "the table has no identities: targets are numbered anew in every frame, tracks are none"
            )
        if beyond := int(is_outside(locator, read.box_px[:, :2] + read.box_px[:, 2:] / 2).sum()):
            width, height = locator.camera.size_px
            journal.notes.append(
                f"{beyond} of {len(read)} boxes lie far outside the camera's pictures of {width} x {height} px: is its "
                "file for this size?"
            )
        with progress("locate", len(frames_to_locate(read, locator.site.landmarks)), quiet) as tick:
            for grounded in locator.locate_table(read):
                output.write(grounded)
                tick()
    return journal


def about(locator: "AerialLocator") -> dict[str, Any]:
    """What run.json says of how pictures were laid on the ground."""
    camera = locator.camera
    return {
        "origin_deg": locator.site.origin_deg,
        "rate_hz": locator.rate_hz,
        "lens": {"size_px": camera.size_px, "focal_px": camera.focal_px, "centre_px": camera.centre_px},
    }


def map_site(locator: "AerialLocator", background: Path | None) -> "Site":
    """What the maps show of the ground. Raises InputError for a background that cannot be read."""
    from functools import partial

    from torchvision_dddas import geometry
    from torchvision_dddas.io.elevation import read_ortho
    from torchvision_dddas.io.output import Site

    site = locator.site
    return Site(
        names=site.landmarks.names,
        origin_deg=site.origin_deg,
        start_utc_s=site.telemetry.start_utc_s if site.telemetry is not None else math.nan,
        rate_hz=locator.rate_hz,
        background=None if background is None else read_ortho(background, site.places, site.origin_deg),
        camera=locator.camera,
        to_degrees=None if site.origin_deg is None else partial(geometry.lonlat, origin_deg=site.origin_deg),
    )


def summary(journal: "AerialRecord", folder: Path) -> list[str]:
    """What to tell the user at the end."""
    from torchvision_dddas.io.output import AerialRecorder

    made = [name for name in AerialRecorder.files if (folder / name).exists()]
    first = f"{journal.frames} frames, {journal.targets} targets"
    notes = [f"note: {note}" for note in journal.notes]
    return [first, *ground_lines(journal), *notes, f"{folder}: {', '.join(made)}"]


def ground_lines(journal: "RunRecord") -> list[str]:
    """How many positions there are, by what, and how many frames could not be located."""
    counts: dict[str, Any] = {"positions": 0, "by": {}, **journal.counts}
    by = ", ".join(f"{count} by {name}" for name, count in counts["by"].items() if count and name != "nothing")
    lines = [f"{counts['positions']} positions; of the frames {by or 'none'}"]
    if gaps := counts["by"].get("nothing", 0):
        lines.append(f"note: {gaps} frames could not be located and have no positions; run.json says why")
    for what, words in (("weak", "located with something amiss"), ("repairs", "repaired")):
        if spans := counts.get(what):
            lines.append(f"note: {words}, {_longest(spans)}")
    for name, kept in counts.get("landmarks", {}).items():
        # In a frame that could not be located no landmark was used: that tells nothing of this one.
        tried = kept["used"] + kept["left_out"]
        if kept["left_out"] > 0.5 * tried:
            lines.append(
                f"note: {name} was left out in {kept['left_out']} of {tried} frames; is its place "
                "right, and does the ground rise or fall there (--dem)?"
            )
    return lines


def _longest(spans: Sequence[dict[str, Any]]) -> str:
    """The longest of the spans of frames of which the record says something, and how many more there are."""
    most = max(spans, key=lambda row: row["last"] - row["first"])
    first, last = most["first"], most["last"]
    where = f"frame {first}" if first == last else f"frames {first} to {last}"
    return f"{where}: {most['cause']}" + (f"; {len(spans) - 1} more such in run.json" if len(spans) > 1 else "")
