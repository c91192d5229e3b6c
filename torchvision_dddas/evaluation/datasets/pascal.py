"""PASCAL Annotation Version 1.00: the boxes of a picture as INRIA wrote them down."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError

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
    try:
        text = path.read_bytes().decode("latin-1").replace("\r\n", "\n")  # INRIA's own name has an accent
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    size, count, corner = _SIZE.search(text), _COUNT.search(text), _CORNER.search(text)
    if size is None or count is None:
        what = "Image size" if size is None else "Objects with ground truth"
        raise InputError(f"{path} does not tell '{what}'; wanted a PASCAL Annotation of version 1.00")
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
