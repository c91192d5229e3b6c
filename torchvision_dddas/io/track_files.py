"""Write tracks, detections and positions as files that other programs read."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import cannot_write, save_file
from torchvision_dddas.io.column_files import write_columns
from torchvision_dddas.io.foreign_boxes import VISDRONE
from torchvision_dddas.io.ground_tables import read_positions
from torchvision_dddas.io.images import Masks
from torchvision_dddas.io.maps.formats import xml_text
from torchvision_dddas.io.tables import (
    BOX,
    CLASS_COLUMNS,
    FRAME,
    IDENTITY,
    MOT_TRACKS,
    PRECISE_SCORE,
    Schema,
    class_rows,
    mot_rows,
    parse_numbers,
    read_csv,
)
from torchvision_dddas.types import AerialLocations, DetectionTable, FrameResult, Positions, Scene, TrackedFrame, Tracks

_CSV = Schema("tracks", FRAME, IDENTITY, *BOX, PRECISE_SCORE, *CLASS_COLUMNS)
_MOST_VALUES = 65535  # the largest value of a 16-bit mask
# Names of other data sets for VisDrone's categories.
_VISDRONE_NAMES = {"person": "pedestrian", "bike": "bicycle", "motorbike": "motor", "motorcycle": "motor"}

Item = FrameResult | TrackedFrame | Tracks | Scene | AerialLocations
"""The results of one frame that can be written."""
Size = tuple[int, int] | None
"""Width and height of the pictures; None if unknown."""


def write_tracks(
    tracks: DetectionTable | Tracks | Positions | Iterable[Item],
    path: str | Path,
    *,
    to: str | None = None,
    size: Size = None,
    pictures: Sequence[str] = (),
) -> tuple[str, ...]:
    """Write the boxes or places of a clip in one of FORMATS. Return notes on what the format cannot hold.

    tracks: a table, or the results of frames in order, as `Pipeline`, `Tracker` and `read_detections` give them.
    to: the format; None: the ending of the path decides. size: (width, height) of the pictures, which yolo and davis
    need. pictures: their file names, in order. Only Parquet and GeoPackage hold places, such as `result.locations` of
    `Pipeline`.
    Raise InputError for nothing to write, an unknown format, a missing size or place, or if the disk refuses.

    >>> tracks = td.Tracks(1, np.array([7]), np.array([[10.0, 20, 20, 9]]), np.ones(1), np.zeros(1, int))
    >>> notes = td.write_tracks([tracks], "tracks.json", size=(64, 48))
    >>> td.read_detections("tracks.json").identity
    array([7])
    """
    path, ending = Path(path), Path(path).suffix.lower()
    if (to := to or _ENDINGS.get(ending, "")) not in FORMATS or (to in ("parquet", "gpkg") and ending != f".{to}"):
        what = f"{path.name} cannot be {to}" if to else f"the ending of {path.name} names no format"
        raise InputError(f"{what}; give one of {', '.join(FORMATS)}, the last two as .parquet and .gpkg")
    if size is None and to in ("yolo", "davis"):
        raise InputError(f"{to} needs the size of the pictures: give --clip CLIP, or size=(width, height)")
    write, holds = FORMATS[to]
    if isinstance(table := _table_of(tracks), Positions):
        if to not in ("parquet", "gpkg"):
            raise InputError(f"{to} holds boxes, and these are places: write .parquet or .gpkg")
        write_columns(table.to_columns(), path)
        return ()
    has = {"identities": table.identity > 0, "classes": table.label != "", "scores": table.score != 1}
    lost = [name for name, is_known in has.items() if is_known.any() and name not in holds]
    notes = [f"{to} has no place for {' and '.join(lost)}, which are left out"] if lost else []
    if holds[0] == "identities" and not has["identities"].all():
        if not has["identities"].any():
            raise InputError(f"{to} holds tracks, and none of these boxes has an identity: track them first")
        notes.append(f"{(~has['identities']).sum()} boxes without identity are left out")
        table = table[has["identities"]]
    if to in ("coco", "yolo", "cvat") and (table.label == "").any():
        notes.append(f"{(table.label == '').sum()} boxes without a class get the class target")
    try:
        notes += write(table, path, size, pictures)
    except OSError as error:
        raise cannot_write(path, error) from error
    return tuple(notes)


def convert_positions(table: Path, path: Path, to: str | None = None) -> int:
    """Write all columns of a table of positions as Parquet or GeoPackage, and return the number of its rows.

    Raise InputError as `read_positions` and `write_tracks` do.
    """
    count, ending = len(places := read_positions(table)), path.suffix.lower()
    if count == 0 or ending not in (".parquet", ".gpkg") or to not in (None, ending[1:]):
        write_tracks(places, path, to=to)
        return count
    text = read_csv(table, "positions")
    write_columns({name: _typed([row[k] for row in text.rows]) for k, name in enumerate(text.header)}, path)
    return count


def _typed(cells: list[str]) -> Sequence[Any] | np.ndarray:
    """Return the cells as whole numbers, numbers or words."""
    values = parse_numbers(cells)
    if np.isinf(values).any():
        return cells
    return values.astype(np.int64) if (values == np.round(values)).all() else values


def _table_of(tracks: DetectionTable | Tracks | Positions | Iterable[Item]) -> Tracks | Positions:
    """Return all rows in one table. Raise InputError if there are no results, or both boxes and places."""
    if isinstance(tracks, Positions):
        return tracks
    if isinstance(tracks, DetectionTable):
        label, class_id = tracks.classes(slice(None))
        identity = np.full(len(tracks), -1) if tracks.identity is None else tracks.identity
        row, link = np.full(len(tracks), -1), np.full(len(tracks), np.nan)
        columns = identity, tracks.box_px, tracks.score, row, link, None, label, class_id
        return replace(Tracks(0, *columns), frame=tracks.frame)  # type: ignore[arg-type]
    parts = [_part_of(item) for item in ([tracks] if isinstance(tracks, Tracks) else tracks)]
    places = [part for part in parts if isinstance(part, Positions)]
    boxes = [part for part in parts if isinstance(part, Tracks)]
    if places and boxes:
        raise InputError("write_tracks got boxes and places; wanted one of them")
    if not parts:
        raise InputError("write_tracks got no results to write")
    return Positions.concat(places) if places else Tracks.concat(boxes)


def _part_of(item: object) -> Tracks | Positions:
    if isinstance(item, AerialLocations):
        return item.positions
    if isinstance(item, Scene):
        found = item.detections
        columns = found.box_px, found.score, np.arange(len(found)), np.full(len(found), np.nan)
        return Tracks(item.frame.number, np.full(len(found), -1), *columns, label=found.label, class_id=found.class_id)
    part = getattr(item, "tracks", item)
    if not isinstance(part, Tracks):
        raise InputError(f"write_tracks got {type(item).__name__}; wanted results of Pipeline or Tracker, or a table")
    return part


# --------------------------------------------------------------------------------------------------------------------
# Writers, one for each format. Each writes a table and returns notes on what the format cannot hold.


def _write_csv(table: Tracks, path: Path, size: Size, names: Sequence[str]) -> list[str]:
    rows = {**_mot_rows(table), **class_rows(table.label, table.class_id)}
    rows["identity"] = [number if number > 0 else None for number in table.identity.tolist()]
    save_file(path, (_CSV.header + _CSV.format_rows(rows)).encode())
    return []


def _frames(table: Tracks) -> np.ndarray:
    return np.asarray(table.frame)


def _mot_rows(table: Tracks) -> dict[str, Any]:
    return mot_rows(table.frame, table.box_px, table.score, table.identity)


def _write_mot(table: Tracks, path: Path, size: Size, names: Sequence[str]) -> list[str]:
    save_file(path, MOT_TRACKS.format_rows(_mot_rows(table)).encode())
    return []


def _write_visdrone(table: Tracks, path: Path, size: Size, names: Sequence[str]) -> list[str]:
    """Write VisDrone text. The last columns are the category, and truncation and occlusion as unknown (-1)."""
    numbers = {name: number for number, name in enumerate(VISDRONE, 1)}
    called = {name: _VISDRONE_NAMES.get(name.lower(), name.lower()) for name in set(table.label.tolist())}
    category = np.array([numbers.get(called[name], len(VISDRONE) + 1) for name in table.label])
    save_file(path, MOT_TRACKS.format_rows({**_mot_rows(table), "x": category}).encode())
    renamed = sorted(name for name in called if name.lower() in _VISDRONE_NAMES)
    notes = [f"class {name} is written as {numbers[called[name]]}, {called[name]}" for name in renamed]
    uncounted = "written as 11, others, which the scores of VisDrone do not count"
    if others := sorted(name for name in called if name and called[name] not in numbers):
        notes.append(f"VisDrone has no class {', '.join(others)}: {uncounted}")
    if "" in called:
        notes.append(f"{(table.label == '').sum()} boxes without a class are {uncounted}")
    return notes


def _numbered_classes(table: Tracks, first: int) -> tuple[dict[int, str], np.ndarray]:
    """Return the name of each class, and the class of each row, (N,). Keep the table's numbers if all rows have one."""
    pairs = {*zip(table.class_id.tolist(), table.label.tolist(), strict=True)}
    names = {number: name or str(number) for number, name in sorted(pairs)}
    if min(names, default=-1) >= 0 and len(names) == len(pairs):
        return names, table.class_id
    words = sorted(set(table.label.tolist()))
    return {k: name or "target" for k, name in enumerate(words, first)}, np.searchsorted(words, table.label) + first


