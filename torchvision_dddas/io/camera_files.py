"""Cameras on the ground from TOML files, and where a moving one stood from a CSV.

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
from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.csv_text import Line, opened
from torchvision_dddas.io.toml_text import toml_of
from torchvision_dddas.types import Camera, PoseTable

LIMITS: dict[str, tuple[float, float]] = {
    "focal_px": (1, 1e6),
    "focal_v_px": (1, 1e6),
    "hfov_deg": (0.1, 170),
    "width_px": (1, 1e5),
    "height_px": (1, 1e5),
    "height_m": (0.01, 1000),
    "pitch_deg": (-89, 89),
    "roll_deg": (-180, 180),
    "heading_deg": (-360, 360),
    "east_m": (-1e7, 1e7),
    "north_m": (-1e7, 1e7),
    "longitude_deg": (-180, 180),
    "latitude_deg": (-90, 90),
    "k1": (-10, 10),
    "k2": (-100, 100),
    "focal_sigma": (0, 1),
    "height_sigma_m": (0, 100),
    "pitch_sigma_deg": (0, 45),
    "heading_sigma_deg": (0, 180),
    "position_sigma_m": (0, 1000),
}
"""Every key that is a number, and what it may be. `centre_px` is a pair; `name` a text.

focal_v_px: along the columns, where pixels are not square. centre_px: u, v of the optical axis. pitch_deg: positive
down. roll_deg: turned clockwise. k1, k2: radial distortion as OpenCV has it. The sigmas are standard deviations; of the
focal length as a share.
"""

SIGMAS = {
    "focal_sigma": "focal_sigma",
    "height_sigma_m": "height_sigma_m",
    "pitch_sigma_deg": "pitch_sigma_rad",
    "heading_sigma_deg": "heading_sigma_rad",
    "position_sigma_m": "position_sigma_m",
}
"""What Camera calls them. Left out: 1 %, 0.05 m, 0.5°, 2° (a compass) and 1.43 m (a GPS of 3.5 m in 95 %)."""

KEYS = (*LIMITS, "centre_px", "name")
PLACES = (("longitude_deg", "latitude_deg"), ("east_m", "north_m"))


def camera_keys(path: str | Path) -> dict[str, Any]:
    """The keys of a camera's file, complete or not, each checked.

    Raises InputError with the file and the key: unreadable, no TOML, a key that no camera has, a value out of range.
    """
    content = toml_of(path, "camera")
    for key in content:
        if key not in KEYS:
            near = get_close_matches(key, KEYS, 1)
            raise InputError(
                f"camera {path} has the key {key}, which no camera has; "
                + (f"did you mean {near[0]}?" if near else f"there are {', '.join(KEYS)}")
            )
    for key in LIMITS.keys() & content.keys():
        _number(content[key], key, path)
    if "centre_px" in content:
        _pair(content["centre_px"], path)
    if not isinstance(content.get("name", ""), str):
        raise InputError(f"camera {path}: name is {content['name']!r}; wanted a text in quotes")
    return content


def left_open(camera: str | Path, poses: PoseTable | None = None) -> str:
    """What a camera's file, and its poses, do not say, and what is taken for it, in words; empty where all is there."""
    given = {*camera_keys(camera), *(poses.values if poses is not None else ())}
    gaps = []
    if "height_m" not in given:
        gaps.append("no height_m: the foot row tells nothing")
    if "pitch_deg" not in given:
        gaps.append("no pitch_deg: it looks level")
    if "heading_deg" not in given:
        gaps.append("no heading_deg: it looks north")
    if not given & {"east_m", "longitude_deg"}:
        gaps.append("no place: it stands at 0, 0")
    return f"{camera} has {'; '.join(gaps)}" if gaps else ""


def read_camera(path: str | Path) -> Camera:
    """Read a camera. Raises InputError with the file and the key: unreadable, unknown, missing, out of range."""
    content = camera_keys(path)
    numbers = {key: float(content[key]) for key in LIMITS if key in content}
    if missing := [key for key in ("width_px", "height_px") if key not in numbers]:
        raise InputError(f"camera {path} lacks {', '.join(missing)}: the size of its pictures")
    size = int(numbers["width_px"]), int(numbers["height_px"])
    focal = _focal(numbers, size, path)
    place, geographic = _place(numbers, path)
    angles = {
        f"{name}_rad": math.radians(numbers[f"{name}_deg"])
        for name in ("heading", "pitch", "roll")
        if f"{name}_deg" in numbers
    }
    sigmas = {
        SIGMAS[key]: math.radians(numbers[key]) if key.endswith("_deg") else numbers[key]
        for key in SIGMAS
        if key in numbers
    }
    return Camera(
        name=content.get("name", Path(path).stem),
        size_px=size,
        focal_px=focal,
        centre_px=_pair(content.get("centre_px", [(size[0] - 1) / 2, (size[1] - 1) / 2]), path),
        place=place,
        geographic=geographic,
        height_m=numbers.get("height_m", math.nan),
        k1=numbers.get("k1", 0.0),
        k2=numbers.get("k2", 0.0),
        **angles,
        **sigmas,
    )


