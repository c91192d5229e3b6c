"""`dddas detect`: moving targets from a moving camera."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.clips import clip_facts, folders_for, last_lines
from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Backend, Config, EngineOption, Overrides, Quiet, Rate
from torchvision_dddas.cli.progress import progress

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.io.output.run_record import DetectionRecord


@explained
def detect(
    inputs: Annotated[
        list[str],
        typer.Argument(metavar="INPUT...", help="A video file, a folder or glob of images, camera:0 or rtsp://..."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results; several inputs get a folder each in it.")] = Path(
        "dddas-out"
    ),
    config: Config = None,
    set_: Overrides = None,
    backend: EngineOption = Backend.auto,
    save: Annotated[
        str, typer.Option(metavar="NAMES", help="masks,overlay, all or none; the tables are always written.")
    ] = "all",
    telemetry: Annotated[
        Path | None, typer.Option(metavar="CSV", help="time_s,altitude_m,speed_m_s of the vehicle.")
    ] = None,
    rate: Rate = None,
    quiet: Quiet = False,
) -> None:
    """Find what moves in clips filmed by a moving camera.

    Writes detections.txt (MOTChallenge), detections.csv, masks/, overlay.mp4 and run.json under --out.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.io.output import DetectionRecorder, parse_save

    settings, names = load_config(config, set_ or []), parse_save(save, DetectionRecorder.saved)
    for clip, folder in zip(inputs, folders_for(inputs, out), strict=True):
        journal = detect_clip(clip, folder, settings, backend.value, names, telemetry, rate, quiet)
        if not quiet:
            for line in summary(journal, folder, names):
                typer.echo(line)


def detect_clip(
    clip: str,
    folder: Path,
    settings: "Settings",
    backend: str,
    save: Sequence[str],
    telemetry: Path | None = None,
    rate_hz: float | None = None,
    quiet: bool = False,
) -> "DetectionRecord":
    """Detect in one clip and write under a folder; returns the record of the run.

    Raises InputError for bad input, and KeyboardInterrupt after the outputs up to the last whole frame are in place.
    """
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.output import DetectionRecorder

    refuse_own_input([Path(clip)], [folder / name for name in DetectionRecorder.files], "folder with --out")
    with DetectionRecorder(folder, save) as output:
        from torchvision_dddas import open_video
        from torchvision_dddas.detection import detect_motion, load_engine
        from torchvision_dddas.io.telemetry import read_telemetry

        source = open_video(clip, rate_hz=rate_hz)
        flight = read_telemetry(telemetry, settings.aerial.clock_offset_s, clip) if telemetry else None
        engine = load_engine(backend, settings)
        facts = {
            "input": clip,
            "telemetry": telemetry,
            "clip": clip_facts(source),
            "backend": engine.name,
            "settings": settings.model_dump(),
        }
        journal = output.begin(facts, source.rate_hz)
        journal.notes += flight.notes if flight is not None else ()
        try:
            with progress(source.name, source.count, quiet) as tick:
                for scene in detect_motion(source, settings, engine, flight):
                    output.write(scene)
                    tick()
        finally:
            journal.problems += [str(problem) for problem in source.problems]
    return journal


def summary(journal: "DetectionRecord", folder: Path, save: Sequence[str]) -> list[str]:
    """What to tell the user at the end."""
    saved = {"masks": "masks/", "overlay": "overlay.mp4"}
    made = ["detections.csv", "detections.txt", *(saved[name] for name in save), "run.json"]
    doubtful = f"{journal.unreliable_frames} frames with unreliable registration"
    first = f"{journal.frames} frames, {journal.targets} targets, {doubtful}"
    return last_lines(first, journal, folder, made, journal.notes)
