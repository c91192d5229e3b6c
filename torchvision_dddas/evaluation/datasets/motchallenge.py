"""MOTChallenge, 2015 to 2020, and what others published in its layout.

    SEQUENCE/seqinfo.ini        frameRate, seqLength, imDir
    SEQUENCE/img1/000001.jpg    pictures, from 1; here a video in SEQUENCE may stand for them
    SEQUENCE/gt/gt.txt          frame,id,x,y,w,h, then
                                2015: counts (0 or 1), and on the ground, in metres: x,y,z; -1 where unknown
                                2016 and later: counts, class, visibility
    SEQUENCE/det/det.txt        public detections

The folder is a sequence, or holds some, or holds train/ and test/ that do. What counts is what counts for TrackEval.
2015: rows marked 0 are as if not there. Later: pedestrians (class 1) not marked 0; found boxes on persons on vehicles
(2), who stand for ever (7), on distractors (8), reflections (12), and in 2020 vehicles without a motor (6), are taken
out. Boxes of all classes take part in the matching that finds those.

Terms, as its makers state them: CC BY-NC-SA 3.0; cite the paper of the year.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.annotations import boxes_by_frame, read_rows, table_of
from torchvision_dddas.evaluation.datasets.files import check_numbering, count_frames, images_in, number_of, videos_in
from torchvision_dddas.evaluation.datasets.record import (
    Clip,
    Collector,
    Dataset,
    Wanted,
    check_options,
    find_below,
    folders_in,
)
from torchvision_dddas.evaluation.metrics.truth import (
    Positions,
    SeqInfo,
    Truth,
    load_truth,
    read_seqinfo,
    read_text,
    split_cells,
)

TERMS = "CC BY-NC-SA 3.0"
BENCHMARKS = ("", "MOT15", "MOT16", "MOT17", "MOT20")
PEDESTRIAN = 1
DISTRACTORS = (2, 7, 8, 12)
NON_MOTORIZED = 6
_COLUMNS = ("frame", "identity", "x", "y", "width", "height", "counts", "class", "visibility")
_GROUND = ("frame", "identity", "x", "y", "width", "height", "counts", "ground x", "ground y", "ground z")
_MARKS = ("seqinfo.ini", "gt/gt.txt", "det/det.txt")


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """Options. benchmark: MOT15, MOT16, MOT17 or MOT20, whose rules count; else as the file's columns and the name say.

    least_visibility: pedestrians less visible than that are no mistake, found or not (2016 and later).
    """
    given = check_options("motchallenge", options, {"benchmark": "", "least_visibility": 0.0})
    if given["benchmark"] not in BENCHMARKS:
        raise InputError(f"'{given['benchmark']}' is no benchmark; wanted one of {', '.join(BENCHMARKS[1:])}")
    collector = Collector("motchallenge", folder, TERMS, wanted)
    places = sequences(folder)
    if not places:
        return collector.refuse(f"{folder} holds no sequence; wanted SEQUENCE/gt/gt.txt in it, or in its train/")

    def clip_of(name: str) -> Clip:
        clip = sequence(places[name], given["benchmark"], given["least_visibility"])
        if not clip.pictures:
            collector.notes.append(f"{name}: no pictures, which belong in {places[name] / 'img1'}")
        return replace(clip, name=name)

    return collector.collect(places, clip_of)


def sequences(folder: Path) -> dict[str, Path]:
    """The sequences in a folder by name: its own, or those up to three folders deep; two of a name by their folders."""
    places: dict[str, Path] = {}
    for place in find_below(folder, lambda place: any((place / mark).is_file() for mark in _MARKS), 3):
        name = place.name if place.name not in places else "-".join(place.relative_to(folder).parts)
        places[name or place.resolve().name] = place
    return places


def sequence(place: Path, benchmark: str = "", least_visibility: float = 0.0) -> Clip:
    """The clip of a sequence's folder. Raises InputError: no truth, broken files, different frame counts."""
    info = read_seqinfo(place / "seqinfo.ini") if (place / "seqinfo.ini").is_file() else SeqInfo()
    path = place / "gt" / "gt.txt"
    if not path.is_file():
        raise InputError(f"no truth, which belongs in {path} (that of test sequences is not published)")
    images = images_in(place / info.pictures)
    pictures = check_numbering(images, 1) if images else videos_in(place)
    if len(pictures) > 1 and not images:
        raise InputError(f"{place} holds {len(pictures)} videos; wanted one, or pictures in {place / info.pictures}")
    frames = count_frames(pictures, info.length, "seqinfo.ini")
    later = benchmark not in ("", "MOT15") or (not benchmark and _count_columns(path) == len(_COLUMNS))
    name = place.resolve().name
    vehicles = (NON_MOTORIZED,) if (benchmark or name).startswith("MOT20") else ()
    truth = _with_classes(path, (*DISTRACTORS, *vehicles), least_visibility, frames) if later else _of_2015(path)
    truth = replace(truth, length=frames or truth.length)
    if frames and truth.frames[-1] > frames:
        raise InputError(f"{path} labels frame {truth.frames[-1]}, but the clip has {frames}; is it the same clip?")
    given = place / "det" / "det.txt"
    given_or_none = given if given.is_file() else None
    last = frames or truth.frames[-1]
    return Clip(name, place, pictures, info.rate_hz, last, truth, shows=("people",), given=given_or_none)


def single_pictures(place: Path) -> dict[int, Path]:
    """The pictures of a sequence by frame, where not all of them need be there: those of its folders img1*."""
    folders = [place / name for name in folders_in(place) if name.startswith("img1")]
    paths = [path for folder in folders for path in images_in(folder)]
    return {number: path for path in paths if (number := number_of(path)) is not None}


def _count_columns(path: Path) -> int:
    return len(split_cells(next((line for line in read_text(path).splitlines() if line.strip()), "")))


def _of_2015(path: Path) -> Truth:
    truth = load_truth(path)
    if truth.tracks is None:
        raise InputError(f"{path} has no identities; wanted MOTChallenge's frame,id,x,y,w,h,counts")
    if _count_columns(path) < len(_GROUND):
        return truth
    rows = read_rows(path, _GROUND).values
    known = ~(rows[:, 7:10] == -1).all(axis=1) & (rows[:, 9] != -1) & (rows[:, 6] != 0)
    if not rows[:, 7:10].any() or not known.any():  # zeros alone: nobody measured
        return truth
    where = Positions(rows[known, 0].astype(np.int64), rows[known, 1].astype(np.int64), rows[known, 7:9])
    return replace(truth, positions=where)


def _with_classes(path: Path, distractors: tuple[int, ...], least_visibility: float, length: int) -> Truth:
    rows = read_rows(path, _COLUMNS)
    frame, identity, counts, kind, visibility = (rows.values[:, k] for k in (0, 1, 6, 7, 8))
    table = table_of(path, frame, identity, rows.values[:, 2:6], rows.line)
    hidden = (visibility < least_visibility) & (kind == PEDESTRIAN)
    ignored = np.isin(kind, distractors) | hidden
    true = (kind == PEDESTRIAN) & (counts != 0) & ~hidden
    if not true.any():
        raise InputError(f"{path} holds no pedestrian that counts")
    kept, others = table.at(true), table.at(~true & ~ignored)
    boxes = boxes_by_frame(kept, max(length, int(table.frame.max())))
    return Truth("boxes", path, {}, boxes, kept, table.at(ignored), ignoring="removed", others=others)
