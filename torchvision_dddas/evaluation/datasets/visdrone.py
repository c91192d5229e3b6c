"""VisDrone-MOT: road users seen from drones over Chinese cities.

    SPLIT/sequences/NAME/0000001.jpg   pictures, from 1
    SPLIT/annotations/NAME.txt         frame,id,left,top,width,height,counts,category,truncation,occlusion

The folder is a split (VisDrone2019-MOT-val), or holds some. Categories are CATEGORIES, from 1; 0 is a region that
nobody labelled, and so is 11 (others), as in its makers' toolkit: boxes there, true or found, do not count. Nor do
rows that count 0 and other categories than the requested ones: a found box on one is no mistake.

Terms, as its makers state them: for academic research only.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.evaluation.datasets.annotations import check_classes, check_known, read_rows, table_of, truth_of
from torchvision_dddas.evaluation.datasets.files import check_numbering, images_in
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options, folders_in
from torchvision_dddas.evaluation.metrics.truth import TrackTable, Truth

TERMS = "academic research only"
CATEGORIES = ("pedestrian", "people", "bicycle", "car", "van", "truck", "tricycle", "awning-tricycle", "bus", "motor")
UNLABELLED, OTHERS = 0, 11
_COLUMNS = ("frame", "identity", "left", "top", "width", "height", "counts", "category")


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """Options. classes: those that count, of CATEGORIES; all by default."""
    classes = check_options("visdrone", options, {"classes": list(CATEGORIES)})["classes"]
    check_classes(classes, CATEGORIES, "VisDrone")
    collector = Collector("visdrone", folder, TERMS, wanted)
    splits = [s for s in (folder, *(folder / n for n in folders_in(folder))) if (s / "annotations").is_dir()]
    if not splits:
        return collector.refuse(f"{folder} holds no annotations/; wanted a split of VisDrone-MOT, or a folder of them")
    places = {path.stem: path for split in splits for path in sorted((split / "annotations").glob("*.txt"))}
    for split in splits:
        collector.report_unlabelled(folders_in(split / "sequences"), places, f"{split / 'annotations'}/{{}}.txt")

    def clip_of(name: str) -> Clip:
        home = places[name].parents[1] / "sequences" / name
        pictures = check_numbering(images_in(home), 1)
        truth = read_truth(places[name], classes, len(pictures))
        return collector.label_clip(name, places[name], pictures, truth, home)

    return collector.collect(places, clip_of)


def read_truth(path: Path, classes: list[str], length: int = 0) -> Truth:
    """An annotation file; length: of the clip, 0 where unknown. Raises InputError with file and line."""
    rows = read_rows(path, _COLUMNS)
    frame, identity, counts, category = (rows.values[:, k] for k in (0, 1, 6, 7))
    check_known(path, rows, category, range(OTHERS + 1), "category", f"0 to {OTHERS}")
    region, box = np.isin(category, (UNLABELLED, OTHERS)), rows.values[:, 2:6]
    regions = TrackTable.of(frame[region], identity[region], box[region])
    rest = ~region
    table = table_of(path, frame[rest], identity[rest], box[rest], rows.line[rest])
    words = np.array(CATEGORIES)[category[rest].astype(int) - 1]
    return truth_of(path, table, np.isin(words, classes) & (counts[rest] != 0), length, regions)
