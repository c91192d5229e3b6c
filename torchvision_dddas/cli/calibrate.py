"""`dddas calibrate`: find the camera data that ranging needs, from people in the camera's pictures."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchvision_dddas.cli.options import Config, Overrides, echo, parse_size, report_errors
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from torchvision_dddas.config import Settings

BODY_HEIGHTS_M = 0.1, 10.0  # lowest and greatest height of a person, or of an object used instead
UNROUNDED = ("longitude_deg", "latitude_deg", "east_m", "north_m")  # keys that are written with all digits
FOCAL_KEYS = ("focal_px", "focal_v_px", "hfov_deg", "focal_sigma")

Found = tuple[dict[str, float], list[str]]
"""Keys of a camera's TOML, and lines for the user."""


@report_errors
def calibrate(
    table: Annotated[
        Path | None,
        typer.Argument(help="A CSV of distance_m,height_px; or boxes of people: detections or tracks."),
    ] = None,
    body_height: Annotated[
        float | None, typer.Option(metavar="M", help="Height of the person. [default: ground.body_height_m]")
    ] = None,
    distance: Annotated[float | None, typer.Option(metavar="M", help="Distance of the person from the camera.")] = None,
    pixels: Annotated[
        list[float] | None, typer.Option(metavar="N", help="The person's height in a picture; may be repeated.")
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="A camera's TOML to complete; if it has a focal length, find height and pitch."
        ),
    ] = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Size of the pictures, such as 768x576.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="The TOML to write. [default: print it]")] = None,
    config: Config = None,
    set_: Overrides = None,
) -> None:
    """Find a camera's focal length from a person of known height at a known distance, f = D h / H.

    The camera looks horizontally. Give --distance with --pixels or the boxes of one person, or a table of distances.

    With boxes of people all over the picture and a --camera of known focal length: find the camera's height and pitch.
    """
    import numpy as np

    from torchvision_dddas.config import format_toml, load_config
    from torchvision_dddas.io.atomic_files import refuse_folder, refuse_own_input, save_file
    from torchvision_dddas.io.camera_files import LIMITS, has_measurements, read_camera_keys, read_measurements

    settings = load_config(config, set_ or [])
    body_m, (low, high) = settings.ground.body_height_m if body_height is None else body_height, BODY_HEIGHTS_M
    if not low <= body_m <= high:
        raise InputError(f"--body-height must be {low:g} to {high:g} m, got {body_m:g}")
    if out is not None:
        refuse_own_input([] if table is None else [table], [out], "--out")
        refuse_folder(out)
    known = {} if camera is None else read_camera_keys(camera)
    if size is not None:
        known["width_px"], known["height_px"] = parse_size(size, 1, 100_000)
    if pixels and table is not None:
        raise InputError("--pixels and a table were both given; give only one of them")
    if not pixels and table is None:
        raise InputError("calibration needs --distance with --pixels, or a table (see --help); got neither")
    if table is not None and has_measurements(table):
        if distance is not None:
            raise InputError(f"{table} has its own distances, and --distance was given as well; leave one out")
        found, lines = _find_focal_length(*read_measurements(table), body_m)
    elif distance is not None:
        heights_px = np.array(pixels, float) if table is None else _read_heights(table)
        found, lines = _find_focal_length(np.full(len(heights_px), distance), heights_px, body_m)
    elif table is not None:
        found, lines = _find_pose(table, camera, body_m, settings)
    else:
        raise InputError("--pixels needs --distance, the person's distance from the camera in metres")
    key, unit = ("focal_px", "px") if "focal_px" in found else ("height_m", "m")
    low, high = LIMITS[key]
    if not low <= found[key] <= high:
        raise InputError(
            f"{key} would be {found[key]:g} {unit}, which no camera has ({low:g} to {high:g}); check the distances in "
            "metres, the heights in pixels and the body height in metres"
        )
    keys = {name: value for name, value in known.items() if key != "focal_px" or name not in FOCAL_KEYS} | found
    for name, value in keys.items():
        if isinstance(value, float) and name not in UNROUNDED:
            keys[name] = float(f"{value:.6g}")
    text = format_toml(keys)
    for line in lines:
        echo(line, err=out is None)
    if out is None:
        echo(text.removesuffix("\n"))
        return
    save_file(out, text.encode())
    missing = "" if "width_px" in known else "; width_px and height_px are still missing (--size)"
    echo(f"{out}: the camera{missing}")


def _read_heights(table: Path) -> "np.ndarray":
    """Return the heights of one person's whole boxes, px. Raise InputError for several people in a frame."""
    import numpy as np

    from torchvision_dddas.io.detection_tables import read_detections

    read = read_detections(table)
    frames, count = np.unique(read.frame, return_counts=True)
    if len(frames) and count.max() > 1:
        raise InputError(
            f"{table} has {count.max()} boxes in frame {frames[count.argmax()]}; "
            "--distance needs a single person in each picture"
        )
    heights_px = read.box_px[:, 3] if read.cut is None else read.box_px[~read.cut, 3]
    if not len(heights_px):
        raise InputError(f"{table} has no uncut person to calibrate with")
    return heights_px


def _find_focal_length(distances_m: "np.ndarray", heights_px: "np.ndarray", body_height_m: float) -> Found:
    from torchvision_dddas.geo import calibrate_focal_length

    found, n = calibrate_focal_length(distances_m, heights_px, body_height_m), len(heights_px)
    spread = "" if math.isnan(found.spread_px) else f", one measurement ± {found.spread_px:.1f} px"
    figure = f"focal length {found.focal_px:.1f} ± {found.sigma_px:.1f} px"
    lines = [f"{figure} from {n} measurement{'s' * (n != 1)}{spread}"]
    if found.outlier.any():
        first = int(found.outlier.argmax())
        lines.append(
            f"note: {int(found.outlier.sum())} of {n} left out as outliers, the first {heights_px[first]:g} px at "
            f"{distances_m[first]:g} m"
        )
    return {"focal_px": found.focal_px, "focal_sigma": found.sigma_px / found.focal_px}, lines


def _find_pose(table: Path, camera: Path | None, body_height_m: float, settings: "Settings") -> Found:
    from torchvision_dddas.geo import calibrate_pose, touches_border
    from torchvision_dddas.io.camera_files import read_camera
    from torchvision_dddas.io.detection_tables import read_detections

    if camera is None:
        raise InputError(
            f"{table} has boxes without distances: give --distance for one person's, or --camera FILE with a focal "
            "length to find the camera's height and pitch"
        )
    known, read = read_camera(camera), read_detections(table)
    cut = touches_border(read.box_px, known.size_px) if read.cut is None else read.cut
    found = calibrate_pose(read.box_px[~cut], known, body_height_m, settings.ground.height_sigma)
    pitch_deg, sigma_deg = math.degrees(found.pitch_rad), math.degrees(found.pitch_sigma_rad)
    line = (
        f"camera {found.height_m:.2f} ± {found.height_sigma_m:.2f} m above the ground, {pitch_deg:.2f} ± "
        f"{sigma_deg:.2f}° down, from {int((~cut).sum())} boxes; half of them miss by less than "
        f"{found.miss:.1%} of their height"
    )
    keys = {"height_m": found.height_m, "pitch_deg": pitch_deg}
    return keys | {"height_sigma_m": found.height_sigma_m, "pitch_sigma_deg": sigma_deg}, [line]