def _write_coco(table: Tracks, path: Path, size: Size, names: Sequence[str]) -> list[str]:
    """Write annotations with scores, which are also COCO results. Boxes with an identity have a track_id."""
    kinds, number = _numbered_classes(table, 1)
    shape = {} if size is None else {"width": size[0], "height": size[1]}
    boxes = []
    rows = zip(
        *(column.tolist() for column in (_frames(table), number, table.box_px.round(2), table.score)), strict=True
    )
    for row, (frame, kind, box, score) in enumerate(rows):
        item = {"id": row + 1, "image_id": frame, "category_id": kind, "bbox": box, "score": score, "iscrowd": 0}
        item["area"] = round(box[2] * box[3], 2)
        boxes.append(item | ({"track_id": int(table.identity[row])} if table.identity[row] > 0 else {}))
    frames = sorted({*range(1, len(names) + 1), *_frames(table).tolist()})
    # The number at the end of a picture's name need not be its place in the clip.
    images = [{"id": frame, "frame_id": frame, "file_name": _picture(frame, names), **shape} for frame in frames]
    categories = [{"id": number, "name": name} for number, name in kinds.items()]
    save_file(path, json.dumps({"images": images, "annotations": boxes, "categories": categories}).encode())
    return [] if shape else ["the images have no width and height, because the clip was not given"]


