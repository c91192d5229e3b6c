"""Read and write CSV and MOTChallenge text. A schema defines the columns once, for the reader and for the writer."""

import codecs
import csv
import io
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, NamedTuple, TextIO, TypeVar

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.atomic_files import PartFile
from torchvision_dddas.io.column_files import read_columns
from torchvision_dddas.types import Scene

Item = TypeVar("Item")

LAST_FRAME = 10_000_000
"""A higher frame number is rejected as a mistake, such as a time stamp."""

FARTHEST = 1e9
"""Largest place in pixels or metres, variance or score."""


MOST_BOXES = 1000
"""Most boxes in a frame. Tracking and scoring compare each box with all boxes of another frame or the truth.

A frame of 1000 boxes takes 0.6 GB and 1 s to score.
"""


@dataclass(frozen=True)
class Column:
    """A column of a table.

    name: the name with the unit, as `x_px`. format: as for `format(value, ".2f")`; "" for text.
    low, high: the range that a reader accepts, ends included. is_whole: whether numbers must be whole.
    may_be_empty: whether a reader accepts empty cells, which become NaN. wanted: the range in words, for messages.
    """

    name: str
    format: str = ""
    low: float = -math.inf
    high: float = math.inf
    is_whole: bool = False
    may_be_empty: bool = False
    wanted: str = ""

    @property
    def range_text(self) -> str:
        """The allowed content of a cell, in words."""
        if self.wanted:
            return self.wanted
        kind, form = ("whole number", ".0f") if self.is_whole else ("number", "g")
        is_bounded = math.isfinite(self.high - self.low)
        text = f"a {kind} from {self.low:{form}} to {self.high:{form}}" if is_bounded else f"a finite {kind}"
        return text + (", or nothing" if self.may_be_empty else "")


class Schema:
    """The columns of one kind of table.

    what: what the table holds, for messages. has_header: whether the first line names the columns.
    """

    def __init__(self, what: str, *columns: Column, has_header: bool = True) -> None:
        self.what = what
        self.columns = columns
        self.names = tuple(column.name for column in columns)
        self.header = ",".join(self.names) + "\n" if has_header else ""

    def format_rows(self, values: Mapping[str, Any]) -> str:
        """Return lines of text with the cells of some rows, in the order of the columns; "" for no rows.

        values: column name -> one value a row; a single number, word or None applies to every row. Unknown
        numbers (NaN, infinite, None) become empty cells, and words are quoted if CSV requires it. Raise KeyError for
        a missing column.
        """
        given = [values[name] for name in self.names]
        count = next((len(value) for value in given if not _is_single(value)), 1)
        cells = [_format_cells(value, column.format, count) for column, value in zip(self.columns, given, strict=True)]
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(zip(*cells, strict=True))
        return text.getvalue()


def _is_single(value: Any) -> bool:
    return value is None or isinstance(value, str) or np.ndim(value) == 0


def _format_cells(values: Any, form: str, count: int) -> list[str]:
    if _is_single(values):
        return _format_cells([values], form, 1) * count
    items = values.tolist() if isinstance(values, np.ndarray) else values
    if not form:
        return ["" if item is None else str(item) for item in items]
    return ["" if item is None or not math.isfinite(item) else format(item, form) for item in items]


Rows = Mapping[str, Any]
"""Column name -> one value a row, or one value for all rows, as for Schema.format_rows."""


class TableFiles(Generic[Item]):
    """Tables that grow together, item by item, and appear whole at the end.

    is_optional: write no file unless an item has rows; rows are None for items without any.
    tables: path -> the table's schema, and the function that makes its rows from an item:

        TableFiles({folder / "sizes.csv": (SIZES, lambda frame: {"frame": frame.number, "width_px": frame.widths})})
    """

    def __init__(
        self, tables: Mapping[Path, tuple[Schema, Callable[[Item], Rows | None]]], is_optional: bool = False
    ) -> None:
        self._tables, self._is_left_out = tuple(tables.values()), is_optional
        self._files = TextFiles({path: schema.header for path, (schema, _) in tables.items()})

    def write(self, item: Item) -> None:
        """Add the rows of an item to each table. Raise OSError if the disk refuses."""
        given = [(schema, rows(item)) for schema, rows in self._tables]
        if texts := [schema.format_rows(rows) for schema, rows in given if rows is not None]:
            self._is_left_out = False
            self._files.write(*texts)

    def close(self, complete: bool = True) -> None:
        """Move the tables to their places, including those without rows. Raise OSError if they cannot be written."""
        if not self._is_left_out:
            self._files.close()

    def discard(self) -> None:
        """Remove unfinished tables."""
        self._files.discard()


