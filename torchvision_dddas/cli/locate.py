"""`dddas locate`: locate targets on the ground, seen from the air or by cameras on the ground."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchvision_dddas.cli.exits import NOTHING_LOCATED, say
from torchvision_dddas.cli.options import (
    Backend,
    BoxFormat,
    Config,
    EngineOption,
    Out,
    Overrides,
    Poses,
    Quiet,
    Rate,
    Telemetry,
    check_rate,
    load_settings,
    print_lines,
    report_errors,
)
from torchvision_dddas.cli.progress import closing_lines, record_results
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.io.output import RunRecord

CameraFile = Annotated[
    Path | None,
    typer.Option(
        "--camera", metavar="FILE", help="The TOML of the camera, with data that the telemetry lacks: pitch_deg, ..."
    ),
]
Elevation = Annotated[
    Path | None, typer.Option("--dem", metavar="FILE", help="Heights of the ground, a GeoTIFF. [default: level ground]")
]
Geoid = Annotated[
    Path | None,
    typer.Option(
        "--geoid", metavar="FILE", help="Heights of the geoid, a GeoTIFF (aerial.geoid). [default: EGM96, to 1 m]"
    ),
]
Background = Annotated[
    Path | None, typer.Option("--background", metavar="FILE", help="An ortho-photo for the map, a GeoTIFF.")
]

OwnClip = Annotated[
    str | None, typer.Option("--clip", metavar="CLIP", help="The clip itself, for its rate and its picture size.")
]

locate = typer.Typer(help="Find where targets stand on the ground.", no_args_is_help=True)


@locate.command()
@report_errors
def aerial(
    table: Annotated[
        Path, typer.Argument(metavar="TABLE", help="Detections or tracks, CSV or MOTChallenge text, of the clip.")
    ],
    landmarks: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A CSV of landmarks: their places, and their pixels in the frames."),
    ] = None,
    telemetry: Telemetry = None,
    camera: CameraFile = None,
    dem: Elevation = None,
    geoid: Geoid = None,
    clip: OwnClip = None,
    background: Background = None,
    box_format: BoxFormat = None,
    out: Out = Path("dddas-positions"),
    config: Config = None,
    set_: Overrides = None,
    backend: EngineOption = Backend.auto,
    save: Annotated[
        str | None, typer.Option(metavar="NAMES", help="cot,map,report, all or none; tables are always written.")
    ] = None,
    rate: Rate = None,
    quiet: Quiet = False,
) -> None:
    """Locate targets of an aerial clip, by telemetry, by landmarks of known place, or by both.

    Writes positions.csv, fixes.csv (the pose of each picture), maps, a report and run.json under --out.
    """
    from torchvision_dddas import open_video
    from torchvision_dddas.geo import check_table, frames_to_locate, is_outside
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.camera_files import read_camera_keys
    from torchvision_dddas.io.detection_tables import check_within_clip, read_for_clip
    from torchvision_dddas.io.output import AerialRecorder, parse_save
    from torchvision_dddas.io.sources import frame_times
    from torchvision_dddas.pipeline import AerialInput, locator_facts, map_site, read_locator

    if landmarks is None and telemetry is None:
        raise InputError("locating from the air needs --telemetry FILE or --landmarks FILE; got neither")
    given = AerialInput(landmarks, telemetry, camera, dem, background)
    settings, names = load_settings(config, set_, geoid=geoid), parse_save(save, AerialRecorder.saved)
    check_rate(rate)
    inputs = [table, *given.files, *([Path(clip)] if clip else [])]
    refuse_own_input(inputs, [out / name for name in AerialRecorder.files], "folder with --out")
    with AerialRecorder(out, names) as output:
        source = open_video(clip, rate_hz=rate) if clip else None
        keys = {} if camera is None else read_camera_keys(camera, is_aerial=True)
        read = read_for_clip(table, box_format, source, (keys.get("width_px"), keys.get("height_px")))
        size, rate_hz, times_s = None, rate, None
        if source is not None:
            check_within_clip(read, source)
            size, rate_hz, times_s = source.size, source.rate_hz, frame_times(source)
        locator, notes = read_locator(
            given, settings, size, rate_hz, backend.value, (read.first, read.last), "table", clip, extent=read.extent
        )
        check_table(read, locator)
        facts = {"input": table, **given.facts, "rows": len(read), **locator_facts(locator)}
        record = output.begin({**facts, "settings": settings.model_dump()}, map_site(locator, background))
        record.notes += [*read.notes, *notes]
        for name, kind in (("bridges", "bridge"), ("untracked", "untracked")):
            record.counts[name] = int(read.of_kind(kind).sum())
        if not len(read):
            record.notes.append("the table has no rows: nothing to locate")
        elif read.identity is None or (read.identity < 1).all():
            record.notes.append("the table has no identities: targets are numbered per frame, and there are no tracks")
        if beyond := int(is_outside(locator, read.box_px[:, :2] + read.box_px[:, 2:] / 2).sum()):
            width, height = locator.camera.size_px
            record.notes.append(
                f"{beyond} of {len(read)} boxes lie far outside the camera's pictures of {width} x {height} px; check "
                "the size in its file"
            )
        count = len(frames_to_locate(read, locator.site.landmarks))
        record_results(output, record, locator.locate_table(read, times_s=times_s), "locate", count, quiet)
    files = [name for name in AerialRecorder.files if (out / name).exists()]
    first = f"{record.frames} frames, {record.targets} detections"
    print_located(closing_lines([first, *position_lines(record)], record, out, files), record, out, quiet)


@locate.command(context_settings={"ignore_unknown_options": True})
@report_errors
def pixel(
    picture: Annotated[str, typer.Argument(metavar="PICTURE", help="A still picture, or a clip (with --telemetry).")],
    pixels: Annotated[list[str], typer.Argument(metavar="U,V...", help="Pixels, right and down, as 640,360.")],
    time_s: Annotated[float, typer.Option("--time", metavar="S", help="Seconds since a clip's first frame.")] = 0.0,
    telemetry: Telemetry = None,
    landmarks: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A CSV of landmarks: their places, and their pixels.")
    ] = None,
    camera: CameraFile = None,
    dem: Elevation = None,
    geoid: Geoid = None,
    config: Config = None,
    set_: Overrides = None,
    rate: Rate = None,
) -> None:
    """Locate the ground at pixels of a still picture, or of a clip at one time.

    Without --telemetry and --landmarks, the EXIF and XMP of the picture give its camera's place, height and angles.
    Prints a line for each pixel; the ellipse holds the true place with a probability of 95 %.
    """
    import numpy as np

    from torchvision_dddas import open_video
    from torchvision_dddas.io.maps.ground_tracks import semi_axes
    from torchvision_dddas.pipeline import AerialInput, read_locator

    try:
        uv = np.array([[float(number) for number in word.split(",")] for word in pixels]).reshape(len(pixels), 2)
    except ValueError:
        uv = np.full((1, 2), np.nan)
    if not np.isfinite(uv).all():
        raise InputError(f"a pixel must be u,v, such as 640,360; got {' '.join(pixels)}")
    source = open_video(picture, rate_hz=rate, single=True)
    count, rate_hz = source.count, source.rate_hz
    if telemetry is None and landmarks is None:
        if count != 1:
            raise InputError(f"{picture} is a clip; give its --telemetry FILE or --landmarks FILE")
        telemetry = Path(picture)
    if not 0 <= time_s <= (count or math.inf) / rate_hz:
        raise InputError(f"--time {time_s:g} lies outside {picture}, which lasts {(count or 0) / rate_hz:g} s")
    if (outside := ((uv < -0.5) | (uv > np.array(source.size) - 0.5)).any(axis=1)).any():
        u, v = uv[outside.argmax()]
        raise InputError("{:g},{:g} lies outside {}, which has {}x{} px".format(u, v, picture, *source.size))
    given, settings = AerialInput(landmarks, telemetry, camera, dem), load_settings(config, set_, geoid=geoid)
    locator, notes = read_locator(given, settings, source.size, rate_hz, "onboard", None, "clip", picture)
    found = locator.locate_pixels(uv, time_s=time_s)
    axes_m, _ = semi_axes(found.covariance_m2)
    lines = []
    for k, (u, v) in enumerate(uv.tolist()):
        if not np.isfinite(found.east_north_m[k]).all():
            lines.append(f"{u:g},{v:g}: no place; it lies above or near the horizon, or outside the ground heights")
            continue
        place = "{:.3f} m east, {:.3f} m north".format(*found.east_north_m[k])
        if found.lonlat_deg is not None:
            place = "latitude {1:.7f}, longitude {0:.7f}".format(*found.lonlat_deg[k])
        if math.isfinite(found.above_sea_m[k]):
            place += f", {found.above_sea_m[k]:.1f} m above the sea"
        lines.append(f"{u:g},{v:g}: {place}; with 95 % within {axes_m[k, 0]:.1f} x {axes_m[k, 1]:.1f} m")
    print_lines([*lines, *(f"note: {note}" for note in notes)])
    if not np.isfinite(found.east_north_m).any():
        raise typer.Exit(NOTHING_LOCATED)


@locate.command()
@report_errors
def ground(
    tables: Annotated[
        list[Path],
        typer.Argument(metavar="TABLE...", help="Tables of people or tracks, CSV or MOTChallenge, one per camera."),
    ],
    camera: Annotated[list[Path], typer.Option(metavar="FILE", help="The TOML of each table's camera.")],
    poses: Poses = None,
    box_format: BoxFormat = None,
    out: Out = Path("dddas-positions"),
    config: Config = None,
    set_: Overrides = None,
    rate: Rate = None,
    quiet: Quiet = False,
) -> None:
    """Locate people seen by cameras on the ground, by their height and their feet. Several cameras are fused.

    Writes positions.csv, sightings.csv (what each camera alone found), tracks.geojson and tracks.kml if longitudes are
    known, and run.json under --out.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.geo import GroundLocator
    from torchvision_dddas.io.atomic_files import refuse_own_input
    from torchvision_dddas.io.camera_files import describe_missing, read_camera, read_poses
    from torchvision_dddas.io.detection_tables import read_detections
    from torchvision_dddas.io.output import NONE_LOCATED, GroundRecorder

    settings, poses = load_config(config, set_ or []), poses or []
    if len(camera) != len(tables):
        raise InputError(f"{len(tables)} tables and {len(camera)} cameras; give one --camera for each table")
    check_rate(rate)
    if poses and len(poses) != len(tables):
        raise InputError(f"{len(tables)} tables and {len(poses)} files of poses; give one --poses for each, or none")
    refuse_own_input([*tables, *camera, *poses], [out / name for name in GroundRecorder.files], "folder with --out")
    with GroundRecorder(out) as output:
        cameras = [read_camera(file) for file in camera]
        read = [
            read_detections(path, order=box_format, size=one.size_px) for path, one in zip(tables, cameras, strict=True)
        ]
        where = [read_poses(file) for file in poses] if poses else [None] * len(tables)
        locator = GroundLocator(cameras, settings=settings, poses=where, rate_hz=rate)
        frames = locator.locate_tables(read)
        facts = {
            "input": list(tables),
            "cameras": list(camera),
            "poses": list(poses),
            "rows": [len(table) for table in read],
            "settings": settings.model_dump(),
        }
        names = [one.name for one in cameras]
        names = [f"{name}-{n}" if names.count(name) > 1 else name for n, name in enumerate(names, 1)]
        record = output.begin(facts, names, locator.origin_deg is not None)
        missing = (describe_missing(file, pose) for file, pose in zip(camera, where, strict=True))
        record.notes += [
            *(note for table in read for note in table.notes),
            *(note for note in missing if note),
            *locator.notes,
        ]
        record_results(output, record, frames, "locate", quiet=quiet)
        if not any(len(table) for table in read):
            record.notes.append("the tables have no rows: nothing to locate")
        elif not record.counts["people"]:
            record.notes.append(f"{NONE_LOCATED}no sighting has a distance (see sightings.csv)")
    by = record.counts["sightings"]
    counts = f"{by['both']} by height and feet, {by['height']} by height, {by['feet']} by feet alone"
    lines = [f"{record.frames} frames, {record.targets} sightings ({counts}), {record.counts['people']} positions"]
    if by["bearing"] and record.counts["people"]:
        lines.append(f"note: {by['bearing']} sightings have a bearing but no distance (see sightings.csv)")
    files = [*(name for name in GroundRecorder.files if name != "run.json" and (out / name).exists()), "run.json"]
    print_located(closing_lines(lines, record, out, files), record, out, quiet)


