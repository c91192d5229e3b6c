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
        str,
        typer.Option(metavar="NAMES", help="frames,video,masks,ground, all or none; tables are always written."),
    ] = "frames,masks,ground",
    quiet: Quiet = False,
) -> None:
    """Simulate a team of vehicles in and above a desert, and write the data of its instruments and the truth.

    Writes frames/, telemetry.csv, landmarks.csv, colours.toml, camera.toml and dem.tif for `dddas run`,
    ground/ for `dddas people` and `dddas locate ground`, truth/ for `dddas evaluate`, scenario.toml and run.json.
    """
    from torchvision_dddas.io.output import parse_save
    from torchvision_dddas.lab.simulation import RECORDED, load_scenario, record_scenario, scenario_names

    if scenario is None:
        print_lines([f"{name:12s} {load_scenario(name).about}" for name in scenario_names()])
        return
    if frames is not None and frames < 1:
        raise InputError(f"--frames must be 1 or more, got {frames}")
    chosen, kinds = load_scenario(scenario, set_ or [], seed), parse_save(save, RECORDED)
    record = record_scenario(out, chosen, kinds, frames, scenario, partial(progress, quiet=quiet))
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
