"""compare.html: what changed from one study to another, clip by clip, and whether it is beyond noise."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from torchvision_dddas.evaluation.metrics.registry import describe, title_of_group
from torchvision_dddas.evaluation.report.measures import TITLES
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
    "Better and worse are beyond noise: p below 0.05 after Holm's correction for all tests of this table. "
    "“On these clips”: significant over blocks of their frames, which holds for these clips alone. "
    "“Too little to tell”: so few frames or clips could not show any change."
)

Entry = Mapping[str, Any]


def comparison_report(comparison: Mapping[str, Any]) -> str:
    """The HTML. comparison: as `compare_studies` returns it, NaN as None."""
    first, second = str(comparison["first"]), str(comparison["second"])
    return render_page(
        "comparison.html",
        title=f"{first} and {second}: comparison",
        first=first,
        second=second,
        meaning=MEANING,
        tasks=[_task(task, changes, first, second) for task, changes in comparison["tasks"].items()],
        notes=comparison["notes"],
    )


def _task(task: str, changes: Mapping[str, Any], first: str, second: str) -> dict[str, Any]:
    """What the page shows of a task: a card with its first measure and counts of clips, and its section."""
    title = TITLES.get(task, task)
    verdicts = [str(entry["says"]) for groups in changes["clips"].values() for _, _, entry in _rows(groups)[:1]]
    n_better, n_worse = (sum(verdict.startswith(word) for verdict in verdicts) for word in ("better", "worse"))
    found = {
        "id": task,
        "title": title,
        "change": "",
        "n_better": n_better,
        "n_worse": n_worse,
        "n_others": len(verdicts) - n_better - n_worse,
        "n_same": len(changes["same"]),
        "section": comparison_section(task, title, changes, first, second),
    }
    if pooled := _rows(changes["pooled"]):
        group, name, entry = pooled[0]
        before, after = (number_cell(entry[end], describe(name).digits).text for end in ("first", "second"))
        found |= {"change": _signed(entry, name), "metric": _title(group, name), "before": before, "after": after}
        found["verdict"] = entry["says"]
    return found


def comparison_section(anchor: str, title: str, changes: Mapping[str, Any], first: str, second: str) -> Markup:
    """The section of a task: plots clip by clip, all clips together, single clips.

    anchor: the target of links. changes: of this task, as in `compare_studies`. first, second: names of columns.
    """
    pooled = [
        _row(_title(group, name), name, entry, ("over_clips", "over_frames"))
        for group, name, entry in _rows(changes["pooled"])
    ]
    by_clip = [
        [text_cell(clip), *_row(_title(group, name), name, entry, ("over_frames",))]
        for clip, groups in changes["clips"].items()
        for group, name, entry in _rows(groups)
    ]
    columns = [Column("measure", text=True), Column(first), Column(second), Column("change", "with its 95 % interval")]
    verdict = Column("verdict", text=True)
    section = render_page(
        "comparison_section.html",
        id=anchor,
        title=title,
        charts=_charts(changes["clips"]),
        pooled=table("all clips together", [*columns, Column("p, clips"), Column("p, frames"), verdict], pooled),
        by_clip=by_clip and table("clip by clip", [Column("clip", text=True), *columns, Column("p"), verdict], by_clip),
        same=changes["same"],
    )
    return Markup(section)


def _charts(clips: Mapping[str, Mapping[str, Any]]) -> list[tuple[Markup, str]]:
    """The change of each group's first measure clip by clip, the largest loss first, and a note."""
    charts = []
    for group in dict.fromkeys(group for groups in clips.values() for group in groups):
        changed = [(clip, *_rows({group: groups[group]})[0]) for clip, groups in clips.items() if groups.get(group)]
        rows = [Interval(clip, *_change(entry)) for clip, _, _, entry in changed if entry["change"] is not None]
        if not rows:
            continue
        name = changed[0][2]
        rows.sort(key=lambda row: row.value * (-1 if describe(name).better < 0 else 1))
        ends = [abs(v) for row in rows for v in (row.value, row.low, row.high) if math.isfinite(v)]
        reach = max(ends) or 1.0
        svg = interval_chart(f"Change of {_title(group, name)}", rows, Interval("no change", 0.0), (-reach, reach))
        n_left_out = len(rows) - MOST_ROWS
        charts.append((svg, f"{n_left_out} more in the table" if n_left_out > 0 else ""))
    return charts


def _row(title: str, name: str, entry: Entry, ways: Sequence[str]) -> list[Cell]:
    digits = describe(name).digits
    low, high = _change(entry)[1:]
    cells = [text_cell(title), number_cell(entry["first"], digits), number_cell(entry["second"], digits)]
    small = number_cell(entry["change"], digits, (low, high)).small
    cells.append(Cell(_signed(entry, name), entry["change"], small))
    cells += [number_cell(None if (effect := entry.get(way)) is None else effect["p_holm"]) for way in ways]
    return [*cells, text_cell(str(entry["says"]))]


def _rows(groups: Mapping[str, Mapping[str, Entry]]) -> list[tuple[str, str, Entry]]:
    return [(group, name, entry) for group, names in groups.items() for name, entry in names.items()]


def _change(entry: Entry) -> tuple[float, float, float]:
    """The change and the ends of its interval: over clips where there is one, else over frames."""
    effects = [effect for way in ("over_clips", "over_frames") if (effect := entry.get(way)) is not None]
    spans = [effect["interval"] for effect in effects if effect["interval"] is not None]
    change = math.nan if entry["change"] is None else float(entry["change"])
    low, high = spans[0] if spans else (math.nan, math.nan)
    return change, low, high


def _signed(entry: Entry, name: str) -> str:
    change = entry["change"]
    text = format_number(math.nan if change is None else change, describe(name).digits)
    return f"+{text}" if change and change > 0 else text


def _title(group: str, name: str) -> str:
    return f"{describe(name).title}, {title_of_group(group)}"
