"""`dddas simulate`: a scenario as files: what the instruments in the air and on the ground give, and the truth."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Quiet
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.io.output import RunRecord
    from torchvision_dddas.simulation import RadioReport, RecordedFrame, Scenario, Shot, Simulator


@explained
def simulate(
    scenario: Annotated[
        str | None,
        typer.Argument(metavar="SCENARIO", help="A shipped scenario, or a TOML file. [default: list those there are]"),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("dddas-simulate"),
    seed: Annotated[int | None, typer.Option(help="What chance decides. [default: the scenario's]")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KNOB=VALUE", help="Change the scenario, as uav.altitude_m=100; may be repeated."
        ),
    ] = None,
    frames: Annotated[int | None, typer.Option(metavar="N", help="Frames to make. [default: the whole run]")] = None,
    save: Annotated[
        str,
        typer.Option(metavar="NAMES", help="frames,video,masks,ground, all or none; tables are always written."),
    ] = "frames,masks,ground",
    quiet: Quiet = False,
) -> None:
    """Simulate a team above and on a piece of desert, and write what its instruments give, and what is true.

    Writes frames/, telemetry.csv, landmarks.csv, colours.toml, camera.toml and dem.tif as `dddas run` takes them,
    ground/ as `dddas people` and `dddas locate ground` do, truth/ as `dddas evaluate` does, scenario.toml and run.json.
    """
    from torchvision_dddas.io.output import parse_save
    from torchvision_dddas.simulation import RECORDED, load_scenario, scenario_names

    if scenario is None:
        for name in scenario_names():
            typer.echo(f"{name:12s} {load_scenario(name).about}")
        return
    if frames is not None and frames < 1:
        raise InputError(f"--frames is {frames}; wanted 1 or more")
    chosen = load_scenario(scenario, set_ or [], seed)
    kinds = parse_save(save, RECORDED)
    journal = simulate_into(out, chosen, kinds, frames, quiet, scenario)
    if not quiet:
        for line in summary(journal, out, chosen):
            typer.echo(line)


def simulate_into(
    folder: Path,
    scenario: "Scenario",
    save: tuple[str, ...],
    frames: int | None = None,
    quiet: bool = False,
    name: str = "simulated",
) -> "RunRecord":
    """Run a scenario and write it under a folder; returns the record of the run. name: the scenario's, for messages.

    Raises InputError for bad input, and KeyboardInterrupt after the outputs up to the last whole frame are in place.
    """
    from torchvision_dddas import geometry
    from torchvision_dddas.simulation import RecordingOutput, name_scenario_in_errors, open_simulator, scenario_toml

    with RecordingOutput(folder, save) as output:
        with name_scenario_in_errors(name):
            simulator = open_simulator(scenario)
        count = min(simulator.frames, frames or simulator.frames)
        facts = {
            "scenario": scenario.model_dump(mode="json"),
            "clip": {"size": simulator.camera.size_px, "rate_hz": scenario.clip.rate_hz, "frames": count},
        }
        origin = scenario.world.origin_deg
        journal = output.begin(
            facts,
            scenario.clip.rate_hz,
            simulator.camera,
            simulator.colours,
            scenario_toml(scenario),
            lambda metres: geometry.lonlat(metres, origin),
        )
        with progress(Path(name).stem, count, quiet) as tick:
            for number, filmed in enumerate(_filmed(simulator, "ground" in save), 1):
                output.write(filmed)
                tick()
                if number == 1:
                    journal.notes += write_dem(folder / "dem.tif", simulator)
                if number == count:
                    break
        if "video" in save and journal.counts["dropped"]:
            journal.notes.append("where the camera dropped a frame, clip.mp4 shows the one before again")
    return journal


def _filmed(simulator: "Simulator", ground: bool) -> "Iterator[RecordedFrame]":
    """The frames of a run that nobody steers. ground: whether ground vehicles take pictures, all at once."""
    from torchvision_dddas.config import Settings, with_parameters
    from torchvision_dddas.simulation import RecordedFrame, scenario_settings

    scenario = simulator.scenario
    apart_s = with_parameters(Settings(), scenario_settings(scenario)).steering.picture_s
    apart = max(1, round(apart_s * scenario.clip.rate_hz))
    while True:
        begun = time.perf_counter()
        shot = simulator.next()
        if shot is None:
            return
        drawn = time.perf_counter()
        looks = ground and (shot.truth.frame - 1) % apart == 0
        seen = [simulator.picture(name) for name in simulator.names] if looks else []
        seconds = {"air": drawn - begun} | ({"ground": time.perf_counter() - drawn} if looks else {})
        yield RecordedFrame(
            shot.truth,
            None if shot.frame is None else shot.frame.image,
            tuple((moment.time_s, moment.flight) for moment in shot.said if moment.flight is not None),
            tuple(_heard(shot, simulator.names)),
            tuple(picture for picture in seen if picture is not None),
            seconds,
        )


def _heard(shot: "Shot", names: tuple[str, ...]) -> "Iterator[RadioReport]":
    from torchvision_dddas.simulation import RadioReport

    for moment in shot.said:
        for report in moment.reports:
            name = names[report.vehicle]
            yield RadioReport(name, report.frame, report.lonlat_deg, report.sigma_m, report.planned)


def write_dem(path: Path, simulator: "Simulator") -> list[str]:
    """The ground's heights above the sea as a GeoTIFF; returns a note where rasterio is missing.

    Raises InputError if the disk refuses.
    """
    import numpy as np

    from torchvision_dddas.io.atomic_files import cannot_write, remove, temporary

    try:
        import rasterio
        from rasterio.crs import CRS
        from rasterio.transform import from_origin
    except ImportError:
        return ["dem.tif is left out: it needs rasterio, pip install 'torchvision-dddas[elevation]'"]
    relief, world = simulator.world.relief, simulator.scenario.world
    heights = (relief.up_m + world.above_sea_m)[::-1].astype(np.float32)
    # The plane that touches the ellipsoid at the origin, as targets.geodesy has it.
    lon, lat = world.origin_deg
    local = CRS.from_proj4(f"+proj=ortho +lat_0={lat!r} +lon_0={lon!r} +datum=WGS84 +units=m")
    step = relief.step_m
    top = relief.corner_m[1] + (heights.shape[0] - 0.5) * step
    part = temporary(path)
    try:
        with rasterio.open(
            part,
            "w",
            driver="GTiff",
            height=heights.shape[0],
            width=heights.shape[1],
            count=1,
            dtype="float32",
            crs=local,
            transform=from_origin(relief.corner_m[0] - step / 2, top, step, step),
            nodata=np.nan,
        ) as raster:
            raster.write(heights, 1)
            raster.units = ("m",)
        part.replace(path)
    except OSError as error:
        remove(part)
        raise cannot_write(path, error) from error
    return []


def summary(journal: "RunRecord", folder: Path, scenario: "Scenario") -> list[str]:
    """What to tell the user at the end: the counts, what happened, notes, and how to go on."""
    events = journal.counts["events"]
    lines = [f"{journal.frames} frames of {scenario.camera.width_px}×{scenario.camera.height_px}, {len(events)} events"]
    lines += [f"  {event['time_s']:6.1f} s  {event['what']}" for event in events[:12]]
    if len(events) > 12:
        lines.append(f"  ... and {len(events) - 12} more, in run.json")
    lines += [f"note: {note}" for note in journal.notes]
    made = [name for name in ("frames", "clip.mp4", "truth", "ground") if (folder / name).exists()]
    lines.append(f"{folder}: {', '.join([*made, 'tables', 'scenario.toml', 'run.json'])}")
    if (folder / "frames").exists():
        options = [
            f"--{name} {folder / file}"
            for name, file in (
                ("landmarks", "landmarks.csv"),
                ("telemetry", "telemetry.csv"),
                ("colours", "colours.toml"),
                ("camera", "camera.toml"),
                ("dem", "dem.tif"),
            )
            if (folder / file).exists()
        ]
        rate = f" --rate {scenario.clip.rate_hz:g}" if scenario.clip.rate_hz != 10 else ""
        lines.append(f"Next: dddas run {folder / 'frames'} {' '.join(options)}{rate}")
    return lines
