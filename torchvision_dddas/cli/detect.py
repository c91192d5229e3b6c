"""`dddas detect`: find moving targets in clips of a moving camera."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.exits import noting
from torchvision_dddas.cli.options import (
    CLIP,
    Backend,
    ClassFile,
    Config,
    Detector,
    EngineOption,
    Ignore,
    LeastScore,
    Movers,
    OutPerInput,
    Overrides,
    Provider,
    Quiet,
    Rate,
    Telemetry,
    check_movers,
    load_settings,
    open_detector,
    print_lines,
    report_errors,
)
from torchvision_dddas.cli.progress import closing_lines, folders_for, record_results

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.detection import OnnxDetector


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
    detector: Detector = None,
    provider: Provider = None,
    score: LeastScore = None,
    classes: ClassFile = None,
    movers: Movers = False,
    quiet: Quiet = False,
) -> None:
    """Find what moves in clips filmed by a moving camera, or what a network of your own finds (--detector).

    Writes detections.txt (MOTChallenge), detections.csv, masks/, overlay.mp4 and run.json under --out. Without
    --movers a network has no masks.
    """
    from torchvision_dddas.io.output import DetectionRecorder, parse_save

    settings, names = load_settings(config, set_, ignore, quiet), parse_save(save, DetectionRecorder.saved)
    network = open_detector(detector, provider, score, classes)
    check_movers(network, movers, {"--telemetry": telemetry, "--ignore": ignore})
    if network is not None and not movers:
        names = tuple(name for name in names if name != "masks")
    done: list[str] = []
    with noting(lambda: f"all of {', '.join(done)} is kept", lambda: done):
        for clip, folder in zip(inputs, folders_for(inputs, out), strict=True):
            how = telemetry, rate, quiet, network, movers
            print_lines(detect_clip(clip, folder, settings, backend.value, names, *how), quiet)
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
    network: "OnnxDetector | None" = None,
    movers: bool = False,
) -> list[str]:
    """Detect in one clip, write under a folder, and return the closing lines. Raise InputError for bad input."""
    from torchvision_dddas import open_video
    from torchvision_dddas.detection import load_engine
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.output import DetectionRecorder, clip_facts
    from torchvision_dddas.pipeline import clip_notes, find_scenes, note_uncovered, note_unused, prepare_detection

    given = [Path(clip), *([network.path] if network is not None else [])]
    refuse_own_input(given, [folder / name for name in DetectionRecorder.files], "folder with --out")
    with DetectionRecorder(folder, save) as output:
        source = open_video(clip, rate_hz=rate_hz, full_scale=settings.levels.given)
        settings, flight, notes = prepare_detection(telemetry, settings, source, clip)
        engine = load_engine(backend, settings)
        facts = {
            "input": clip,
            "telemetry": telemetry,
            "clip": clip_facts(source),
            "backend": engine.name,
            **({"detector": network.facts, "movers": movers} if network is not None else {}),
            "settings": settings.model_dump(),
        }
        record = output.begin(facts, source.rate_hz)
        record.notes += [*notes, *(network.notes if network is not None else ())]
        if network is not None and not movers:
            record.scale = None  # the scale belongs to the search for movers
            record.notes += note_unused(settings)
        found = find_scenes(source, settings, engine, flight, network, movers)
        scenes = note_uncovered(found, flight, record.notes)
        record_results(output, record, scenes, source.name, source.count, quiet, source)
        record.notes += clip_notes(source, 1, settings) if network is None or movers else []
    saved = {"masks": "masks/", "overlay": "overlay.mp4"}
    files = ["detections.csv", "detections.txt", *(saved[name] for name in save), "run.json"]
    doubtful = f"{record.unreliable_frames} frames with unreliable registration"
    return closing_lines(f"{record.frames} frames, {record.targets} detections, {doubtful}", record, folder, files)
