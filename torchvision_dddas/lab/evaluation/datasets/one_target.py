"""Data sets with one labelled target in each clip: UAV123 and VIVID; in VIVID all vehicles may be labelled."""

import re
from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.tables import read_csv
from torchvision_dddas.lab.evaluation.datasets import files
from torchvision_dddas.lab.evaluation.datasets.annotations import boxes_by_frame, table_of
from torchvision_dddas.lab.evaluation.datasets.record import Clip, Reader
from torchvision_dddas.lab.evaluation.metrics.text_rows import FARTHEST, read_text
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth, TrackTable, load_truth, read_mask


class Uav123(Reader):
    """UAV123, UAV20L and UAV123 at 10 frames a second (Mueller, Smith and Ghanem, 2016).

        data_seq/UAV123/SEQUENCE/000001.jpg   the frames
        anno/UAV123/CLIP.txt                  x,y,width,height a line, NaN where the target is hidden or outside
        configSeqs.m                          where each clip begins and ends in its sequence: car6_2 is a part of car6

    UAV20L and UAV123_10fps lie beside UAV123 in data_seq and anno, or have a folder of their own. Only a clip that is a
    whole sequence can be read without configSeqs.m.
    """

    kind = "uav123"
    layout = "UAV123, UAV20L or UAV123 at 10 frames a second: anno/, data_seq/ and configSeqs.m"
    terms = "for research; whoever uses it cites Mueller, Smith and Ghanem (2016)"
    defaults: ClassVar = {"variant": "", "still": [], "rate_hz": None}
    rates_hz: ClassVar = {"UAV123": 30.0, "UAV20L": 30.0, "UAV123_10fps": 10.0}

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        variant = self.options["variant"]
        if variant and variant not in self.rates_hz:
            raise InputError(f"'{variant}' is not a variant of UAV123; wanted {', '.join(self.rates_hz)}")
        self._variant = variant or next((v for v in self.rates_hz if (self.folder / "anno" / v).is_dir()), "")
        # The sequences of UAV20L may be among the sequences of UAV123.
        shared = "UAV123" if self._variant == "UAV20L" else self._variant
        annotations, sequences = self.folder / "anno", self.folder / "data_seq"
        self._annotations = _first_folder(annotations / self._variant, annotations)
        self._sequences = _first_folder(sequences / self._variant, sequences / shared, sequences)

    def _places(self) -> Mapping[str, tuple[Any, ...]]:
        parts = {self._annotations: "the boxes, CLIP.txt", self._sequences: "the frames, one folder for each sequence"}
        if absent := [f"{place} does not exist; wanted {what}" for place, what in parts.items() if not place.is_dir()]:
            return self._refuse(*absent)
        path = self.folder / "configSeqs.m"
        text = read_text(path, "latin-1") if path.is_file() else ""
        # One file may contain a table for each variant, which begins as seqUAV123_10fps = {...
        tables = re.split(r"seq(UAV\w+)\s*=\s*\{", text)
        mine = dict(zip(tables[1::2], tables[2::2], strict=True)).get(self._variant, text)
        spans = {
            name: (re.split(r"[\\/]", where.rstrip("\\/"))[-1], int(first), int(last))
            for name, where, first, last in _PART.findall(mine)
        }
        return {path.stem: spans.get(path.stem, (path.stem,)) for path in self._annotations.glob("*.txt")}

    def _clip(self, name: str, place: tuple[Any, ...]) -> Clip:
        still = any(fnmatchcase(name, pattern) for pattern in self.options["still"])
        if name.startswith("building") and not still:
            raise InputError("its target is a building; name the clip in `still` if nothing moves")
        home, span = self._sequences / place[0], place[1:]
        pictures = files.images_in(home)
        if not pictures:
            wanted = "" if span else f", or configSeqs.m, which states the sequence that {name} is part of"
            raise InputError(f"{home} holds no pictures; wanted the frames of the clip{wanted}")
        if span:
            first, last = span
            pictures = tuple(p for p in pictures if first <= (files.number_of(p) or 0) <= last)
            if len(pictures) != last - first + 1:
                held = f"{len(pictures)} of the frames {first} to {last} of {name}"
                raise InputError(f"{home} holds {held}; wanted all of them")
        truth = None if still else load_truth(self._annotations / f"{name}.txt")
        rate_hz = self.options["rate_hz"] or self.rates_hz.get(self._variant or self.folder.name, 30.0)
        return files.fit_clip(Clip(name, home, pictures, rate_hz, len(pictures), truth, still))


def _first_folder(*places: Path) -> Path:
    return next(filter(Path.is_dir, places), places[0])


_PART = re.compile(
    r"'name'\s*,\s*'([^']+)'\s*,\s*'path'\s*,\s*'([^']*)'\s*,\s*'startFrame'\s*,\s*(\d{1,8})\s*,\s*'endFrame'\s*,\s*(\d{1,8})"
)


