"""DARPA VIVID, egtest01 to egtest05, as in the tracking evaluation of PETS 2005 (Collins et al.)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.annotations import boxes_by_frame, table_of
from torchvision_dddas.evaluation.datasets.files import (
    check_mask_sizes,
    fit_clip,
    frames_by_number,
    images_in,
    masks_by_frame,
)
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options, folders_in
from torchvision_dddas.evaluation.metrics.truth import FARTHEST, TrackTable, Truth, read_mask, read_text
from torchvision_dddas.io.tables import read_csv

TERMS = "for the evaluation of trackers; to be cited as Collins, Zhou and Teh (PETS 2005)"

RATE_HZ = 30.0


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The clips of a folder. See `kinds.KINDS`."""
    rate_hz = check_options("vivid", options, {"rate_hz": None})["rate_hz"] or RATE_HZ
    names = [name for name in folders_in(folder) if "mask" not in name.lower() and name.lower() != "groundtruth"]

    def clip_of(name: str) -> Clip:
        place = folder / name
        pictures = images_in(place) or images_in(place / name)
        if not pictures:
            raise InputError(f"{place} holds no pictures; wanted frame00000.jpg and so on")
        frames = frames_by_number(pictures)
        if not frames:
            raise InputError(f"{pictures[0].parent}: the names of the pictures lack numbers, or repeat them")
        truth = _truth(folder, name, frames, pictures)
        return fit_clip(Clip(name, place, pictures, rate_hz, len(pictures), truth))

    return Collector("vivid", folder, TERMS, wanted).collect(names, clip_of)


def _truth(folder: Path, name: str, frames: Mapping[int, int], pictures: tuple[Path, ...]) -> Truth:
    """The truth of a clip, wherever it lies. Raises InputError where there is none."""
    homes = (folder / name, folder, folder / "Groundtruth", folder / "groundtruth")
    for pattern, reader in (("*_truth.csv", vehicles), ("*.txt", boxes)):
        for home in homes:
            if found := [p for p in sorted(home.glob(f"{name}{pattern}")) if p.is_file()]:
                return reader(found[0], frames)
    for home in homes:
        inside = folders_in(home)
        folders = [home / d for d in inside if "mask" in d.lower() and (home == folder / name or d.startswith(name))]
        if folders:
            return masks(folders[0], frames, pictures)
    raise InputError(f"{folder} has no truth of it; wanted {name}_truth.csv, {name}*.txt or a folder {name}_mask")


def vehicles(path: Path, frames: Mapping[int, int]) -> Truth:
    """All vehicles: name,frame,identity,x,y,width,height under a line of names. frames: number of a picture -> frame.

    Frames without a row are taken as empty up to the last that has one. Raises InputError with file and line.
    """
    rows = []
    _, lines, cells_of = read_csv(path, "truth")
    for number, cells in zip(lines, cells_of, strict=True):
        where = f"truth {path}, line {number}"
        if len(cells) != 7:
            raise InputError(f"{where}: {len(cells)} columns; wanted name,frame,identity,x,y,width,height")
        row = _numbers(cells[1:], where)
        rows.append([_frame(row[0], frames, where), *row[1:]])
    if not rows:
        raise InputError(f"{path} holds no boxes; wanted name,frame,identity,x,y,width,height a line")
    values = np.array(rows)
    if len(fractions := values[values[:, 1] % 1 != 0]):
        raise InputError(f"{path}: {fractions[0, 1]:g} is no identity; wanted whole numbers")
    table = table_of(path, values[:, 0], values[:, 1], values[:, 2:], np.array(lines))
    boxes = boxes_by_frame(table, int(table.frame.max()))
    return Truth("boxes", path, {}, boxes, table, length=len(frames))


def boxes(path: Path, frames: Mapping[int, int]) -> Truth:
    """One target: frame,x,y,width,height of some frames, or x,y,width,height of each. Raises InputError."""
    lines = [line.replace(",", " ").split() for line in read_text(path).splitlines() if line.strip()]
    if not lines or len(lines[0]) not in (4, 5):
        held = f"has {len(lines[0])} columns" if lines else "is empty"
        raise InputError(f"{path} {held}; wanted frame,x,y,width,height, or x,y,width,height, a line")
    found: dict[int, np.ndarray] = {}
    for number, cells in enumerate(lines, 1):
        where = f"{path}, line {number}"
        if len(cells) != len(lines[0]):
            raise InputError(f"{where}: {len(cells)} columns; the first line has {len(lines[0])}")
        row = _numbers(cells, where, allow_nan=True)
        frame = number if len(row) == 4 else _frame(row[0], frames, where)
        if frame in found:
            raise InputError(f"{where}: frame {row[0]:g} is there twice; wanted one box a frame")
        found[frame] = np.array(row[-4:])
    if len(lines[0]) == 4 and len(lines) != len(frames):
        raise InputError(f"{path} has {len(lines)} lines, but the clip {len(frames)} frames; wanted a line a frame")
    return _one(path, found, len(frames))


def masks(place: Path, frames: Mapping[int, int], pictures: tuple[Path, ...]) -> Truth:
    """One target, by the box about what is not 0 in its masks. Raises InputError."""
    files = masks_by_frame(images_in(place), frames, place.parent)
    if not files:
        raise InputError(f"{place} holds no masks; wanted the truth of every tenth frame")
    check_mask_sizes(pictures[0], files.values())
    return _one(place, {frame: _box_about(read_mask(path)) for frame, path in files.items()}, len(frames))


def _one(place: Path, found: Mapping[int, np.ndarray], length: int) -> Truth:
    """The truth of one target. found: its box by frame, NaN where it is not visible."""
    frames = sorted(found)
    rows = np.array([found[frame] for frame in frames])
    seen = ~np.isnan(rows).any(axis=1)
    tracks = TrackTable(np.array(frames)[seen], np.ones(int(seen.sum()), np.int64), rows[seen])
    return Truth("one target", place, {}, {frame: found[frame][None] for frame in frames}, tracks, length=length)


def _box_about(mask: np.ndarray) -> np.ndarray:
    v, u = np.nonzero(mask)
    if not len(u):
        return np.full(4, np.nan)
    return np.array([u.min(), v.min(), np.ptp(u) + 1, np.ptp(v) + 1], float)


def _numbers(cells: list[str], where: str, allow_nan: bool = False) -> list[float]:
    """Cells as numbers.  Raises InputError."""
    values = []
    for cell in cells:
        try:
            value = float(cell)
        except ValueError:
            value = np.inf
        if not (abs(value) <= FARTHEST or (allow_nan and np.isnan(value))):
            raise InputError(f"{where}: wanted a number from {-FARTHEST:g} to {FARTHEST:g}, got '{cell[:40]}'")
        values.append(value)
    return values


def _frame(number: float, frames: Mapping[int, int], where: str) -> int:
    """The frame of the picture with a number. Raises InputError where there is none."""
    found = frames.get(int(number)) if number == number and number == int(number) else None
    if found is None:
        raise InputError(f"{where}: there is no picture {number:g}; the clip has {min(frames)} to {max(frames)}")
    return found
