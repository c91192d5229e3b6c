"""compare.html: what changed from one study to another, clip by clip, and whether it is beyond noise."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from torchvision_dddas.evaluation.report.measures import GROUPS, TITLES, measure
from torchvision_dddas.io.report import (
    MOST_ROWS,
    Cell,
    Column,
    Interval,
    format_number,
    interval_chart,
    number_cell,
    render_page,
    table,
    text_cell,
)

MEANING = (
    "Better and worse are beyond noise: p below 0.05 after Holm's correction for all that is asked here. "
    "“On these clips” is by blocks of their frames and says nothing of other clips; "
    "“too little to tell”: so few frames or clips could not show any change."
)

Entry = Mapping[str, Any]


def comparison_report(found: Mapping[str, Any]) -> str:
    """The HTML. found: as `compare_studies` returns it, NaN as None."""
    first, second = str(found["first"]), str(found["second"])
    title = f"{first} and {second}: comparison"
    parts = [f"<h1>{escape(first)} → {escape(second)} <span>comparison</span></h1>", f'<p class="soft">{MEANING}</p>']
    parts += ['<div class="cards">', *(_card(task, mine) for task, mine in found["tasks"].items()), "</div>"]
    if found["notes"]:
        items = "".join(f"<li>{escape(note)}</li>" for note in found["notes"])
        parts.append(f"<details open><summary>Not compared ({len(found['notes'])})</summary><ul>{items}</ul></details>")
    for task, mine in found["tasks"].items():
        parts += compared(task, TITLES.get(task, task), mine, first, second)
    return render_page("page.html", title=title, parts=parts)


def _card(task: str, mine: Mapping[str, Any]) -> str:
    """A task at a glance: its first measure, and how many clips went which way."""
    parts = [f'<h3><a href="#{escape(task)}">{escape(TITLES.get(task, task))}</a></h3>']
    pooled = _rows(mine["pooled"])
    if pooled:
        group, name, entry = pooled[0]
        parts.append(f'<div class="big">{_signed(entry, name)} <span>{escape(_title(group, name))}</span></div>')
        ends = [_value(entry[end], name) for end in ("first", "second")]
        parts.append(f"<p>{ends[0]} → {ends[1]}: <b>{escape(entry['says'])}</b></p>")
    clips = [entry for groups in mine["clips"].values() for _, _, entry in _rows(groups)[:1]]
    ways = {word: sum(str(entry["says"]).startswith(word) for entry in clips) for word in ("better", "worse")}
    said = ", ".join(f"{count} {word} beyond noise" for word, count in ways.items())
    parts.append(f"<p>clips: {said}, {len(clips) - sum(ways.values())} not, {len(mine['same'])} the same</p>")
    return f'<section class="card">{"".join(parts)}</section>'


def compared(anchor: str, title: str, mine: Mapping[str, Any], first: str, second: str) -> list[str]:
    """The section of a task: plots clip by clip, all clips together, single clips. mine: found["tasks"][task].

    anchor: what a link to the section names; first, second: what the columns are called.
    """
    parts = [f'<h2 id="{escape(anchor)}">{escape(title)}</h2>']
    if plots := _plots(mine["clips"], mine["same"]):
        parts += ['<div class="plots">', *plots, "</div>"]
    rows = [
        _row(_title(group, name), name, entry, ("over_clips", "over_frames"))
        for group, name, entry in _rows(mine["pooled"])
    ]
    columns = [*_columns("measure", first, second), Column("p, clips"), Column("p, frames"), Column("says", text=True)]
    parts += ["<h3>All clips together</h3>", table("all clips together", columns, rows)]
    of_clips = [
        [text_cell(clip), *_row(_title(group, name), name, entry, ("over_frames",))]
        for clip, groups in mine["clips"].items()
        for group, name, entry in _rows(groups)
    ]
    if of_clips:
        columns = [
            Column("clip", text=True),
            *_columns("measure", first, second),
            Column("p"),
            Column("says", text=True),
        ]
        parts += ["<h3>Clip by clip</h3>", table("clip by clip", columns, of_clips)]
    if mine["same"]:
        parts.append(f'<p class="note">The same in both to the last digit: {escape(", ".join(mine["same"]))}.</p>')
    return parts


def _plots(clips: Mapping[str, Mapping[str, Any]], same: Sequence[str]) -> list[str]:
    """The change of each group's first measure clip by clip, the largest loss first."""
    plots = []
    for group in dict.fromkeys(group for groups in clips.values() for group in groups):
        having = [(clip, *_rows({group: groups[group]})[0]) for clip, groups in clips.items() if groups.get(group)]
        rows = [Interval(clip, *_change(entry)) for clip, _, _, entry in having if entry["change"] is not None]
        if not rows:
            continue
        name = having[0][2]
        rows.sort(key=lambda row: row.value * (-1 if measure(name).better < 0 else 1))
        left = len(rows) - MOST_ROWS
        ends = [abs(v) for row in rows for v in (row.value, row.low, row.high) if math.isfinite(v)]
        reach = max(ends) or 1.0
        svg = interval_chart(f"Change of {_title(group, name)}", rows, Interval("no change", 0.0), (-reach, reach))
        note = f"<figcaption>{left} more in the table</figcaption>" if left > 0 else ""
        plots.append(f"<figure>{svg}{note}</figure>")
    return plots


def _columns(what: str, first: str, second: str) -> list[Column]:
    return [Column(what, text=True), Column(first), Column(second), Column("change", "with its 95 % interval")]


def _row(title: str, name: str, entry: Entry, ways: Sequence[str]) -> list[Cell]:
    digits = measure(name).digits
    low, high = _change(entry)[1:]
    cells = [text_cell(title), number_cell(entry["first"], digits), number_cell(entry["second"], digits)]
    small = number_cell(entry["change"], digits, (low, high)).small
    cells.append(Cell(_signed(entry, name), entry["change"], small))
    for way in ways:
        told = entry.get(way)
        cells.append(number_cell(None if told is None else told["p_holm"]))
    return [*cells, text_cell(str(entry["says"]))]


def _rows(groups: Mapping[str, Mapping[str, Entry]]) -> list[tuple[str, str, Entry]]:
    return [(group, name, entry) for group, names in groups.items() for name, entry in names.items()]


def _change(entry: Entry) -> tuple[float, float, float]:
    """The change and the ends of its interval: over clips where there is one, else over frames."""
    ways = [told for way in ("over_clips", "over_frames") if (told := entry.get(way)) is not None]
    spans = [told["interval"] for told in ways if told["interval"] is not None]
    change = math.nan if entry["change"] is None else float(entry["change"])
    low, high = spans[0] if spans else (math.nan, math.nan)
    return change, low, high


def _signed(entry: Entry, name: str) -> str:
    change = entry["change"]
    text = format_number(math.nan if change is None else change, measure(name).digits)
    return f"+{text}" if change and change > 0 else text


def _value(value: float | None, name: str) -> str:
    return format_number(math.nan if value is None else value, measure(name).digits)


def _title(group: str, name: str) -> str:
    return f"{measure(name).name}, {GROUPS.get(group, group)}"
