"""`dddas run`: the whole path, from a clip to places on the ground."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchvision_dddas.cli.aerial import (
    Background,
    Flown,
    Heights,
    Lens,
    about,
    ground_lines,
    map_site,
)
from torchvision_dddas.cli.clips import clip_facts, last_lines
from torchvision_dddas.cli.mission import SIMULATED, fly
from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Backend, Config, EngineOption, Overrides, Quiet, Rate
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.run_inputs import AerialInput, prepare_run

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.io.output import RunRecord


@explained
def run(
    clip: Annotated[
        str,
        typer.Argument(
            metavar="CLIP", help="A video file, a folder or glob of images, camera:0, rtsp://... or sim:SCENARIO"
        ),
    ],
    landmarks: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A CSV of landmarks: where they were. [default: none located]")
    ] = None,
    telemetry: Flown = None,
    colours: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The TOML of the landmarks' colours, by `dddas colours`.")
    ] = None,
    camera: Lens = None,
    dem: Heights = None,
    background: Background = None,
    interval: Annotated[int, typer.Option(metavar="D", help="Follow targets at every D-th frame: 1, 1+D, ...")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("dddas-run"),
    config: Config = None,
    set_: Overrides = None,
    backend: EngineOption = Backend.auto,
    save: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="overlay,cot,map,report, all or none; of sim:NAME truth too; tables are always written.",
        ),
    ] = None,
    rate: Rate = None,
    scene: Annotated[
        list[str] | None,
        typer.Option("--scene", metavar="KNOB=VALUE", help="Change a parameter of a scenario (sim:NAME)."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the scenario's chances, in place of its own.")] = None,
    live: Annotated[
        bool,
        typer.Option("--live", help="Keep up with the pictures as they come; a folder of its own for each session."),
    ] = False,
    emit: Annotated[
        list[str] | None,
        typer.Option(
            metavar="STREAM",
            help="With --live: json:-, json:FILE, mot:FILE, cot:udp://HOST:PORT, ...; may be repeated.",
        ),
    ] = None,
    serve: Annotated[
        str | None,
        typer.Option(metavar="[HOST:]PORT", help="With --live: a page on how it goes, /metrics and /health.json."),
    ] = None,
    people: Annotated[bool, typer.Option("--people", help="With --live: recognize people too.")] = False,
    quiet: Quiet = False,
) -> None:
    """Find what moves in a clip from the air, give it lasting identities, and locate it by landmarks of known place.

    Writes the tables of `dddas detect`, `dddas track` and `dddas locate aerial`, landmarks.csv (where they were seen),
    overlay.mp4, maps, a report and run.json under --out.
    """
    from torchvision_dddas.config import load_config

    if interval < 1:
        raise InputError(f"--interval is {interval}; wanted 1 or more frames")
    _check_live(live, {"--emit": emit, "--serve": serve, "--people": people}, {"--save": save, "--scene": scene})
    _check_live(live, {}, {"--background": background, "--seed": seed})
    if clip.startswith(SIMULATED) and not live:
        files = {"--landmarks": landmarks, "--telemetry": telemetry, "--rate": rate, "--dem": dem}
        files |= {"--colours": colours, "--camera": camera, "--background": background}
        files["--interval"] = interval if interval != 1 else None
        fly(clip.removeprefix(SIMULATED), out, config, set_ or [], scene or [], seed, backend.value, save, files, quiet)
        return
    if scene or seed is not None:
        raise InputError(f"--scene and --seed change a simulated scenario, and {clip} is none; give sim:NAME")
    others = {"--colours": colours, "--camera": camera, "--dem": dem, "--background": background}
    if landmarks is None and (useless := [name for name, given in others.items() if given is not None]):
        raise InputError(f"{useless[0]} is of no use without --landmarks FILE: nothing would be located")
    given = None if landmarks is None else AerialInput(landmarks, telemetry, camera, dem, background, colours)
    settings = load_config(config, set_ or [])
    if live:
        from torchvision_dddas.cli.live import run_live

        raise typer.Exit(
            run_live(
                out, clip, given, telemetry, interval, settings, backend.value, emit or (), serve, people, rate, quiet
            )
        )
    from torchvision_dddas.io.output import PipelineRecorder, parse_save

    names = parse_save(save, PipelineRecorder.saved)
    journal = run_into(out, clip, given, telemetry, interval, settings, backend.value, names, rate, quiet)
    if not quiet:
        for line in summary(journal, out, given is not None, names):
            typer.echo(line)


def _check_live(live: bool, only: dict[str, Any], never: dict[str, Any]) -> None:
    """Raises InputError for an option that is of no use. only, never: what is given for --live alone, for others."""
    for option, given in (never if live else only).items():
        if given is not None and given is not False and given != []:
            raise InputError(
                f"{option} is of no use with --live, which draws and steers nothing"
                if live
                else f"{option} is for a run that keeps up with a camera; give --live too"
            )


def run_into(
    folder: Path,
    clip: str,
    given: AerialInput | None,
    telemetry: Path | None,
    interval: int,
    settings: "Settings",
    backend: str = "auto",
    save: Sequence[str] = (),
    rate_hz: float | None = None,
    quiet: bool = False,
) -> "RunRecord":
    """The whole path, written under a folder; returns the record of the run. given: None where nothing is located.

    Raises InputError for bad input, and KeyboardInterrupt after the outputs up to the last whole frame are in place.
    """
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.output import PipelineRecorder

    files = given.files if given is not None else [telemetry] if telemetry is not None else []
    refuse_own_input([Path(clip), *files], [folder / name for name in PipelineRecorder.files], "folder with --out")
    with PipelineRecorder(folder, save) as output:
        from torchvision_dddas import open_video
        from torchvision_dddas.pipeline import Pipeline

        source = open_video(clip, rate_hz=rate_hz)
        ready = prepare_run(given, telemetry, settings, source, backend, clip)
        settings, engine, watch, notes = ready.settings, ready.engine, ready.watch, ready.notes
        facts: dict[str, Any] = {
            "input": clip,
            "telemetry": telemetry,
            "clip": clip_facts(source),
            "interval_frames": interval,
            "backend": engine.name,
        }
        rate = source.rate_hz / interval
        if watch is not None and given is not None:
            facts |= {**given.facts, **about(watch.locator), "settings": settings.model_dump()}
            site = map_site(watch.locator, given.background)
            journal = output.begin(facts, rate, source.size, site)
        else:
            journal = output.begin({**facts, "settings": settings.model_dump()}, rate, source.size)
            notes.append("no --landmarks was given: nothing was located")
        journal.notes += notes
        try:
            count = None if source.count is None else -(-source.count // interval)
            with progress(source.name, count, quiet) as tick:
                pipeline = Pipeline.from_parts(engine, settings, ready.flight, watch, interval)
                for surveyed in pipeline(source):
                    output.write(surveyed)
                    tick()
        finally:
            journal.problems += [str(problem) for problem in source.problems]
    return journal


def summary(journal: "RunRecord", folder: Path, located: bool, save: Sequence[str]) -> list[str]:
    """What to tell the user at the end."""
    from torchvision_dddas.io.output import PipelineRecorder

    files = PipelineRecorder.files if located else PipelineRecorder.found_files
    made = [n for n in files if (folder / n).exists() and (n != "overlay.mp4" or "overlay" in save)]
    counts = journal.counts
    found = f"{journal.frames} frames, {journal.targets} targets, {counts.get('identities', 0)} identities"
    first, *others = last_lines(found, journal, folder, made, journal.notes)
    return [first, *(ground_lines(journal) if located else []), *others]