def _picture(frame: int, names: Sequence[str]) -> str:
    return names[frame - 1] if frame <= len(names) else f"{frame:06d}.jpg"


def _write_yolo(table: Tracks, path: Path, size: Size, names: Sequence[str]) -> list[str]:
    """Write centres and sizes as shares of the picture. Cut boxes at the border. Write scores unless all are 1."""
    assert size is not None
    low, high = np.clip(table.box_px[:, :2], 0, size), np.clip(table.box_px[:, :2] + table.box_px[:, 2:], 0, size)
    kinds, number = _numbered_classes(table, 0)
    shares = np.c_[(low + high) / 2, high - low] / (*size, *size)
    lines: dict[int, list[str]] = {}
    for row in np.flatnonzero((high > low).all(axis=1)).tolist():
        cells = [f"{number[row]}", *(f"{share:.6f}" for share in shares[row])]
        cells += [f"{table.score[row]:.6g}"] if (table.score != 1).any() else []
        lines.setdefault(_frames(table)[row], []).append(" ".join(cells))
    files = {frame: Path(_picture(frame, names)).with_suffix(".txt").name for frame in lines}
    _refuse_others(path, {*files.values(), "classes.txt"}, "*.txt")
    for frame, texts in lines.items():
        save_file(path / files[frame], ("\n".join(texts) + "\n").encode())
    words = [kinds.get(k, str(k)) for k in range(max(kinds, default=-1) + 1)]
    save_file(path / "classes.txt", ("\n".join(words) + "\n").encode())
    is_cut = (high - low < table.box_px[:, 2:] - 1e-6).any(axis=1)
    return [f"{is_cut.sum()} boxes go beyond the picture: they are cut, or left out"] if is_cut.any() else []


def _refuse_others(folder: Path, names: set[str], pattern: str) -> None:
    """Raise InputError if a folder holds further files, which a reader would take for files of this table."""
    if others := sorted({file.name for file in folder.glob(pattern)} - names):
        raise InputError(f"{folder} holds {others[0]}, which is not of these boxes; give an empty folder, or remove it")