def print_located(lines: Sequence[str], record: "RunRecord", folder: Path, quiet: bool) -> None:
    """Print closing lines. If there were targets but none was located, say why and end with NOTHING_LOCATED."""
    from torchvision_dddas.io.output import NONE_LOCATED

    cause = next((note for note in record.notes if record.targets and note.startswith(NONE_LOCATED)), "")
    print_lines([line for line in lines if not cause or line != f"note: {cause}"], quiet)
    if cause:
        say(f"{cause}; all other results are in {folder}")
        raise typer.Exit(NOTHING_LOCATED)


def position_lines(record: "RunRecord") -> list[str]:
    """Return the number of positions by method, and the frames that could not be located or were repaired."""
    counts: dict[str, Any] = {"positions": 0, "by": {}, **record.counts}
    by = ", ".join(f"{count} by {name}" for name, count in counts["by"].items() if count and name != "nothing")
    lines = [f"{counts['positions']} positions; of the frames {by or 'none'}"]
    if bridges := counts.get("bridges", 0):
        lines.append(f"note: boxes that bridge gaps between detections were not seen and have no place: {bridges}")
    if untracked := counts.get("untracked", 0):
        lines.append(f"note: detections without identity were not tracked and have no place: {untracked}")
    for what, words in (("weak", "located with a warning"), ("repairs", "repaired")):
        if spans := counts.get(what):
            lines.append(f"note: {words}, {_describe_longest(spans)}")
    for name, kept in counts.get("landmarks", {}).items():
        # Count located frames only, because frames that were not located use no landmark.
        tried = kept["used"] + kept["left_out"]
        if kept["left_out"] > 0.5 * tried:
            lines.append(
                f"note: {name} was left out in {kept['left_out']} of {tried} frames; check its "
                "place, and whether the ground rises or falls there (--dem)"
            )
    return lines


def _describe_longest(spans: Sequence[dict[str, Any]]) -> str:
    longest = max(spans, key=lambda row: row["last"] - row["first"])
    first, last = longest["first"], longest["last"]
    where = f"frame {first}" if first == last else f"frames {first} to {last}"
    more = f"; {len(spans) - 1} more in run.json" if len(spans) > 1 else ""
    return f"{where}: {longest['cause']}{more}"
