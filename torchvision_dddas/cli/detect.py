"""`dddas detect`: find moving targets in clips of a moving camera."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.exits import noting
from torchvision_dddas.cli.options import (
    CLIP,
    Backend,
    Config,
    EngineOption,
    Ignore,
    OutPerInput,
    Overrides,
    Quiet,
    Rate,
    Telemetry,
    load_settings,
    print_lines,
    report_errors,
)
from torchvision_dddas.cli.progress import closing_lines, folders_for, record_results

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings


@report_errors
def detect(
    inputs: Annotated[list[str], typer.Argument(metavar="INPUT...", help=CLIP)],
    out: OutPerInput = Path("dddas-out"),
    config: Config = None,
    set_: Overrides = None,
    backend: EngineOption = Backend.auto,
    save: Annotated[
        str, typer.Option(metavar="NAMES", help="masks,overlay, all or none; the tables are always written.")
    ] = "all",
    telemetry: Telemetry = None,
    rate: Rate = None,
    ignore: Ignore = None,
    quiet: Quiet = False,
) -> None:
    """Find what moves in clips filmed by a moving camera.

    Writes detections.txt (MOTChallenge), detections.csv, masks/, overlay.mp4 and run.json under --out.
    """
    from torchvision_dddas.io.output import DetectionRecorder, parse_save

    settings, names = load_settings(config, set_, ignore, quiet), parse_save(save, DetectionRecorder.saved)
    done: list[str] = []
    with noting(lambda: f"all of {', '.join(done)} is kept", lambda: done):
        for clip, folder in zip(inputs, folders_for(inputs, out), strict=True):
            print_lines(detect_clip(clip, folder, settings, backend.value, names, telemetry, rate, quiet), quiet)
            done.append(folder.name)


def detect_clip(
    clip: str,
    folder: Path,
    settings: "Settings",
    backend: str,
    save: Sequence[str],
    telemetry: Path | None = None,
    rate_hz: float | None = None,
    quiet: bool = False,
) -> list[str]:
    """Detect in one clip, write under a folder, and return the closing lines. Raise InputError for bad input."""
    from torchvision_dddas import open_video
    from torchvision_dddas.detection import detect_motion, load_engine
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.output import DetectionRecorder, clip_facts
    from torchvision_dddas.pipeline import clip_notes, note_uncovered, prepare_detection

    refuse_own_input([Path(clip)], [folder / name for name in DetectionRecorder.files], "folder with --out")
    with DetectionRecorder(folder, save) as output:
        source = open_video(clip, rate_hz=rate_hz, full_scale=settings.levels.given)
        settings, flight, notes = prepare_detection(telemetry, settings, source, clip)
        engine = load_engine(backend, settings)
        facts = {
            "input": clip,
            "telemetry": telemetry,
            "clip": clip_facts(source),
            "backend": engine.name,
            "settings": settings.model_dump(),
        }
        record = output.begin(facts, source.rate_hz)
        record.notes += notes
        scenes = note_uncovered(detect_motion(source, settings, engine, flight), flight, record.notes)
        record_results(output, record, scenes, source.name, source.count, quiet, source)
        record.notes += clip_notes(source, 1, settings)
    saved = {"masks": "masks/", "overlay": "overlay.mp4"}
    files = ["detections.csv", "detections.txt", *(saved[name] for name in save), "run.json"]
    doubtful = f"{record.unreliable_frames} frames with unreliable registration"
    return closing_lines(f"{record.frames} frames, {record.targets} detections, {doubtful}", record, folder, files)