class TextFiles:
    """Text files that grow together and appear whole at the end. content: path -> first line of the file."""

    def __init__(self, content: Mapping[Path, str]) -> None:
        self._content = dict(content)
        self._parts: list[PartFile] = []
        self._files: list[TextIO] = []

    def write(self, *texts: str) -> None:
        """Add text to each file, in the order of the paths."""
        for file, part, text in zip(self._open(), self._parts, texts, strict=True):
            with part.naming():
                file.write(text)

    def close(self) -> None:
        """Move all files, also unchanged files, to their places. Raise OSError if they cannot be written."""
        for file, part in zip(self._open(), self._parts, strict=True):
            with part.naming():
                file.close()
        for part in self._parts:
            part.keep()

    def discard(self) -> None:
        """Remove unfinished files."""
        for file in self._files:
            with suppress(OSError):  # a full disk refuses the last lines again
                file.close()
        for part in self._parts:
            part.discard()

    def _open(self) -> list[TextIO]:
        if not self._files:
            for path, first in self._content.items():
                self._parts.append(PartFile(path))
                self._files.append(self._parts[-1].open_text())
                self._files[-1].write(first)
        return self._files


# --------------------------------------------------------------------------------------------------------------------
# Reading.


class CsvText(NamedTuple):
    """The cells of a CSV without surrounding blanks; blank lines are left out.

    header: the cells of the first line, none in an empty file. line: line number of each row, from 1. rows: cells.
    """

    header: list[str]
    line: list[int]
    rows: list[list[str]]

    @property
    def unit(self) -> str:
        """The word for a row in messages."""
        return "line"


# The beginning of a file determines its format.
_HEAD_BYTES, _HEAD_LINES = 65_536, 50
_QUOTED, _SEP_LINE = re.compile(r'"[^"]*"'), re.compile(r'"?sep=([,;|\t])"?')
# Require digits only after a mark: two adjacent runs of digits would take time quadratic in the length of a number.
_NUMBER = re.compile(r"[-+]?\d*(?:[.,]\d*)?(?:[eE][-+]?\d+)?")
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(?:,\d{3})+(?:\.\d+)?")
_POINTED = re.compile(r"[-+]?[1-9]\d{0,2}(?:\.\d{3})+(?:,\d+)?")  # 1.540,25


def _from_windows(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeDecodeError)
    return error.object[error.start : error.end].decode("cp1252"), error.end


codecs.register_error("windows", _from_windows)


def read_csv(path: str | Path, what: str = "", has_header: bool = True) -> CsvText:
    """Read the cells of a CSV. what: the content, for messages. has_header: whether line 1 names the columns.

    Cells are separated by commas, semicolons, tabs or bars, and numbers may have decimal commas; the first lines
    decide. A line `sep=;` is left out. Text is UTF-8, UTF-16 with its mark, or Windows-1252. Parquet counts as CSV;
    its `line` is the row. Raise InputError if the file is unreadable or not CSV text.
    """
    name = f"{what} {path}".strip()
    if Path(path).suffix.lower() == ".parquet":
        columns = read_columns(Path(path), name)
        table = [[_cell(value) for value in row] for row in zip(*columns.values(), strict=True)]
        number = [*range(len(table) + 1)]
        return CsvText([*columns], number[1:], table) if has_header else CsvText([], number, [[*columns], *table])
    lines, rows = list[int](), list[list[str]]()
    try:
        with Path(path).open("rb") as raw:
            head = raw.read(_HEAD_BYTES)
        is_wide = head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        encoding, errors = ("utf-16", "strict") if is_wide else ("utf-8-sig", "windows")
        separator, comma = _find_format(head.decode(encoding, "replace"))
        with Path(path).open(newline="", encoding=encoding, errors=errors) as file:
            reader = csv.reader(file, delimiter=separator, skipinitialspace=True)
            for row in reader:
                if any(cells := list(map(str.strip, row))):
                    lines.append(reader.line_num)
                    rows.append(cells)
    except OSError as error:
        raise InputError(f"{name} cannot be read: {error.strerror}") from None
    except (UnicodeError, csv.Error) as error:
        raise InputError(f"{name} is not CSV text: {error}") from None
    if comma is not None:
        form = _NUMBER if comma else _THOUSANDS
        if comma == ".,":
            comma, rows = (
                ".",
                [[c.replace(".", "") if "." in c and _POINTED.fullmatch(c) else c for c in row] for row in rows],
            )
        rows = [[c.replace(",", comma) if "," in c and form.fullmatch(c) else c for c in row] for row in rows]
    if rows and _SEP_LINE.fullmatch(separator.join(rows[0])):
        del lines[0], rows[0]
    return CsvText(rows[0], lines[1:], rows[1:]) if has_header and rows else CsvText([], lines, rows)


