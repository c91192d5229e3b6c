"""UAVDT, the benchmark of many targets (UAV-benchmark-M): vehicles seen from a drone.

    UAV-benchmark-M/M0101/img000001.jpg                pictures, from 1, 30 a second
    UAV-benchmark-MOTD_v1.0/GT/M0101_gt_whole.txt      frame,id,left,top,width,height,out-of-view,occlusion,category
                               M0101_gt_ignore.txt     frame,id,left,top,width,height,...: regions without labels
    M_attr/train or test/M0101_attr.txt                a line of 0 and 1: ATTRIBUTES

GT may also lie beside the sequences. Boxes in the ignored regions, true or found, do not count; categories that are
not asked for neither count nor harm.

Terms, as its makers state them: for research; cite the paper (Du et al., ECCV 2018).
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.annotations import asked, read_rows, table_of, text_of, truth_of
from torchvision_dddas.evaluation.datasets.files import images_in, whole
from torchvision_dddas.evaluation.datasets.kinds import Wanted
from torchvision_dddas.evaluation.datasets.record import Clip, Dataset, checked, folders_in, gather
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.metrics.truth import Truth

TERMS = "research only"
RATE_HZ = 30.0
CATEGORIES = ("car", "truck", "bus")
ATTRIBUTES = (
    "daylight",
    "night",
    "fog",
    "low-alt",
    "medium-alt",
    "high-alt",
    "front-view",
    "side-view",
    "bird-view",
    "long-term",
)
_COLUMNS = ("frame", "identity", "left", "top", "width", "height", "out-of-view", "occlusion", "category")
_TRUTHS = ("UAV-benchmark-MOTD_v1.0/GT", "UAV-benchmark-M/GT", "GT", ".")
_PICTURES = ("UAV-benchmark-M", "UAVDT_Benchmark_M", ".", "..")
_WHOLE, _IGNORE = "_gt_whole.txt", "_gt_ignore.txt"


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """Options. classes: those that count, of CATEGORIES; all by default. attributes: sequences that have them all."""
    given = checked("uavdt", options, {"classes": list(CATEGORIES), "attributes": []})
    asked(np.zeros(0), given["classes"], CATEGORIES, "UAVDT")
    asked(np.zeros(0), given["attributes"], ATTRIBUTES, "UAVDT's sequences")
    truths = next((t for name in _TRUTHS if any((t := folder / name).glob(f"*{_WHOLE}"))), None)
    if truths is None:
        nothing = f"{folder} holds no {_TRUTHS[0]}/M0101{_WHOLE}: the truth of UAVDT belongs there"
        return Dataset("uavdt", folder, (), TERMS, (nothing,))
    places = {path.name.removesuffix(_WHOLE): path for path in sorted(truths.glob(f"*{_WHOLE}"))}
    homes = [folder / name for name in _PICTURES if (folder / name).is_dir()]
    notes: list[str] = []
    lacking = [
        f"{name}: no truth, which belongs in {truths / name}{_WHOLE}"
        for name in folders_in(folder / _PICTURES[0] if (folder / _PICTURES[0]).is_dir() else folder)
        if name[:1] == "M" and name[1:].isdecimal() and name not in places and wanted(name)
    ]

    def clip_of(name: str) -> Clip:
        pictures = whole(next((p for home in homes if (p := images_in(home / name))), ()), 1)
        truth = read_truth(places[name], given["classes"], len(pictures))
        if not pictures:
            notes.append(f"{name}: no pictures, which belong in {folder / _PICTURES[0] / name}")
        return Clip(name, places[name], pictures, RATE_HZ, len(pictures) or truth.frames[-1], truth)

    def has(name: str) -> bool:
        return not given["attributes"] or set(given["attributes"]) <= set(_attributes(folder, name, lacking))

    found = gather("uavdt", folder, TERMS, [n for n in places if wanted(n) and has(n)], clip_of, lacking)
    return replace(found, notes=tuple(notes))


def read_truth(path: Path, classes: list[str], length: int = 0) -> Truth:
    """NAME_gt_whole.txt, with NAME_gt_ignore.txt beside it where there is one. Raises InputError with file and line."""
    rows = read_rows(path, _COLUMNS)
    category = rows.values[:, 8]
    known = np.isin(category, range(1, len(CATEGORIES) + 1))
    if not known.all():
        i = int((~known).argmax())
        raise InputError(f"{path}, line {rows.line[i]}: the category is {category[i]:g}; wanted 1 to {len(CATEGORIES)}")
    table = table_of(path, rows.values[:, 0], rows.values[:, 1], rows.values[:, 2:6], rows.line)
    words = np.array(CATEGORIES, object)[category.astype(int) - 1]
    beside = path.with_name(path.name.removesuffix(_WHOLE) + _IGNORE)
    regions = None
    if beside.is_file():
        ignored = read_rows(beside, _COLUMNS[:6]).values
        regions = TrackTable(ignored[:, 0].astype(np.int64), ignored[:, 1].astype(np.int64), ignored[:, 2:6])
    return truth_of(path, table, asked(words, classes, CATEGORIES, "UAVDT"), length, regions)


def read_attributes(path: Path) -> list[str]:
    """The attributes of a sequence. Raises InputError where the file holds anything but a 0 or 1 for each."""
    cells = text_of(path).replace(",", " ").split()
    if len(cells) != len(ATTRIBUTES) or not set(cells) <= {"0", "1"}:
        raise InputError(f"{path} does not hold {len(ATTRIBUTES)} times 0 or 1: {','.join(ATTRIBUTES)}")
    return [name for name, cell in zip(ATTRIBUTES, cells, strict=True) if cell == "1"]


def _attributes(folder: Path, name: str, lacking: list[str]) -> list[str]:
    paths = [folder / "M_attr" / part / f"{name}_attr.txt" for part in ("train", "test", ".")]
    path = next((p for p in paths if p.is_file()), None)
    try:
        if path is None:
            raise InputError(f"no attributes, which belong in {paths[0]}")
        return read_attributes(path)
    except InputError as error:
        lacking.append(f"{name}: {error}")
        return []
