"""report.html of a run: figures, map, key frames, plots over time, tables, and what was run, in one offline file."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torchvision_dddas.io.output.key_frames import KeyFrame
from torchvision_dddas.io.output.run_record import RunRecord, finite
from torchvision_dddas.io.output.timelines import Timeline
from torchvision_dddas.io.report import Cell, Column, Panel, render_page, table

REPORT = "report.html"
MOST_TABLE_ROWS = 200
"""Rows of a table in the report; run.json or log.txt has them all."""
FOLDED_FACTS = ("scenario", "settings")
"""Facts that are folded away because they are long."""

Table = tuple[str, Sequence[str], Sequence[Sequence[Any]], str]
"""A title, the columns' names, rows of values, and a text for a table without rows."""


@dataclass(frozen=True)
class RunSummary:
    """The content of a run's report.

    figures: names and values. facts: what was run. notes: sentences. map_picture: PNG or JPEG.
    first_tables: shown before the map. panels: drawn above those of the timeline.
    """

    title: str
    state: str
    figures: Sequence[tuple[str, str]]
    facts: Mapping[str, Any]
    tables: Sequence[Table]
    notes: Sequence[str] = field(default_factory=tuple)
    map_picture: bytes | None = None
    first_tables: Sequence[Table] = ()
    key_frames: Sequence[KeyFrame] = ()
    panels: Sequence[Panel] = ()

    @classmethod
    def of(
        cls,
        record: RunRecord,
        title: str,
        complete: bool,
        figures: Sequence[tuple[str, str]],
        tables: Sequence[Table] = (),
    ) -> "RunSummary":
        """Summarize a run with the facts and notes of its record."""
        return cls(title, describe_state(complete), figures, record.facts, tables, [*record.notes, *record.problems])


def describe_state(complete: bool) -> str:
    """How a run ended, in words."""
    return "complete" if complete else "interrupted: up to the last whole frame"


def run_report(summary: RunSummary, timeline: Timeline) -> str:
    """The HTML of report.html."""
    facts = {name: value for name, value in summary.facts.items() if name not in FOLDED_FACTS}
    folded = {name: summary.facts[name] for name in FOLDED_FACTS if name in summary.facts}
    return render_page(
        "run.html",
        title=summary.title,
        summary=summary,
        first_tables=[_html_table(one) for one in summary.first_tables],
        tables=[_html_table(one) for one in summary.tables],
        plots=timeline.chart(summary.panels),
        facts=_html_table(("What was run", ("what", "value"), list(facts.items()), "")),
        folded={name: json.dumps(finite(value), indent=2) for name, value in folded.items()},
    )


def format_span(first: int, last: int) -> str:
    """A span of frames, such as `3 to 7`."""
    return f"{first}" if first == last else f"{first} to {last}"


def _html_table(content: Table) -> dict[str, Any]:
    """Its title, the HTML of the first MOST_TABLE_ROWS rows, how many more there are, the text if there are none."""
    title, names, rows, empty = content
    columns = [Column(name, text=True) for name in names]
    cells = [[_cell(value) for value in row] for row in rows[:MOST_TABLE_ROWS]]
    html = table(title, columns, cells) if rows else ""
    return {"title": title, "html": html, "more": len(rows) - len(cells), "empty": empty}


def _cell(value: Any) -> Cell:
    number = isinstance(value, (int, float)) and math.isfinite(value)
    return Cell(_text(value), value if number else _text(value))


def _text(value: Any) -> str:
    """A value for a reader."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "unknown"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_text(v)}" for name, v in value.items())
    if isinstance(value, Iterable) and not isinstance(value, (str, bytes)):
        return ", ".join(_text(v) for v in value)
    return str(value)