def _cell(value: Any) -> str:
    return "" if value is None or value != value else str(value)


def _find_format(head: str) -> tuple[str, str | None]:
    """Return the separator of cells, and the replacement for a comma in numbers: "." if decimal, "" for thousands.

    The replacement is ".," if the comma is decimal and points separate thousands. None: leave commas.
    """
    lines = [line for line in head.splitlines() if line.strip()][:_HEAD_LINES]
    told = _SEP_LINE.fullmatch(lines[0]) if lines else None
    bare = [_QUOTED.sub("", line) for line in lines]

    def rank(sign: str) -> tuple[int, float]:
        """Return the number of lines with equally many cells, and the share of numbers among the cells."""
        counts = Counter(count for line in bare if (count := line.count(sign)))
        cells = [cell.strip() for line in bare for cell in line.split(sign)]
        return max(counts.values(), default=0), sum(map(bool, map(_NUMBER.fullmatch, cells))) / max(len(cells), 1)

    separator = told[1] if told is not None else max(",;\t|", key=rank)
    last = bare[-1].split() if bare else []
    if told is None and not rank(separator)[0] and all(len(line.split()) == len(last) for line in bare):
        separator = " " if len(last) > 1 and _NUMBER.fullmatch(last[-1]) else separator
    try:
        cells = [cell.strip() for row in csv.reader(lines, delimiter=separator, skipinitialspace=True) for cell in row]
    except csv.Error:
        return separator, None
    numbers = [cell for cell in cells if _NUMBER.fullmatch(cell) or _THOUSANDS.fullmatch(cell)]
    commas = [cell for cell in numbers if "," in cell]
    pointed = [cell for cell in cells if "." in cell and _POINTED.fullmatch(cell)]
    points = sum("." in cell for cell in numbers if "," not in cell)
    is_thousands = all(map(_THOUSANDS.fullmatch, commas))
    # Points can separate thousands only if commas are certainly decimal.
    if not is_thousands and pointed and points <= len(pointed) <= len(commas):
        return separator, ".,"
    if 10 * points > len(commas):
        return separator, "" if commas and is_thousands else None
    # If all commas may separate thousands, the separator decides: semicolons are used where commas are decimal.
    return separator, "." if separator == ";" or not is_thousands else None


