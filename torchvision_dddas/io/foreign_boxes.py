"""Read boxes of other programs and data sets: COCO, CVAT, UA-DETRAC, BDD100K, VisDrone, VIRAT, and masks."""

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.images import natural_order, read_mask
from torchvision_dddas.io.tables import CsvText

VISDRONE = (
    *("pedestrian", "people", "bicycle", "car", "van"),
    *("truck", "tricycle", "awning-tricycle", "bus", "motor"),
)
"""The categories of VisDrone, numbered from 1. Category 0 is an unlabelled region, 11 another object."""
VIRAT = ("person", "car", "vehicle", "object", "bike")
"""The types of VIRAT's objects, numbered from 1. Type 0 is unknown."""

COLUMNS = ("frame", "identity", "x_px", "y_px", "width_px", "height_px", "score", "class_id", "class")
"""The columns of a Row. An unknown value is None."""

Row = tuple[Any, ...]
_Reader = Callable[[bytes, Sequence[str], list[str]], Iterable[Row]]


class BoxText(CsvText):
    """The cells of boxes from a file that is not a table. `line` is the number of each box in its file."""

    @property
    def unit(self) -> str:
        """The word for a row in messages."""
        return "box"


def read_foreign(path: Path, pictures: Sequence[str] = ()) -> tuple[CsvText, list[str]] | None:
    """Return the cells and notes of a JSON, an XML or a folder of masks; None for other paths. Frames count from 1.

    Cells are those of the known COLUMNS. pictures: the names of the clip's pictures without endings, in order; by
    default, the numbers in file names are frames. Raise InputError with the file and the number of the box.
    """
    said: list[str] = []
    if os.path.isdir(path):  # noqa: PTH112 (pathlib raises for a name that no file can have)
        files = sorted(path.glob("*.png"), key=lambda file: natural_order(file.name))
        if any(file.suffix == ".txt" for file in path.iterdir()):
            return None
        if not files and (masks := path / "masks").is_dir():  # `write_tracks` writes DAVIS masks into this folder
            return read_foreign(masks, pictures)
        if not files:
            return None
        text, notes = _cells(path, _read_masks(files, pictures, said))
        return text, notes + said
    readers: dict[str, _Reader] = {".json": _read_json, ".xml": _read_xml}
    if (reader := readers.get(path.suffix.lower())) is None:
        return None
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"detections {path} cannot be read: {error.strerror}") from None
    text, notes = _cells(path, reader(content, pictures, said))
    return text, notes + said


def name_columns(path: Path, text: CsvText) -> tuple[CsvText, list[str]] | None:
    """Return text of VisDrone or VIRAT with the names of its columns, and notes; None for any other text."""
    try:
        if path.name.endswith("viratdata.objects.txt"):
            rows = [_virat_row(*map(int, row)) for row in text.rows]
        elif text.rows and all(len(row) == 10 for row in text.rows):
            codes = np.array([[float(cell) for cell in row[7:]] for row in text.rows])
            is_known = np.isin(codes[:, 1:], (-1, 0, 1, 2)).all() and np.isin(codes[:, 0], range(12)).all()
            if not is_known or not codes[:, 0].any():
                return None
            rows = [_visdrone_row(*row[:8]) for row in text.rows if float(row[7])]
        else:
            return None
    except (TypeError, ValueError):
        return None
    kept = [line for line, row in zip(text.line, text.rows, strict=True) if len(row) != 10 or float(row[7])]
    left_out = len(text.rows) - len(rows)
    notes = [f"{left_out} unlabelled regions of VisDrone are left out"] * bool(left_out)
    named = [["" if cell is None else str(cell) for cell in row] for row in rows]
    return CsvText([*COLUMNS], kept, named), notes


def _visdrone_row(*cells: str) -> Row:
    category = int(float(cells[7]))
    return (*cells[:7], category, VISDRONE[category - 1] if category <= len(VISDRONE) else "others")


def _virat_row(identity: int, _duration: int, frame: int, x: int, y: int, w: int, h: int, kind: int) -> Row:
    return frame + 1, identity + 1, x, y, w, h, None, kind, VIRAT[kind - 1] if kind else None


