"""`dddas calibrate-flight`: estimate the errors of the user's vehicle from a flight over points of known place."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.locate import CameraFile, Elevation, Geoid, OwnClip
from torchvision_dddas.cli.options import (
    REPORTS,
    Config,
    Overrides,
    Rate,
    check_rate,
    load_settings,
    print_lines,
    report_errors,
)

if TYPE_CHECKING:
    from torchvision_dddas.geo import FlightErrors


@report_errors
def calibrate_flight(
    points: Annotated[
        Path,
        typer.Argument(metavar="POINTS", help="A CSV of points as for landmarks: places, and pixels in the frames."),
    ],
    telemetry: Annotated[Path, typer.Option(metavar="FILE", help=REPORTS)],
    camera: CameraFile = None,
    dem: Elevation = None,
    geoid: Geoid = None,
    clip: OwnClip = None,
    out: Annotated[Path, typer.Option(metavar="FILE", help="The configuration to write.")] = Path("flight.toml"),
    config: Config = None,
    set_: Overrides = None,
    rate: Rate = None,
) -> None:
    """Estimate the errors of a vehicle's log from points of known place in its pictures, and write a configuration.

    Give 20 pictures or more, taken from several directions, distances and heights, with one to four points each.
    """
    from torchvision_dddas import open_video
    from torchvision_dddas.config import format_toml
    from torchvision_dddas.geo import estimate_flight_errors, find_looks
    from torchvision_dddas.io.atomic_files import refuse_folder, refuse_own_input, save_file
    from torchvision_dddas.io.sources import frame_times
    from torchvision_dddas.pipeline import AerialInput, read_locator

    given, settings = AerialInput(points, telemetry, camera, dem), load_settings(config, set_, geoid=geoid)
    check_rate(rate)
    refuse_own_input([*given.files, *(Path(name) for name in (clip, config) if name)], [out], "--out")
    refuse_folder(out)
    source = open_video(clip, rate_hz=rate) if clip else None
    size, rate_hz, times_s = (source.size, source.rate_hz, frame_times(source)) if source else (None, rate, None)
    locator, notes = read_locator(given, settings, size, rate_hz, "onboard", None, "clip", clip)
    errors = estimate_flight_errors(find_looks(locator, times_s), locator.camera, settings.aerial)
    log = vars(locator.site.telemetry)
    columns = {"tilt": "tilt_sigma_rad", "heading": "heading_sigma_rad", "position": "position_sigma_m"}
    columns |= {"height": "altitude_sigma_m"}
    own = [part for part, column in columns.items() if any(map(math.isfinite, log[column].tolist()))]
    values = errors.settings(settings.aerial, own)
    count = f"{errors.points} points in {errors.pictures} pictures"
    made = f"by dddas calibrate-flight, from {count} of {points} and {telemetry}"
    content = {"aerial": {name.removeprefix("aerial."): value for name, value in values.items()}}
    save_file(out, format_toml(content, [made]).encode())
    if not all(math.isfinite(sigma_m) for sigma_m in locator.site.landmarks.sigma_m.tolist()):
        notes.append(
            f"points without sigma_m get the standard deviation {settings.landmarks.sigma_m:g} m (landmarks.sigma_m)"
        )
    if own:
        notes.append(f"not written: {', '.join(own)}; the log, its course or the camera's file states this error")
    if errors.wrong:
        names = (f"{locator.site.landmarks.names[mark]} in frame {frame}" for frame, mark in errors.wrong)
        notes.append(f"left out, because they contradict the other points: {', '.join(names)}")
    lines = [count, *describe_errors(errors, values), *(f"note: {note}" for note in notes)]
    print_lines([*lines, f"{out}: {len(values)} parameters; give it with --config {out}"])


def describe_errors(errors: "FlightErrors", values: dict[str, float]) -> list[str]:
    """Return a table of the errors, and notes on errors without a parameter or not determined by the flight."""
    from torchvision_dddas.geo import OFFSETS, PART_OF_OFFSET, PARTS

    lines, folded, notes = [f"{'error':<14}{'offset':>16}{'sigma':>15}{'stated':>8}"], [], []
    for k, name in enumerate(OFFSETS):
        scale, unit = (180 / math.pi, "deg") if k < 3 else (1, "m") if k < 6 else (100, "%")
        offset, beside = float(errors.offset[k]) * scale, float(errors.offset_sigma[k]) * scale
        line = f"{f'{name} {unit}':<16}{f'{offset:+.2f} ± {beside:.2f}':>14}"
        if name != "focal length":
            part = PART_OF_OFFSET[k]
            sigma, stated = float(errors.sigma[part]) * scale, float(errors.stated[part]) * scale
            found = f"{sigma:.2f} ± {sigma * errors.relative[part]:.2f}" if errors.shown[part] else "not shown"
            line += f"{found:>15}{stated:>8.2f}"
            matters = errors.shown[part] and abs(offset) > 2 * beside
            if matters and f"aerial.{name}_offset_deg" not in values:
                folded.append(name)
            elif matters and name == "pitch":
                way = "lower" if offset > 0 else "higher"
                what = f"the camera looks {abs(offset):.1f} deg {way} than the log says"
                notes.append(f"note: {what}; aerial.pitch_offset_deg corrects this")
        lines.append(line)
    lines += notes
    if folded:
        lines.append(f"note: no parameter corrects the offset of {', '.join(folded)}; the written sigmas contain it")
    if kept := [name for name, shown in zip(PARTS, errors.shown, strict=True) if not shown]:
        more = "give more pictures, from other headings, distances and heights"
        lines.append(f"note: not determined by this flight, so the stated value is kept: {', '.join(kept)}; {more}")
    return lines