def _write_cvat(table: Tracks, path: Path, size: Size, names: Sequence[str]) -> list[str]:
    """Write CVAT for video 1.1. A box with outside="1" ends each part of a track; else CVAT repeats the last box."""
    frames = np.unique(table.frame)
    step, last = int(np.diff(frames).min(initial=1 << 30)), max(int(frames.max(initial=0)), len(names))
    labels = sorted({name or "target" for name in table.label.tolist()})
    shape = "" if size is None else "<original_size><width>{}</width><height>{}</height></original_size>".format(*size)
    lines = [
        '<?xml version="1.0" encoding="utf-8"?>',
        f"<annotations><version>1.1</version><meta><task><size>{last}</size><mode>interpolation</mode><labels>",
        *(f"<label><name>{xml_text(name)}</name></label>" for name in labels),
        f"</labels>{shape}</task></meta>",
    ]
    changed = 0
    for identity in np.unique(table.identity).tolist():
        rows = np.flatnonzero(table.identity == identity)
        changed += len({name for name in table.label[rows] if name}) > 1
        rows = rows[np.argsort(_frames(table)[rows], kind="stable")]
        name = next((name for name in table.label[rows] if name), "target")
        lines.append(f'<track id="{identity}" label="{xml_text(name)}">')
        numbers = _frames(table)[rows].tolist()
        for row, frame, after in zip(rows.tolist(), numbers, [*numbers[1:], last + 1 + step], strict=True):
            left, top, width, height = table.box_px[row].tolist()
            edges = f'xtl="{left:.2f}" ytl="{top:.2f}" xbr="{left + width:.2f}" ybr="{top + height:.2f}"'
            ends = [frame, *([frame + step] if after > frame + step <= last else [])]
            lines += [
                f'<box frame="{number - 1}" outside="{int(number > frame)}" occluded="0" keyframe="1" {edges}/>'
                for number in ends
            ]
        lines.append("</track>")
    save_file(path, ("\n".join([*lines, "</annotations>"]) + "\n").encode())
    return [f"{changed} tracks change their class: cvat holds one, the first"] if changed else []


def _write_davis(table: Tracks, path: Path, size: Size, names: Sequence[str]) -> list[str]:
    """Write masks/000001.png and so on. The values of the masks are identities."""
    assert size is not None
    if (most := int(table.identity.max(initial=0))) > _MOST_VALUES:
        raise InputError(f"identity {most} is above {_MOST_VALUES}, the largest value of a mask")
    masks, frames = Masks(path), _frames(table)
    count = max(int(frames.max(initial=0)), len(names))
    _refuse_others(path / "masks", {f"{frame:06d}.png" for frame in range(1, count + 1)}, "*.png")
    path.mkdir(parents=True, exist_ok=True)
    edges = np.c_[table.box_px[:, :2], table.box_px[:, :2] + table.box_px[:, 2:]].round()
    edges = np.clip(edges, 0, [*size, *size]).astype(int)
    for frame in range(1, count + 1):
        mask = np.zeros(size[::-1], np.uint16)
        for row in np.flatnonzero(frames == frame).tolist():
            left, top, right, bottom = edges[row]
            mask[top:bottom, left:right] = table.identity[row]
        masks.add(frame, mask)
    return ["the masks are filled boxes, because tracks have no outlines; where boxes overlap, the last is on top"]


def _write_columns(table: Tracks, path: Path, size: Size, names: Sequence[str]) -> list[str]:
    if path.suffix.lower() == ".gpkg":
        raise InputError(f"{path} holds places, and these are boxes: give the positions.csv of dddas run or locate")
    write_columns(table.to_columns(), path)
    return []


_ALL = ("scores", "classes", "identities")
FORMATS: dict[str, tuple[Callable[[Tracks, Path, Size, Sequence[str]], list[str]], Sequence[str]]] = {
    "csv": (_write_csv, _ALL),
    "mot": (_write_mot, ("scores", "identities")),
    "visdrone": (_write_visdrone, _ALL),
    "coco": (_write_coco, _ALL),
    "yolo": (_write_yolo, ("scores", "classes")),
    "cvat": (_write_cvat, ("identities", "classes")),
    "davis": (_write_davis, ("identities",)),
    "parquet": (_write_columns, _ALL),
    "gpkg": (_write_columns, _ALL),
}
"""The writer of each format, and what the format can hold. If `identities` is first, the format holds only tracks."""

_ENDINGS = {"": "yolo", ".csv": "csv", ".txt": "mot", ".json": "coco", ".xml": "cvat"} | {
    f".{name}": name for name in ("parquet", "gpkg")
}
