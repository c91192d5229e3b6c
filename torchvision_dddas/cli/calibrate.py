"""`dddas calibrate`: what ranging needs to know of a camera, from people in its pictures."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.mistakes import explained
from torchvision_dddas.cli.options import Config, Overrides
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings

LEAST_M, MOST_M = 0.1, 10.0
"""Heights of a person, or of what stands in for one."""

PLACES = ("longitude_deg", "latitude_deg", "east_m", "north_m")
"""Keys whose numbers are written with all their digits."""

Found = tuple[dict[str, float], list[str]]
"""Keys of a camera's TOML, and what to tell the user."""


@explained
def calibrate(
    table: Annotated[
        Path | None,
        typer.Argument(help="A CSV of distance_m,height_px; or boxes of people: detections or tracks."),
    ] = None,
    body_height: Annotated[
        float | None, typer.Option(metavar="M", help="Height of the person. [default: ground.body_height_m]")
    ] = None,
    distance: Annotated[
        float | None, typer.Option(metavar="M", help="How far from the camera the person stands.")
    ] = None,
    pixels: Annotated[
        list[float] | None, typer.Option(metavar="N", help="The person's height in a picture; may be repeated.")
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A camera's TOML to complete; with its focal length, find how it stands."),
    ] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Size of the pictures, such as 768x576.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="The TOML to write. [default: print it]")] = None,
    config: Config = None,
    set_: Overrides = None,
) -> None:
    """Find a camera's focal length from a person of known height at a known distance, f = D h / H.

    The camera looks level at the person. Give --distance with --pixels or the boxes of one person; or many distances.

    With boxes of people all over the picture and a --camera of known focal length: find the camera's height and pitch.
    """
    from torchvision_dddas.config import load_config
    from torchvision_dddas.io.camera_files import has_measurements

    settings = load_config(config, set_ or [])
    tall = settings.ground.body_height_m if body_height is None else body_height
    if not LEAST_M <= tall <= MOST_M:
        raise InputError(f"--body-height is {tall:g}; wanted metres, {LEAST_M:g} to {MOST_M:g}")
    if out is not None:
        _check_out(out, table)
    known = _known(camera, size)
    if pixels and table is not None:
        raise InputError("--pixels and a table were given; give the person's heights in one way")
    if not pixels and table is None:
        raise InputError("nothing to calibrate by: give --distance with --pixels, or a table (see --help)")
    if table is not None and has_measurements(table):
        if distance is not None:
            raise InputError(f"{table} has its own distances, and --distance was given as well; leave one out")
        found, lines = _from_measurements(table, tall)
    elif distance is not None:
        found, lines = _from_person(table, pixels or [], distance, tall)
    elif table is not None:
        found, lines = _from_people(table, camera, tall, settings)
    else:
        raise InputError("--pixels needs --distance: how far from the camera the person stood, in metres")
    text = _toml({**_without_focal(known, found), **found})
    for line in lines:
        typer.echo(line, err=out is None)
    if out is None:
        typer.echo(text, nl=False)
    else:
        _write(out, text)
        lacks = "" if "width_px" in known else "; it still lacks width_px and height_px (--size)"
        typer.echo(f"{out}: the camera{lacks}")


def _from_measurements(table: Path, body_height_m: float) -> Found:
    from torchvision_dddas.io.camera_files import read_measurements

    distance, height = read_measurements(table)
    return _focal(distance.tolist(), height.tolist(), body_height_m)


def _from_person(table: Path | None, pixels: list[float], distance_m: float, body_height_m: float) -> Found:
    if table is not None:
        import numpy as np

        from torchvision_dddas.io.detection_tables import read_detections

        read = read_detections(table)
        frames, count = np.unique(read.frame, return_counts=True)
        if len(frames) and count.max() > 1:
            raise InputError(
                f"{table} has {count.max()} boxes in frame {frames[count.argmax()]}; "
                "--distance wants one person alone in each picture"
            )
        whole = np.ones(len(read), bool) if read.cut is None else ~read.cut
        pixels = read.box_px[whole, 3].tolist()
        if not pixels:
            raise InputError(f"{table} has no whole person to calibrate by")
    return _focal([distance_m] * len(pixels), pixels, body_height_m)


