"""INRIA person: pictures of people who stand, and pictures without any.

    Test/pos/crop001501.png              pictures with people
    Test/annotations/crop001501.txt      PASCAL Annotation Version 1.00: their boxes
    Test/neg/00000002a.png               pictures without people
    (and the same under Train)

or a folder of crops such as 96X160H96/Train/pos: each picture shows one person in its middle, 96 px high (H96); the
width of a body is taken for 0.41 of that. Pictures are of many sizes, so that a clip here is all pictures of one size:
pos-640x480, neg-320x240. Its frames are not of one film, and only people can be looked for in it.

Terms, as its makers state them: as is, without any warranty; the pictures are of several owners, for research.
"""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.gathering import gather
from torchvision_dddas.evaluation.datasets.kinds import Wanted
from torchvision_dddas.evaluation.datasets.options import checked
from torchvision_dddas.evaluation.datasets.pascal import read_annotation
from torchvision_dddas.evaluation.datasets.picture_size import size_of
from torchvision_dddas.evaluation.datasets.pictures import images_in
from torchvision_dddas.evaluation.datasets.record import Clip, Dataset
from torchvision_dddas.evaluation.metrics.truth import Truth

TERMS = "research; as is, without any warranty"
BODY_HEIGHT_PX = 96.0
WIDTH_SHARE = 0.41
"""A standing body's width by its height (Dollár et al., 2012)."""

Pictured = tuple[Path, tuple[int, int], np.ndarray]
"""A picture, its (width, height) and the boxes (N, 4) of its people."""


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """Options. part: Test or Train. body_height_px: of the person in each crop."""
    given = checked("inria", options, {"part": "Test", "body_height_px": BODY_HEIGHT_PX})
    home = folder / given["part"] if (folder / given["part"]).is_dir() else folder
    notes: list[str] = []
    if (home / "pos").is_dir() or (home / "neg").is_dir():
        nobody = np.zeros((0, 4))
        found = {
            "pos": _each(images_in(home / "pos"), _annotated, notes),
            "neg": _each(images_in(home / "neg"), lambda picture: (picture, size_of(picture), nobody), notes),
        }
        notes += [f"no pictures in {home / name}, where they belong" for name in found if not images_in(home / name)]
    elif crops := images_in(folder):
        height_px = given["body_height_px"]

        def one(picture: Path) -> Pictured:
            size = size_of(picture)
            return picture, size, body_of(size, height_px)

        found = {"crops": _each(crops, one, notes)}
    else:
        lacking = f"{folder} holds neither {given['part']}/pos nor pictures; wanted INRIA person or its crops"
        return Dataset("inria", folder, (), TERMS, (lacking,))
    clips = {clip.name: clip for name, pictures in found.items() for clip in _by_size(home, name, pictures)}
    return gather("inria", folder, TERMS, filter(wanted, clips), clips.__getitem__, notes)


def body_of(size: tuple[int, int], height_px: float) -> np.ndarray:
    """(1, 4) the body in the middle of a crop of a size. Raises InputError where it is higher than the crop."""
    width, height = size
    if not 0 < height_px <= height:
        raise InputError(f"a crop is {height} px high, which no body of {height_px:g} px fits; see body_height_px")
    across = WIDTH_SHARE * height_px
    return np.array([[(width - across) / 2, (height - height_px) / 2, across, height_px]])


def _annotated(picture: Path) -> Pictured:
    path = picture.parents[1] / "annotations" / f"{picture.stem}.txt"
    if not path.is_file():
        raise InputError(f"no truth, which belongs in {path}")
    said, size = read_annotation(path), size_of(picture)
    if said.size != size:
        raise InputError(f"it is {size[0]}×{size[1]} pixels, but {path} says {said.size[0]}×{said.size[1]}")
    return picture, size, said.box_px


def _each(pictures: Iterable[Path], read_one: Callable[[Path], Pictured], notes: list[str]) -> list[Pictured]:
    """All that can be read; the others are told."""
    found = []
    for picture in pictures:
        try:
            found.append(read_one(picture))
        except InputError as error:
            notes.append(f"{picture.parent.name}/{picture.name}: {error}")
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
