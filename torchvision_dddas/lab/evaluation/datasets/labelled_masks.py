"""Data sets with masks as truth: Berkeley motion segmentation, change detection and DAVIS."""

import re
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import ClassVar, NamedTuple

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets import files
from torchvision_dddas.lab.evaluation.datasets.folder import clip_at, is_clip
from torchvision_dddas.lab.evaluation.datasets.record import Clip, Reader
from torchvision_dddas.lab.evaluation.metrics.text_rows import read_text
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth, Labels

_PHOTOS = frozenset({".jpg", ".jpeg", ".png"})
_LONGEST_NAME = 250  # bytes of a file's name: most systems allow 255, and another suffix may be tried


class Davis(Reader):
    """DAVIS 2016 (Perazzi et al.) and 2017 (Pont-Tuset et al.): densely annotated video segmentation.

    JPEGImages/480p/CLIP/00000.jpg    the frames, played at 24 a second
    Annotations/480p/CLIP/00000.png   2016: 255 is the object, 0 all else; 2017: a palette's colour an object
    ImageSets/2016/val.txt, 2017/     a name a line; in the first release ImageSets/480p/val.txt, a frame a line
    """

    kind = "davis"
    layout = "DAVIS 2016 or 2017: JPEGImages/, Annotations/ and ImageSets/"
    terms = (
        "2016: BSD licence; 2017: Creative Commons Attribution 4.0; some clips under terms of their own; to be cited"
    )
    defaults: ClassVar = {"subset": "", "year": "", "resolution": "480p", "rate_hz": None}

    def _places(self) -> Mapping[str, tuple[Path, Path]]:
        photos, masks = (self.folder / name / self.options["resolution"] for name in ("JPEGImages", "Annotations"))
        parts = {photos: "the frames, one folder for each clip", masks: "the masks, one folder for each clip"}
        if absent := [f"{place} does not exist; wanted {what}" for place, what in parts.items() if not place.is_dir()]:
            return self._refuse(*absent)
        try:
            names = (
                self._read_list() if self.options["subset"] else [*files.folders_in(photos), *files.folders_in(masks)]
            )
        except InputError as error:
            return self._refuse(str(error))
        return {name: (photos / name, masks / name) for name in names}

    def _clip(self, name: str, place: tuple[Path, Path]) -> Clip:
        pictures, masks = files.images_in(place[0]), files.images_in(place[1], frozenset({".png"}))
        if not pictures:
            raise InputError(f"{place[0]} holds no pictures; wanted the frames of the clip")
        if not masks:
            raise InputError(f"{place[1]} holds no masks; wanted the truth of the clip")
        rate_hz = self.options["rate_hz"] or 24.0
        return _clip_of_masks(name, place[0], pictures, place[1], masks, rate_hz)

    def _read_list(self) -> list[str]:
        """Return the clips of a subset. Raise InputError if no list of that name exists."""
        sets, subset, year = self.folder / "ImageSets", self.options["subset"], self.options["year"]
        homes = [sets / name for name in ([year] if year else ["2017", "2016"])]
        if year != "2017":
            homes.append(sets / self.options["resolution"])
        path = next((p for home in homes if (p := home / f"{subset}.txt").is_file()), None)
        if path is None:
            there = sorted({p.stem for home in homes for p in home.glob("*.txt")})
            held = f"it has {', '.join(there)}" if there else "it has no lists"
            raise InputError(f"{sets} has no list {subset}.txt of {' or '.join(p.name for p in homes)}; {held}")
        # "bear", or "/JPEGImages/480p/bear/00000.jpg /Annotations/480p/bear/00000.png"
        first = [line.split()[0] for line in read_text(path).split("\n") if line.strip()]
        return [Path(word).parent.name if "/" in word else word for word in first]


