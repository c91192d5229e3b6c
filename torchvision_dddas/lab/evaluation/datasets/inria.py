"""INRIA person: pictures of standing people, and pictures without people."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.files import images_in, size_of
from torchvision_dddas.lab.evaluation.datasets.record import Clip, Reader
from torchvision_dddas.lab.evaluation.metrics.text_rows import read_text
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth

WIDTH_SHARE = 0.41
"""Width of a standing body divided by its height (Dollár et al., 2012)."""


class Inria(Reader):
    """INRIA person: a clip has the pictures of one size of pos/, of neg/ or of a folder of crops."""

    kind = "inria"
    layout = "INRIA person: Test/ with pos/, annotations/ and neg/; or a folder of crops, each of one person"
    terms = "research; as is, without any warranty"
    defaults: ClassVar = {"part": "Test", "body_height_px": 96.0}

    def _places(self) -> Mapping[str, tuple[Path, list[tuple[Path, np.ndarray]]]]:
        part = self.options["part"]
        home = self.folder / part if (self.folder / part).is_dir() else self.folder
        readers: dict[str, tuple[Path, Callable[[Path, tuple[int, int]], np.ndarray]]]
        if (home / "pos").is_dir() or (home / "neg").is_dir():
            readers = {
                "pos": (home / "pos", _annotated_boxes),
                "neg": (home / "neg", lambda picture, size: np.zeros((0, 4))),
            }
        elif images_in(self.folder):
            readers = {"crops": (self.folder, lambda picture, size: body_of(size, self.options["body_height_px"]))}
        else:
            return self._refuse(
                f"{self.folder} holds neither {part}/pos nor pictures; wanted INRIA person or its crops"
            )
        places: dict[str, tuple[Path, list[tuple[Path, np.ndarray]]]] = {}
        for name, (place, boxes_of) in readers.items():
            for picture in images_in(place):
                try:
                    size = size_of(picture)
                    labelled = picture, boxes_of(picture, size)
                except InputError as error:
                    self.missing.append(f"{picture.parent.name}/{picture.name}: {error}")
                    continue
                places.setdefault(f"{name}-{size[0]}x{size[1]}", (home / name, []))[1].append(labelled)
        absent = [place for place, _ in readers.values() if not images_in(place)]
        self.missing += [f"{place} holds no pictures; wanted pictures there" for place in absent]
        return places

    def _clip(self, name: str, place: tuple[Path, list[tuple[Path, np.ndarray]]]) -> Clip:
        home, labelled = place
        boxes = {frame: box_px for frame, (_, box_px) in enumerate(labelled, 1)}
        truth = ClipTruth("boxes", home, {}, boxes, length=len(labelled))
        pictures = tuple(picture for picture, _ in labelled)
        return Clip(name, home.parent, pictures, frames=len(labelled), truth=truth, shows=("people",))


def body_of(size: tuple[int, int], height_px: float) -> np.ndarray:
    """Return the body in the middle of a crop, (1, 4). Raise InputError if the body is higher than the crop."""
    width, height = size
    if not 0 < height_px <= height:
        raise InputError(f"a crop is {height} px high, too low for a body of {height_px:g} px; see body_height_px")
    across = WIDTH_SHARE * height_px
    return np.array([[(width - across) / 2, (height - height_px) / 2, across, height_px]])


def _annotated_boxes(picture: Path, size: tuple[int, int]) -> np.ndarray:
    path = picture.parents[1] / "annotations" / f"{picture.stem}.txt"
    if not path.is_file():
        raise InputError(f"no truth; it belongs in {path}")
    annotation = read_annotation(path)
    if annotation.size != size:
        stated = f"{path} says {annotation.size[0]}×{annotation.size[1]}"
        raise InputError(f"it is {size[0]}×{size[1]} pixels, but {stated}")
    return annotation.box_px


_NUMBER = r"(-?\d{1,7})"
_SIZE = re.compile(rf"^Image size \(X x Y x C\) *: *{_NUMBER} x {_NUMBER} x", re.ASCII | re.MULTILINE)
_CORNER = re.compile(rf"^# *Top left pixel co-ordinates *: *\({_NUMBER}, *{_NUMBER}\)", re.ASCII | re.MULTILINE)
_BOX = re.compile(
    rf"^Bounding box for object \d+ \"[^\"\n]*\" \(Xmin, Ymin\) - \(Xmax, Ymax\) *: "
    rf"*\({_NUMBER}, *{_NUMBER}\) *- *\({_NUMBER}, *{_NUMBER}\)",
    re.ASCII | re.MULTILINE,
)
_COUNT = re.compile(r"^Objects with ground truth *: *(\d{1,4})", re.ASCII | re.MULTILINE)


class Annotation(NamedTuple):
    """size: (width, height) of the picture. box_px: (N, 4) x, y, width, height, pixels from 0."""

    size: tuple[int, int]
    box_px: np.ndarray


def read_annotation(path: Path) -> Annotation:
    """Read a file. Raise InputError for another kind of file, a wrong number of boxes, or an empty box."""
    text = read_text(path, "latin-1").replace("\r\n", "\n")  # INRIA's own name contains an accent
    size, count, corner = _SIZE.search(text), _COUNT.search(text), _CORNER.search(text)
    if size is None or count is None:
        what = "Image size" if size is None else "Objects with ground truth"
        raise InputError(f"{path} does not hold '{what}'; wanted a PASCAL Annotation of version 1.00")
    boxes = np.array([[int(number) for number in found.groups()] for found in _BOX.finditer(text)], float)
    boxes = boxes.reshape(-1, 4)
    if len(boxes) != int(count[1]):
        raise InputError(f"{path} announces {count[1]} objects, but has {len(boxes)} boxes")
    boxes -= np.tile([float(corner[1]), float(corner[2])] if corner else [0.0, 0.0], 2)
    boxes[:, 2:] += 1 - boxes[:, :2]  # the box includes both corners
    if not (boxes[:, 2:] > 0).all():
        raise InputError(f"{path} has a box whose end is before its start")
    width, height = int(size[1]), int(size[2])
    if min(width, height) < 1:
        raise InputError(f"{path} says the picture is {width}×{height} pixels")
    return Annotation((width, height), boxes)
