"""Cameras on the ground: TOML files of cameras, CSVs of the poses of moving cameras, and CSVs of measured heights.

focal_px = 1195            # or hfov_deg; `dddas calibrate` finds it
width_px = 768
height_px = 576
height_m = 1.2             # above the ground
pitch_deg = 3.0            # down
heading_deg = 54.3         # clockwise from true north
longitude_deg = -110.95    # or east_m, north_m
latitude_deg = 32.23
"""

import math
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.config import read_toml
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.tables import PLACES, Column, Schema, read_csv, read_table
from torchvision_dddas.types import Camera, PoseTable

LIMITS: dict[str, tuple[float, float]] = {
    "focal_px": (1, 1e6), "focal_v_px": (1, 1e6), "hfov_deg": (0.1, 170), "width_px": (1, 1e5), "height_px": (1, 1e5),
    "height_m": (0.01, 1000), "pitch_deg": (-89, 89), "roll_deg": (-180, 180), "heading_deg": (-360, 360),
    "east_m": (-1e7, 1e7), "north_m": (-1e7, 1e7), "longitude_deg": (-180, 180), "latitude_deg": (-90, 90),
    "k1": (-10, 10), "k2": (-100, 100), "p1": (-1, 1), "p2": (-1, 1), "k3": (-1000, 1000),
    "focal_sigma": (0, 1), "height_sigma_m": (0, 100), "pitch_sigma_deg": (0, 45),
    "heading_sigma_deg": (0, 180), "position_sigma_m": (0, 1000), "takeoff_above_sea_m": (-500, 9000),
    "elevation_m": (-500, 9000),
}  # fmt: skip
"""Range of every numeric key. `centre_px` is a pair; `name` is text.

focal_v_px: focal length along the columns, if pixels are not square. centre_px: u, v of the optical axis. pitch_deg:
positive down. roll_deg: clockwise. takeoff_above_sea_m: height of the take-off point of an aerial vehicle.
elevation_m: height above the sea of the ground below a ground camera. k1, k2, k3: radial distortion, p1, p2: tangential
distortion, as in OpenCV. The sigmas are standard deviations; focal_sigma is a share of the focal length. Their defaults
are 1 %, 0.05 m, 0.5°, 2° (a compass) and 1.43 m (a GPS). Aerial cameras have the defaults of the group `aerial`.
"""

DISTORTION = ("k1", "k2", "p1", "p2", "k3")
"""The keys of the lens distortion, in OpenCV's order."""

KEYS = (*LIMITS, "centre_px", "name")
_SIZE = ("width_px", "height_px")
# Keys that are fields of Camera; degrees become radians.
_FIELDS = (
    *("height_m", "pitch_deg", "roll_deg", "heading_deg", *DISTORTION, "takeoff_above_sea_m", "elevation_m"),
    *(key for key in LIMITS if "sigma" in key),
)