class CdNet(Reader):
    """Change detection: CDnet 2012 (Goyette et al.) and 2014 (Wang et al.), changedetection.net.

        CATEGORY/VIDEO/input/in000001.jpg         the frames
        CATEGORY/VIDEO/groundtruth/gt000001.png   0 static, 50 hard shadow, 85 outside the region of interest,
                                                  170 unknown, 255 moving
        CATEGORY/VIDEO/temporalROI.txt            the first and the last frame that count

    The folder holds the categories, or `dataset` as in the archive. Movers share one value: boxes are not scored.
    """

    kind = "cdnet"
    layout = "CDnet 2012 or 2014: a folder for each category, in it one for each video with input/ and groundtruth/"
    terms = "whoever publishes results acknowledges changedetection.net and cites its papers"
    defaults: ClassVar = {"rate_hz": None}

    def _places(self) -> Mapping[str, Path]:
        home = self.folder / "dataset" if "dataset" in files.folders_in(self.folder) else self.folder
        return {
            f"{kind}-{name}": home / kind / name
            for kind in files.folders_in(home)
            for name in files.folders_in(home / kind)
        }

    def _clip(self, name: str, place: Path) -> Clip:
        parts = ("input", "groundtruth", "temporalROI.txt")
        if absent := [part for part in parts if not (place / part).exists()]:
            raise InputError(f"{place} has no {absent[0]}; wanted {', '.join(parts)}")
        pictures, truth = files.images_in(place / "input"), place / "groundtruth"
        if not pictures:
            raise InputError(f"{place / 'input'} holds no pictures; wanted the frames of the clip")
        region = place / "temporalROI.txt"
        words = read_text(region).split()
        numbers = [int(word) for word in words if word.isdecimal() and len(word) < 9]
        if not len(words) == len(numbers) == 2 or numbers[0] > numbers[1]:
            raise InputError(f"{region} says '{' '.join(words)[:40]}'; wanted the first and the last frame that count")
        first, last = numbers
        masks = [p for p in files.images_in(truth) if first <= (files.number_of(p) or 0) <= last]
        if not masks:
            raise InputError(f"{truth} labels no frame from {first} to {last}; wanted masks")
        labels = Labels(background=(0, 50), unscored=(85, 170), separate=False)
        return _clip_of_masks(name, place, pictures, truth, masks, self.options["rate_hz"], labels)


def _clip_of_masks(
    name: str,
    place: Path,
    pictures: tuple[Path, ...],
    home: Path,
    masks: Iterable[Path],
    rate_hz: float | None,
    labels: Labels | None = None,
) -> Clip:
    """Return a clip whose masks have the numbers of its pictures. home: folder of the masks."""
    found = files.masks_by_frame(masks, files.frames_by_number(pictures), pictures[0].parent)
    truth = ClipTruth("masks", home, found, {}, length=len(pictures), labels=labels or Labels())
    return files.fit_clip(Clip(name, place, pictures, rate_hz, len(pictures), truth))


