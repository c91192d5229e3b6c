"""`dddas track`: identities of targets, from frame to frame."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.clips import clip_facts, last_lines
from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Backend, Config, EngineOption, Overrides, Quiet, Rate
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.detection import Engine
    from torchvision_dddas.io.output.run_record import TrackRecord
    from torchvision_dddas.types import DetectionTable, Source, TrackedFrame


@explained
def track(
    clip: Annotated[
        str | None,
        typer.Argument(metavar="INPUT", help="A video file, a folder or glob of images, camera:0 or rtsp://..."),
    ] = None,
    detections: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="MOTChallenge text, or detections.csv. [default: detect in INPUT]"),
    ] = None,
    interval: Annotated[int, typer.Option(metavar="D", help="Look at every D-th frame: 1, 1+D, 1+2D, ...")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("dddas-tracks"),
    config: Config = None,
    set_: Overrides = None,
    backend: EngineOption = Backend.auto,
    save: Annotated[
        str | None, typer.Option(metavar="NAMES", help="overlay, all or none; the tables are always written.")
    ] = None,
    rate: Rate = None,
    quiet: Quiet = False,
) -> None:
    """Give the targets of a clip identities that last: its own detections, or those of a table, with or without clip.

    Writes tracks.txt (MOTChallenge), tracks.csv, overlay.mp4 where there is a clip, and run.json under --out.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.io.output import TrackRecorder, parse_save

    settings, names = load_config(config, set_ or []), parse_save(save, TrackRecorder.saved)
    if clip is None and detections is None:
        raise InputError("track needs a clip, a table of detections (--detections FILE), or both; none was given")
    if interval < 1:
        raise InputError(f"--interval is {interval}; wanted 1 or more frames")
    if clip is None and save and names:
        raise InputError("--save overlay needs a clip to draw on; give INPUT, or leave --save out")
    if clip is None:
        names = ()
    journal = track_into(out, clip, detections, interval, settings, backend.value, names, rate, quiet)
    if not quiet:
        for line in summary(journal, out, names):
            typer.echo(line)


def track_into(
    folder: Path,
    clip: str | None,
    detections: Path | None,
    interval: int,
    settings: "Settings",
    backend: str = "auto",
    save: Sequence[str] = (),
    rate_hz: float | None = None,
    quiet: bool = False,
) -> "TrackRecord":
    """Track and write under a folder; returns the record of the run. One of clip and detections must be given.

    Raises InputError for bad input, and KeyboardInterrupt after the outputs up to the last whole frame are in place.
    """
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.output import TrackRecorder

    given = [Path(name) for name in (clip, detections) if name is not None]
    refuse_own_input(given, [folder / name for name in TrackRecorder.files], "folder with --out")
    with TrackRecorder(folder, save) as output:
        from torchvision_dddas import open_video
        from torchvision_dddas.detection import load_engine
        from torchvision_dddas.io.detection_tables import check_birth_score, check_table, read_detections
        from torchvision_dddas.types import is_sampled

        table = read_detections(detections) if detections is not None else None
        source = open_video(clip, rate_hz=rate_hz) if clip is not None else None
        notes = check_table(table, interval, source) if table is not None else []
        if table is not None and settings.track.mode == "default":
            notes += check_birth_score(table, settings.track.birth_score)
        engine = load_engine(backend, settings) if source is not None else None
        facts = {
            "input": clip,
            "detections": detections,
            "clip": source and clip_facts(source),
            "rows": None
            if table is None
            else {"given": len(table), "used": int(is_sampled(table.frame, interval).sum())},
            "interval_frames": interval,
            "backend": engine and engine.name,
            "settings": settings.model_dump(),
        }
        journal = output.begin(
            facts, (source.rate_hz if source else 10.0) / interval, source.size if source else (1, 1)
        )
        journal.notes += notes
        try:
            name = source.name if source is not None else str(detections)
            with progress(name, looks(table, source, interval), quiet) as tick:
                for followed in _followed(table, source, engine, settings, interval):
                    output.write(followed)
                    tick()
            if source is not None and table is not None and table.last > source.last:
                journal.notes.append(f"the clip ended after frame {source.last}, the table goes on to {table.last}")
        finally:
            journal.problems += [str(problem) for problem in source.problems] if source is not None else []
    return journal


def _followed(
    table: "DetectionTable | None",
    source: "Source | None",
    engine: "Engine | None",
    settings: "Settings",
    interval: int,
) -> "Iterator[TrackedFrame]":
    from torchvision_dddas.tracking import track_clip, track_scenes, track_table

    if source is None or engine is None:
        assert table is not None
        return track_table(table, settings, interval)
    if table is not None:
        return track_clip(source, table, engine, settings, interval)
    from torchvision_dddas.detection import detect_motion

    return track_scenes(detect_motion(source, settings, engine), settings, interval, source.size)


def looks(table: "DetectionTable | None", source: "Source | None", interval: int) -> int | None:
    """How many frames will be looked at; None where the end is not known."""
    last = source.count if source is not None else table.last if table is not None else None
    return None if last is None else -(-last // interval)


def summary(journal: "TrackRecord", folder: Path, save: Sequence[str]) -> list[str]:
    """What to tell the user at the end."""
    made = ["tracks.csv", "tracks.txt", *(f"{name}.mp4" for name in save), "run.json"]
    found = f"{journal.frames} frames, {journal.targets} detections, {journal.tracked.identities} identities"
    first = f"{found}, {journal.tracked.untracked} detections without one"
    return last_lines(first, journal, folder, made, journal.notes)
