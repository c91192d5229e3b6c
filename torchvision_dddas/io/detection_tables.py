"""Read detections from MOTChallenge text, a CSV with named columns, YOLO's labels, or the format of another program."""

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.foreign_boxes import name_columns, read_foreign
from torchvision_dddas.io.images import natural_order
from torchvision_dddas.io.tables import (
    BOX,
    FARTHEST,
    FRAME,
    LAST_FRAME,
    Column,
    CsvTable,
    CsvText,
    Schema,
    check_crowding,
    parse_numbers,
    read_csv,
    read_table,
)
from torchvision_dddas.types import DetectionTable, Source, are_corners, is_sampled, share_orders

MOT_NAMES = ("frame", "identity", "x_px", "y_px", "width_px", "height_px", "score")
"""The columns of MOTChallenge text, which does not name its columns."""

FEET = ("feet_u_px", "feet_v_px")
"""Columns of the point between the feet, in pixels from the centre of the first pixel."""

CLASS = ("class", "class_name", "label")
"""Possible names of the column of classes. If a table has several, the first in this order is read."""

ORDERS = {
    "yolo": ("x_center y_center width height", "xcenter ycenter width height", "cx cy w h", "xc yc w h"),
    "xyxy": ("x1 y1 x2 y2", "xmin ymin xmax ymax", "x_min y_min x_max y_max", "left top right bottom"),
    "xywh": ("x y w h", "x y width height", "left top w h", "left top width height"),
}
"""Orders of the four columns of a box, and the names that other programs give the columns. yolo: centre and size.

Names are compared without capitals and without the prefixes of _BEFORE.
"""

_BEFORE = re.compile(r"(bbox|bb|box)_")

_OWN_NAMES = {
    **dict.fromkeys(("frame_id", "frame_index", "frame_number"), "frame"),
    **dict.fromkeys(("id", "track_id", "tracker_id"), "identity"),
    **dict.fromkeys(("confidence", "conf"), "score"),
}

_MANY, _FILLS = 20, 50
"""If at least _MANY boxes lie in [0, 100], and reach beyond _FILLS in x and in y, they are percent of a picture."""

FEW_SHARE = 0.01
"""Scores outside [0, 1] are mistakes if their share is smaller than this. Otherwise the scores have another scale."""

_FILLED = 10
"""Short lines are filled up with empty cells, to at most this many times the number of given cells."""

REQUIRED = ("frame", "x_px", "y_px", "width_px", "height_px")

SCHEMA = Schema(
    "detections",
    replace(FRAME, low=0, wanted=f"a whole number from 1 to {LAST_FRAME}, or from 0 throughout"),
    *(replace(column, low=-FARTHEST) for column in BOX),  # the numbers may be in another order, such as corners
    Column("score", ".6g", may_be_empty=True),
    Column("identity"),
    Column("class_id", "d", -1, 2**53, is_whole=True, may_be_empty=True),
    Column("kind"),
    Column("cut", "d", 0, 1, is_whole=True, may_be_empty=True, wanted="1 if the border cuts the target, else 0"),
    *(Column(name, ".2f", -FARTHEST, FARTHEST, may_be_empty=True, wanted="pixels") for name in FEET),
    *map(Column, CLASS),
)