class CsvTable:
    """A table that was read. columns: name -> (N,) float64, or a list of text. line: (N,) int64, from 1."""

    def __init__(self, path: str | Path, what: str, text: CsvText) -> None:
        self.what, self.header, self._path, self._rows = what, tuple(text.header), path, text.rows
        self._unit = text.unit
        self.line = np.array(text.line, np.int64)
        self.columns: dict[str, Any] = {}

    def __len__(self) -> int:
        return len(self.line)

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a column; NaN in every row if the table lacks it."""
        values: np.ndarray = self.columns.get(name, np.full(len(self), np.nan))
        return values

    def stack(self, *names: str) -> np.ndarray:
        """Return several columns side by side, (N, K)."""
        return np.stack([self[name] for name in names], axis=1)

    def cell(self, name: str, row: int) -> str:
        """Return the text of a cell."""
        return self._rows[row][self.header.index(name)]

    def error(self, message: str, row: int | None = None) -> InputError:
        """Return an InputError with the file and the line of a row."""
        place = "" if row is None else f", {self._unit} {self.line[row]}"
        return InputError(f"{self.what} {self._path}{place}: {message}")

    def refuse(self, is_wrong: np.ndarray, message: str) -> None:
        """Raise InputError at the first wrong row. is_wrong: (N,) bool."""
        if is_wrong.any():
            raise self.error(message, int(is_wrong.argmax()))

    def require_rows(self) -> None:
        """Raise InputError for a table without rows."""
        if not len(self):
            raise InputError(f"{self.what} {self._path} has a header but no rows")


def read_table(
    path: str | Path, schema: Schema, required: Sequence[str] = (), is_ragged: bool = False, text: CsvText | None = None
) -> CsvTable:
    """Read the columns of a schema that a CSV has; further columns are ignored.

    required: names that the table must have. is_ragged: whether lines may have more or fewer cells than the first, as
    long as the schema's columns are present. text: the file's cells, if already read.
    Raise InputError with file and line for an unreadable file, a column that is missing or named twice, too many or
    too few cells, or a cell that is not a number or out of range.
    """
    text = text or read_csv(path, schema.what)
    header, _, rows = text
    table = CsvTable(path, schema.what, text)
    if missing := [name for name in required if name not in header]:
        columns = ", ".join(filter(None, header)) or "none"
        raise InputError(
            f"{schema.what} {path} lacks {', '.join(missing)}; its columns are {columns}, wanted {','.join(required)}"
        )
    if twice := [name for name in schema.names if header.count(name) > 1]:
        raise table.error(f"column {twice[0]} is named twice; give each name once")
    counts = np.array([len(cells) for cells in rows], int)
    if not is_ragged and (is_odd := counts != len(header)).any():
        count = int(counts[is_odd][0])
        table.refuse(is_odd, f"{count} column{'s' * (count != 1)}; the first line names {len(header)}")
    for column in schema.columns:
        if column.name in header:
            place = header.index(column.name)
            table.refuse(counts <= place, f"{column.name} is missing: the line ends before it")
            cells = [cells[place] for cells in rows]
            table.columns[column.name] = _numbers(table, column, cells) if column.format else cells
    return table


def _numbers(table: CsvTable, column: Column, cells: list[str]) -> np.ndarray:
    """Return (N,) float64, NaN for an empty cell. Raise InputError for a cell that is not a number in the range."""
    values = parse_numbers(cells)
    is_wrong = np.isinf(values) | (values < column.low) | (values > column.high)
    if not column.may_be_empty:
        is_wrong |= np.isnan(values)
    if column.is_whole:
        is_wrong |= np.isfinite(values) & (values != np.round(values))
    if is_wrong.any():
        row = int(is_wrong.argmax())
        raise table.error(f"{column.name} is '{cells[row]}'; wanted {column.range_text}", row)
    return values


def parse_numbers(cells: Sequence[str]) -> np.ndarray:
    """Return (N,) float64: NaN for an empty cell, infinity for text that is not a number, `nan` included."""
    try:
        values = np.array([float(cell) if cell else math.nan for cell in cells], float)
        if "_" not in "".join(cells) and np.isnan(values).sum() == cells.count(""):
            return values
    except ValueError:
        pass
    return np.array([_parse_number(cell) if cell else math.nan for cell in cells], float)


def check_crowding(frame: np.ndarray, name: str, rows: str = "boxes") -> None:
    """Raise InputError if one of the frames (N,) has more than MOST_BOXES rows. name: the table's name."""
    numbers, counts = np.unique(frame, return_counts=True)
    if len(counts) and counts.max() > MOST_BOXES:
        crowded = numbers[counts.argmax()]
        raise InputError(
            f"{name} has {counts.max()} {rows} in frame {crowded:g}; wanted at most {MOST_BOXES} in a frame"
        )


def _parse_number(cell: str) -> float:
    try:
        value = math.inf if "_" in cell else float(cell)  # only Python reads 1_0 as a number
    except ValueError:
        return math.inf
    return math.inf if math.isnan(value) else value


# --------------------------------------------------------------------------------------------------------------------
# Columns and tables that several modules read or write.

