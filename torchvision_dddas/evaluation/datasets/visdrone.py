"""VisDrone-MOT: what is seen from drones over Chinese cities.

    SPLIT/sequences/NAME/0000001.jpg   pictures, from 1
    SPLIT/annotations/NAME.txt         frame,id,left,top,width,height,counts,category,truncation,occlusion

The folder is a split (VisDrone2019-MOT-val), or holds some. Categories are CATEGORIES, from 1; 0 is a region that
nobody labelled, and so is 11 (others), as in its makers' toolkit: boxes there, true or found, do not count. Nor do
rows that count 0 and other categories than those asked for: a found box on one is no mistake.

Terms, as its makers state them: for academic research only.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.annotations import asked, read_rows, table_of, truth_of
from torchvision_dddas.evaluation.datasets.files import images_in, whole
from torchvision_dddas.evaluation.datasets.kinds import Wanted
from torchvision_dddas.evaluation.datasets.record import Clip, Dataset, checked, folders_in, gather
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.metrics.truth import Truth

TERMS = "academic research only"
CATEGORIES = (
    "pedestrian",
    "people",
    "bicycle",
    "car",
    "van",
    "truck",
    "tricycle",
    "awning-tricycle",
    "bus",
    "motor",
)
UNLABELLED, OTHERS = 0, 11
_COLUMNS = ("frame", "identity", "left", "top", "width", "height", "counts", "category")


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """Options. classes: those that count, of CATEGORIES; all by default."""
    classes = checked("visdrone", options, {"classes": list(CATEGORIES)})["classes"]
    asked(np.zeros(0), classes, CATEGORIES, "VisDrone")
    splits = [s for s in (folder, *(folder / n for n in folders_in(folder))) if (s / "annotations").is_dir()]
    if not splits:
        nothing = f"{folder} holds no annotations/; wanted a split of VisDrone-MOT, or a folder of them"
        return Dataset("visdrone", folder, (), TERMS, (nothing,))
    places = {path.stem: path for split in splits for path in sorted((split / "annotations").glob("*.txt"))}
    notes: list[str] = []
    lacking = [
        f"{name}: no truth, which belongs in {split / 'annotations' / name}.txt"
        for split in splits
        if (split / "sequences").is_dir()
        for name in folders_in(split / "sequences")
        if name not in places and wanted(name)
    ]

    def clip_of(name: str) -> Clip:
        folder = places[name].parents[1] / "sequences" / name
        pictures = whole(images_in(folder), 1)
        truth = read_truth(places[name], classes, len(pictures))
        if not pictures:
            notes.append(f"{name}: no pictures, which belong in {folder}")
        return Clip(name, places[name], pictures, frames=len(pictures) or truth.frames[-1], truth=truth)

    found = gather("visdrone", folder, TERMS, filter(wanted, places), clip_of, lacking)
    return replace(found, notes=tuple(notes))


def read_truth(path: Path, classes: list[str], length: int = 0) -> Truth:
    """An annotation file; length: of the clip, 0 where it is not known. Raises InputError with file and line."""
    rows = read_rows(path, _COLUMNS)
    frame, identity, counts, category = (rows.values[:, k] for k in (0, 1, 6, 7))
    known = np.isin(category, range(OTHERS + 1))
    if not known.all():
        i = int((~known).argmax())
        raise InputError(f"{path}, line {rows.line[i]}: the category is {category[i]:g}; wanted 0 to {OTHERS}")
    region = np.isin(category, (UNLABELLED, OTHERS))
    box, whole_number = rows.values[:, 2:6], category.astype(int)
    regions = TrackTable(frame[region].astype(np.int64), identity[region].astype(np.int64), box[region])
    rest = ~region
    table = table_of(path, frame[rest], identity[rest], box[rest], rows.line[rest])
    words = np.array(CATEGORIES, object)[whole_number[rest] - 1]
    right = asked(words, classes, CATEGORIES, "VisDrone") & (counts[rest] != 0)
    return truth_of(path, table, right, length, regions)