def read_detections(
    path: str | Path, *, order: str | None = None, size: tuple[float, float] | None = None, pictures: Sequence[str] = ()
) -> DetectionTable:
    r"""Read a table, `frame,id,x,y,w,h[,score[,...]]` with commas or blanks, or a CSV that names the REQUIRED columns.

    The path may also be a Parquet file, a file of `foreign_boxes` (COCO, CVAT, VisDrone and others), or a folder of
    YOLO's labels: a file `class cx cy w h [score]` for each picture, and optional class names in classes.txt.
    pictures: their names without endings, in order; by default, a number at the end of a file's name is the frame.
    order: order of a box's columns, one of ORDERS; None: the names and numbers decide. size: (width, height) of the
    pictures; boxes within [0, 1] are shares of it. Frames may count from 0, and rows may come in any order.
    An identity counts as missing unless it is a whole number from 1. The columns `score`, `identity`, `cut`, FEET,
    CLASS and `class_id` are optional. Other columns, and unnamed columns after the score, are ignored.
    A table without rows is valid: `dddas detect` writes such a table for a clip without motion. Raise InputError with
    file and line for an unreadable file, too few columns, a column named twice, a value that is no number or out of
    range, a few scores outside [0, 1] (see FEW_SHARE), shares of an unknown size, or boxes of unknown order.

    >>> written = pathlib.Path("boxes.txt").write_text("1,-1,40,60,20,20,0.9,-1,-1,-1\n")
    >>> td.read_detections("boxes.txt").at(1).xyxy
    array([[40., 60., 60., 80.]])
    """
    is_folder = os.path.isdir(path)  # noqa: PTH112 (pathlib raises for a name that no file can have)
    foreign = read_foreign(Path(path), pictures)
    if foreign is not None:
        is_folder, is_named, (text, said) = False, True, foreign
    else:
        text, is_named = _read_labels(Path(path), pictures) if is_folder else _read_cells(path, "detections")
        named = None if is_named or is_folder else name_columns(Path(path), text)
        (text, said), is_named = named or (text, []), is_named or named is not None
    if is_named:
        header, found = _rename(text)
        text, order = text._replace(header=header), order or found
    if not is_named:
        for line, row in zip(text.line, text.rows, strict=True):
            if len(row) < 6:
                count = f"{len(row)} column{'s' * (len(row) != 1)}"
                raise InputError(f"detections {path}, line {line}: {count}; wanted frame,id,x,y,w,h[,score]")
        text = CsvText([*MOT_NAMES], text.line, [[*row[:7], ""][:7] for row in text.rows])
    table = read_table(path, SCHEMA, REQUIRED, text=text)
    check_crowding(table["frame"], f"detections {path}")
    box_px, order, notes = _in_pixels(table, order, size, is_folder, path)
    notes += said
    for k, column in enumerate(BOX):
        is_wrong = box_px[:, k] < column.low
        table.refuse(is_wrong, f"{column.name} is '{box_px[is_wrong, k][:1].sum():g}'; wanted {column.wanted}")
    if not is_named:
        _check_columns(parse_numbers(table.columns["identity"]), box_px, path)
    has_none = np.isnan(table["score"])
    if has_none.any() and not has_none.all():
        notes.append(f"{has_none.sum()} of {len(table)} rows have no score: they count as certain")
    score = np.where(has_none, 1.0, table["score"])
    # A table without column names may have scores on any scale, such as 87.5: detectors of MOTChallenge give them. Only
    # whole numbers are then read as percent.
    is_score = is_named or (score == np.round(score)).all()
    if is_score and score.min(initial=0) >= 0 and 20 <= score.max(initial=0) <= 100:
        score = score / 100
        notes.append("scores are numbers up to 100: they were read as percent")
    is_outside = (score < 0) | (score > 1)
    # One score of 1.3 among thousands of probabilities must not make all rows count as certain.
    if 0 < is_outside.sum() < FEW_SHARE * len(score):
        table.refuse(
            is_outside,
            f"score is {score[is_outside][0]:g}; {is_outside.sum()} of {len(score)} scores lie outside [0, 1]. Wanted "
            "probabilities in [0, 1], or scores on another scale throughout",
        )
    identity = parse_numbers(table.columns.get("identity", [""] * len(table)))
    is_identity = (identity >= 1) & (identity <= 2**53) & (identity == np.round(identity))
    kinds = set(table.columns.get("kind", ()))
    class_id = table.columns.get("class_id")
    if is_folder or (order == "yolo" and not is_named):
        class_id, is_identity = identity, np.zeros(len(table), bool)
    label = next((table.columns[name] for name in CLASS if name in table), None)
    if class_id is not None:
        class_id = np.where(np.isfinite(class_id), class_id, -1).astype(np.int64)
        known = _class_names(Path(path)) if is_folder else {}
        label = [known.get(k, str(k)) if k >= 0 else "" for k in class_id.tolist()] if label is None else label
    frame = table["frame"].astype(np.int64)
    if (frame == 0).any():
        frame += 1
        notes.append("frames count from 0: frame 0 of the table is the first picture, frame 1 here")
    rows = np.argsort(frame, kind="stable")
    return DetectionTable(
        str(path),
        frame[rows],
        box_px[rows],
        score[rows],
        table.line[rows],
        own=kinds == {"moving"},
        identity=np.where(is_identity, identity, -1).astype(np.int64)[rows],
        cut=table["cut"][rows] > 0 if "cut" in table else None,
        feet_px=table.stack(*FEET)[rows] if set(FEET) <= table.columns.keys() else None,
        ours=kinds == {"moving"} or {"identity", "kind", "row", "speed_px_per_frame"} <= set(table.header),
        label=None if label is None else np.array(label, object)[rows],
        kind=np.array(table["kind"])[rows] if kinds else None,
        class_id=None if class_id is None else class_id[rows],
        notes=tuple(notes),
    )


