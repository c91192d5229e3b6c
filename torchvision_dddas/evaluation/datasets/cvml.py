"""CVML: the annotation of PETS 2009 and CAVIAR as XML.

    NAME.xml    <dataset><frame number="0"><objectlist><object id="1"><box h="" w="" xc="" yc=""/></object>...

with the pictures in a folder of the XML's name beside it, or in the XML's own folder: frame_0000.jpg ..., or a video.
The folder holds such XML, itself or in its folders. Frames count from 0; xc, yc is the middle of a box. XML that is
something else, such as a camera's calibration, is passed over.

Terms: PETS 2009 is the University of Reading's, for research; CAVIAR is for any use, with thanks to the EC funded
project IST 2001 37540; the annotation of PETS 2009 by A. Milan, for research.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.annotations import LAST, table_of, truth_of
from torchvision_dddas.evaluation.datasets.files import check_numbering, count_frames, images_in, number_of, videos_in
from torchvision_dddas.evaluation.datasets.record import Clip, Collector, Dataset, Wanted, check_options, folders_in
from torchvision_dddas.evaluation.metrics.truth import FARTHEST, Truth, to_number

TERMS = "research only; cite PETS 2009 or CAVIAR"


def read(folder: Path, options: Mapping[str, Any], wanted: Wanted) -> Dataset:
    """Options. rate_hz: frames a second of pictures; PETS 2009 has 7, CAVIAR 25."""
    rate_hz = check_options("cvml", options, {"rate_hz": None})["rate_hz"]
    collector = Collector("cvml", folder, TERMS, wanted)
    places = {path.stem: path for path in _annotations_below(folder, 2)}
    if not places:
        return collector.refuse(f"{folder} holds no CVML annotation; wanted NAME.xml with <dataset><frame number=...>")
    parents = [path.parent for path in places.values()]

    def clip_of(name: str) -> Clip:
        path = places[name]
        homes = [path.with_suffix(""), *([path.parent] if parents.count(path.parent) == 1 else [])]
        images = next((found for home in homes if (found := images_in(home))), ())
        video = next((found[:1] for home in homes if (found := videos_in(home))), ())
        pictures = check_numbering(images, number_of(images[0]) or 0) if images else video
        truth = read_truth(path, count_frames(pictures))
        return collector.label_clip(name, path, pictures, truth, homes[0], rate_hz=rate_hz, shows=("people",))

    return collector.collect(places, clip_of)


def read_truth(path: Path, length: int = 0) -> Truth:
    """An annotation; length: frames of the clip, 0 where it is not known. Raises InputError with file and frame."""
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path} is broken XML: {error}") from None
    rows = []
    for frame in root.iter("frame"):
        number = _number(path, frame, "number", "a frame")
        where = f"frame {number:g}"
        if number != int(number) or not 0 <= number < LAST:
            raise InputError(f"{path}: a frame has the number {number:g}; wanted a whole one, 0 to {LAST - 1}")
        for target in frame.iterfind("objectlist/object"):
            identity, box = _number(path, target, "id", where), target.find("box")
            if box is None or identity != int(identity):
                raise InputError(f"{path}: object {identity:g} of {where} has no box or no whole id")
            xc, yc, w, h = (_number(path, box, key, where) for key in ("xc", "yc", "w", "h"))
            rows.append([number + 1, identity, xc - w / 2, yc - h / 2, w, h])
    if not rows:
        raise InputError(f"{path} holds no box; wanted <dataset><frame number=...><objectlist><object id=...><box ...>")
    v = np.array(rows)
    table = table_of(path, v[:, 0], v[:, 1], v[:, 2:], np.arange(1, len(v) + 1))
    return truth_of(path, table, np.ones(len(v), bool), length)


def _number(path: Path, element: ElementTree.Element, key: str, where: str) -> float:
    value = to_number(text := element.get(key, ""))
    if not abs(value) <= FARTHEST:
        raise InputError(f"{path}: {element.tag} of {where} has {key}='{text}'; wanted a number")
    return value


def _annotations_below(folder: Path, depth: int) -> list[Path]:
    here = sorted(p for p in folder.iterdir() if p.suffix.lower() == ".xml" and p.is_file() and _may_be_cvml(p))
    return here + [p for name in folders_in(folder) if depth for p in _annotations_below(folder / name, depth - 1)]


def _may_be_cvml(path: Path) -> bool:
    """Whether an XML file may be an annotation: broken ones are, so that they are reported; calibrations are not."""
    try:
        with path.open("rb") as file:
            beginning = file.read(4096)
    except OSError:
        return True
    return b"<dataset" in beginning or b"<Camera" not in beginning