FRAME = Column("frame", "d", 1, LAST_FRAME, is_whole=True)
IDENTITY = Column("identity", "d")
BOX = (
    *(Column(name, ".2f", -FARTHEST, FARTHEST, wanted="pixels from -1e+09 to 1e+09") for name in ("x_px", "y_px")),
    *(Column(name, ".2f", 1e-3, FARTHEST, wanted="pixels from 0.001 to 1e+09") for name in ("width_px", "height_px")),
)
SCORE = Column("score", ".4f")
PRECISE_SCORE = replace(SCORE, format=".6g")
KIND = Column("kind")
MOTION = (Column("heading_deg", ".1f"), Column("speed_px_per_frame", ".3f"))
EAST_NORTH = tuple(Column(name, ".4f", -FARTHEST, FARTHEST) for name in ("east_m", "north_m"))
# A square centimetre is 0.0001 m2: a fixed number of digits would truncate small variances.
COVARIANCE = tuple(
    Column(name, ".6g", -FARTHEST, FARTHEST, may_be_empty=True)
    for name in ("var_east_m2", "cov_east_north_m2", "var_north_m2")
)
DEGREES = tuple(
    Column(name, ".9f", -most, most, may_be_empty=True) for name, most in (("longitude_deg", 180), ("latitude_deg", 90))
)
TARGET = Column("target", "d", 1, 2**53, is_whole=True)
PLACES = (("longitude_deg", "latitude_deg"), ("east_m", "north_m"))
"""The two kinds of places in tables."""

MOT = Schema("boxes", FRAME, IDENTITY, *BOX, SCORE, *(Column(n, "d") for n in ("x", "y", "z")), has_header=False)
"""MOTChallenge text: `frame,identity,x,y,width,height,score,-1,-1,-1`, frames from 1, pixels from 0.

An identity of -1 means no identity.
"""

MOT_TRACKS = Schema("tracks", FRAME, IDENTITY, *BOX, PRECISE_SCORE, *MOT.columns[-3:], has_header=False)
"""The same columns with unrounded scores."""

CLASS_COLUMNS = (Column("class"), Column("class_id", ".0f"))
DETECTIONS = Schema("detections", FRAME, TARGET, *BOX, SCORE, KIND, Column("area_px", ".0f"), *MOTION, *CLASS_COLUMNS)
"""detections.csv of `dddas detect`. heading_deg: clockwise from the picture's upward direction.

heading_deg and speed_px_per_frame are relative to the background. class, class_id: empty if unknown.
"""


def mot_rows(frame: int, box_px: np.ndarray, score: np.ndarray, identity: np.ndarray | int = -1) -> dict[str, Any]:
    """Return the columns of MOT and MOT_TRACKS for the boxes (N, 4) of a frame."""
    box = dict(zip(("x_px", "y_px", "width_px", "height_px"), np.reshape(box_px, (-1, 4)).T, strict=True))
    return {"frame": frame, "identity": identity, **box, "score": score, "x": -1, "y": -1, "z": -1}


def class_rows(label: np.ndarray, class_id: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of CLASS_COLUMNS."""
    return {"class": label, "class_id": np.where(class_id < 0, np.nan, class_id)}


def compass_deg(heading_rad: float) -> float:
    """Convert a heading in image axes (0 right, pi/2 down) to degrees clockwise from image up, in tenths below 360."""
    return round(math.degrees(heading_rad) + 90, 1) % 360


def detection_tables(folder: Path) -> TableFiles[Scene]:
    """Return the tables detections.txt and detections.csv of a clip's frames."""

    def mot(scene: Scene) -> Rows:
        return mot_rows(scene.frame.number, scene.detections.box_px, scene.detections.score)

    def named(scene: Scene) -> Rows:
        found = scene.detections
        return {
            **mot(scene),
            "target": np.arange(1, len(found) + 1),
            "kind": found.kind,
            "area_px": found.area_px,
            "heading_deg": [compass_deg(heading) for heading in found.heading_rad.tolist()],
            "speed_px_per_frame": found.speed_px,
            **class_rows(found.label, found.class_id),
        }

    return TableFiles({folder / "detections.txt": (MOT, mot), folder / "detections.csv": (DETECTIONS, named)})