def _cells(path: Path, rows: Iterable[Row]) -> tuple[CsvText, list[str]]:
    """Return the rows as text, without columns that are always unknown. Raise InputError with the number of the box."""
    found: list[Row] = []
    try:
        for row in rows:
            found.append(row)  # noqa: PERF402 (the number of rows says where an error is)
    except InputError:
        raise
    except (ElementTree.ParseError, json.JSONDecodeError, UnicodeError, RecursionError) as error:
        raise InputError(f"detections {path} is broken: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise InputError(f"detections {path}, box {len(found) + 1}: {what}") from None
    identity, notes = _number_identities([row[1] for row in found])
    columns = [[row[k] for row in found] for k in range(len(COLUMNS))]
    columns[1] = identity
    kept = [k for k, column in enumerate(columns) if k < 6 or any(cell is not None for cell in column)]
    cells = [["" if columns[k][row] is None else str(columns[k][row]) for k in kept] for row in range(len(found))]
    return BoxText([COLUMNS[k] for k in kept], list(range(1, len(found) + 1)), cells), notes


def _number_identities(given: list[Any]) -> tuple[list[int | None], list[str]]:
    """Return identities as whole numbers from 1, and notes. Numbers from 0 grow by 1; words are numbered in order."""
    given = [None if identity == -1 else identity for identity in given]  # -1 means no identity
    known = [str(identity) for identity in given if identity is not None]
    if all(re.fullmatch("[0-9]{1,15}", identity) for identity in known):
        first = int("0" in {identity.lstrip("0") or "0" for identity in known})
        notes = ["identities count from 0: one is added to each of them"] * first
        return [None if identity is None else int(identity) + first for identity in given], notes
    numbers = {name: number for number, name in enumerate(dict.fromkeys(known), 1)}
    notes = ["identities are words: they are numbered in their order"]
    return [None if identity is None else numbers[str(identity)] for identity in given], notes


def frames_of(names: Sequence[str], pictures: Sequence[str], said: list[str]) -> list[int]:
    """Return the frame, from 1, of each picture: its place in the clip, else the number in its name, else its order.

    said: takes a note if the order decides.
    """
    stems = [Path(name).stem for name in names]
    places = {name: number for number, name in enumerate(pictures, 1)}
    if places and set(stems) <= set(places):
        return [places[stem] for stem in stems]
    ends = [re.search(r"[0-9]{1,9}$", stem) for stem in stems]
    numbers = [int(end[0]) for end in ends if end]
    if len(set(numbers)) < len(stems):
        lacking = len(stems) - len(set(numbers))
        said.append(
            f"{lacking} of {len(stems)} pictures have no number of their own at the end of their names: the order of "
            "the pictures in the file gives the frames"
        )
        return list(range(1, len(stems) + 1))
    return [number + (min(numbers) == 0) for number in numbers]


def _read_json(content: bytes, pictures: Sequence[str], said: list[str]) -> Iterator[Row]:
    """Read COCO or BDD100K. said: takes notes on what is left out or assumed."""
    data = json.loads(content)
    frames = data.get("frames") if isinstance(data, dict) else data
    if isinstance(frames, list) and any("labels" in frame for frame in frames):
        yield from _read_bdd(frames)
    else:
        yield from _read_coco(data if isinstance(data, dict) else {"annotations": data}, pictures, said)


def _read_coco(data: dict[str, Any], pictures: Sequence[str], said: list[str]) -> Iterator[Row]:
    """Read COCO's detections (a list), or annotations. `track_id` or `instance_id` is the identity, if given.

    Source: cocodataset.org, data format and results format; TAO and CocoVID for tracks.
    """
    images = data.get("images", [])
    if len({image.get("video_id") for image in images}) > 1:
        raise ValueError("the images are of several videos; wanted one file for each video")
    if images and all("frame_id" in image for image in images):
        first = min(image["frame_id"] for image in images)
        numbers = [image["frame_id"] + (first == 0) for image in images]
    else:
        numbers = frames_of([str(image["file_name"]) for image in images], pictures, said)
    frames = {image["id"]: number for image, number in zip(images, numbers, strict=True)}
    if data["annotations"] and not images:
        said.append("the file lists no images: each image_id is taken as the number of a frame")
    names = {category["id"]: category["name"] for category in data.get("categories", [])}
    if crowds := sum(bool(box.get("iscrowd")) for box in data["annotations"]):
        said.append(f"{crowds} boxes of crowds (iscrowd) are left out")
    for box in data["annotations"]:
        if box.get("iscrowd"):
            continue
        number, kind = box["image_id"], box.get("category_id")
        if images and number not in frames:
            raise ValueError(f"image_id {number} is not among the {len(images)} images")
        if len(box["bbox"]) != 4:
            raise ValueError(f"bbox has {len(box['bbox'])} numbers; wanted x, y, width, height")
        held = box.get("attributes") or {}
        identity = next((of[k] for of in (box, held) for k in ("track_id", "instance_id") if k in of), None)
        yield frames.get(number, number), identity, *box["bbox"], box.get("score"), kind, names.get(kind)


def _read_bdd(frames: list[dict[str, Any]]) -> Iterator[Row]:
    """Read BDD100K's tracks in Scalabel's format. The right and lower edges lie on the last pixel."""
    numbers = [frame.get("frameIndex", place) for place, frame in enumerate(frames)]
    if len({frame.get("videoName") for frame in frames}) > 1:
        raise ValueError("the frames are of several videos; wanted one file for each video")
    for number, frame in zip(numbers, frames, strict=True):
        for target in frame.get("labels") or ():
            if (box := target.get("box2d")) is not None:
                width, height = box["x2"] - box["x1"] + 1, box["y2"] - box["y1"] + 1
                place = (box["x1"], box["y1"], width, height)
                yield number + 1, target["id"], *place, target.get("score"), None, target.get("category")


def _read_xml(content: bytes, pictures: Sequence[str], said: list[str]) -> Iterator[Row]:
    root = ElementTree.fromstring(content)
    if regions := sum(len(ignored) for ignored in root.iter("ignored_region")):
        said.append(f"{regions} ignored regions of UA-DETRAC are left out")
    if root.tag not in ("sequence", "annotations"):
        raise ValueError(f"the XML begins with <{root.tag}>; wanted <annotations> of CVAT or <sequence> of UA-DETRAC")
    yield from _read_detrac(root) if root.tag == "sequence" else _read_cvat(root, pictures, said)


def _read_cvat(root: ElementTree.Element, pictures: Sequence[str], said: list[str]) -> Iterator[Row]:
    """Read CVAT for video 1.1, whose frames count from 0, or CVAT for images, which has no identities.

    Source: docs.cvat.ai, XML annotation format.
    """

    def place(box: ElementTree.Element) -> tuple[float, ...]:
        left, top, right, bottom = (float(box.attrib[key]) for key in ("xtl", "ytl", "xbr", "ybr"))
        return left, top, right - left, bottom - top

    for track in root.iter("track"):
        for box in track.iter("box"):
            if box.get("outside", "0") == "0":
                yield int(box.attrib["frame"]) + 1, track.attrib["id"], *place(box), None, None, track.get("label")
    images = list(root.iter("image"))
    frames = frames_of([image.attrib["name"] for image in images], pictures, said)
    for frame, image in zip(frames, images, strict=True):
        for box in image.iter("box"):
            yield frame, None, *place(box), None, None, box.get("label")


def _read_detrac(root: ElementTree.Element) -> Iterator[Row]:
    """Read UA-DETRAC: <frame num><target_list><target id><box left top width height/><attribute vehicle_type/>."""
    for frame in root.iter("frame"):
        for target in frame.iter("target"):
            box, kind = target.find("box"), target.find("attribute")
            if box is None:
                raise ValueError(f"target {target.get('id')} of frame {frame.get('num')} has no <box>")
            place = (float(box.attrib[key]) for key in ("left", "top", "width", "height"))
            label = None if kind is None else kind.get("vehicle_type")
            yield int(frame.attrib["num"]), target.attrib["id"], *place, None, None, label


def _read_masks(files: Sequence[Path], pictures: Sequence[str], said: list[str]) -> Iterator[Row]:
    """Yield the extent of the pixels of each value of a mask as a box. The value 0 is background."""
    from scipy import ndimage  # imported here, because it would slow down the start of every run

    frames = frames_of([file.name for file in files], pictures, said)
    for frame, file in zip(frames, files, strict=True):
        mask = read_mask(file)
        palette = _palette(file.read_bytes())
        values, places = np.unique(mask, return_inverse=True)
        for value, extent in zip(values.tolist(), ndimage.find_objects(places.reshape(mask.shape) + 1), strict=True):
            if value and extent is not None:
                (top, bottom), (left, right) = ((side.start, side.stop) for side in extent)
                identity = palette.get(value, value)
                yield frame, identity, left, top, right - left, bottom - top, None, None, None


def _palette(png: bytes) -> dict[int, int]:
    """Return the palette index of each colour, numbered as in `read_mask`; empty for a PNG without a palette."""
    at = png.find(b"PLTE")
    if png[25:26] != b"\x03" or at < 0:
        return {}
    size = int.from_bytes(png[at - 4 : at], "big")
    colours = np.frombuffer(png[at + 4 : at + 4 + size], np.uint8).reshape(-1, 3) @ np.array([65536, 256, 1])
    return {colour: place for place, colour in reversed([*enumerate(colours.tolist())])}
