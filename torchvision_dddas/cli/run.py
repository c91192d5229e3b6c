"""`dddas run`: the whole path, from a clip to places on the ground."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchvision_dddas.cli.aerial import (
    AerialInput,
    Background,
    Flown,
    Heights,
    Lens,
    about,
    ground_facts,
    ground_lines,
    locator_for,
)
from torchvision_dddas.cli.clips import clip_facts, last_lines
from torchvision_dddas.cli.mission import SIMULATED, fly
from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Backend, Config, Engine, Overrides, Quiet, Rate
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.geolocating import Locator, Watch
    from torchvision_dddas.settings import Settings
    from torchvision_dddas.sinks.journal import Record
    from torchvision_dddas.sources import Source


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
    backend: Engine = Backend.auto,
    save: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="overlay,cot,map,report, all or none; of sim:NAME truth too; tables are always written.",
        ),
    ] = None,
    rate: Rate = None,
    scene: Annotated[
        list[str] | None, typer.Option("--scene", metavar="KNOB=VALUE", help="Change a knob of a scenario (sim:NAME).")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the scenario's chances, in place of its own.")] = None,
    quiet: Quiet = False,
) -> None:
    """Find what moves in a clip from the air, give it lasting identities, and locate it by landmarks of known place.

    Writes the tables of `dddas detect`, `dddas track` and `dddas locate aerial`, landmarks.csv (where they were seen),
    overlay.mp4, maps, a report and run.json under --out.
    """
    from torchvision_dddas.settings import load
    from torchvision_dddas.sinks import saved
    from torchvision_dddas.sinks.survey_output import SAVED

    if interval < 1:
        raise InputError(f"--interval is {interval}; wanted 1 or more frames")
    if clip.startswith(SIMULATED):
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
    settings, names = load(config, set_ or []), saved(save, SAVED)
    journal = run_into(out, clip, given, telemetry, interval, settings, backend.value, names, rate, quiet)
    if not quiet:
        for line in summary(journal, out, given is not None, names):
            typer.echo(line)


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
) -> "Record":
    """The whole path, written under a folder; returns the record of the run. given: None where nothing is located.

    Raises InputError for bad input, and KeyboardInterrupt after the outputs up to the last whole frame are in place.
    """
    from torchvision_dddas.sinks.survey_output import FoundOutput, SurveyOutput
    from torchvision_dddas.sinks.whole import refuse_own_input

    kind = FoundOutput if given is None else SurveyOutput
    files = given.files if given is not None else [telemetry] if telemetry is not None else []
    refuse_own_input([Path(clip), *files], [folder / name for name in kind.files], "folder with --out")
    with kind(folder, save) as output:
        from torchvision_dddas.sources import open_source
        from torchvision_dddas.sources.telemetry import read_telemetry
        from torchvision_dddas.surveying import survey
        from torchvision_dddas.vision import load

        source = open_source(clip, rate_hz=rate_hz)
        watch, notes = (None, []) if given is None else _watch(given, settings, source, backend)
        flight = None
        if watch is not None:
            flight = watch.locator.site.telemetry
            settings, more = _sized(settings, watch.locator)
            notes += more
        elif telemetry is not None:
            flight = read_telemetry(telemetry, settings.aerial.clock_offset_s, clip)
        vision = load(backend, settings)
        facts: dict[str, Any] = {
            "input": clip,
            "telemetry": telemetry,
            "clip": clip_facts(source),
            "interval_frames": interval,
            "backend": vision.name,
        }
        journal: Record
        rate = source.rate_hz / interval
        if isinstance(output, SurveyOutput):
            assert given is not None
            assert watch is not None
            site = watch.locator.site
            facts |= {**given.facts, **about(watch.locator), "settings": settings.model_dump()}
            journal = output.begin(facts, **ground_facts(watch.locator, given.background))
            output.also(journal, rate, source.size, site.landmarks.names, site.origin_deg is not None)
            write = output.survey
        else:
            journal = output.begin({**facts, "settings": settings.model_dump()}, rate, source.size)
            write = output.write
            notes.append("no --landmarks was given: nothing was located")
        journal.notes += notes
        try:
            count = None if source.count is None else -(-source.count // interval)
            with progress(source.name, count, quiet) as tick:
                for surveyed in survey(source, vision, settings, flight, watch, interval):
                    write(surveyed)
                    tick()
        finally:
            journal.problems += [str(problem) for problem in source.problems]
    return journal


def _watch(given: AerialInput, settings: "Settings", source: "Source", backend: str) -> "tuple[Watch, list[str]]":
    from torchvision_dddas.geolocating import Watch, check_colours
    from torchvision_dddas.sources.colours import read_colours
    from torchvision_dddas.vision import load_colours

    colours = read_colours(given.colours) if given.colours is not None else None
    frames = None if source.count is None else (1, source.count)
    locator, notes = locator_for(
        given, settings, source.size, source.rate_hz, backend, frames, "clip", source.name, colours
    )
    helped = locator.site.telemetry is not None and settings.aerial.mode == "pose"
    check_colours(locator.site.landmarks, colours, helped)
    if colours is not None and (bare := [n for n in locator.site.landmarks.names if n not in colours.names]):
        notes.append(f"no colour is given for {', '.join(bare)}: not looked for in the pictures")
    return Watch(locator, colours, load_colours(backend) if colours is not None else None), notes


def _sized(settings: "Settings", locator: "Locator") -> "tuple[Settings, list[str]]":
    """With the camera's own focal length where targets' sizes are told from the altitude, unless another is set."""
    from torchvision_dddas.settings import Settings, with_knobs

    focal = locator.camera.focal_px[0]
    if locator.site.telemetry is None or settings.gates.focal_px != Settings().gates.focal_px:
        return settings, []
    note = f"gates.focal_px is the camera's {focal:.0f} px, so that sizes in metres hold"
    return with_knobs(settings, {"gates.focal_px": focal}), [note]


def summary(journal: "Record", folder: Path, located: bool, save: Sequence[str]) -> list[str]:
    """What to tell the user at the end."""
    from torchvision_dddas.sinks.survey_output import ALL, FOUND

    files = ALL if located else FOUND
    made = [n for n in files if (folder / n).exists() and (n != "overlay.mp4" or "overlay" in save)]
    counts = journal.counts
    found = f"{journal.frames} frames, {journal.targets} targets, {counts.get('identities', 0)} identities"
    first, *others = last_lines(found, journal, folder, made, journal.notes)
    return [first, *(ground_lines(journal) if located else []), *others]