class Bms(Reader):
    """Berkeley motion segmentation: BMS-26 (Brox and Malik, 2010) and FBMS-59 (Ochs, Malik and Brox, 2014).

        Trainingset/CLIP/*.jpg             the frames, named by number; BMS-26: moseg_dataset/CLIP/, first as .ppm
        Trainingset/CLIP/GroundTruth/      FBMS-59; in BMS-26 the same files lie in CLIP/
            *Def.dat                       the values of the regions, and which files label which frames
            *_gt.ppm, *_gt.pgm, *.pgm      the labels: a colour (one number) or a grey value for each region

    The first region is the background, as in the authors' evaluation. *PROB_gt files are not read. Clips of
    `frames/` and `masks/` are read as in `folder`.
    """

    kind = "bms"
    layout = "Berkeley motion segmentation: BMS-26 and FBMS-59, as published or as frames/ and masks/"
    terms = "for research purposes only; any commercial use is prohibited; to be cited"
    defaults: ClassVar = {"rate_hz": None}
    sets = ("Trainingset", "Testset", "moseg_dataset", "FBMS_Trainingset", "FBMS_Testset")
    """Folders of clips, as in the archives. They may contain each other."""

    def _places(self) -> Mapping[str, Path]:
        places: dict[str, Path] = {}
        for place in self._clips_below(self.folder):
            if place.name in places and self.wanted(place.name):
                read = f"{places[place.name]} is read; {place} of the same name is not read"
                self.missing.append(f"{place.name}: {read}")
            places.setdefault(place.name, place)
        return places

    def _clips_below(self, folder: Path) -> list[Path]:
        inside = [folder / name for name in files.folders_in(folder)]
        deeper = [clip for place in inside if place.name in self.sets for clip in self._clips_below(place)]
        return [place for place in inside if place.name not in self.sets] + deeper

    def _clip(self, name: str, place: Path) -> Clip:
        rate_hz = self.options["rate_hz"]
        if is_clip(place):
            return files.fit_clip(clip_at(place, name, rate_hz))
        home = place / "GroundTruth" if (place / "GroundTruth").is_dir() else place
        path = next(iter(sorted(home.glob("*Def.dat"))), None)
        if path is None:
            raise InputError(f"{place} has no truth; wanted {name}Def.dat and masks in {home}, or frames/ and masks/")
        definition = read_definition(path)
        label_files = {file for _, file, _ in definition.labelled}
        # A PPM or PGM is a frame only if there is no JPEG, because BMS-26 has labels among the frames.
        pictures = files.images_in(place, _PHOTOS) or tuple(
            p
            for p in files.images_in(place, frozenset({".ppm"}))
            if p.name not in label_files and not p.stem.endswith("_gt")
        )
        if not pictures:
            raise InputError(f"{path} is the truth of a clip without pictures; put the pictures into {place}")
        if len(pictures) < definition.frames:
            held = f"{place} holds {len(pictures)} pictures"
            raise InputError(f"{path} is of {definition.frames} frames, but {held}; is it whole?")
        frames = {p.stem: frame for frame, p in enumerate(pictures, 1)}
        masks = {}
        for number, file, picture in definition.labelled:
            frame = frames.get(Path(picture).stem)
            if frame is None:
                raise InputError(f"{path}: picture {picture} of frame {number} is not in {place}; is it whole?")
            # Some definitions name a .ppm file that is a .pgm file, or vice versa.
            named = home / file
            tried = (named, *(named.with_suffix(suffix) for suffix in (".ppm", ".pgm", ".png")))
            masks[frame] = next(filter(Path.is_file, tried), named)
            if not masks[frame].is_file():
                raise InputError(f"{named} does not exist, but the definition beside it names it")
        labels = Labels(background=definition.regions[:1], movers=definition.regions[1:])
        truth = ClipTruth("masks", home, dict(sorted(masks.items())), {}, length=len(pictures), labels=labels)
        return files.fit_clip(Clip(name, place, pictures, rate_hz, len(pictures), truth))


class Definition(NamedTuple):
    """A clip's *Def.dat. regions: the value of each. labelled: number, label file, picture of each labelled frame."""

    regions: tuple[int, ...]
    frames: int
    labelled: tuple[tuple[int, str, str], ...]


def read_definition(path: Path) -> Definition:
    """Read a definition, in which a line that ends with a colon names the next line. Raise InputError if damaged.

    The names are: Total number of regions; Scale of region K (the value of its pixels); Total number of frames in this
    shot; and for each labelled frame Frame number, File name (labels) and Input file name (picture).
    """
    lines = [line.strip() for line in read_text(path, "latin-1").splitlines() if line.strip()]
    entries = [
        (name[:-1].strip().lower(), value)
        for name, value in pairwise(lines)
        if name.endswith(":") and not value.endswith(":")
    ]

    def whole(text: str) -> int:
        if not text.isdecimal() or len(text) > 9:
            raise InputError(f"{path}: wanted a whole number, got '{text[:40]}'")
        return int(text)

    def file(text: str) -> str:
        """Return the name of a file beside the definition, without the folders of the authors' machine."""
        name = re.split(r"[\\/]", text)[-1]
        if name in ("", ".", "..") or "\0" in name or len(name.encode()) > _LONGEST_NAME:
            raise InputError(f"{path}: '{text[:40]}' is not the name of a file")
        return name

    regions = [whole(value) for name, value in entries if name.startswith("scale of region")]
    frames = [whole(value) for name, value in entries if name.startswith("total number of frames")]
    numbers, masks, pictures = (
        [value for name, value in entries if name == wanted]
        for wanted in ("frame number", "file name", "input file name")
    )
    if len(regions) < 2 or len(frames) != 1:
        raise InputError(f"{path} is not a definition of a clip; wanted two regions or more, and the number of frames")
    if not len(numbers) == len(masks) == len(pictures) or not numbers:
        raise InputError(
            f"{path} names {len(numbers)} labelled frames, {len(masks)} files and {len(pictures)} pictures; "
            "wanted as many of each, and at least one"
        )
    rows = [(whole(n), file(f), file(p)) for n, f, p in zip(numbers, masks, pictures, strict=True)]
    return Definition(tuple(regions), frames[0], tuple(rows))