def _rename(text: CsvText) -> tuple[list[str], str | None]:
    """Return the header with this package's names of columns, and the order of ORDERS that the names show, or None."""
    header, bare = list(text.header), [_BEFORE.sub("", name.lower()) for name in text.header]
    order = "xywh" if set(REQUIRED) <= set(header) else None
    for kind, names in ORDERS.items():
        for known in (several.split() for several in names):
            if order is None and set(known) <= set(bare):
                own, order = dict(zip(known, REQUIRED[1:], strict=True)), kind
                header = [own.get(short, name) for short, name in zip(bare, header, strict=True)]
    if {"class", "name"} <= set(header) and "class_id" not in header:  # YOLOv5: the number, and its name
        at = header.index("class")
        if all(row[at].isdigit() for row in text.rows if len(row) > at):
            header = [{"class": "class_id", "name": "class"}.get(name, name) for name in header]
    return header, order


def _in_pixels(
    table: CsvTable, order: str | None, size: tuple[float, float] | None, is_folder: bool, path: str | Path
) -> tuple[np.ndarray, str, list[str]]:
    """Return boxes (N, 4) as x, y, width, height in pixels, the order of the columns, and notes. Raise InputError."""
    box, notes, whole = table.stack(*REQUIRED[1:]), list[str](), 1
    shares, first, last = share_orders(box), box[:, :2], box[:, 2:]
    if not shares and len(percent := share_orders(box / 100)) and size is not None and min(size) > 200:
        if len(box) >= _MANY and (np.maximum(first, last).max(axis=0) > _FILLS).all() and (box % 1).any():
            shares, whole = percent, 100
        else:
            notes.append("all boxes lie within the first 100 px of the picture: divide them by 100 if they are percent")
    is_corners = are_corners(box, (whole, whole) if shares else size)
    found, limits = order or "xywh", f"[0, {whole}]"
    if shares and size is None:
        raise InputError(
            f"detections {path}: boxes in [0, 1] are shares of a picture ({' or '.join(shares)}), whose "
            "size is not known: give the clip too (`dddas convert --clip CLIP` takes it), or boxes in pixels"
        )
    if order is None and is_folder:
        found = "yolo"
        if (found not in shares) if shares else is_corners:
            raise InputError(f"labels {path}: the numbers look like corners; pass --box-format xyxy if they are")
        if not shares:
            notes.append("the labels are not shares: they were read as centre and size in pixels")
    elif order is None and shares:
        found = "xyxy" if "xyxy" in shares and is_corners else shares[0]
        if len(shares) > 1 and not is_corners:
            raise InputError(
                f"detections {path}: boxes in {limits} may be {' or '.join(shares)}; pass --box-format to choose"
            )
    elif order is None and is_corners:
        found = "xyxy"
        notes.append("the boxes look like corners: they were read as xyxy; --box-format sets another order")
    if shares and size is not None:
        box = box * np.array([*size, *size]) / whole
        kind = "shares" if whole == 1 else "percent"
        notes.append(f"boxes lie in {limits}: they were read as {found} in {kind} of {size[0]:g} x {size[1]:g} px")
    first, last = box[:, :2], box[:, 2:]
    if found == "xyxy":
        return np.c_[first, last - first], found, notes
    return np.c_[first - last / 2, last] if found == "yolo" else box, found, notes


