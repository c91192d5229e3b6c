"""DAVIS 2016 (Perazzi et al.) and 2017 (Pont-Tuset et al.): densely annotated video segmentation.

    JPEGImages/480p/CLIP/00000.jpg    the frames; also Full-Resolution and 1080p, as the option `resolution` says
    Annotations/480p/CLIP/00000.png   2016: 255 is the object, 0 all else; 2017: a palette's colour an object
    ImageSets/2016/val.txt, 2017/     a name a line; in the first release ImageSets/480p/val.txt, a frame a line

The annotated objects are those that the clip is about: others that move are not labelled, and are false when found.
Options: subset (train, val, trainval, test-dev ...: clips that such a list names; all by default), year (2016 or 2017:
whose list; by default the one there is), resolution (480p), rate_hz (24 by default, as the clips are played).
Terms of use, by its makers: BSD (2016), Creative Commons Attribution 4.0 (2017); clips by others under their own terms.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.files import fit_clip, frames_by_number, images_in, masks_by_frame
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options, folders_in
from torchvision_dddas.evaluation.metrics.truth import Truth, read_text

TERMS = "2016: BSD licence; 2017: Creative Commons Attribution 4.0; some clips under terms of their own; to be cited"

OPTIONS: Mapping[str, Any] = {"subset": "", "year": "", "resolution": "480p", "rate_hz": None}

RATE_HZ = 24.0


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The clips of a folder that holds JPEGImages and Annotations. See `kinds.KINDS`."""
    given = check_options("davis", options, OPTIONS)
    collector = Collector("davis", folder, TERMS, wanted)
    photos, masks = (folder / name / given["resolution"] for name in ("JPEGImages", "Annotations"))
    parts = {photos: "the frames, a folder a clip", masks: "the masks, a folder a clip"}
    if absent := [f"{place} does not exist; wanted {what}" for place, what in parts.items() if not place.is_dir()]:
        return collector.refuse(*absent)
    try:
        names = _read_list(folder, given) if given["subset"] else [*{*folders_in(photos), *folders_in(masks)}]
    except InputError as error:
        return collector.refuse(str(error))

    def clip_of(name: str) -> Clip:
        pictures = images_in(photos / name)
        labels = images_in(masks / name, frozenset({".png"}))
        if not pictures:
            raise InputError(f"{photos / name} holds no pictures; wanted the frames of the clip")
        if not labels:
            raise InputError(f"{masks / name} holds no masks; wanted the truth of the clip")
        found = masks_by_frame(labels, frames_by_number(pictures), photos / name)
        truth = Truth("masks", masks / name, found, {}, length=len(pictures))
        return fit_clip(Clip(name, photos / name, pictures, given["rate_hz"] or RATE_HZ, len(pictures), truth))

    return collector.collect(names, clip_of)


def _read_list(folder: Path, given: Mapping[str, Any]) -> list[str]:
    """The clips of a subset. Raises InputError where no list of that name exists."""
    sets = folder / "ImageSets"
    years = [given["year"]] if given["year"] else ["2017", "2016"]
    places = [*(sets / year for year in years), *([sets / given["resolution"]] if given["year"] != "2017" else [])]
    path = next((p for place in places if (p := place / f"{given['subset']}.txt").is_file()), None)
    if path is None:
        there = sorted({p.stem for place in places for p in place.glob("*.txt")})
        held = f"it has {', '.join(there)}" if there else "it has no lists"
        raise InputError(f"{sets} has no list {given['subset']}.txt of {' or '.join(p.name for p in places)}; {held}")
    # "bear", or "/JPEGImages/480p/bear/00000.jpg /Annotations/480p/bear/00000.png"
    first = [line.split()[0] for line in read_text(path).split("\n") if line.strip()]
    return list(dict.fromkeys(Path(word).parent.name if "/" in word else word for word in first))
