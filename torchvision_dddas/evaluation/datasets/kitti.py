"""KITTI tracking: what a car sees of the others, in pixels and in metres.

    training/image_02/0000/000000.png   the left colour camera, frames from 0, 10 a second
    training/label_02/0000.txt          frame id type truncated occluded alpha left top right bottom
                                        height width length x y z rotation
    training/calib/0000.txt             R_rect, Tr_velo_cam, Tr_imu_velo
    training/oxts/0000.txt              lat lon alt roll pitch yaw ..., a line a frame

DontCare rows are regions that nobody labelled. What does not count and does not harm, as for TrackEval: what is cut
off by the border (truncated above 0) or whose occlusion is unknown (above 2), and here all classes that are not asked
for (TrackEval: vans beside cars, people who sit beside pedestrians). TrackEval also takes out what was found without a
match and is at most 25 px high; that is not done here. Positions need calib and oxts: metres east and north of where
the car's receiver was in the first frame.

Terms, as its makers state them: CC BY-NC-SA 3.0.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.annotations import read_rows
from torchvision_dddas.evaluation.datasets.boxes import asked, table_of, truth_of
from torchvision_dddas.evaluation.datasets.footage import agreed, whole
from torchvision_dddas.evaluation.datasets.gathering import folders_in, gather
from torchvision_dddas.evaluation.datasets.kinds import Wanted
from torchvision_dddas.evaluation.datasets.kitti_pose import positions_of
from torchvision_dddas.evaluation.datasets.options import checked
from torchvision_dddas.evaluation.datasets.pictures import images_in
from torchvision_dddas.evaluation.datasets.record import Clip, Dataset
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.metrics.truth import Truth

TERMS = "CC BY-NC-SA 3.0"
RATE_HZ = 10.0
CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Person", "Person_sitting", "Cyclist", "Tram", "Misc")
UNLABELLED = "DontCare"
LEAST_OCCLUDED_UNKNOWN = 3
_COLUMNS = (
    "frame", "identity", "type", "truncated", "occluded", "alpha", "left", "top", "right", "bottom",
    "height", "width", "length", "x", "y", "z",
)  # fmt: skip


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """Options. classes: those that count, of CLASSES; all by default."""
    classes = checked("kitti", options, {"classes": list(CLASSES)})["classes"]
    asked(np.zeros(0), classes, CLASSES, "KITTI")
    home = folder / "training" if (folder / "training").is_dir() else folder
    places = {path.stem: path for path in sorted((home / "label_02").glob("*.txt"))}
    if not places:
        nothing = f"{folder} holds no training/label_02/0000.txt: the truth of KITTI tracking belongs there"
        return Dataset("kitti", folder, (), TERMS, (nothing,))
    named = folders_in(home / "image_02") if (home / "image_02").is_dir() else []
    notes: list[str] = []
    lacking = [
        f"{name}: no truth, which belongs in {home / 'label_02' / name}.txt"
        for name in named
        if name not in places and wanted(name)
    ]

    def clip_of(name: str) -> Clip:
        pictures = whole(images_in(home / "image_02" / name), 0)
        calibration, flight = home / "calib" / f"{name}.txt", home / "oxts" / f"{name}.txt"
        unsure = [str(path) for path in (calibration, flight) if not path.is_file()]
        truth = read_truth(places[name], classes, len(pictures), None if unsure else (calibration, flight))
        if unsure:
            notes.append(f"{name}: no places in metres, which need {' and '.join(unsure)}")
        if not pictures:
            notes.append(f"{name}: no pictures, which belong in {home / 'image_02' / name}")
        return Clip(name, places[name], pictures, RATE_HZ, agreed(pictures, 0, "") or truth.frames[-1], truth)

    found = gather("kitti", folder, TERMS, filter(wanted, places), clip_of, lacking)
    return replace(found, notes=tuple(notes))


def read_truth(
    path: Path, classes: list[str] | None = None, length: int = 0, pose: tuple[Path, Path] | None = None
) -> Truth:
    """A label file. length: frames of the clip, 0 where unknown. pose: the files of calib and oxts.

    Raises InputError with file and line.
    """
    rows = read_rows(path, _COLUMNS, "type", first=0)
    v, words = rows.values, rows.word.astype(str)
    known = np.isin(words, (*CLASSES, UNLABELLED))
    if not known.all():
        i = int((~known).argmax())
        raise InputError(f"{path}, line {rows.line[i]}: the type is '{words[i]}'; wanted {', '.join(CLASSES)}")
    frame, box = v[:, 0] + 1, np.column_stack([v[:, 6:8], v[:, 8:10] - v[:, 6:8]])
    region = words == UNLABELLED
    regions = TrackTable(frame[region].astype(np.int64), v[region, 1].astype(np.int64), box[region])
    rest = ~region
    table = table_of(path, frame[rest], v[rest, 1], box[rest], rows.line[rest])
    whole_ones = (v[rest, 3] <= 0) & (v[rest, 4] < LEAST_OCCLUDED_UNKNOWN)
    counts = asked(words[rest], classes or CLASSES, CLASSES, "KITTI") & whole_ones
    where = positions_of(table.at(counts), v[rest][counts, 13:16], *pose) if pose else None
    return truth_of(path, table, counts, length, regions if region.any() else None, where)
