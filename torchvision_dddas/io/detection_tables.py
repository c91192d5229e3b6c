"""Detections from a table: MOTChallenge text of any tool, or a CSV with named columns as `dddas detect` writes it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.tables import (
    BOX,
    FARTHEST,
    FRAME,
    Column,
    CsvText,
    Schema,
    check_crowding,
    parse_numbers,
    read_csv,
    read_table,
)
from torchvision_dddas.types import DetectionTable, Source, is_sampled

MOT_NAMES = ("frame", "identity", "x_px", "y_px", "width_px", "height_px", "score")
"""The columns of MOTChallenge text, which has no first line that names them."""

FEET = ("feet_u_px", "feet_v_px")
"""Columns of the point between the feet, from the first pixel's centre."""

CLASS = ("class", "class_name", "label")
"""Names that the column of classes may have; the first that is there counts."""

FEW_SHARE = 0.01
"""Where fewer of the scores lie outside [0, 1], they are mistakes among probabilities and not another scale."""

_FILLED = 10
"""A table has no more than this many times the cells that its lines have."""

REQUIRED = ("frame", "x_px", "y_px", "width_px", "height_px")

SCHEMA = Schema(
    "detections",
    FRAME,
    *BOX,
    Column("score", ".6g", may_be_empty=True),
    Column("identity"),
    Column("kind"),
    Column("cut", "d", 0, 1, is_whole=True, may_be_empty=True, wanted="1 where the border cuts it, else 0"),
    *(Column(name, ".2f", -FARTHEST, FARTHEST, may_be_empty=True, wanted="pixels") for name in FEET),
    *map(Column, CLASS),
)


def read_detections(path: str | Path) -> DetectionTable:
    """Read `frame,id,x,y,w,h[,score[,...]]`, by commas or blanks; or a CSV whose first line names REQUIRED columns.

    An identity that is no whole number from 1 is none. The columns `score`, `identity`, `cut`, FEET and CLASS may be
    there; any other and all that follows the score are ignored. Rows may come in any order; blank lines are skipped.
    A table without rows is valid: `dddas detect` writes one for a clip in which nothing moves.
    Raises InputError with file and line: unreadable, too few columns, a column named twice, not a finite number, out of
    range, a few scores outside [0, 1] (see FEW_SHARE).
    """
    text, is_named = _read_cells(path, "detections")
    if not is_named:
        for line, row in zip(text.line, text.rows, strict=True):
            if len(row) < 6:
                count = f"{len(row)} column{'s' * (len(row) != 1)}"
                raise InputError(f"detections {path}, line {line}: {count}; wanted frame,id,x,y,w,h[,score]")
        text = CsvText([*MOT_NAMES], text.line, [[*row[:7], ""][:7] for row in text.rows])
    table = read_table(path, SCHEMA, REQUIRED, text=text)
    check_crowding(table["frame"], f"detections {path}")
    score = np.where(np.isnan(table["score"]), 1.0, table["score"])
    is_outside = (score < 0) | (score > 1)
    # One score of 1.3 among thousands of probabilities must not make all of these certain.
    if 0 < is_outside.sum() < FEW_SHARE * len(score):
        table.refuse(
            is_outside,
            f"score is {score[is_outside][0]:g}; {is_outside.sum()} of {len(score)} scores lie outside [0, 1]. Wanted "
            "probabilities in [0, 1], or scores on another scale throughout",
        )
    identity = parse_numbers(table.columns.get("identity", [""] * len(table)))
    is_identity = (identity >= 1) & (identity <= 2**53) & (identity == np.round(identity))
    kinds = set(table.columns.get("kind", ()))
    label = next((table.columns[name] for name in CLASS if name in table), None)
    order = np.argsort(table["frame"], kind="stable")
    return DetectionTable(
        str(path),
        table["frame"][order].astype(np.int64),
        table.stack(*REQUIRED[1:])[order],
        score[order],
        table.line[order],
        own=kinds == {"moving"},
        identity=np.where(is_identity, identity, -1).astype(np.int64)[order],
        cut=table["cut"][order] > 0 if "cut" in table else None,
        feet_px=table.stack(*FEET)[order] if set(FEET) <= table.columns.keys() else None,
        ours=kinds == {"moving"} or {"identity", "kind", "row", "speed_px_per_frame"} <= set(table.header),
        label=None if label is None else np.array(label, object)[order],
        kind=np.array(table["kind"])[order] if kinds else None,
    )


