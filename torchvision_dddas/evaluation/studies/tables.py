"""The measures of a study as tables for other programs: CSV, and Parquet where pyarrow is there."""

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchvision_dddas.evaluation.studies.record import Results
from torchvision_dddas.evaluation.studies.summary import GROUPS
from torchvision_dddas.io.atomic_files import temporary, write_whole


class Row(NamedTuple):
    """One figure. clip: its name, or "pooled" or "mean". low, high: its interval, NaN where there is none."""

    study: str
    task: str
    scope: str
    clip: str
    group: str
    measure: str
    value: float
    low: float
    high: float


class FrameRow(NamedTuple):
    """One count of one frame, by its name."""

    study: str
    task: str
    clip: str
    frame: int
    group: str
    name: str
    value: float


def rows(metrics: Mapping[str, Any]) -> list[Row]:
    """Every figure of the content of metrics.json. scope: clip, pooled or mean, for a clip may have any name."""
    found = []
    for task, mine in metrics["tasks"].items():
        places = [("clip", name, clip) for name, clip in mine["clips"].items()]
        for scope, name, groups in (*places, ("pooled", "", mine["pooled"]), ("mean", "", mine["mean"])):
            spans = groups.get("intervals", {})
            for group in GROUPS:
                for measure, value in groups.get(group, {}).items():
                    low, high = spans.get(group, {}).get(measure) or (math.nan, math.nan)
                    known = math.nan if value is None else float(value)
                    found.append(Row(metrics["name"], task, scope, name, group, measure, known, low, high))
    return found


def frame_rows(results: Results) -> Iterator[FrameRow]:
    """Every count of every frame, of clips by name; frames that a group has no use for are left out."""
    for case in sorted(results.cases, key=lambda case: (case.task, case.clip.name)):
        if case.scored is None:
            continue
        for group, counts in case.scored.per_frame.items():
            for name, values in counts.items():
                for frame, value in zip(case.scored.frames.tolist(), values.tolist(), strict=True):
                    if not math.isnan(value):
                        yield FrameRow(results.spec.name, case.task, case.clip.name, frame, group, name, value)


def write_csv(place: Path, metrics: Mapping[str, Any]) -> None:
    """Write the figures; a cell is empty where one is undefined. Raises OSError."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(Row._fields)
    table.writerows([_cell(value) for value in row] for row in rows(metrics))
    write_whole(place, text.getvalue().encode())


def write_parquet(folder: Path, metrics: Mapping[str, Any], results: Results) -> tuple[str, ...]:
    """Write metrics.parquet and frames.parquet; the names of what was written, none without pyarrow.

    Raises OSError.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError:
        return ()
    made: dict[str, tuple[Any, Sequence[Any]]] = {
        "metrics.parquet": (Row, rows(metrics)),
        "frames.parquet": (FrameRow, list(frame_rows(results))),
    }
    kinds = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
    for name, (kind, content) in made.items():
        columns = {
            field: pyarrow.array([row[i] for row in content], kinds[of])
            for i, (field, of) in enumerate(kind.__annotations__.items())
        }
        part = temporary(folder / name)
        try:
            pyarrow.parquet.write_table(pyarrow.table(columns), part)
            part.replace(folder / name)
        finally:
            part.unlink(missing_ok=True)
    return tuple(made)


def _cell(value: str | float) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return value
