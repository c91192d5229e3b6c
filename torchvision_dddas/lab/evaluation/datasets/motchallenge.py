"""MOTChallenge, 2015 to 2020, and other data sets in its layout."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets import files
from torchvision_dddas.lab.evaluation.datasets.annotations import boxes_by_frame, table_of
from torchvision_dddas.lab.evaluation.datasets.record import Clip, Reader
from torchvision_dddas.lab.evaluation.metrics.text_rows import read_columns, read_text, split_cells
from torchvision_dddas.lab.evaluation.metrics.truth import (
    ClipTruth,
    SeqInfo,
    TruePositions,
    load_truth,
    read_seqinfo,
)

BENCHMARKS = ("MOT15", "MOT16", "MOT17", "MOT20")
PEDESTRIAN = 1
DISTRACTORS = (2, 7, 8, 12)  # a person on a vehicle, a person who never moves, distractor, reflection
NON_MOTORIZED = 6  # a vehicle without a motor, a distractor of 2020
_COLUMNS = ("frame", "identity", "x", "y", "width", "height", "counts", "class", "visibility")
_GROUND = ("frame", "identity", "x", "y", "width", "height", "counts", "ground x", "ground y", "ground z")
_MARKS = ("seqinfo.ini", "gt/gt.txt", "det/det.txt")


class MotChallenge(Reader):
    """MOTChallenge: the folder is a sequence, holds sequences, or holds train/ and test/ with sequences.

        SEQUENCE/seqinfo.ini        frameRate, seqLength, imDir
        SEQUENCE/img1/000001.jpg    pictures, from 1; a video in SEQUENCE may replace them
        SEQUENCE/gt/gt.txt          frame,id,x,y,w,h, then
                                    2015: counts (0 or 1), and on the ground, in metres: x,y,z; -1 if unknown
                                    2016 and later: counts, class, visibility
        SEQUENCE/det/det.txt        public detections

    The same rows count as in TrackEval. 2015: rows marked 0 are ignored. Later: pedestrians not marked 0 count, and
    found boxes on distractors are removed. Boxes of all classes take part in the matching with distractors.
    """

    kind = "motchallenge"
    layout = "MOTChallenge 2015 to 2020 and similar: SEQUENCE/gt/gt.txt, with img1/ or a video if there is one"
    terms = "CC BY-NC-SA 3.0"
    defaults: ClassVar = {"benchmark": "", "least_visibility": 0.0}

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        benchmark = self.options["benchmark"]
        if benchmark and benchmark not in BENCHMARKS:
            raise InputError(f"'{benchmark}' is not a benchmark; wanted one of {', '.join(BENCHMARKS)}")

    def _places(self) -> Mapping[str, Path]:
        return sequences(self.folder) or self._refuse(
            f"{self.folder} holds no sequence; wanted SEQUENCE/gt/gt.txt in it, or in its train/"
        )

    def _clip(self, name: str, place: Path) -> Clip:
        clip = sequence(place, **self.options)
        if not clip.pictures:
            self.notes.append(f"{name}: no pictures; they belong in {place / 'img1'}")
        return replace(clip, name=name)


def sequences(folder: Path) -> dict[str, Path]:
    """Return sequences by name: the folder or folders up to three levels deep. Equal names get their folder's name."""
    places: dict[str, Path] = {}
    for place in files.find_below(folder, lambda place: any((place / mark).is_file() for mark in _MARKS), 3):
        name = place.name if place.name not in places else "-".join(place.relative_to(folder).parts)
        places[name or place.resolve().name] = place
    return places


def sequence(place: Path, benchmark: str = "", least_visibility: float = 0.0) -> Clip:
    """Return the clip in a sequence's folder. Raise InputError without truth, for broken files, other frame counts."""
    info = read_seqinfo(place / "seqinfo.ini") if (place / "seqinfo.ini").is_file() else SeqInfo()
    path = place / "gt" / "gt.txt"
    if not path.is_file():
        raise InputError(f"no truth; it belongs in {path} (the truth of test sequences is not published)")
    images = files.images_in(place / info.pictures)
    pictures = files.check_numbering(images, 1) if images else files.videos_in(place)
    if len(pictures) > 1 and not images:
        raise InputError(f"{place} holds {len(pictures)} videos; wanted one, or pictures in {place / info.pictures}")
    frames = files.count_frames(pictures, info.length, "seqinfo.ini")
    columns = len(split_cells(next((line for line in read_text(path).splitlines() if line.strip()), "")))
    name = place.resolve().name
    if benchmark not in ("", "MOT15") or (not benchmark and columns == len(_COLUMNS)):
        vehicles = (NON_MOTORIZED,) if (benchmark or name).startswith("MOT20") else ()
        truth = _with_classes(path, (*DISTRACTORS, *vehicles), least_visibility, frames)
    else:
        truth = _of_2015(path, columns >= len(_GROUND))
    truth = replace(truth, length=frames or truth.length)
    last = frames or truth.frames[-1]
    if truth.frames[-1] > last:
        raise InputError(f"{path} labels frame {truth.frames[-1]}, but the clip has {frames}; is it the same clip?")
    given = place / "det" / "det.txt"
    public = given if given.is_file() else None
    return Clip(name, place, pictures, info.rate_hz, last, truth, shows=("people",), given=public)


def _of_2015(path: Path, has_ground: bool) -> ClipTruth:
    truth = load_truth(path)
    if truth.tracks is None:
        raise InputError(f"{path} has no identities; wanted MOTChallenge's frame,id,x,y,w,h,counts")
    if not has_ground:
        return truth
    rows = read_columns(path, _GROUND)
    ground = rows.stack(*_GROUND[7:])
    known = ~(ground == -1).all(axis=1) & (ground[:, 2] != -1) & (rows["counts"] != 0)
    if not ground.any() or not known.any():  # all zeros: the ground positions were not measured
        return truth
    frame, identity = (rows[name][known].astype(np.int64) for name in ("frame", "identity"))
    return replace(truth, positions=TruePositions(frame, identity, ground[known, :2]))


def _with_classes(path: Path, distractors: tuple[int, ...], least_visibility: float, length: int) -> ClipTruth:
    rows = read_columns(path, _COLUMNS)
    table = table_of(path, rows["frame"], rows["identity"], rows.stack(*_COLUMNS[2:6]), rows.line)
    is_pedestrian = rows["class"] == PEDESTRIAN
    hidden = is_pedestrian & (rows["visibility"] < least_visibility)
    ignored = np.isin(rows["class"], distractors) | hidden
    true = is_pedestrian & (rows["counts"] != 0) & ~hidden
    if not true.any():
        raise InputError(f"{path} holds no pedestrian that counts")
    kept, others = table.at(true), table.at(~true & ~ignored)
    boxes = boxes_by_frame(kept, max(length, int(table.frame.max())))
    return ClipTruth("boxes", path, {}, boxes, kept, table.at(ignored), ignoring="removed", others=others)
