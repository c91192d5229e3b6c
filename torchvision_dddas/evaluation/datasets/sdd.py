"""Stanford Drone: people, bicycles and carts on a campus, from straight above.

    annotations/SCENE/VIDEO/annotations.txt   id xmin ymin xmax ymax frame lost occluded generated "label"
    annotations/SCENE/VIDEO/reference.jpg     one picture of it
    videos/SCENE/VIDEO/video.mov              (or .mp4)

or folders with annotations.txt and reference.jpg of any names, with a video where there is one. Frames count from 0.
Lost rows lie outside the picture and are left out; occluded and generated (interpolated) ones count. Labels are
LABELS; those that are not asked for neither count nor harm. Whoever stands is labelled too: to a detector of motion
they are missed.

Terms, as its makers state them: CC BY-NC-SA 3.0.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.annotations import asked, read_rows, table_of, truth_of
from torchvision_dddas.evaluation.datasets.files import agreed, videos_in
from torchvision_dddas.evaluation.datasets.kinds import Wanted
from torchvision_dddas.evaluation.datasets.record import Clip, Dataset, checked, folders_in, gather
from torchvision_dddas.evaluation.metrics.truth import Truth

TERMS = "CC BY-NC-SA 3.0"
LABELS = ("Pedestrian", "Biker", "Skater", "Cart", "Car", "Bus")
ANNOTATIONS = "annotations.txt"
_COLUMNS = ("identity", "xmin", "ymin", "xmax", "ymax", "frame", "lost", "occluded", "generated", "label")
_DEEP = 3


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """Options. classes: those that count, of LABELS; all by default. Clips are named SCENE-VIDEO or by their folder."""
    classes = checked("sdd", options, {"classes": list(LABELS)})["classes"]
    asked(np.zeros(0), classes, LABELS, "Stanford Drone")
    places = clips_in(folder)
    if not places:
        lacking = f"{folder} holds no {ANNOTATIONS}; wanted annotations/SCENE/VIDEO/{ANNOTATIONS} in it"
        return Dataset("sdd", folder, (), TERMS, (lacking,))
    notes: list[str] = []

    def clip_of(name: str) -> Clip:
        place = places[name]
        video = _video(place)
        frames = agreed(video, 0, "")
        truth = read_truth(place / ANNOTATIONS, classes, frames)
        if not video:
            notes.append(f"{name}: no pictures; its video belongs in {place}")
        return Clip(name, place, video, frames=frames or truth.frames[-1], truth=truth)

    found = gather("sdd", folder, TERMS, filter(wanted, places), clip_of)
    return replace(found, notes=tuple(notes))


def clips_in(folder: Path) -> dict[str, Path]:
    """The folders with annotations by the clip's name."""
    return {_name(place, folder): place for place in _below(folder, _DEEP)}


def read_truth(path: Path, classes: list[str] | None = None, length: int = 0) -> Truth:
    """An annotation file; length: frames of the clip, 0 where it is not known. Raises InputError with file and line."""
    rows = read_rows(path, _COLUMNS, "label", first=0)
    v = rows.values
    seen = v[:, 6] == 0
    box = np.column_stack([v[:, 1:3], v[:, 3:5] - v[:, 1:3]])
    table = table_of(path, v[seen, 5] + 1, v[seen, 0], box[seen], rows.line[seen])
    words = rows.word[seen]
    unknown = ~np.isin(words.astype(str), LABELS)
    if unknown.any():
        i = int(unknown.argmax())
        raise InputError(f"{path}, line {rows.line[seen][i]}: the label is '{words[i]}'; wanted {', '.join(LABELS)}")
    return truth_of(path, table, asked(words, classes or LABELS, LABELS, "Stanford Drone"), length)


def _below(folder: Path, deep: int) -> list[Path]:
    if (folder / ANNOTATIONS).is_file():
        return [folder]
    return [place for name in folders_in(folder) if deep for place in _below(folder / name, deep - 1)]


def _name(place: Path, folder: Path) -> str:
    parts = place.relative_to(folder).parts
    parts = parts[1:] if parts[:1] == ("annotations",) else parts
    return "-".join(parts) or place.resolve().name


def _video(place: Path) -> tuple[Path, ...]:
    """Of the clip whose annotations lie in a folder: beside them, or under videos/ as published."""
    top = place.parents[1] if len(place.parents) > 1 else place
    beside = top.parent / "videos" / place.parent.name / place.name if top.name == "annotations" else place
    return (videos_in(place) or videos_in(beside))[:1]
