"""`dddas run`: the whole path, from a clip or a simulated scenario to places on the ground."""

import os
import re
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

import typer

from torchvision_dddas.cli.exits import Ended
from torchvision_dddas.cli.locate import Background, CameraFile, Elevation, Geoid, position_lines, print_located
from torchvision_dddas.cli.options import (
    CLIP,
    REPORTS,
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
    check_interval,
    load_settings,
    note_patrol,
    open_detector,
    print_lines,
    refuse_options,
    report_errors,
)
from torchvision_dddas.cli.progress import closing_lines, progress, record_results
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.geo import Zones
    from torchvision_dddas.io.output import RunRecord


SIMULATED = "sim:"
PASSWORD = "DDDAS_PASSWORD"  # in the environment
_LOGIN = re.compile(r"([a-z][a-z0-9+.-]*://[^/?#@:]+)@(.*)", re.I | re.S)


class Latency(StrEnum):
    """When a live run gives identities: at once and provisionally, or when they are settled."""

    settled = "settled"
    now = "now"


@report_errors
def run(
    clips: Annotated[
        list[str], typer.Argument(metavar="CLIP...", help=f"sim:SCENARIO. {CLIP} Several of one flight, in order.")
    ],
    landmarks: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="A CSV of landmarks; live also udp:, mavlink:, cot:. [default: no landmarks]"
        ),
    ] = None,
    telemetries: Annotated[
        list[Path] | None,
        typer.Option(
            "--telemetry",
            metavar="FILE",
            help=f"{REPORTS} Of several clips one of each, or one of all. With --live also as it comes: "
            "a growing CSV, a FIFO, -, klv, udp:, nmea:, gpsd:, mavlink:",
        ),
    ] = None,
    colours: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The TOML of the landmarks' colours, by `dddas colours`.")
    ] = None,
    camera: CameraFile = None,
    dem: Elevation = None,
    geoid: Geoid = None,
    background: Background = None,
    interval: Annotated[int, typer.Option(metavar="D", help="Track at every D-th frame: 1, 1+D, ...")] = 1,
    out: Out = Path("dddas-run"),
    config: Config = None,
    set_: Overrides = None,
    backend: EngineOption = Backend.auto,
    save: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="overlay,cot,map,report, all or none; with sim:NAME also truth; tables are always written. "
            "With --live: overlay,clips. [default: all; with --live none]",
        ),
    ] = None,
    rate: Rate = None,
    ignore: Ignore = None,
    detections: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Boxes and classes of your own detector. [default: find what moves]"),
    ] = None,
    box_format: BoxFormat = None,
    detector: Detector = None,
    provider: Provider = None,
    score: LeastScore = None,
    classes: ClassFile = None,
    movers: Movers = False,
    zones: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="GeoJSON or KML of areas and lines: who enters, leaves, dwells, crosses."),
    ] = None,
    ground: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE", help="The TOML of a ground platform: its clip, camera and poses. May be repeated."
        ),
    ] = None,
    aerial: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="The TOML of a further UAV: its clip, its telemetry. May be repeated."),
    ] = None,
    scene: Annotated[
        list[str] | None,
        typer.Option(
            "--scene", metavar="PARAMETER=VALUE", help="Change a parameter of sim:NAME; see dddas settings scenario."
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Random seed of the scenario, in place of its own.")] = None,
    live: Annotated[
        bool,
        typer.Option("--live", help="Keep up with pictures as they arrive; each session gets its own folder in --out."),
    ] = False,
    emit: Annotated[
        list[str] | None,
        typer.Option(
            metavar="STREAM",
            help="With --live: json:-, json:FILE, mot:FILE, cot:udp://HOST:PORT, video:udp://...; may be repeated.",
        ),
    ] = None,
    serve: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:]PORT",
            help="With --live: serve a page with the picture, a map and targets; /metrics and /health.json.",
        ),
    ] = None,
    serve_token: Annotated[
        str | None,
        typer.Option(
            metavar="TOKEN",
            help="Ask for this token, else $DDDAS_SERVE_TOKEN. [default: with a HOST beyond this machine a new token]",
        ),
    ] = None,
    people: Annotated[bool, typer.Option("--people", help="With --live: also recognize people.")] = False,
    password_file: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help=f"Its first line is the password of rtsp://NAME@HOST/..., else ${PASSWORD}."),
    ] = None,
    wait: Annotated[
        bool, typer.Option("--wait", help="With --live: wait for a camera or stream that is not there yet.")
    ] = False,
    latency: Annotated[
        Latency | None,
        typer.Option(
            help="With --live: now gives provisional identities at once. [default: settled]", show_default=False
        ),
    ] = None,
    command: Annotated[
        str | None,
        typer.Option(
            metavar="LINK",
            help="With --live: a vehicle, mavlink:udp:HOST:PORT, ...; its commands are printed, and not sent.",
        ),
    ] = None,
    allow_commands: Annotated[
        bool, typer.Option("--allow-commands", help="Send the commands, inside --geofence and --altitude-band.")
    ] = False,
    geofence: Annotated[
        str | None,
        typer.Option(metavar="FILE|LON,LAT,M", help="GeoJSON or KML of polygons, or a circle: where it may fly."),
    ] = None,
    altitude_band: Annotated[
        str | None, typer.Option(metavar="LOW,HIGH", help="Metres above home between which it may fly.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Find what moves in a clip from the air, give it lasting identities, and locate it.

    Places come from what the vehicle reports (--telemetry), from landmarks of known place (--landmarks), or from both.

    Writes the tables of `dddas detect`, `dddas track` and `dddas locate aerial`, landmarks.csv (where they were seen),
    overlay.mp4, maps, a report and run.json under --out; with --ground also confirmed.csv
    and fused.csv; of a simulation also crowds.csv (crowds as ground vehicles see them).
    """
    from torchvision_dddas.geo import Zones
    from torchvision_dddas.pipeline import AerialInput

    check_interval(interval)
    placed = None if zones is None else Zones(zones)
    clip = _with_password(clips[0], password_file)
    logs = telemetries or []
    telemetry = logs[0] if logs else None
    if len(clips) > 1 and (live or any(name.startswith(SIMULATED) for name in clips)):
        raise InputError(f"{len(clips)} clips were given; wanted one with --live, and one sim:SCENARIO")
    if len(clips) == 1 < len(logs):
        raise InputError(f"one clip and {len(logs)} logs; give one --telemetry")
    platforms = {"--ground": ground[0] if ground else None, "--aerial": aerial[0] if aerial else None}
    given_boxes = {"--detections": detections, "--detector": detector, "--movers": movers or None}
    limits = {"--allow-commands": allow_commands or None, "--geofence": geofence, "--altitude-band": altitude_band}
    if live:
        others: dict[str, object] = {"--scene": scene, "--background": background, "--seed": seed}
        why = "is of no use with --live: a live run cannot take a table of boxes; give a network with --detector"
        refuse_options({"--detections": detections}, why)
        refuse_options(others, "is of no use with --live, which draws no maps and simulates nothing")
        if command is None:
            refuse_options(limits, "is for --command mavlink:...; give it too")
        if serve is None:
            refuse_options({"--serve-token": serve_token}, "is for --serve PORT; give it too")
    else:
        others = {"--emit": emit, "--serve": serve, "--serve-token": serve_token, "--command": command}
        others |= {"--people": people or None, "--wait": wait or None, "--latency": latency}
        refuse_options({**others, **limits}, "is for a run that keeps up with a camera; give --live too")
        for file in (file for file in (*logs, landmarks) if file is not None and not file.exists()):
            from torchvision_dddas.live import is_live_input

            if is_live_input(str(file)):
                raise InputError(f"{file} comes live, beside a camera or a stream; give --live, or a file")
    beside = {"--colours": colours, "--camera": camera, "--dem": dem, "--geoid": geoid, "--background": background}
    if clip.startswith(SIMULATED) and not live and not Path(clip).exists():
        inputs = {"--landmarks": landmarks, "--telemetry": telemetry, "--rate": rate, "--ignore": ignore, **beside}
        inputs |= {**given_boxes, **platforms}
        inputs["--interval"] = None if interval == 1 else interval
        refuse_options(inputs, f"is of no use with {clip}: it comes from the simulated vehicles")
        _fly(
            clip.removeprefix(SIMULATED), out, config, set_ or [], scene or [], seed, backend.value, save, quiet, placed
        )
        return
    if scene or seed is not None:
        raise InputError(f"--scene and --seed change a simulated scenario, but {clip} is no scenario; give sim:NAME")
    if landmarks is None:
        refuse_options({"--colours": colours}, "is of no use without --landmarks FILE: they are the landmarks' colours")
    if landmarks is None and telemetry is None:
        refuse_options(beside, "is of no use without --telemetry FILE or --landmarks FILE: nothing would be located")
    if detections is None and detector is None:
        refuse_options(
            {"--movers": movers or None}, "is for --detector or --detections; a run finds what moves by itself"
        )
    elif detections is not None and detector is not None:
        raise InputError("--detections and --detector were both given; give one of them")
    elif not movers:
        refuse_options({"--ignore": ignore}, "is for the search for movers; give --movers too, or leave it out")
    network = open_detector(detector, provider, score, classes)
    if detections is None and box_format is not None:
        raise InputError("--box-format is for --detections FILE; give it too")
    given = None
    if landmarks is not None or telemetry is not None:
        given = AerialInput(landmarks, telemetry, camera, dem, background, colours)
    settings = load_settings(config, set_, ignore, quiet, geoid)
    if live:
        from torchvision_dddas.io.output import parse_save
        from torchvision_dddas.live import RECORDED, CommandOptions, LiveOptions, run_live

        options = LiveOptions(
            out=out,
            clip=clip,
            settings=settings,
            given=given,
            telemetry=telemetry,
            interval=interval,
            backend=backend.value,
            emit=emit or (),
            serve=serve,
            people=people,
            rate_hz=rate,
            quiet=quiet,
            wait=wait,
            zones=placed,
            ground=ground or (),
            aerial=aerial or (),
            detector=network,
            movers=movers,
            commanding=None if command is None else CommandOptions(command, allow_commands, geofence, altitude_band),
            serve_token=serve_token,
            save=() if save is None else parse_save(save, RECORDED),
            lag=0 if latency is Latency.now else None,
        )
        code = run_live(options)
        raise typer.Exit(Ended(code))  # the last line on the screen says where the results are
    from torchvision_dddas import open_video
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.detection_tables import check_table, read_for_clip
    from torchvision_dddas.io.joined_clips import JoinedSource
    from torchvision_dddas.io.output import PipelineRecorder, clip_facts, parse_save
    from torchvision_dddas.pipeline import (
        Pipeline,
        assemble_files,
        clip_notes,
        locator_facts,
        map_site,
        note_unused,
        open_uav,
    )

    names = parse_save(save, PipelineRecorder.saved)
    beside_clip = [path for path in (zones, detections, detector, classes) if path is not None]
    team = None
    if ground or aerial:
        from torchvision_dddas.control import GroundTeam

        further = [open_uav(path, settings, backend.value) for path in aerial or ()]
        team = GroundTeam(ground or (), settings, backend.value, further)
        beside_clip += team.files
        if twice := {Path(name).resolve() for name in clips} & {file.resolve() for file in team.files}:
            raise InputError(f"{twice.pop()} is the clip of the run and of a platform; give each its own")
    files = [*(given.files if given is not None else ()), *logs, *beside_clip]
    refuse_own_input([*map(Path, clips), *files], [out / name for name in PipelineRecorder.files], "folder with --out")
    with PipelineRecorder(out, names) as output:
        opened = [open_video(name, rate_hz=rate, full_scale=settings.levels.given) for name in (clip, *clips[1:])]
        source = opened[0] if len(opened) == 1 else JoinedSource(opened, logs)
        table = None if detections is None else read_for_clip(detections, box_format, source)
        checked = network.notes if network is not None else []
        checked = checked if table is None else check_table(table, interval, source)
        ready = assemble_files(given, telemetry, settings, source, backend.value, clip)
        facts: dict[str, Any] = {
            "input": clip if len(clips) == 1 else clips,
            "clip": clip_facts(source),
            "interval_frames": interval,
            "backend": ready.engine.name,
        }
        site = None
        if ready.watch is not None and given is not None:
            facts |= {**given.facts, **locator_facts(ready.watch.locator)}
            site = map_site(ready.watch.locator, background)
        if placed is not None:
            placed.check(site is not None, None if site is None else site.origin_deg)
        if team is not None:
            team.check(site is not None, *((site.origin_deg, site.start_utc_s) if site is not None else (None,)))
        facts |= {
            **{key: paths for key, paths in (("ground", ground), ("aerial", aerial)) if paths},
            "telemetry": logs if len(logs) > 1 else telemetry,
            "zones_file": zones,
            "detections_file": detections,
            **({"detector": network.facts} if network is not None else {}),
            **({"movers": True} if movers else {}),
            "settings": ready.settings.model_dump(),
        }
        record = output.begin(facts, source.rate_hz / interval, source.size, site, placed.zones if placed else ())
        boxes = network or table
        finds_movers = boxes is None or movers
        if not finds_movers:
            record.scale = None  # this scale belongs to the motion detector
        record.notes += [*ready.notes, *checked]
        if not finds_movers and not aerial:  # the pictures of further UAVs are searched for motion
            # The landmarks' own blobs are cut out by this size.
            record.notes += note_unused(settings, ("small.min_area_px",) if landmarks is not None else ())
        count = None if source.count is None else -(-source.count // interval)
        pipeline = Pipeline.from_assembly(ready, interval=interval, detector=boxes, movers=movers)
        results = pipeline(source) if team is None else team.mark(pipeline(source))
        results = results if placed is None else placed.mark(results)
        try:
            record_results(output, record, results, source.name, count, quiet, source)
        finally:  # also record the platforms of an interrupted run
            if team is not None:
                record.counts["platforms"] = team.facts
        record.notes += [
            *pipeline.notes,
            *(placed.notes if placed else ()),
            *(team.notes if team else ()),
            *(clip_notes(source, interval, ready.settings) if finds_movers else ()),
        ]
        if table is not None and table.last > source.last:
            record.notes.append(f"the clip ended after frame {source.last}, the table goes on to {table.last}")
    lines = _summary(record, out, site is not None, "overlay" in names)
    if given is None:
        print_lines(lines, quiet)
    else:
        print_located(lines, record, out, quiet)


def _with_password(clip: str, path: Path | None) -> str:
    """Add the password to an address with a user name only, from the file, else from the environment."""
    login = _LOGIN.fullmatch(clip)
    if path is None:
        password = os.environ.get(PASSWORD, "")
    elif login is None:
        raise InputError(f"--password-file is for an address with a name alone, rtsp://NAME@HOST/...; got {clip}")
    else:
        try:
            with path.open("rb") as file:
                password = file.readline(4096).decode().rstrip("\r\n")
        except (OSError, ValueError) as error:
            raise InputError(f"--password-file {path} cannot be read: {getattr(error, 'strerror', error)}") from None
        if not password:
            raise InputError(f"--password-file {path} begins with an empty line; wanted the password")
    return f"{login[1]}:{quote(password, safe='')}@{login[2]}" if login is not None and password else clip


def _fly(
    scenario: str,
    out: Path,
    config: str | None,
    overrides: list[str],
    scene: list[str],
    seed: int | None,
    backend: str,
    save: str | None,
    quiet: bool,
    zones: "Zones | None",
) -> None:
    from torchvision_dddas.io.output import parse_save
    from torchvision_dddas.lab.evaluation.simulated_run import run_scenario
    from torchvision_dddas.lab.simulation import SimulatedRunRecorder

    note_patrol(config, quiet)
    names = parse_save(save, SimulatedRunRecorder.saved)
    show = partial(progress, quiet=quiet)
    record, score = run_scenario(out, scenario, config, overrides, scene, seed, backend, names, show, zones)
    first, *others = _summary(record, out, True, "overlay" in names)
    lines = [first, *score.lines(), *others]
    if "truth" in names:
        command = f"dddas evaluate {out / 'truth' / 'gt.txt'} {out}"
        lines.append(f"{out / 'truth'}: the truth; boxes in the picture (not places, as above) are scored by {command}")
    print_located(lines, record, out, quiet)


def _summary(record: "RunRecord", folder: Path, is_located: bool, has_overlay: bool) -> list[str]:
    from torchvision_dddas.io.output import PipelineRecorder

    known = PipelineRecorder.files if is_located else PipelineRecorder.found_files
    files = [n for n in known if (folder / n).exists() and (n != "overlay.mp4" or has_overlay)]
    # If targets are located, a note counts the detections without identity.
    apart = " of" if is_located else ","
    identities = record.counts.get("identities", 0)
    found = f"{record.frames} frames, {record.targets} detections{apart} {identities} identities"
    return closing_lines([found, *(position_lines(record) if is_located else [])], record, folder, files)