def read_camera_keys(
    path: str | Path, is_aerial: bool = False, content: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Read and check the keys of a camera's file. Keys may be missing. is_aerial: the camera may look straight down.

    content: the keys, if they are a table in another file; path is then used only in messages.
    Raise InputError with the file and the key if the file is unreadable or not TOML, or a key or value is not allowed.
    """
    content = read_toml(path, "camera") if content is None else content
    for key in content:
        if key not in KEYS:
            near = get_close_matches(key, KEYS, 1)
            hint = f"did you mean {near[0]}?" if near else f"the keys are {', '.join(KEYS)}"
            raise InputError(f"camera {path} has the unknown key {key}; {hint}")
    limits = LIMITS | {"pitch_deg": (-90, 90)} if is_aerial else LIMITS
    for key, (low, high) in limits.items():
        value = content.get(key, low)
        if not (_is_number(value) and low <= value <= high) or (key in _SIZE and value != int(value)):
            kind = "whole number" if key in _SIZE else "number"
            shown = "far too large" if isinstance(value, int) and abs(value) > 10**40 else repr(value)[:40]
            raise InputError(f"camera {path}: {key} is {shown}; wanted a {kind} from {low:g} to {high:g}")
    centre = content.get("centre_px", [0, 0])
    if not (isinstance(centre, list) and len(centre) == 2 and all(_is_number(v) and abs(v) <= 1e5 for v in centre)):
        raise InputError(f"camera {path}: centre_px is {centre!r}; wanted [u, v] of the optical axis, in pixels")
    if not isinstance(content.get("name", ""), str):
        raise InputError(f"camera {path}: name is {content['name']!r}; wanted a text in quotes")
    return content


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def describe_missing(camera: str | Path, poses: PoseTable | None = None, content: dict[str, Any] | None = None) -> str:
    """Return which keys a camera's file and its poses lack, and what is assumed instead; "" if nothing is missing."""
    given = {*read_camera_keys(camera, content=content), *(poses.values if poses is not None else ())}
    assumed = {
        "no height_m: distances from the foot row are unknown": {"height_m"},
        "no pitch_deg: a level camera is assumed": {"pitch_deg"},
        "no heading_deg: north is assumed": {"heading_deg"},
        "no place: 0, 0 is assumed": {"east_m", "longitude_deg"},
    }
    gaps = [words for words, keys in assumed.items() if not given & keys]
    return f"{camera} has {'; '.join(gaps)}" if gaps else ""


def read_aerial_camera(path: str | Path, size_px: tuple[int, int] | None) -> Camera:
    """Read an aerial camera. The file may lack the size, if size_px is given, and the focal length, which is then NaN.

    Raise InputError as `read_camera` does.
    """
    return _build_camera(path, size_px, is_aerial=True)


def read_camera(path: str | Path, *, content: dict[str, Any] | None = None) -> Camera:
    r"""Read a camera. content: as in `read_camera_keys`.

    Raise InputError with the file and the key if the file is unreadable, or a key is unknown, missing or out of range.

    >>> lines = ["focal_px = 500", "width_px = 640", "height_px = 480", "height_m = 1.2", "east_m = 0", "north_m = 0"]
    >>> written = pathlib.Path("camera.toml").write_text("\n".join([*lines, "heading_deg = 90", "pitch_deg = 0"]))
    >>> td.read_camera("camera.toml").focal_px
    (500.0, 500.0)
    """
    return _build_camera(path, content=content)


def _build_camera(
    path: str | Path,
    size_px: tuple[int, int] | None = None,
    is_aerial: bool = False,
    content: dict[str, Any] | None = None,
) -> Camera:
    content = dict(read_camera_keys(path, is_aerial, content))
    if size_px is not None and not set(_SIZE) & content.keys():
        content |= dict(zip(_SIZE, size_px, strict=True))
    numbers = {key: float(content[key]) for key in LIMITS if key in content}
    if missing := [key for key in _SIZE if key not in numbers]:
        raise InputError(f"camera {path} lacks {', '.join(missing)}: the size of its pictures")
    width, height = (int(numbers[key]) for key in _SIZE)
    lenses = [key for key in ("focal_px", "hfov_deg") if key in numbers]
    if len(lenses) != 1 and not (is_aerial and not lenses):
        given = "both focal_px and hfov_deg; give one" if "focal_px" in numbers else "no focal length (focal_px)"
        raise InputError(
            f"camera {path} has {given}. `dddas calibrate` finds it from a person of known height at a known distance"
        )
    if "focal_px" in numbers:
        focal = numbers["focal_px"]
    else:
        focal = width / 2 / math.tan(math.radians(numbers.get("hfov_deg", math.nan)) / 2)
    place, geographic = _place(numbers, path)
    u, v = content.get("centre_px", [(width - 1) / 2, (height - 1) / 2])
    fields = {
        key.replace("_deg", "_rad"): math.radians(numbers[key]) if key.endswith("_deg") else numbers[key]
        for key in _FIELDS
        if key in numbers
    }
    return Camera(
        given=frozenset([*fields, *(["focal_px"] if lenses else [])]),
        name=content.get("name", Path(path).stem),
        size_px=(width, height),
        focal_px=(focal, numbers.get("focal_v_px", focal)),
        centre_px=(float(u), float(v)),
        place=place,
        geographic=geographic,
        **fields,
    )


def _place(numbers: dict[str, float], path: str | Path) -> tuple[tuple[float, float], bool]:
    given = [[key for key in kind if key in numbers] for kind in PLACES]
    if all(given):
        raise InputError(f"camera {path} has {given[0][0]} and {given[1][0]}; give the place in degrees or in metres")
    for kind, keys in zip(PLACES, given, strict=True):
        if len(keys) == 1:
            raise InputError(f"camera {path} has {keys[0]} alone; give {' and '.join(kind)}")
    first, second = PLACES[0] if given[0] else PLACES[1]
    return (numbers.get(first, 0.0), numbers.get(second, 0.0)), bool(given[0])


# --------------------------------------------------------------------------------------------------------------------
# Tables.

_POSE_NAMES = ("frame", "time_s", *PLACES[0], *PLACES[1], "heading_deg", "pitch_deg")
POSES = Schema("poses", *(Column(name, "g", *LIMITS.get(name, (-1e12, 1e12))) for name in _POSE_NAMES))


def read_poses(path: str | Path) -> PoseTable:
    r"""Read the poses of a camera from `frame` or `time_s` and the other columns of POSES. Ignore further columns.

    Raise InputError with file and line as read_table does, and if no column of POSES, half a place or no row is given,
    or if frames or times do not rise.

    >>> written = pathlib.Path("poses.csv").write_text("frame,heading_deg\n1,0\n2,5\n")
    >>> td.read_poses("poses.csv").values["heading_deg"]
    array([0., 5.])
    """
    text = read_csv(path, "poses")
    columns = f"poses {path}: its columns are {', '.join(text.header) or 'none'}"
    known = [name for name in POSES.names if name in text.header]
    if not {"frame", "time_s"} & set(known):
        raise InputError(f"{columns}; wanted frame or time_s among them")
    clock, *wanted = [name for name in known if name != "time_s" or "frame" not in known]
    if not wanted:
        raise InputError(f"{columns}; wanted any of {', '.join(POSES.names[2:])}")
    for kind in PLACES:
        if (kind[0] in wanted) != (kind[1] in wanted):
            raise InputError(f"{columns}; wanted {' and '.join(kind)} together")
    if PLACES[0][0] in wanted and PLACES[1][0] in wanted:
        raise InputError(f"poses {path} has longitude_deg and east_m; give places in degrees or in metres")
    table = read_table(path, Schema("poses", *(c for c in POSES.columns if c.name in (clock, *wanted))), (), True, text)
    table.require_rows()
    at = table[clock]
    if (is_back := np.diff(at) <= 0).any():
        row = int(is_back.argmax()) + 1
        raise table.error(f"{clock} goes from {at[row - 1]:g} to {at[row]:g}; wanted rising values", row)
    return PoseTable(str(path), at, clock == "time_s", {name: table[name] for name in wanted})


MEASUREMENTS = Schema(
    "measurements",
    *(Column(name, "g", 1e-9, 1e9, wanted="a number above 0") for name in ("distance_m", "height_px")),
)


def has_measurements(path: str | Path) -> bool:
    """Return whether the first line of a file names the columns of MEASUREMENTS; False for an unreadable file."""
    try:
        with Path(path).open(encoding="utf-8-sig") as file:
            return set(MEASUREMENTS.names) <= {name.strip() for name in file.readline().split(",")}
    except (OSError, UnicodeDecodeError):
        return False


def read_measurements(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a person's distances (N,), m, and heights (N,), px. Raise InputError as read_table, or without rows."""
    table = read_table(path, MEASUREMENTS, MEASUREMENTS.names, is_ragged=True)
    table.require_rows()
    return table["distance_m"], table["height_px"]
