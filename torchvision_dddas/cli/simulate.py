"""`dddas simulate`: write a scenario as files: data of instruments in the air and on the ground, and the truth."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.options import Out, Quiet, print_lines, report_errors
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.io.output import RunRecord
    from torchvision_dddas.lab.simulation import Scenario


@report_errors
def simulate(
    scenario: Annotated[
        str | None,
        typer.Argument(metavar="SCENARIO", help="A shipped scenario, or a TOML file. [default: list the shipped ones]"),
    ] = None,
    out: Out = Path("dddas-simulate"),
    seed: Annotated[int | None, typer.Option(help="Random seed. [default: as in the scenario]")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="PARAMETER=VALUE",
            help="Change the scenario, such as uav.altitude_m=100; see dddas settings scenario; may be repeated.",
        ),
    ] = None,
    frames: Annotated[int | None, typer.Option(metavar="N", help="Frames to make. [default: the whole run]")] = None,
    save: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="frames,video,masks,ground, all or none; tables are always written. [default: frames,masks,ground; "
            "none with --serve]",
        ),
    ] = None,
    serve: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="Serve the UAV's camera as MPEG-TS with KLV: udp://HOST:PORT sends there, tcp://HOST:PORT listens.",
        ),
    ] = None,
    serve_mavlink: Annotated[
        str | None,
        typer.Option(metavar="LINK", help="Serve the UAV as a MAVLink system that obeys: udpout:127.0.0.1:14550."),
    ] = None,
    speed: Annotated[
        float | None, typer.Option(metavar="X", help="Speed of a served world; 2 is twice real time. [default: 1]")
    ] = None,
    link: Annotated[
        str | None,
        typer.Option(
            metavar="CONDITIONS", help="Of the served links: latency=0.5,jitter=0.1,loss=0.05,dropout=2/20,clock=1."
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="FAULT", help="Of a served instrument, as gps=stuck@10..20; may be repeated."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Simulate a team of vehicles in and above a desert, and write the data of its instruments and the truth.

    With --serve or --serve-mavlink, other programs see and steer the world while it runs.

    Writes frames/, telemetry.csv, landmarks.csv, colours.toml, camera.toml and dem.tif for `dddas run`,
    ground/ for `dddas people` and `dddas locate ground`, truth/ for `dddas evaluate`, scenario.toml and run.json.
    """
    from torchvision_dddas.io.output import parse_save
    from torchvision_dddas.lab.simulation import (
        RECORDED,
        ServeOptions,
        load_scenario,
        record_scenario,
        scenario_names,
    )

    if scenario is None:
        print_lines([f"{name:12s} {load_scenario(name).about}" for name in scenario_names()])
        return
    if frames is not None and frames < 1:
        raise InputError(f"--frames must be 1 or more, got {frames}")
    served = None
    if serve is not None or serve_mavlink is not None:
        served = ServeOptions(serve, serve_mavlink, 1.0 if speed is None else speed, link, tuple(fault or ()))
    elif speed is not None or link is not None or fault:
        raise InputError("--speed, --link and --fault are for a served world: give --serve or --serve-mavlink")
    if save is None:
        save = "frames,masks,ground" if served is None else "none"
    chosen, kinds = load_scenario(scenario, set_ or [], seed), parse_save(save, RECORDED)
    record = record_scenario(out, chosen, kinds, frames, scenario, partial(progress, quiet=quiet), served)
    print_lines(_summary(record, out, chosen), quiet)


def _summary(record: "RunRecord", folder: Path, scenario: "Scenario") -> list[str]:
    """Return counts, events, notes, and the next command."""
    events = record.counts["events"]
    lines = [f"{record.frames} frames of {scenario.camera.width_px}×{scenario.camera.height_px}, {len(events)} events"]
    lines += [f"  {event['time_s']:6.1f} s  {event['what']}" for event in events[:12]]
    if len(events) > 12:
        lines.append(f"  ... and {len(events) - 12} more, in run.json")
    lines += [f"note: {note}" for note in record.notes]
    files = [name for name in ("frames", "clip.mp4", "truth", "ground") if (folder / name).exists()]
    lines.append(f"{folder}: {', '.join([*files, 'tables', 'scenario.toml', 'run.json'])}")
    if (folder / "frames").exists():
        names = ("landmarks.csv", "telemetry.csv", "colours.toml", "camera.toml", "dem.tif")
        given = names if scenario.team.ugvs else names[1:]  # without ground vehicles, the file has no landmarks
        options = [f"--{name.partition('.')[0]} {folder / name}" for name in given if (folder / name).exists()]
        rate = f" --rate {scenario.clip.rate_hz:g}" if scenario.clip.rate_hz != 10 else ""
        lines.append(f"Next: dddas run {folder / 'frames'} {' '.join(options)}{rate}")
    return lines
