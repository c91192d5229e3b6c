"""INRIA person: pictures of people who stand, and pictures without any."""

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.files import images_in, size_of
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options
from torchvision_dddas.evaluation.metrics.truth import Truth, read_text

TERMS = "research; as is, without any warranty"
BODY_HEIGHT_PX = 96.0
WIDTH_SHARE = 0.41
"""A standing body's width by its height (Dollár et al., 2012)."""

Pictured = tuple[Path, tuple[int, int], np.ndarray]
"""A picture, its (width, height) and the boxes (N, 4) of its people."""

BoxReader = Callable[[Path, tuple[int, int]], np.ndarray]
"""From a picture and its (width, height) to the boxes (N, 4) of its people. Raises InputError."""


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """Options. part: Test or Train. body_height_px: of the person in each crop."""
    given = check_options("inria", options, {"part": "Test", "body_height_px": BODY_HEIGHT_PX})
    collector = Collector("inria", folder, TERMS, wanted)
    home = folder / given["part"] if (folder / given["part"]).is_dir() else folder
    if (home / "pos").is_dir() or (home / "neg").is_dir():
        nobody = np.zeros((0, 4))
        readers: dict[str, tuple[Path, BoxReader]] = {
            "pos": (home / "pos", _annotated_boxes),
            "neg": (home / "neg", lambda picture, size: nobody),
        }
    elif images_in(folder):
        readers = {"crops": (folder, lambda picture, size: body_of(size, given["body_height_px"]))}
    else:
        return collector.refuse(
            f"{folder} holds neither {given['part']}/pos nor pictures; wanted INRIA person or its crops"
        )
    found = {name: _read_each(images_in(place), boxes_of, collector) for name, (place, boxes_of) in readers.items()}
    absent = [place for place, _ in readers.values() if not images_in(place)]
    collector.missing += [f"no pictures in {place}, where they belong" for place in absent]
    clips = {clip.name: clip for name, pictures in found.items() for clip in _by_size(home, name, pictures)}
    return collector.collect(clips, clips.__getitem__)


def body_of(size: tuple[int, int], height_px: float) -> np.ndarray:
    """(1, 4) the body in the middle of a crop of a size. Raises InputError where it is higher than the crop."""
    width, height = size
    if not 0 < height_px <= height:
        raise InputError(f"a crop is {height} px high, which no body of {height_px:g} px fits; see body_height_px")
    across = WIDTH_SHARE * height_px
    return np.array([[(width - across) / 2, (height - height_px) / 2, across, height_px]])


def _annotated_boxes(picture: Path, size: tuple[int, int]) -> np.ndarray:
    path = picture.parents[1] / "annotations" / f"{picture.stem}.txt"
    if not path.is_file():
        raise InputError(f"no truth, which belongs in {path}")
    annotation = read_annotation(path)
    if annotation.size != size:
        said = f"{path} says {annotation.size[0]}×{annotation.size[1]}"
        raise InputError(f"it is {size[0]}×{size[1]} pixels, but {said}")
    return annotation.box_px


def _read_each(pictures: Iterable[Path], boxes_of: BoxReader, collector: Collector) -> list[Pictured]:
    """All that can be read; the others go to the data set's missing clips."""
    found = []
    for picture in pictures:
        try:
            size = size_of(picture)
            found.append((picture, size, boxes_of(picture, size)))
        except InputError as error:
            collector.missing.append(f"{picture.parent.name}/{picture.name}: {error}")
    return found


def _by_size(home: Path, name: str, pictures: list[Pictured]) -> list[Clip]:
    clips = []
    for size in sorted({size for _, size, _ in pictures}):
        some = [picture for picture in pictures if picture[1] == size]
        boxes = {frame: box_px for frame, (_, _, box_px) in enumerate(some, 1)}
        truth = Truth("boxes", home / name, {}, boxes, length=len(some))
        files = tuple(path for path, _, _ in some)
        clips.append(Clip(f"{name}-{size[0]}x{size[1]}", home, files, frames=len(some), truth=truth, shows=("people",)))
    return clips


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
    """Read a file. Raises InputError: none of this kind, more or fewer boxes than announced, an empty box."""
    text = read_text(path, "latin-1").replace("\r\n", "\n")  # INRIA's own name has an accent
    size, count, corner = _SIZE.search(text), _COUNT.search(text), _CORNER.search(text)
    if size is None or count is None:
        what = "Image size" if size is None else "Objects with ground truth"
        raise InputError(f"{path} does not hold '{what}'; wanted a PASCAL Annotation of version 1.00")
    boxes = np.array([[int(number) for number in found.groups()] for found in _BOX.finditer(text)], float)
    boxes = boxes.reshape(-1, 4)
    if len(boxes) != int(count[1]):
        raise InputError(f"{path} announces {count[1]} objects and has the boxes of {len(boxes)}")
    boxes -= np.tile([float(corner[1]), float(corner[2])] if corner else [0.0, 0.0], 2)
    boxes[:, 2:] += 1 - boxes[:, :2]  # both corners are in the box
    if not (boxes[:, 2:] > 0).all():
        raise InputError(f"{path} has a box whose end is before its beginning")
    width, height = int(size[1]), int(size[2])
    if min(width, height) < 1:
        raise InputError(f"{path} says the picture is {width}×{height} pixels")
    return Annotation((width, height), boxes)
