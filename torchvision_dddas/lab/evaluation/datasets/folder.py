"""Clips in the project's own layout: one folder for each clip, also as `dddas simulate` writes them."""

import json
from collections.abc import Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import ClassVar

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.detection_tables import read_rows
from torchvision_dddas.io.ground_tables import read_positions
from torchvision_dddas.lab.evaluation.datasets import files
from torchvision_dddas.lab.evaluation.datasets.record import Clip, Reader
from torchvision_dddas.lab.evaluation.metrics.truth import (
    ClipTruth,
    SeqInfo,
    TruePositions,
    find_truth,
    load_truth,
    read_seqinfo,
)

FRAMES = ("frames", "img1")
"""Folders that may hold a clip's pictures."""


class Folder(Reader):
    """The user's own data: a folder of clips in the plain convention, or one clip."""

    kind = "folder"
    layout = "your own: one folder for each clip, with frames/ or a video, and masks/, boxes_xywh.txt or gt/gt.txt"
    defaults: ClassVar = {"still": [], "people": [], "rate_hz": None}

    def _places(self) -> Mapping[str, Path]:
        return clips_in(self.folder, is_clip(self.folder))

    def _clip(self, name: str, place: Path) -> Clip:
        people, still = (any(fnmatchcase(name, p) for p in self.options[key]) for key in ("people", "still"))
        found = clip_at(place, name, self.options["rate_hz"])
        return files.fit_clip(replace(found, still=still, shows=("people",) if people else ("movers",)))


class Simulated(Reader):
    """The output of `dddas simulate`: a folder of runs, or one run.

        RUN/frames/000001.jpg     the UAV's pictures, or clip.mp4; a dropped picture is an empty file
        RUN/truth/masks/          the moving targets, including ground vehicles
        RUN/truth/gt.txt          the targets without the ground vehicles, with identities
        RUN/truth/positions.csv   the positions of the targets
        RUN/telemetry.csv, landmarks.csv, colours.toml, camera.toml, dem.tif
        RUN/run.json              frames per second, and whether the run was finished

    If masks were not saved, gt.txt has the boxes. The pictures of the ground vehicles, ground/, are not read.
    """

    kind = "simulated"
    layout = "the output of dddas simulate: one folder for each run"

    def _places(self) -> Mapping[str, Path]:
        return clips_in(self.folder, (self.folder / "truth").is_dir())

    def _clip(self, name: str, place: Path) -> Clip:
        truth = place / "truth"
        if not truth.is_dir():
            raise InputError(f"{place} has no truth/; wanted the output of `dddas simulate --out`")
        if not _pictures_at(place):
            raise InputError(f"{place} holds neither frames/ nor clip.mp4; simulate it with --save frames,masks")
        clip = clip_at(place, name, _rate_of_run(place / "run.json"))
        for part in ("gt.txt", "positions.csv"):
            if not (truth / part).is_file():
                raise InputError(f"{truth / part} does not exist; the run was not finished, simulate it again")
        is_empty = not (truth / "gt.txt").read_bytes().strip()
        labelled = ClipTruth("boxes", truth, {}, {}) if is_empty else load_truth(truth / "gt.txt")
        if (truth / "masks").is_dir():
            masks = load_truth(truth / "masks", 1).masks
            labelled = replace(labelled, kind="masks", place=truth, masks=masks)
        if not labelled.masks and is_empty:
            raise InputError(f"{truth}: no target is visible in the pictures")
        positions, fleet = _visible_positions(truth / "positions.csv")
        return files.fit_clip(
            replace(clip, truth=replace(labelled, length=clip.frames, positions=positions, fleet=fleet))
        )


def clips_in(folder: Path, is_one: bool) -> dict[str, Path]:
    """Return the folders of clips by name: the clips in a folder, or the folder if it is a clip."""
    return {folder.resolve().name: folder} if is_one else {name: folder / name for name in files.folders_in(folder)}


