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

import re
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.files import fit_clip, images_in
from torchvision_dddas.evaluation.datasets.folder import clip_at, is_clip
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options, folders_in
from torchvision_dddas.evaluation.metrics.truth import Labels, Truth, read_text

TERMS = "for research purposes only; any commercial use is prohibited; to be cited"

SETS = ("Trainingset", "Testset", "moseg_dataset", "FBMS_Trainingset", "FBMS_Testset")
"""Folders of clips, as the archives unpack; they may lie in one another."""

PHOTOS = frozenset({".jpg", ".jpeg", ".png"})

_LONGEST_NAME = 250
"""Bytes of a file's name; another suffix may be tried, and 255 is what most systems take."""


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """The clips of a folder, or of the published sets in it. See `kinds.KINDS`."""
    rate_hz = check_options("bms", options, {"rate_hz": None})["rate_hz"]
    collector = Collector("bms", folder, TERMS, wanted)
    places: dict[str, Path] = {}
    for place in _clips(folder):
        if place.name in places and wanted(place.name):
            collector.missing.append(f"{place.name}: {places[place.name]} is read, {place} of the same name is not")
        places.setdefault(place.name, place)

    def clip_of(name: str) -> Clip:
        place = places[name]
        return fit_clip(clip_at(place, name, rate_hz) if is_clip(place) else _published(place, name, rate_hz))

    return collector.collect(places, clip_of)


def _clips(folder: Path) -> list[Path]:
    inside = [folder / name for name in folders_in(folder)]
    deeper = [clip for place in inside if place.name in SETS for clip in _clips(place)]
    return [place for place in inside if place.name not in SETS] + deeper


def _published(place: Path, name: str, rate_hz: float | None) -> Clip:
    home = place / "GroundTruth" if (place / "GroundTruth").is_dir() else place
    path = next(iter(sorted(home.glob("*Def.dat"))), None)
    if path is None:
        raise InputError(f"{place} has no truth; wanted {name}Def.dat and masks in {home}, or frames/ and masks/")
    definition = read_definition(path)
    label_files = {file for _, file, _ in definition.labelled}
    # A PPM or PGM is a frame only where there is no JPEG: in BMS-26 labels lie among the frames.
    pictures = images_in(place, PHOTOS) or tuple(
        p for p in images_in(place, frozenset({".ppm"})) if p.name not in label_files and not p.stem.endswith("_gt")
    )
    if not pictures:
        raise InputError(f"{path} is the truth of a clip without pictures; put them into {place}")
    if len(pictures) < definition.frames:
        held = f"{place} holds {len(pictures)} pictures"
        raise InputError(f"{path} is of {definition.frames} frames, but {held}; is it whole?")
    frames = {p.stem: frame for frame, p in enumerate(pictures, 1)}
    masks = {}
    for number, file, picture in definition.labelled:
        frame = frames.get(Path(picture).stem)
        if frame is None:
            raise InputError(f"{path}: picture {picture} of frame {number} is not in {place}; is it whole?")
        masks[frame] = _find_mask(home / file)
    labels = Labels(background=definition.regions[:1], movers=definition.regions[1:])
    truth = Truth("masks", home, dict(sorted(masks.items())), {}, length=len(pictures), labels=labels)
    return Clip(name, place, pictures, rate_hz, len(pictures), truth)


def _find_mask(path: Path) -> Path:
    """A file of labels; some definitions name a .ppm that is a .pgm, or the other way round."""
    for found in (path, *(path.with_suffix(suffix) for suffix in (".ppm", ".pgm", ".png"))):
        if found.is_file():
            return found
    raise InputError(f"{path} does not exist; the definition beside it names it")


class Definition(NamedTuple):
    """A clip's *Def.dat. regions: the value of each. labelled: number, file of labels, picture, of each frame."""

    regions: tuple[int, ...]
    frames: int
    labelled: tuple[tuple[int, str, str], ...]


def read_definition(path: Path) -> Definition:
    """Read a definition: lines that end with a colon name what is in the next line. Raises InputError if damaged.

    Total number of regions; Scale of region K (the value of its pixels); Total number of frames in this shot; and of
    each labelled frame its Frame number, File name (labels) and Input file name (picture).
    """
    lines = [line.strip() for line in read_text(path, "latin-1").splitlines() if line.strip()]
    entries = [
        (name[:-1].strip().lower(), value)
        for name, value in pairwise(lines)
        if name.endswith(":") and not value.endswith(":")
    ]
    regions = [_whole(value, path) for name, value in entries if name.startswith("scale of region")]
    frames = [_whole(value, path) for name, value in entries if name.startswith("total number of frames")]
    numbers, files, pictures = (
        [value for name, value in entries if name == wanted]
        for wanted in ("frame number", "file name", "input file name")
    )
    if len(regions) < 2 or len(frames) != 1:
        raise InputError(f"{path} is no definition of a clip; wanted two regions or more, and the number of frames")
    if not len(numbers) == len(files) == len(pictures) or not numbers:
        raise InputError(
            f"{path} names {len(numbers)} labelled frames, {len(files)} files and {len(pictures)} pictures; "
            "wanted as many of each, and at least one"
        )
    rows = [(_whole(n, path), _file(f, path), _file(p, path)) for n, f, p in zip(numbers, files, pictures, strict=True)]
    return Definition(tuple(regions), frames[0], tuple(rows))


def _whole(text: str, path: Path) -> int:
    if not text.isdecimal() or len(text) > 9:
        raise InputError(f"{path}: wanted a whole number, got '{text[:40]}'")
    return int(text)


def _file(text: str, path: Path) -> str:
    """The name of a file beside the definition, without the folders of its makers' machine."""
    name = re.split(r"[\\/]", text)[-1]
    if name in ("", ".", "..") or "\0" in name or len(name.encode()) > _LONGEST_NAME:
        raise InputError(f"{path}: '{text[:40]}' is no name of a file")
    return name