def read_header(path: str | Path) -> list[str]:
    """The column names of a table, MOT_NAMES where its first line holds numbers, none where it is empty."""
    text, is_named = _read_cells(path)
    return text.header if text.rows or is_named else []


def read_rows(path: str | Path, without: Sequence[str] = ()) -> tuple[list[str], list[list[str]]]:
    """The column names and cells of a table that its reader found valid, sorted by frame as readers sort it.

    without: columns to leave out. Raises InputError where it cannot be read, or where a few lines have many times the
    columns of the others, which would all be filled up.
    """
    (header, lines, rows), _ = _read_cells(path)
    counts = [len(row) for row in rows]
    if len(header) * len(rows) > _FILLED * sum(counts):
        line = lines[counts.index(max(counts))]
        raise InputError(
            f"{path}, line {line}: {max(counts)} columns, over {_FILLED} times those of most; wanted as many in each"
        )
    frame = header.index("frame")
    kept = [place for place, name in enumerate(header) if name not in without]
    rows = [[*row, *[""] * (len(header) - len(row))] for row in sorted(rows, key=lambda row: float(row[frame]))]
    return [header[place] for place in kept], [[row[place] for place in kept] for row in rows]


def _read_cells(path: str | Path, what: str = "") -> tuple[CsvText, bool]:
    """The cells of a table, and whether its first line names the columns; else they get the names of MOTChallenge."""
    _, line, rows = read_csv(path, what, has_header=False)
    # The first name may be empty: so a table with an index begins.
    first, *_ = [*" ".join(rows[0]).split(), ""] if rows else [""]
    if first[:1].isalpha() and first.lower() not in ("nan", "inf", "infinity"):
        return CsvText(rows[0], line[1:], rows[1:]), True
    rows = [row if len(row) > 1 else row[0].split() for row in rows]
    widest = max((len(row) for row in rows), default=len(MOT_NAMES))
    header = [*MOT_NAMES, *(f"column_{place}" for place in range(len(MOT_NAMES) + 1, widest + 1))]
    return CsvText(header[:widest], line, rows), False


# --------------------------------------------------------------------------------------------------------------------
# Whether a table fits its clip and the detection interval.


def check_table(table: DetectionTable, interval: int, source: Source | None = None) -> list[str]:
    """Notes on rows that are left out or read in an unexpected way, each a sentence without a full stop.

    Raises InputError as check_within_clip does, and where no row lies on a sampled frame.
    """
    name = f"detections {table.path}"
    if len(table) == 0:
        return [f"{name} holds no rows"]
    if source is not None:
        check_within_clip(table, source)
    notes = []
    left_out = len(table) - int(is_sampled(table.frame, interval).sum())
    if left_out == len(table):
        sampled = ", ".join(str(1 + k * interval) for k in range(3))
        raise InputError(
            f"{name} has no row on frames {sampled}, ..., which --interval {interval} samples; its first is on frame "
            f"{table.first}: number the frames so that one of them is 1, or take --interval 1"
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
        notes.append(f"scores from {low:g} to {high:g} are no probabilities: every row counts as certain")
    if source is not None:
        low, high = table.box_px[:, :2], table.box_px[:, :2] + table.box_px[:, 2:]
        if outside := int(((high <= 0) | (low >= source.size)).any(axis=1).sum()):
            notes.append(f"{outside} boxes lie wholly outside the picture; they are tracked like the others")
    return notes


def check_within_clip(table: DetectionTable, source: Source) -> None:
    """Raises InputError for a table that goes on after the end of a clip whose length is known."""
    if source.exact and source.count is not None and table.last > source.count:
        is_beyond = table.frame > source.count
        raise InputError(
            f"detections {table.path}, line {table.line[is_beyond].min()}: the table goes on to frame {table.last} but "
            f"{source.name} ends after frame {source.count} ({is_beyond.sum()} of {len(table)} rows lie beyond); is it "
            "the table of this clip?"
        )