class Vivid(Reader):
    """DARPA VIVID, egtest01 to egtest05, as in the tracking evaluation of PETS 2005 (Collins et al.).

    The truth is in the clip's folder, beside it or in Groundtruth/: NAME_truth.csv (all vehicles), NAME*.txt (the box
    of one target in all or some frames) or a folder NAME_mask (masks of one target in some frames).
    """

    kind = "vivid"
    layout = "VIVID of PETS 2005: egtest01/ to egtest05/, with boxes or masks of every tenth frame"
    terms = "for the evaluation of trackers; to be cited as Collins, Zhou and Teh (PETS 2005)"
    defaults: ClassVar = {"rate_hz": None}

    def _places(self) -> Mapping[str, Path]:
        names = [n for n in files.folders_in(self.folder) if "mask" not in n.lower() and n.lower() != "groundtruth"]
        return {name: self.folder / name for name in names}

    def _clip(self, name: str, place: Path) -> Clip:
        pictures = files.images_in(place) or files.images_in(place / name)
        if not pictures:
            raise InputError(f"{place} holds no pictures; wanted frame00000.jpg and so on")
        frames = files.frames_by_number(pictures)
        if not frames:
            raise InputError(f"{pictures[0].parent}: the names of the pictures lack numbers, or repeat them")
        truth = self._truth(name, frames, pictures)
        return files.fit_clip(Clip(name, place, pictures, self.options["rate_hz"] or 30.0, len(pictures), truth))

    def _truth(self, name: str, frames: Mapping[int, int], pictures: tuple[Path, ...]) -> ClipTruth:
        homes = (self.folder / name, self.folder, self.folder / "Groundtruth", self.folder / "groundtruth")
        for pattern, reader in (("*_truth.csv", _all_vehicles), ("*.txt", _one_box_a_line)):
            for home in homes:
                if found := [p for p in sorted(home.glob(f"{name}{pattern}")) if p.is_file()]:
                    return reader(found[0], frames)
        for home in homes:
            for inside in files.folders_in(home):
                if "mask" in inside.lower() and (home == homes[0] or inside.startswith(name)):
                    return _boxes_about_masks(home / inside, frames, pictures)
        raise InputError(
            f"{self.folder} has no truth of this clip; wanted {name}_truth.csv, {name}*.txt or a folder {name}_mask"
        )


def _all_vehicles(path: Path, frames: Mapping[int, int]) -> ClipTruth:
    """Read name,frame,identity,x,y,width,height under a line of names. frames: number of a picture -> frame.

    Frames without a row count as empty, up to the last frame with a row. Raise InputError with file and line.
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
        raise InputError(f"{path} holds no boxes; wanted name,frame,identity,x,y,width,height in each line")
    values = np.array(rows)
    if len(fractions := values[values[:, 1] % 1 != 0]):
        raise InputError(f"{path}: {fractions[0, 1]:g} is not an identity; wanted whole numbers")
    table = table_of(path, values[:, 0], values[:, 1], values[:, 2:], np.array(lines))
    return ClipTruth("boxes", path, {}, boxes_by_frame(table, int(table.frame.max())), table, length=len(frames))


def _one_box_a_line(path: Path, frames: Mapping[int, int]) -> ClipTruth:
    """Read frame,x,y,width,height of some frames, or x,y,width,height of each. Raise InputError."""
    lines = [line.replace(",", " ").split() for line in read_text(path).splitlines() if line.strip()]
    if not lines or len(lines[0]) not in (4, 5):
        held = f"has {len(lines[0])} columns" if lines else "is empty"
        raise InputError(f"{path} {held}; wanted frame,x,y,width,height or x,y,width,height in each line")
    found: dict[int, np.ndarray] = {}
    for number, cells in enumerate(lines, 1):
        where = f"{path}, line {number}"
        if len(cells) != len(lines[0]):
            raise InputError(f"{where}: {len(cells)} columns; the first line has {len(lines[0])}")
        row = _numbers(cells, where, allow_nan=True)
        frame = number if len(row) == 4 else _frame(row[0], frames, where)
        if frame in found:
            raise InputError(f"{where}: frame {row[0]:g} occurs twice; wanted one box for each frame")
        found[frame] = np.array(row[-4:])
    if len(lines[0]) == 4 and len(lines) != len(frames):
        raise InputError(f"{path} has {len(lines)} lines, but the clip has {len(frames)} frames; wanted one for each")
    return _one_target(path, found, len(frames))


def _boxes_about_masks(place: Path, frames: Mapping[int, int], pictures: tuple[Path, ...]) -> ClipTruth:
    """Return one target by the box around the nonzero pixels of its masks. Raise InputError."""
    labels = files.masks_by_frame(files.images_in(place), frames, place.parent)
    if not labels:
        raise InputError(f"{place} holds no masks; wanted the truth of every tenth frame")
    files.check_mask_sizes(pictures[0], labels.values())
    boxes = {}
    for frame, path in labels.items():
        shown = (read_mask(path) != 0).astype(np.uint8)
        boxes[frame] = np.array(cv2.boundingRect(shown), float) if shown.any() else np.full(4, np.nan)
    return _one_target(place, boxes, len(frames))


def _one_target(place: Path, boxes: Mapping[int, np.ndarray], length: int) -> ClipTruth:
    """Return the truth of one target. boxes: its box by frame, NaN if it is not visible."""
    frames = sorted(boxes)
    rows = np.array([boxes[frame] for frame in frames])
    seen = ~np.isnan(rows).any(axis=1)
    tracks = TrackTable(np.array(frames)[seen], np.ones(int(seen.sum()), np.int64), rows[seen])
    return ClipTruth("one target", place, {}, {frame: boxes[frame][None] for frame in frames}, tracks, length=length)


def _numbers(cells: list[str], where: str, allow_nan: bool = False) -> list[float]:
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
    """Return the frame of the picture with a number. Raise InputError if there is no such picture."""
    found = frames.get(int(number)) if number == number and number == int(number) else None
    if found is None:
        raise InputError(f"{where}: there is no picture {number:g}; the clip has {min(frames)} to {max(frames)}")
    return found
