"""The measures of a task: a plot of each group's first one clip by clip, and a table of all of them."""

import math

from torchvision_dddas.evaluation.report.figures import Figure, Told
from torchvision_dddas.evaluation.report.words import GROUPS, SHOWN, measure
from torchvision_dddas.io.report import MOST_ROWS, Cell, Column, Interval, interval_chart, number_cell, table, text_cell

UNDRAWN = ("location",)
"""Groups whose plot says no more than their table."""


def groups_of(told: Told) -> list[str]:
    """The groups that any clip has, in the page's order."""
    having = dict.fromkeys(group for clip in told.clips.values() for group in clip)
    return [*(g for g in GROUPS if g in having), *(g for g in having if g not in GROUPS)]


def shown(told: Told, group: str) -> list[str]:
    """The measures of a group's table that any clip has a value of."""
    figures = [pair for clip in told.clips.values() for pair in clip.get(group, {}).items()]
    having = dict.fromkeys(name for name, figure in figures if math.isfinite(figure.value))
    if group in SHOWN:
        return [name for name in SHOWN[group] if name in having]
    counts = [name for name in having if name.startswith("n_")]
    return [*(name for name in having if name not in counts), *counts]


def measure_table(told: Told, group: str, frames: dict[str, int]) -> str:
    """A row a clip, and below them what belongs to all; each figure with its interval."""
    names = shown(told, group)
    columns = [Column("clip", text=True), Column("frames", "frames scored")]
    columns += [Column(measure(name).name, measure(name).meaning) for name in names]
    rows = [
        [text_cell(clip), number_cell(frames.get(clip)), *(_cell(groups[group].get(name), name) for name in names)]
        for clip, groups in told.clips.items()
        if group in groups
    ]
    foot = []
    if len(rows) > 1:
        for title, groups in (("pooled", told.pooled), ("mean over clips", told.mean)):
            if group in groups:
                foot.append([text_cell(title), Cell(""), *(_cell(groups[group].get(name), name) for name in names)])
    return table(f"{GROUPS.get(group, group)}, clip by clip", columns, rows, foot)


def measure_plot(told: Told, group: str) -> tuple[str, int]:
    """The group's first measure clip by clip, the worst first, and how many clips are left out; empty for one clip."""
    names = shown(told, group)
    if not names or group in UNDRAWN:
        return "", 0
    name = names[0]
    known = measure(name)
    rows = [
        Interval(clip, *groups[group][name])
        for clip, groups in told.clips.items()
        if name in groups.get(group, {}) and math.isfinite(groups[group][name].value)
    ]
    if not rows:
        return "", 0
    rows.sort(key=lambda row: -row.value if known.better < 0 else row.value)
    whole = told.pooled.get(group, {}).get(name, Figure(math.nan))
    title = f"{known.name}, {GROUPS.get(group, group)}"
    all_of_them = Interval("pooled", *whole) if len(rows) > 1 else None
    span = (0.0, 1.0 if known.share else 0.0)
    return interval_chart(title, rows, all_of_them, span), max(len(rows) - MOST_ROWS, 0)


def _cell(value: Figure | None, name: str) -> Cell:
    if value is None:
        return number_cell(None)
    digits = measure(name).digits
    return number_cell(value.value, digits, (value.low, value.high))
