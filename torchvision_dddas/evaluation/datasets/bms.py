"""Berkeley motion segmentation: BMS-26 (Brox and Malik, 2010) and FBMS-59 (Ochs, Malik and Brox, 2014).

    Trainingset/CLIP/, Testset/CLIP/   FBMS-59; BMS-26 has its clips in moseg_dataset/CLIP/; any of these may be named
    CLIP/*.jpg                         the frames (BMS-26 first came as .ppm), named by number
    CLIP/GroundTruth/                  FBMS-59; in BMS-26 the same files lie in CLIP/
    .../*Def.dat                       the values of the regions, and which files label which frames
    .../*_gt.ppm, *_gt.pgm, *.pgm      the labels: a colour (red, green, blue as one number) or a grey value a region

The first region is the background, as the makers' own evaluation has it; each other one is a mover. A few masks hold
values that the definition does not list: those pixels count for nothing. *PROB_gt files are not read. Clips of
`frames/` and `masks/` are read as in `folder`, 0 being the background. Options: rate_hz.
Terms of use, by its makers: for research purposes only; any commercial use is prohibited.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets import bms_definition
from torchvision_dddas.evaluation.datasets.files import fitted, images_in
from torchvision_dddas.evaluation.datasets.folder import clip_at, looks_like
from torchvision_dddas.evaluation.datasets.kinds import Wanted
from torchvision_dddas.evaluation.datasets.record import Clip, Dataset, checked, folders_in, gather
from torchvision_dddas.evaluation.metrics.truth import Labels, Truth

TERMS = "for research purposes only; any commercial use is prohibited; to be cited"

SETS = ("Trainingset", "Testset", "moseg_dataset", "FBMS_Trainingset", "FBMS_Testset")
"""Folders of clips, as the archives unpack; they may lie in one another."""

PHOTOS = frozenset({".jpg", ".jpeg", ".png"})


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The clips of a folder, or of the published sets in it. See `kinds.KINDS`."""
    said = checked("bms", options, {"rate_hz": None})
    places: dict[str, Path] = {}
    told = []
    for place in _clips(folder):
        if place.name in places and wanted(place.name):
            told.append(f"{place.name}: both {places[place.name]} and {place} are there; the latter is left out")
        places.setdefault(place.name, place)

    def clip_of(name: str) -> Clip:
        place = places[name]
        if looks_like(place):
            return fitted(clip_at(place, name, said["rate_hz"]))
        return fitted(_published(place, name, said["rate_hz"]))

    return gather("bms", folder, TERMS, filter(wanted, places), clip_of, told)


def _clips(folder: Path) -> list[Path]:
    """The folders of clips in a folder and in the published sets in it."""
    inside = [folder / name for name in folders_in(folder)]
    deeper = [clip for place in inside if place.name in SETS for clip in _clips(place)]
    return [place for place in inside if place.name not in SETS] + deeper


def _published(place: Path, name: str, rate_hz: float | None) -> Clip:
    home = place / "GroundTruth" if (place / "GroundTruth").is_dir() else place
    path = next(iter(sorted(home.glob("*Def.dat"))), None)
    if path is None:
        raise InputError(f"{place} has no truth; wanted {name}Def.dat and masks in {home}, or frames/ and masks/")
    said = bms_definition.read(path)
    labelled = {file for _, file, _ in said.labelled}
    # A PPM or PGM is a frame only where there is no JPEG: in BMS-26 labels lie among the frames.
    pictures = images_in(place, PHOTOS) or tuple(
        p for p in images_in(place, frozenset({".ppm"})) if p.name not in labelled and not p.stem.endswith("_gt")
    )
    if not pictures:
        raise InputError(f"{path} is the truth of a clip without pictures; put them into {place}")
    if len(pictures) < said.frames:
        raise InputError(f"{path} is of {said.frames} frames, but {place} holds {len(pictures)} pictures; is it whole?")
    frames = {p.stem: frame for frame, p in enumerate(pictures, 1)}
    masks = {}
    for number, file, picture in said.labelled:
        frame = frames.get(Path(picture).stem)
        if frame is None:
            raise InputError(f"{path}: picture {picture} of frame {number} is not in {place}; is it whole?")
        masks[frame] = _mask(home, file)
    labels = Labels(background=said.regions[:1], movers=said.regions[1:])
    truth = Truth("masks", home, dict(sorted(masks.items())), {}, length=len(pictures), labels=labels)
    return Clip(name, place, pictures, rate_hz, len(pictures), truth)


def _mask(home: Path, file: str) -> Path:
    """A file of labels; some definitions name a .ppm that is a .pgm, or the other way round."""
    path = home / file
    for found in (path, *(path.with_suffix(suffix) for suffix in (".ppm", ".pgm", ".png"))):
        if found.is_file():
            return found
    raise InputError(f"{path} is not there; the definition beside it names it")