def _check_columns(identity: np.ndarray, box_px: np.ndarray, path: str | Path) -> None:
    """Raise InputError if text without names of columns has other columns than frame,id,x,y,w,h."""
    is_small = ((box_px > 0) & (box_px < 1)).all(axis=0) & (len(box_px) >= np.array([5, 5, 1, 1]))
    if 2 * (identity[np.isfinite(identity)] % 1 > 0).sum() > len(identity) or (is_small & (len(box_px) > 0)).any():
        what = ["x", "y", "width", "height"][int(is_small.argmax())] if is_small.any() else ""
        raise InputError(
            f"detections {path}: {f'every {what} is below 1 px' if what else 'the second column holds no identities'}; "
            "wanted frame,id,x,y,w,h[,score], or frame,id,x1,y1,x2,y2[,score] with --box-format xyxy, or a first line "
            "that names the columns, such as frame,x1,y1,x2,y2,score"
        )


def _read_labels(folder: Path, pictures: Sequence[str]) -> tuple[CsvText, bool]:
    """Return the labels of a YOLO folder as the cells of a table without names. Raise InputError with file and line."""
    files = sorted((f for f in folder.glob("*.txt") if f.stem != "classes"), key=lambda file: natural_order(file.name))
    ends = [re.search(r"[0-9]{1,9}$", file.stem) for file in files]
    first = min((int(end[0]) for end in ends if end), default=1)
    places = {name: number for number, name in enumerate(pictures, 1)}
    lines, rows = list[int](), list[list[str]]()
    for file, end in zip(files, ends, strict=True):
        number = places.get(file.stem) if places else int(end[0]) + (first == 0) if end else None
        if number is None:
            raise InputError(f"{file} belongs to no picture: wanted a picture's name, or a name that ends in a number")
        for line, row in enumerate(read_csv(file, "labels", has_header=False).rows, 1):
            cells = row if len(row) > 1 else row[0].split()
            if not 5 <= len(cells) <= 7:
                raise InputError(f"labels {file}, line {line}: {len(cells)} columns; wanted class cx cy w h [score]")
            lines.append(line)
            rows.append([str(number), *cells[:6]])
    if not files:
        raise InputError(f"folder {folder} holds no labels (a .txt file for each picture)")
    return CsvText([*MOT_NAMES], lines, rows), False


def _class_names(folder: Path) -> dict[int, str]:
    """Return the names of classes by number, from the lines of classes.txt in a folder of labels or above it."""
    for file in (folder / "classes.txt", folder.parent / "classes.txt"):
        if file.is_file():
            return dict(enumerate(file.read_text("utf-8-sig", "replace").splitlines()))
    return {}


def read_for_clip(
    path: Path, order: str | None, source: Source | None, size: tuple[float | None, float | None] = (None, None)
) -> DetectionTable:
    """Read detections for a clip, whose size replaces the given size. Raise InputError as `read_detections` does."""
    size = size if source is None else source.size
    known = (size[0], size[1]) if size[0] and size[1] else None
    return read_detections(path, order=order, size=known, pictures=[file.stem for file in getattr(source, "files", ())])


def read_header(path: str | Path) -> list[str]:
    """Return the column names of a table: MOT_NAMES if its first line holds numbers, [] if the table is empty."""
    text, is_named = _read_cells(path)
    return text.header if text.rows or is_named else []


def is_mot_text(path: Path) -> bool:
    """Whether a file is text without names of columns that no other format explains. Raises InputError."""
    if path.is_dir() or path.suffix.lower() in (".json", ".xml", ".parquet"):
        return False
    text, is_named = _read_cells(path, "result")
    return not is_named and name_columns(path, text) is None


def read_rows(path: str | Path, without: Sequence[str] = ()) -> tuple[list[str], list[list[str]]]:
    """Return the column names and cells of a valid table, sorted by frame as its reader sorts it.

    without: columns to leave out. Raise InputError if the table cannot be read, or if a few lines have so many columns
    that filling up the other lines would exceed _FILLED.
    """
    (header, lines, rows), _ = _read_cells(path)
    counts = [len(row) for row in rows]
    if len(header) * len(rows) > _FILLED * sum(counts):
        line = lines[counts.index(max(counts))]
        raise InputError(
            f"{path}, line {line}: {max(counts)} columns, over {_FILLED} times as many as usual; wanted the same number"
        )
    frame = header.index("frame")
    kept = [place for place, name in enumerate(header) if name not in without]
    rows = [[*row, *[""] * (len(header) - len(row))] for row in sorted(rows, key=lambda row: float(row[frame]))]
    return [header[place] for place in kept], [[row[place] for place in kept] for row in rows]