def is_clip(folder: Path) -> bool:
    """Return whether a folder is a clip, and not a folder of clips."""
    return any((folder / name).is_dir() for name in FRAMES) or find_truth(folder) is not None


def clip_at(place: Path, name: str, rate_hz: float | None = None) -> Clip:
    """Return the clip in a folder. rate_hz: replaces the rate in seqinfo.ini.

    Raise InputError without pictures and truth, for several videos, and for files that cannot be read.
    """
    pictures, truth = _pictures_at(place), None
    if (labels := find_truth(place)) is not None:
        numbers = files.frames_by_number(pictures) if len(pictures) > 1 else {}
        if labels.is_dir() and numbers:
            masks = [path for path in files.images_in(labels, frozenset({".png"})) if path.stem.isdecimal()]
            truth = ClipTruth("masks", labels, files.masks_by_frame(masks, numbers, pictures[0].parent), {})
        else:
            truth = load_truth(labels)
    elif not pictures:
        raise InputError(f"{place} holds neither pictures nor truth; wanted frames/ or a video, and masks/ or boxes")

    def first(*patterns: str) -> Path | None:
        return next((path for pattern in patterns for path in sorted(place.glob(pattern)) if path.is_file()), None)

    positions = first("positions.csv", "truth/positions.csv")
    if truth is not None and positions is not None:
        table = read_positions(positions)
        true_places = TruePositions(table.frame, table.target, table.east_north_m, table.lonlat_deg)
        truth = replace(truth, positions=true_places)
    info = read_seqinfo(place / "seqinfo.ini") if (place / "seqinfo.ini").is_file() else SeqInfo()
    return Clip(
        name,
        place,
        pictures,
        rate_hz or info.rate_hz,
        files.count_frames(pictures) or info.length,
        truth,
        given=first("det/det.txt", "det.txt"),
        telemetry=first("telemetry.*"),
        landmarks=first("landmarks.csv"),
        colours=first("colours.toml"),
        camera=first("camera.toml"),
        elevation=first("dem.*"),
    )


def _pictures_at(place: Path) -> tuple[Path, ...]:
    for name in FRAMES:
        if found := files.images_in(place / name):
            return found
    videos = [v for v in files.videos_in(place) if v.stem != "telemetry"]  # MPEG-TS that carries only metadata
    if len(videos) > 1:
        raise InputError(f"{place} holds {len(videos)} videos, {videos[0].name} and {videos[1].name}; wanted one")
    return tuple(videos)


def _visible_positions(path: Path) -> tuple[TruePositions, TruePositions]:
    """Return the positions of visible targets, and of ground vehicles, which are the landmarks. Raise InputError."""
    table = read_positions(path)
    header, cells = read_rows(path)
    if absent := [name for name in ("kind", "visible_px") if name not in header]:
        raise InputError(f"positions {path} lacks {', '.join(absent)}; wanted the output of `dddas simulate`")
    kind, visible = header.index("kind"), header.index("visible_px")
    is_fleet = np.array([row[kind] == "ugv" for row in cells], bool)
    is_visible = np.array([row[visible] not in ("", "0") for row in cells], bool)

    def only(rows: np.ndarray) -> TruePositions:
        degrees = None if table.lonlat_deg is None else table.lonlat_deg[rows]
        return TruePositions(table.frame[rows], table.target[rows], table.east_north_m[rows], degrees)

    return only(is_visible & ~is_fleet), only(is_fleet)


def _rate_of_run(path: Path) -> float | None:
    """Return the frames per second of the run. Raise InputError if it was not finished, or the file is damaged."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        rate, state = record["clip"]["rate_hz"], record["state"]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise InputError(f"{path} does not hold the frames per second: {str(error)[:80]}") from None
    if state != "complete":
        raise InputError(f"{path}: the run is {state}; simulate it again")
    return float(rate) if isinstance(rate, (int, float)) and 0 < rate <= 1000 else None
