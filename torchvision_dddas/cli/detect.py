"""`dddas detect`: moving targets from a moving camera."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Backend, Config, Engine, Overrides, Quiet, Rate
from torchvision_dddas.cli.progress import progress

if TYPE_CHECKING:
    from torchvision_dddas.settings import Settings
    from torchvision_dddas.sinks.journal import Journal


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
    backend: Engine = Backend.auto,
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
    from torchvision_dddas.settings import load
    from torchvision_dddas.sinks import saved

    settings, names = load(config, set_ or []), saved(save)
    folders = [out] if len(inputs) == 1 else [out / name for name in clip_names(inputs)]
    for clip, folder in zip(inputs, folders, strict=True):
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
) -> "Journal":
    """Detect in one clip and write under a folder; returns the record of the run.

    Raises InputError for bad input, and KeyboardInterrupt after the outputs up to the last whole frame are in place.
    """
    from torchvision_dddas.sinks import Output

    with Output(folder, save) as output:
        from torchvision_dddas.run import run
        from torchvision_dddas.sources import open_source
        from torchvision_dddas.sources.telemetry import read_telemetry
        from torchvision_dddas.vision import load

        source = open_source(clip, rate_hz=rate_hz)
        flight = read_telemetry(telemetry) if telemetry else None
        vision = load(backend, settings)
        facts = {
            "input": clip,
            "telemetry": telemetry,
            "clip": {
                "name": source.name,
                "size": source.size,
                "rate_hz": source.rate_hz,
                "announced_frames": source.count,
            },
            "backend": vision.name,
            "settings": settings.model_dump(),
        }
        journal = output.begin(facts, source.rate_hz)
        try:
            with progress(source.name, source.count, quiet) as tick:
                for scene in run(source, vision, settings, flight):
                    output.write(scene)
                    tick()
        finally:
            journal.problems += [str(problem) for problem in source.problems]
    return journal


def clip_names(inputs: Sequence[str]) -> list[str]:
    """A folder name for each input, no two alike: its own name, or its parent's where that says more than `frames`."""
    names: list[str] = []
    for clip in inputs:
        path = Path(clip.rstrip("/"))
        dull = [p.name in ("", "frames", "images") or bool(re.search(r"[*?\[]", p.name)) for p in (path, *path.parents)]
        named = path if all(dull) else (path, *path.parents)[dull.index(False)]
        name = named.stem if named == path and not path.is_dir() else named.name
        name = same = re.sub(r"[^\w.-]+", "-", name).strip("-.") or "clip"
        for k in range(2, len(inputs) + 1):
            if same not in names:
                break
            same = f"{name}-{k}"
        names.append(same)
    return names


def summary(journal: "Journal", folder: Path, save: Sequence[str]) -> list[str]:
    """What to tell the user at the end."""
    saved = {"masks": "masks/", "overlay": "overlay.mp4"}
    made = ["detections.csv", "detections.txt", *(saved[name] for name in save), "run.json"]
    doubtful = f"{journal.unreliable_frames} frames with unreliable registration"
    lines = [f"{journal.frames} frames, {journal.targets} targets, {doubtful}", f"{folder}: {', '.join(made)}"]
    if count := len(journal.problems):
        lines.insert(1, f"{count} problems while reading, the first: {journal.problems[0]} (all in run.json)")
    return lines
