"""Stanford Drone: people, bicycles and carts on a campus, from straight above.

    annotations/SCENE/VIDEO/annotations.txt   id xmin ymin xmax ymax frame lost occluded generated "label"
    annotations/SCENE/VIDEO/reference.jpg     one picture of it
    videos/SCENE/VIDEO/video.mov              (or .mp4)

or folders with annotations.txt and reference.jpg of any names, with a video where there is one. Frames count from 0.
Lost rows lie outside the picture and are left out; occluded and generated (interpolated) ones count. Labels are
LABELS; those that are not requested neither count nor harm. Whoever stands is labelled too: a detector of motion
misses them.

Terms, as its makers state them: CC BY-NC-SA 3.0.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.evaluation.datasets.annotations import (
    Rows,
    check_classes,
    check_known,
    read_rows,
    table_of,
    truth_of,
)
from torchvision_dddas.evaluation.datasets.files import count_frames, videos_in
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options, find_below
from torchvision_dddas.evaluation.metrics.truth import Truth

TERMS = "CC BY-NC-SA 3.0"
LABELS = ("Pedestrian", "Biker", "Skater", "Cart", "Car", "Bus")
ANNOTATIONS = "annotations.txt"
_COLUMNS = ("identity", "xmin", "ymin", "xmax", "ymax", "frame", "lost", "occluded", "generated", "label")


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """Options. classes: those that count, of LABELS; all by default. Clips are named SCENE-VIDEO or by their folder."""
    classes = check_options("sdd", options, {"classes": list(LABELS)})["classes"]
    check_classes(classes, LABELS, "Stanford Drone")
    collector = Collector("sdd", folder, TERMS, wanted)
    found = find_below(folder, lambda place: (place / ANNOTATIONS).is_file(), 3)
    places = {_name(place, folder): place for place in found}
    if not places:
        return collector.refuse(f"{folder} holds no {ANNOTATIONS}; wanted annotations/SCENE/VIDEO/{ANNOTATIONS} in it")

    def clip_of(name: str) -> Clip:
        place = places[name]
        video = _video(place)
        truth = read_truth(place / ANNOTATIONS, classes, count_frames(video))
        return collector.label_clip(name, place, video, truth, place)

    return collector.collect(places, clip_of)


def read_truth(path: Path, classes: list[str], length: int = 0) -> Truth:
    """An annotation file; length: frames of the clip, 0 where unknown. Raises InputError with file and line."""
    rows = read_rows(path, _COLUMNS, "label", first=0)
    seen = Rows(*(part[rows.values[:, 6] == 0] for part in rows))
    v, words = seen.values, seen.word.astype(str)
    box = np.column_stack([v[:, 1:3], v[:, 3:5] - v[:, 1:3]])
    table = table_of(path, v[:, 5] + 1, v[:, 0], box, seen.line)
    check_known(path, seen, words, LABELS, "label", ", ".join(LABELS))
    return truth_of(path, table, np.isin(words, classes), length)


def _name(place: Path, folder: Path) -> str:
    parts = place.relative_to(folder).parts
    parts = parts[1:] if parts[:1] == ("annotations",) else parts
    return "-".join(parts) or place.resolve().name


def _video(place: Path) -> tuple[Path, ...]:
    """The video beside the annotations, or under videos/ as published."""
    top = place.parents[1] if len(place.parents) > 1 else place
    beside = top.parent / "videos" / place.parent.name / place.name if top.name == "annotations" else place
    return (videos_in(place) or videos_in(beside))[:1]
