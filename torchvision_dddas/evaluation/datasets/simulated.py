"""What `dddas simulate` writes: a folder a run, or one run.

    RUN/frames/000001.jpg     the UAV's pictures, or clip.mp4; a dropped one is an empty file
    RUN/truth/masks/          the targets that move, ground vehicles among them
    RUN/truth/gt.txt          the targets without the ground vehicles, with identities
    RUN/truth/positions.csv   where they are
    RUN/telemetry.csv, landmarks.csv, colours.toml, camera.toml, dem.tif
    RUN/run.json              frames a second, and whether the run was finished

Pixels and boxes are scored by the masks, identities by gt.txt, places by positions.csv; of the latter the targets that
show, and not the ground vehicles, which are the landmarks. A track on one of them, as the masks show it, is neither
right nor false. Where masks were not saved, gt.txt has the boxes. The
pictures of the ground vehicles, ground/, are not read. Options: none. Terms of use: none but this project's licence.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.files import fit_clip
from torchvision_dddas.evaluation.datasets.folder import clip_at, clips_in, pictures_at
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options
from torchvision_dddas.evaluation.metrics.truth import Positions, Truth, load_truth
from torchvision_dddas.io.detection_tables import read_rows
from torchvision_dddas.io.ground_tables import read_positions


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The runs of a folder, or the one that it is. See `kinds.KINDS`."""
    check_options("simulated", options, {})
    places = clips_in(folder, (folder / "truth").is_dir())

    def clip_of(name: str) -> Clip:
        place = places[name]
        if not (place / "truth").is_dir():
            raise InputError(f"{place} has no truth/; wanted what `dddas simulate --out` writes")
        if not pictures_at(place):
            raise InputError(f"{place} holds neither frames/ nor clip.mp4; simulate it with --save frames,masks")
        clip = clip_at(place, name, _rate(place / "run.json"))
        return fit_clip(replace(clip, truth=_truth(place / "truth", clip.frames)))

    return Collector("simulated", folder, "", wanted).collect(places, clip_of)


def _truth(place: Path, frames: int) -> Truth:
    """Masks, identities and places of a run. Raises InputError where a file is not there or damaged."""
    for name in ("gt.txt", "positions.csv"):
        if not (place / name).is_file():
            raise InputError(f"{place / name} does not exist; the run was not finished, simulate it again")
    empty = not (place / "gt.txt").read_bytes().strip()
    labelled = Truth("boxes", place, {}, {}) if empty else load_truth(place / "gt.txt")
    shown = Truth("masks", place, load_truth(place / "masks", 1).masks, {}) if (place / "masks").is_dir() else labelled
    if not shown.masks and empty:
        raise InputError(f"{place}: no target is visible in the pictures")
    positions, fleet = _positions(place / "positions.csv")
    return replace(
        shown,
        boxes=labelled.boxes,
        tracks=labelled.tracks,
        ignored=labelled.ignored,
        length=frames,
        positions=positions,
        fleet=fleet,
    )


def _positions(path: Path) -> tuple[Positions, Positions]:
    """The places of the visible targets, and of the ground vehicles, which are the landmarks. Raises InputError."""
    said = read_positions(path)
    header, cells = read_rows(path)
    if absent := [name for name in ("kind", "visible_px") if name not in header]:
        raise InputError(f"positions {path} lacks {', '.join(absent)}; wanted what `dddas simulate` writes")
    kind, shown = header.index("kind"), header.index("visible_px")
    fleet = np.array([row[kind] == "ugv" for row in cells], bool)
    shows = np.array([row[shown] not in ("", "0") for row in cells], bool)

    def only(rows: np.ndarray) -> Positions:
        degrees = None if said.lonlat_deg is None else said.lonlat_deg[rows]
        return Positions(said.frame[rows], said.target[rows], said.east_north_m[rows], degrees)

    return only(shows & ~fleet), only(fleet)


def _rate(path: Path) -> float | None:
    """Frames a second of the run. Raises InputError where it was not finished, or the file is damaged."""
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
        rate, state = said["clip"]["rate_hz"], said["state"]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise InputError(f"{path} does not hold the frames a second: {str(error)[:80]}") from None
    if state != "complete":
        raise InputError(f"{path}: the run is {state}; simulate it again")
    return float(rate) if isinstance(rate, (int, float)) and 0 < rate <= 1000 else None