def _focal(distance_m: list[float], height_px: list[float], body_height_m: float) -> Found:
    import numpy as np

    from torchvision_dddas.geo.camera_calibration import calibrate_focal_length

    found = calibrate_focal_length(np.array(distance_m), np.array(height_px), body_height_m)
    _check("focal_px", found.focal_px, "px")
    n = len(height_px)
    spread = "" if math.isnan(found.spread_px) else f", one measurement ± {found.spread_px:.1f} px"
    lines = [
        f"focal length {found.focal_px:.1f} ± {found.sigma_px:.1f} px from {n} measurement{'s' * (n != 1)}{spread}"
    ]
    if found.outlier.any():
        first = int(found.outlier.argmax())
        lines.append(
            f"note: {int(found.outlier.sum())} of {n} left out as outliers, the first {height_px[first]:g} px at "
            f"{distance_m[first]:g} m"
        )
    return {"focal_px": found.focal_px, "focal_sigma": found.sigma_px / found.focal_px}, lines


def _from_people(table: Path, camera: Path | None, body_height_m: float, settings: "Settings") -> Found:
    from torchvision_dddas.geo.camera_calibration import calibrate_pose
    from torchvision_dddas.geo.ranging import touches_border
    from torchvision_dddas.io.camera_files import read_camera
    from torchvision_dddas.io.detection_tables import read_detections

    if camera is None:
        raise InputError(
            f"{table} has boxes without distances: give --distance for one person's, or --camera FILE with a focal "
            "length to find how the camera stands"
        )
    kind, read = read_camera(camera), read_detections(table)
    cut = touches_border(read.box_px, kind.size_px) if read.cut is None else read.cut
    found = calibrate_pose(read.box_px[~cut], kind, body_height_m, settings.ground.height_sigma)
    _check("height_m", found.height_m, "m")
    keys = {
        "height_m": found.height_m,
        "pitch_deg": math.degrees(found.pitch_rad),
        "height_sigma_m": found.height_sigma_m,
        "pitch_sigma_deg": math.degrees(found.pitch_sigma_rad),
    }
    line = (
        f"camera {found.height_m:.2f} ± {found.height_sigma_m:.2f} m above the ground, {keys['pitch_deg']:.2f} ± "
        f"{keys['pitch_sigma_deg']:.2f}° down, from {int((~cut).sum())} boxes; half of them miss by less than "
        f"{found.miss:.1%} of their height"
    )
    return keys, [line]


def _known(camera: Path | None, size: str | None) -> dict[str, object]:
    """The keys of the camera that is to be completed."""
    known: dict[str, object] = {}
    if camera is not None:
        from torchvision_dddas.io.camera_files import read_camera_keys

        known = read_camera_keys(camera)
    if size is not None:
        width, _, height = size.lower().partition("x")
        if not all(side.isdecimal() and len(side) < 7 and 0 < int(side) <= 100_000 for side in (width, height)):
            raise InputError(f"--size is {size!r}; wanted WIDTHxHEIGHT in pixels, such as 768x576")
        known |= {"width_px": int(width), "height_px": int(height)}
    return known


def _without_focal(known: dict[str, object], found: dict[str, float]) -> dict[str, object]:
    """What is known but the focal length that was found anew."""
    old = ("focal_px", "focal_v_px", "hfov_deg", "focal_sigma") if "focal_px" in found else ()
    return {key: value for key, value in known.items() if key not in old}


def _toml(keys: dict[str, object]) -> str:
    from torchvision_dddas.config import format_toml

    return format_toml({key: _rounded(value) if key not in PLACES else value for key, value in keys.items()})


def _rounded(value: object) -> object:
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _check(key: str, value: float, unit: str) -> None:
    """Raises InputError for what no camera's file may hold."""
    from torchvision_dddas.io.camera_files import LIMITS

    low, high = LIMITS[key]
    if not low <= value <= high:
        raise InputError(
            f"{key} would be {value:g} {unit}, which no camera has ({low:g} to {high:g}); check the distances in "
            "metres, the heights in pixels and the body height in metres"
        )


def _check_out(path: Path, table: Path | None) -> None:
    """Raises InputError where the TOML would replace the table, or a folder is in its place."""
    from torchvision_dddas.io.atomic_files import refuse_folder, refuse_own_input

    refuse_own_input([] if table is None else [table], [path], "--out")
    refuse_folder(path)


def _write(path: Path, text: str) -> None:
    from torchvision_dddas.io.atomic_files import cannot_write, write_whole

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text.encode())
    except OSError as error:
        raise cannot_write(path, error) from error