def _read_cells(path: str | Path, what: str = "") -> tuple[CsvText, bool]:
    """Return the cells of a table, and whether its first line names the columns. Unnamed columns get MOT_NAMES."""
    _, line, rows = read_csv(path, what, has_header=False)
    # The first name of a table with an index is empty.
    first, *_ = [*" ".join(rows[0]).split(), ""] if rows else [""]
    if first[:1].isalpha() and first.lower() not in ("nan", "inf", "infinity"):
        low = [name.lower() if name.lower() in SCHEMA.names or name.lower() in _OWN_NAMES else name for name in rows[0]]
        header = [_OWN_NAMES.get(name, name) if _OWN_NAMES.get(name) not in low else name for name in low]
        return CsvText(header, line[1:], rows[1:]), True
    rows = [row if len(row) > 1 else row[0].split() for row in rows]
    widest = max((len(row) for row in rows), default=len(MOT_NAMES))
    header = [*MOT_NAMES, *(f"column_{place}" for place in range(len(MOT_NAMES) + 1, widest + 1))]
    return CsvText(header[:widest], line, rows), False


# --------------------------------------------------------------------------------------------------------------------
# Check that a table fits its clip and the detection interval.


def check_table(table: DetectionTable, interval: int, source: Source | None = None) -> list[str]:
    """Return notes on rows that are left out or read in an unexpected way. A note is a sentence without a full stop.

    Raise InputError as check_within_clip does, and if no row lies on a sampled frame.
    """
    name = f"detections {table.path}"
    if len(table) == 0:
        return [f"{name} holds no rows"]
    if source is not None:
        check_within_clip(table, source)
    notes = [*table.notes]
    left_out = len(table) - int(is_sampled(table.frame, interval).sum())
    if left_out == len(table):
        sampled = ", ".join(str(1 + k * interval) for k in range(3))
        raise InputError(
            f"{name} has no row on frames {sampled}, ..., which --interval {interval} samples; its first row is on "
            f"frame {table.first}: number the frames so that one of them is 1, or take --interval 1"
        )
    frames = np.unique(table.frame)
    step = int(np.gcd.reduce(frames - 1)) if len(frames) > 2 else 1  # two frames do not show an interval
    if left_out:
        notes.append(f"{left_out} of {len(table)} rows lie on frames that --interval {interval} leaves out")
    elif step > interval:
        notes.append(
            f"rows lie on every {step}th frame only, and the frames between count as misses: pass --interval {step} if "
            "they were not searched"
        )
    if table.own:
        notes.append("all rows are moving targets of dddas detect: every row counts as certain")
    elif not table.probable:
        low, high = table.score.min(), table.score.max()
        notes.append(
            f"scores from {low:g} to {high:g} are not probabilities: all rows count as certain (divide percent by 100)"
        )
    if source is not None:
        low, high = table.box_px[:, :2], table.box_px[:, :2] + table.box_px[:, 2:]
        if outside := int(((high <= 0) | (low >= source.size)).any(axis=1).sum()):
            swapped, size = low[:, ::-1], np.array(source.size)
            fits = 10 * outside > len(table) and ((swapped >= 0) & (swapped < size)).all()
            notes.append(
                f"{outside} boxes lie wholly outside the picture; they are tracked like the others"
                f"{'; are x and y swapped?' if fits else ''}"
            )
    return notes


def check_within_clip(table: DetectionTable, source: Source) -> None:
    """Raise InputError if a table continues after the end of a clip of known length."""
    if source.exact and source.count is not None and table.last > source.count:
        is_beyond = table.frame > source.count
        raise InputError(
            f"detections {table.path}, line {table.line[is_beyond].min()}: the table goes on to frame {table.last} but "
            f"{source.name} ends after frame {source.count} ({is_beyond.sum()} of {len(table)} rows lie beyond); is it "
            "the table of this clip?"
        )
