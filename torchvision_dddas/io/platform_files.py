"""Additional platforms: TOML files that name a platform's clip, its camera and its places.

clip = "ugv1.mp4"          # or detections = "people.csv", boxes of an earlier run
camera = "camera.toml"     # or a table [camera] with the keys of such a file
poses = "poses.csv"        # by frame or time_s of this clip; omit it for a camera that stands still
starts_s = 2.5             # when the clip begins, in seconds of the main clip; or starts_utc, a date and time
rate_hz = 10               # of a folder of pictures or a table; a video has its own rate

A further UAV has telemetry or landmarks instead of poses, and may have colours, dem and set, as in `dddas run`.
"""

import math
from dataclasses import dataclass, field
from datetime import datetime
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from torchvision_dddas.config import read_toml
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.camera_files import describe_missing, read_camera, read_camera_keys, read_poses
from torchvision_dddas.io.sources import stream_target
from torchvision_dddas.types import Camera, PoseTable

KEYS: dict[str, tuple[type, ...]] = {
    "name": (str,),
    "clip": (str,),
    "detections": (str,),
    "camera": (str, dict),
    "poses": (str,),
    "starts_s": (float, int),
    "starts_utc": (datetime,),
    "rate_hz": (float, int),
    "interval": (int,),
}
"""Keys and their types. name: the platform's name, by default the file's. interval: people are detected in every n-th
frame of the clip. Relative paths start at the file's own folder.
"""
BESIDE = ("telemetry", "landmarks", "camera", "colours", "dem")
AERIAL_KEYS = {key: kinds for key, kinds in KEYS.items() if key != "poses"} | dict.fromkeys(BESIDE, (str,))
AERIAL_KEYS["set"] = (list,)
"""Keys of a further UAV. Keys of BESIDE name files, like options of `dddas run`. `set` is a list of --set values."""
_KINDS = {str: "a text in quotes", dict: "a table", float: "a number", int: "a whole number"}
_KINDS |= {datetime: "a date and time", list: "a list"}


@dataclass(frozen=True, kw_only=True)
class Platform:
    """The content of a platform's file. clip: the input to open, or "" with detections. files: all files it names.

    starts_s: NaN if starts_utc_s, seconds since 1970, is given instead. beside, overrides: for a further UAV, the given
    files of BESIDE, and its parameter changes.
    """

    name: str
    clip: str
    detections: Path | None
    starts_s: float
    starts_utc_s: float
    rate_hz: float | None
    interval: int
    files: tuple[Path, ...]
    beside: dict[str, Path] = field(default_factory=dict)
    overrides: tuple[str, ...] = ()

    @property
    def is_stream(self) -> bool:
        """Whether the clip is a camera or a network address."""
        return stream_target(self.clip) is not None


@dataclass(frozen=True, kw_only=True)
class PlatformFile(Platform):
    """A platform on the ground. poses: None for a camera that stands still."""

    camera: Camera
    poses: PoseTable | None
    notes: tuple[str, ...] = ()


def read_platform(path: str | Path) -> PlatformFile:
    """Read a platform's file. Raise InputError if it is unreadable, or a key is unknown, missing or of a wrong type."""
    path = Path(path)
    content = _read_keys(path, KEYS)
    if "camera" not in content:
        raise InputError(f"platform {path} lacks camera: the TOML of its camera, or a table [camera]")
    for other in ("clip", "interval"):
        if other in content and "detections" in content:
            raise InputError(f"platform {path} has {other} and detections; give one of them")
    if not {"clip", "detections"} & content.keys():
        raise InputError(f"platform {path} lacks clip (its pictures) or detections (the boxes of its people)")
    if "detections" in content and "rate_hz" not in content:
        raise InputError(f"platform {path} has detections by frame; give rate_hz too, the frames per second")
    files = {key: path.parent / content[key] for key in ("camera", "poses") if isinstance(content.get(key), str)}
    camera_path, poses_path = files.get("camera"), files.get("poses")
    table: dict[str, Any] | None = None if camera_path is not None else content["camera"]
    camera = read_camera(camera_path or path, content=table)
    poses = None if poses_path is None else read_poses(poses_path)
    places = () if poses is None else poses.values
    missing = describe_missing(camera_path or path, poses, table)
    if not {"longitude_deg", "east_m"} & {*read_camera_keys(camera_path or path, content=table), *places}:
        raise InputError(f"platform {path} has no place; give poses with places, or a place in its camera")
    common = _common(path, content, [*files.values()])
    return PlatformFile(**common, camera=camera, poses=poses, notes=(missing,) if missing else ())