def _number(value: Any, key: str, path: str | Path) -> None:
    low, high = LIMITS[key]
    whole = key in ("width_px", "height_px")
    if not (_is_number(value) and low <= value <= high) or (whole and value != int(value)):
        kind = "whole number" if whole else "number"
        shown = "far too large" if isinstance(value, int) and abs(value) > 10**40 else repr(value)[:40]
        raise InputError(f"camera {path}: {key} is {shown}; wanted a {kind} from {low:g} to {high:g}")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _focal(numbers: dict[str, float], size: tuple[int, int], path: str | Path) -> tuple[float, float]:
    if ("focal_px" in numbers) == ("hfov_deg" in numbers):
        given = "both focal_px and hfov_deg; give one" if "focal_px" in numbers else "no focal length (focal_px)"
        raise InputError(
            f"camera {path} has {given}. `dddas calibrate` finds it from a person of known height at a known distance"
        )
    if "focal_px" in numbers:
        along = numbers["focal_px"]
    else:
        along = size[0] / 2 / math.tan(math.radians(numbers["hfov_deg"]) / 2)
    return along, numbers.get("focal_v_px", along)


def _pair(centre: Any, path: str | Path) -> tuple[float, float]:
    if not (isinstance(centre, list) and len(centre) == 2 and all(_is_number(v) and abs(v) <= 1e5 for v in centre)):
        raise InputError(f"camera {path}: centre_px is {centre!r}; wanted [u, v] of the optical axis, in pixels")
    return float(centre[0]), float(centre[1])


def _place(numbers: dict[str, float], path: str | Path) -> tuple[tuple[float, float], bool]:
    given = [[key for key in kind if key in numbers] for kind in PLACES]
    if all(given):
        raise InputError(f"camera {path} has {given[0][0]} and {given[1][0]}; give its place in degrees or in metres")
    for kind, keys in zip(PLACES, given, strict=True):
        if len(keys) == 1:
            raise InputError(f"camera {path} has {keys[0]} alone; wanted {' and '.join(kind)}")
    kind = PLACES[0] if given[0] else PLACES[1]
    return (numbers.get(kind[0], 0.0), numbers.get(kind[1], 0.0)), bool(given[0])


# --------------------------------------------------------------------------------------------------------------------
# Where a moving camera stood.

POSE_COLUMNS = ("frame", "time_s", "longitude_deg", "latitude_deg", "east_m", "north_m", "heading_deg", "pitch_deg")


def read_poses(path: str | Path) -> PoseTable:
    """Read the poses of a camera: `frame` or `time_s`, and any of the other POSE_COLUMNS; further ones are ignored.

    Raises InputError with file and line: unreadable, no such column, half a place, no rows, not a finite number, out
    of range, a frame or time that does not come after the one before.
    """
    with opened(path, "poses") as (header, lines):
        return _parse(header, lines, str(path))


def _parse(header: list[str], lines: Iterator[Line], path: str) -> PoseTable:
    columns = ", ".join(header) or "none"
    if twice := [name for name in POSE_COLUMNS if header.count(name) > 1]:
        raise InputError(f"poses {path}: column {twice[0]} is named twice; wanted each name once")
    known = [name for name in POSE_COLUMNS if name in header]
    if not {"frame", "time_s"} & set(known):
        raise InputError(f"poses {path}: its columns are {columns}; wanted frame or time_s among them")
    timed = "frame" not in known
    wanted = [name for name in known if name not in ("frame", "time_s")]
    if not wanted:
        raise InputError(f"poses {path}: its columns are {columns}; wanted any of {', '.join(POSE_COLUMNS[2:])}")
    for kind in PLACES:
        if (kind[0] in wanted) != (kind[1] in wanted):
            raise InputError(f"poses {path}: its columns are {columns}; wanted {' and '.join(kind)} together")
    if PLACES[0][0] in wanted and PLACES[1][0] in wanted:
        raise InputError(f"poses {path} has longitude_deg and east_m; give places in degrees or in metres")
    names = ["time_s" if timed else "frame", *wanted]
    places = [header.index(name) for name in names]
    rows: list[list[float]] = []
    for number, row in lines:
        cells = [row[place] if place < len(row) else "" for place in places]
        rows.append([_cell(c, n, path, number) for c, n in zip(cells, names, strict=True)])
        if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
            raise InputError(
                f"poses {path}, line {number}: {names[0]} goes from {rows[-2][0]:g} to {rows[-1][0]:g}; "
                "wanted each after the one before"
            )
    if not rows:
        raise InputError(f"poses {path} has a header but no rows")
    table = np.array(rows, float).T
    return PoseTable(path, table[0], timed, dict(zip(wanted, table[1:], strict=True)))


def _cell(text: str, name: str, path: str, line: int) -> float:
    low, high = LIMITS.get(name, (-1e12, 1e12))
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise InputError(f"poses {path}, line {line}: {name} is '{text}'; wanted a number from {low:g} to {high:g}")
    return value
