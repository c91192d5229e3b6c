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
from torchvision_dddas.evaluation.datasets.files import fitted, frames_by_number, images_in, labelled
from torchvision_dddas.evaluation.datasets.kinds import Wanted
from torchvision_dddas.evaluation.datasets.record import Clip, Dataset, checked, folders_in, gather
from torchvision_dddas.evaluation.metrics.truth import Truth

TERMS = "2016: BSD licence; 2017: Creative Commons Attribution 4.0; some clips under terms of their own; to be cited"

OPTIONS: Mapping[str, Any] = {"subset": "", "year": "", "resolution": "480p", "rate_hz": None}

RATE_HZ = 24.0


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The clips of a folder that holds JPEGImages and Annotations. See `kinds.KINDS`."""
    said = checked("davis", options, OPTIONS)
    photos, masks = (folder / name / said["resolution"] for name in ("JPEGImages", "Annotations"))
    told = tuple(f"{place} is not there; there belong {what}" for place, what in _parts(photos, masks).items())
    if told:
        return Dataset("davis", folder, (), TERMS, told)
    try:
        names = _listed(folder, said) if said["subset"] else sorted({*folders_in(photos), *folders_in(masks)})
    except InputError as error:
        return Dataset("davis", folder, (), TERMS, (str(error),))

    def clip_of(name: str) -> Clip:
        place = photos / name
        pictures = images_in(place)
        labels = images_in(masks / name, frozenset({".png"}))
        if not pictures:
            raise InputError(f"{place} holds no pictures; there belong the frames of the clip")
        if not labels:
            raise InputError(f"{masks / name} holds no masks; there belongs the truth of the clip")
        found = labelled(labels, frames_by_number(pictures), place)
        truth = Truth("masks", masks / name, found, {}, length=len(pictures))
        return fitted(Clip(name, place, pictures, said["rate_hz"] or RATE_HZ, len(pictures), truth))

    return gather("davis", folder, TERMS, filter(wanted, names), clip_of)


def _parts(photos: Path, masks: Path) -> dict[Path, str]:
    parts = {photos: "the frames, a folder a clip", masks: "the masks, a folder a clip"}
    return {place: what for place, what in parts.items() if not place.is_dir()}


def _listed(folder: Path, said: Mapping[str, Any]) -> list[str]:
    """The clips of a subset. Raises InputError where no list of that name is there."""
    sets = folder / "ImageSets"
    years = [said["year"]] if said["year"] else ["2017", "2016"]
    places = [*(sets / year for year in years), *([sets / said["resolution"]] if said["year"] != "2017" else [])]
    path = next((p for place in places if (p := place / f"{said['subset']}.txt").is_file()), None)
    if path is None:
        there = sorted({p.stem for place in places for p in place.glob("*.txt")})
        held = f"it has {', '.join(there)}" if there else "it has no lists"
        raise InputError(f"{sets} has no list {said['subset']}.txt of {' or '.join(p.name for p in places)}; {held}")
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {error}") from None
    # "bear", or "/JPEGImages/480p/bear/00000.jpg /Annotations/480p/bear/00000.png"
    first = [line.split()[0] for line in lines if line.strip()]
    return list(dict.fromkeys(Path(word).parent.name if "/" in word else word for word in first))
