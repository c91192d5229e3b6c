"""One's own data: a folder of clips in the plain convention."""

from collections.abc import Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.files import (
    count_frames,
    fit_clip,
    frames_by_number,
    images_in,
    masks_by_frame,
    videos_in,
)
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options, folders_in
from torchvision_dddas.evaluation.metrics.truth import (
    Positions,
    SeqInfo,
    Truth,
    find_truth,
    load_truth,
    read_seqinfo,
)
from torchvision_dddas.io.ground_tables import read_positions

OPTIONS: Mapping[str, Any] = {"still": [], "people": [], "rate_hz": None}


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The clips of a folder, or the one that it is. See `kinds.KINDS`."""
    given = check_options("folder", options, OPTIONS)
    places = clips_in(folder, is_clip(folder))

    def clip_of(name: str) -> Clip:
        people, still = (any(fnmatchcase(name, pattern) for pattern in given[key]) for key in ("people", "still"))
        return fit_clip(clip_at(places[name], name, given["rate_hz"], still, ("people",) if people else ("movers",)))

    return Collector("folder", folder, "", wanted).collect(places, clip_of)


def clips_in(folder: Path, is_one: bool) -> dict[str, Path]:
    """The folders of clips by name: those in a folder, or itself where it is one."""
    return {folder.resolve().name: folder} if is_one else {name: folder / name for name in folders_in(folder)}


FRAMES = ("frames", "img1")
"""Folders that may hold a clip's pictures."""


def is_clip(folder: Path) -> bool:
    """Whether a folder is a clip, and not one of clips."""
    return any((folder / name).is_dir() for name in FRAMES) or find_truth(folder) is not None


def clip_at(
    place: Path,
    name: str,
    rate_hz: float | None = None,
    still: bool = False,
    shows: tuple[str, ...] = ("movers",),
) -> Clip:
    """A clip's folder. rate_hz: in place of seqinfo.ini's.

    Raises InputError: neither pictures nor truth, several videos, files that cannot be read.
    """
    pictures = pictures_at(place)
    truth = truth_at(place, pictures)
    if not pictures and truth is None:
        raise InputError(f"{place} holds neither pictures nor truth; wanted frames/ or a video, and masks/ or boxes")
    positions = next((p for p in (place / "positions.csv", place / "truth" / "positions.csv") if p.is_file()), None)
    if truth is not None and positions is not None:
        truth = replace(truth, positions=positions_at(positions))
    info = read_seqinfo(place / "seqinfo.ini") if (place / "seqinfo.ini").is_file() else SeqInfo()
    return Clip(
        name,
        place,
        pictures,
        rate_hz or info.rate_hz,
        count_frames(pictures) or info.length,
        truth,
        still,
        shows,
        _first(place, "det/det.txt", "det.txt"),
        _first(place, "telemetry.*"),
        _first(place, "landmarks.csv"),
        _first(place, "colours.toml"),
        _first(place, "camera.toml"),
        _first(place, "dem.*"),
    )


def pictures_at(place: Path) -> tuple[Path, ...]:
    """The pictures of a clip's folder, or its video. Raises InputError where there are several videos."""
    for name in FRAMES:
        if found := images_in(place / name):
            return found
    videos = [v for v in videos_in(place) if v.stem != "telemetry"]  # MPEG-TS that carries metadata alone
    if len(videos) > 1:
        raise InputError(f"{place} holds {len(videos)} videos, {videos[0].name} and {videos[1].name}; wanted one")
    return tuple(videos)


def truth_at(place: Path, pictures: tuple[Path, ...]) -> Truth | None:
    """The truth of a clip's folder, None where it has none. Raises InputError where it cannot be read."""
    found = find_truth(place)
    if found is None:
        return None
    numbers = frames_by_number(pictures) if len(pictures) > 1 else {}
    if found.is_dir() and numbers:
        masks = [path for path in images_in(found, frozenset({".png"})) if path.stem.isdecimal()]
        return Truth("masks", found, masks_by_frame(masks, numbers, pictures[0].parent), {})
    return load_truth(found)


def positions_at(path: Path) -> Positions:
    """True places on the ground. Raises InputError where they cannot be read."""
    table = read_positions(path)
    return Positions(table.frame, table.target, table.east_north_m, table.lonlat_deg)


def _first(place: Path, *patterns: str) -> Path | None:
    return next((path for pattern in patterns for path in sorted(place.glob(pattern)) if path.is_file()), None)
