"""`dddas track`: give targets identities that last from frame to frame."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.options import (
    CLIP,
    Backend,
    BoxFormat,
    ClassFile,
    Config,
    Detector,
    EngineOption,
    Ignore,
    LeastScore,
    Movers,
    Out,
    Overrides,
    Provider,
    Quiet,
    Rate,
    Telemetry,
    check_interval,
    check_movers,
    load_settings,
    open_detector,
    print_lines,
    report_errors,
)
from torchvision_dddas.cli.progress import closing_lines, record_results
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.detection import Engine, OnnxDetector
    from torchvision_dddas.types import DetectionTable, Source, TrackedFrame
    from torchvision_dddas.types import Telemetry as Flown


@report_errors
def track(
    clip: Annotated[str | None, typer.Argument(metavar="INPUT", help=CLIP)] = None,
    detections: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="MOTChallenge text, a CSV, or YOLO's labels. [default: detect in INPUT]"),
    ] = None,
    box_format: BoxFormat = None,
    interval: Annotated[int, typer.Option(metavar="D", help="Track at every D-th frame: 1, 1+D, 1+2D, ...")] = 1,
    out: Out = Path("dddas-tracks"),
    config: Config = None,
    set_: Overrides = None,
    backend: EngineOption = Backend.auto,
    save: Annotated[
        str | None, typer.Option(metavar="NAMES", help="overlay, all or none; the tables are always written.")
    ] = None,
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
    """Give lasting identities to targets found in a clip, or to targets of a table, with or without its clip.

    Writes tracks.txt (MOTChallenge), tracks.csv and run.json under --out. With a clip, also writes overlay.mp4 and
    appearance.csv (why the association used appearance, or not). --backend chooses the engine of detection and
    registration, and with --config paper also of the source's histograms and affinities. The default association
    does not run in torch.
    """
    from torchvision_dddas import open_video
    from torchvision_dddas.detection import load_engine
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.detection_tables import check_table, read_for_clip
    from torchvision_dddas.io.output import TrackRecorder, clip_facts, parse_save
    from torchvision_dddas.pipeline import clip_notes, note_unused, prepare_detection
    from torchvision_dddas.types import is_sampled

    settings, names = load_settings(config, set_, ignore, quiet), parse_save(save, TrackRecorder.saved)
    if clip is None and detections is None:
        raise InputError("track needs a clip, a table of detections (--detections FILE), or both; none was given")
    check_interval(interval)
    if telemetry is not None and (clip is None or detections is not None):
        raise InputError("--telemetry is for the detection in a clip; give INPUT, and leave --detections out")
    if clip is None and save and names:
        raise InputError("--save overlay needs a clip to draw on; give INPUT, or leave --save out")
    names = () if clip is None else names
    network = open_detector(detector, provider, score, classes)
    if network is not None and (clip is None or detections is not None):
        raise InputError("--detector looks at the pictures of a clip; give INPUT, and leave --detections out")
    check_movers(network, movers, {"--telemetry": telemetry, "--ignore": ignore})
    inputs = [Path(name) for name in (clip, detections, telemetry, detector, classes) if name is not None]
    refuse_own_input(inputs, [out / name for name in TrackRecorder.files], "folder with --out")
    with TrackRecorder(out, names) as output:
        source = open_video(clip, rate_hz=rate, full_scale=settings.levels.given) if clip is not None else None
        table = read_for_clip(detections, box_format, source) if detections is not None else None
        notes = check_table(table, interval, source) if table is not None else []
        flight = None
        if source is not None and clip is not None:
            settings, flight, more = prepare_detection(telemetry, settings, source, clip)
            notes += [*more, *(network.notes if network is not None else ())]
        engine = load_engine(backend.value, settings) if source is not None else None
        facts = {
            "input": clip,
            "detections": detections,
            "telemetry": telemetry,
            "clip": source and clip_facts(source),
            "rows": None
            if table is None
            else {"given": len(table), "used": int(is_sampled(table.frame, interval).sum())},
            "interval_frames": interval,
            "backend": engine and engine.name,
            **({"detector": network.facts, "movers": movers} if network is not None else {}),
            "settings": settings.model_dump(),
        }
        rate_hz, size = (source.rate_hz, source.size) if source is not None else (10.0, (1, 1))
        record = output.begin(facts, rate_hz / interval, size)
        record.notes += notes
        record.notes += note_unused(settings) if table is not None or (network is not None and not movers) else []
        if network is not None and not movers:
            record.scale = None  # the scale belongs to the search for movers
        last = source.count if source is not None else table.last if table is not None else None
        record_results(
            output,
            record,
            _track(table, source, engine, settings, interval, backend.value, flight, record.notes, network, movers),
            source.name if source is not None else str(detections),
            None if last is None else -(-last // interval),
            quiet,
            source,
        )
        if source is not None and (network is None or movers):
            record.notes += clip_notes(source, interval, settings)
        if source is not None and table is not None and table.last > source.last:
            record.notes.append(f"the clip ended after frame {source.last}, the table goes on to {table.last}")
    counts = record.counts
    found = f"{record.frames} frames, {record.targets} detections, {counts.get('identities', 0)} identities"
    files = [name for name in TrackRecorder.files if (out / name).exists() and (name != "overlay.mp4" or names)]
    print_lines(
        closing_lines(f"{found}, {counts.get('untracked', 0)} detections without identity", record, out, files), quiet
    )


def _track(
    table: "DetectionTable | None",
    source: "Source | None",
    engine: "Engine | None",
    settings: "Settings",
    interval: int,
    backend: str,
    flight: "Flown | None",
    notes: list[str],
    network: "OnnxDetector | None",
    movers: bool,
) -> "Iterator[TrackedFrame]":
    from torchvision_dddas.detection import detect_motion
    from torchvision_dddas.pipeline import Assembly, Pipeline, note_uncovered
    from torchvision_dddas.tracking import track_clip, track_scenes, track_table

    if source is None or engine is None:
        assert table is not None
        return track_table(table, settings, interval)
    if table is not None:
        return track_clip(source, table, engine, settings, interval, backend)
    if network is not None:
        ready = Assembly(settings, engine, flight)
        results = Pipeline.from_assembly(ready, interval=interval, detector=network, movers=movers)(source)
        return (result.tracked for result in results)
    scenes = note_uncovered(detect_motion(source, settings, engine, flight), flight, notes)
    return track_scenes(scenes, settings, interval, source.size, backend=backend, rate_hz=source.rate_hz)
