"""UAVDT, the benchmark of many targets (UAV-benchmark-M): vehicles seen from a drone.

    UAV-benchmark-M/M0101/img000001.jpg                pictures, from 1, 30 a second
    UAV-benchmark-MOTD_v1.0/GT/M0101_gt_whole.txt      frame,id,left,top,width,height,out-of-view,occlusion,category
                               M0101_gt_ignore.txt     frame,id,left,top,width,height,...: regions without labels
    M_attr/train or test/M0101_attr.txt                a line of 0 and 1: ATTRIBUTES

GT may also lie beside the sequences. Boxes in the ignored regions, true or found, do not count; categories that are
not requested neither count nor harm.

Terms, as its makers state them: for research; cite the paper (Du et al., ECCV 2018).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.annotations import check_classes, check_known, read_rows, table_of, truth_of
from torchvision_dddas.evaluation.datasets.files import check_numbering, images_in
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options, folders_in
from torchvision_dddas.evaluation.metrics.truth import TrackTable, Truth, read_text

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
    given = check_options("uavdt", options, {"classes": list(CATEGORIES), "attributes": []})
    check_classes(given["classes"], CATEGORIES, "UAVDT")
    check_classes(given["attributes"], ATTRIBUTES, "UAVDT's sequences")
    collector = Collector("uavdt", folder, TERMS, wanted)
    truths = next((t for name in _TRUTHS if any((t := folder / name).glob(f"*{_WHOLE}"))), None)
    if truths is None:
        return collector.refuse(f"{folder} holds no {_TRUTHS[0]}/M0101{_WHOLE}: the truth of UAVDT belongs there")
    places = {path.name.removesuffix(_WHOLE): path for path in sorted(truths.glob(f"*{_WHOLE}"))}
    homes = [folder / name for name in _PICTURES if (folder / name).is_dir()]
    named = folders_in(folder / _PICTURES[0] if (folder / _PICTURES[0]).is_dir() else folder)
    sequences = [name for name in named if name[:1] == "M" and name[1:].isdecimal()]
    collector.report_unlabelled(sequences, places, f"{truths}/{{}}{_WHOLE}")

    def clip_of(name: str) -> Clip:
        pictures = check_numbering(next((p for home in homes if (p := images_in(home / name))), ()), 1)
        truth = read_truth(places[name], given["classes"], len(pictures))
        belongs = folder / _PICTURES[0] / name
        return collector.label_clip(name, places[name], pictures, truth, belongs, rate_hz=RATE_HZ)

    names = [name for name in places if wanted(name)]
    if given["attributes"]:
        names = [name for name in names if set(given["attributes"]) <= set(_attributes(name, collector))]
    return collector.collect(names, clip_of)


def read_truth(path: Path, classes: list[str], length: int = 0) -> Truth:
    """NAME_gt_whole.txt, with NAME_gt_ignore.txt beside it where there is one. Raises InputError with file and line."""
    rows = read_rows(path, _COLUMNS)
    category = rows.values[:, 8]
    check_known(path, rows, category, range(1, len(CATEGORIES) + 1), "category", f"1 to {len(CATEGORIES)}")
    table = table_of(path, rows.values[:, 0], rows.values[:, 1], rows.values[:, 2:6], rows.line)
    words = np.array(CATEGORIES)[category.astype(int) - 1]
    beside = path.with_name(path.name.removesuffix(_WHOLE) + _IGNORE)
    regions = None
    if beside.is_file():
        ignored = read_rows(beside, _COLUMNS[:6]).values
        regions = TrackTable.of(ignored[:, 0], ignored[:, 1], ignored[:, 2:6])
    return truth_of(path, table, np.isin(words, classes), length, regions)


def _attributes(name: str, collector: Collector) -> list[str]:
    """The attributes of a sequence; what is wrong with their file goes to the data set's missing clips."""
    paths = [collector.folder / "M_attr" / part / f"{name}_attr.txt" for part in ("train", "test", ".")]
    path = next((p for p in paths if p.is_file()), None)
    try:
        if path is None:
            raise InputError(f"no attributes, which belong in {paths[0]}")
        cells = read_text(path).replace(",", " ").split()
        if len(cells) != len(ATTRIBUTES) or not set(cells) <= {"0", "1"}:
            raise InputError(f"{path} does not hold {len(ATTRIBUTES)} times 0 or 1: {','.join(ATTRIBUTES)}")
    except InputError as error:
        collector.missing.append(f"{name}: {error}")
        return []
    return [attribute for attribute, cell in zip(ATTRIBUTES, cells, strict=True) if cell == "1"]