def read_aerial_platform(path: str | Path) -> Platform:
    """Read the file of a further UAV. Raise InputError as `read_platform` does, and if nothing can locate the UAV."""
    path = Path(path)
    content = _read_keys(path, AERIAL_KEYS)
    if "clip" not in content:
        raise InputError(f"platform {path} lacks clip (its pictures)")
    if not {"telemetry", "landmarks"} & content.keys():
        raise InputError(
            f"platform {path} lacks telemetry or landmarks, which are needed to locate targets; without them, "
            "`dddas views` shares identities between tables of tracks"
        )
    beside = {key: path.parent / content[key] for key in BESIDE if key in content}
    common = _common(path, content, [*beside.values()])
    return Platform(**common, beside=beside, overrides=tuple(map(str, content.get("set", ()))))


def _read_keys(path: Path, keys: dict[str, tuple[type, ...]]) -> dict[str, Any]:
    content = read_toml(path, "platform")
    for key, value in content.items():
        if key not in keys:
            near = get_close_matches(key, keys, 1)
            hint = f"did you mean {near[0]}?" if near else f"the keys are {', '.join(keys)}"
            if key in KEYS | AERIAL_KEYS:
                hint = "is this a file for --aerial?" if keys is KEYS else "is this a file for --ground?"
            raise InputError(f"platform {path} has the unknown key {key}; {hint}")
        if not isinstance(value, keys[key]) or isinstance(value, bool):
            raise InputError(f"platform {path}: {key} is {str(value)[:40]!r}; wanted {_KINDS[keys[key][0]]}")
    if empty := [key for key, value in content.items() if value == ""]:
        raise InputError(f"platform {path}: {empty[0]} is empty; give it, or leave the key out")
    if set(content.get("name", "")) & set(";:"):
        raise InputError(f"platform {path}: name is {content['name']!r}; wanted a text without ; and :")
    return content


def _common(path: Path, content: dict[str, Any], files: list[Path]) -> dict[str, Any]:
    """Return the fields that every platform has. files: further files that the platform names."""
    rate_hz, interval, starts_s = content.get("rate_hz"), content.get("interval", 1), content.get("starts_s", 0.0)
    if not (interval >= 1 and (rate_hz is None or 0 < rate_hz <= 1000) and abs(starts_s) < 1e9):
        raise InputError(f"platform {path}: interval must be 1 or more, rate_hz 0 to 1000, starts_s in seconds")
    clip, utc = str(content.get("clip", "")), content.get("starts_utc")
    detections = path.parent / content["detections"] if "detections" in content else None
    named = [] if stream_target(clip) is not None or not clip else [path.parent / clip]
    if utc is not None and "starts_s" in content:
        raise InputError(f"platform {path} has starts_s and starts_utc; give one of them")
    if utc is not None and utc.tzinfo is None:
        raise InputError(f"platform {path}: starts_utc is {utc}; give a time zone too, as in {utc.isoformat()}Z")
    return {
        "name": content.get("name", path.stem),
        "clip": str(named[0]) if named else clip,
        "detections": detections,
        "starts_s": math.nan if utc is not None else float(starts_s),
        "starts_utc_s": math.nan if utc is None else utc.timestamp(),
        "rate_hz": None if rate_hz is None else float(rate_hz),
        "interval": interval,
        "files": (path, *files, *([] if detections is None else [detections]), *named),
    }
