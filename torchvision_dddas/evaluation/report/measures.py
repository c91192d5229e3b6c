"""The measures on a study's page: their figures with intervals, names and meanings, plots and tables."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from torchvision_dddas.evaluation.metrics.registry import GROUPS, describe, title_of_group
from torchvision_dddas.io.report import MOST_ROWS, Cell, Column, Interval, interval_chart, number_cell, table, text_cell

TITLES = {
    "motion": "Motion",
    "tracking": "Tracking",
    "association": "Association",
    "people": "People",
    "location": "Location",
}


class Figure(NamedTuple):
    """A value and the ends of its interval, NaN where unknown."""

    value: float
    low: float = math.nan
    high: float = math.nan


Groups = Mapping[str, Mapping[str, Figure]]
"""Figures by group and measure."""


@dataclass(frozen=True)
class TaskFigures:
    """A task's figures: of each clip by name, of all counts together, and the mean over clips.

    over: by group, what the intervals of all together are over: "clips", or "frames", which says nothing of others.
    """

    clips: Mapping[str, Groups] = field(default_factory=dict)
    pooled: Groups = field(default_factory=dict)
    mean: Groups = field(default_factory=dict)
    over: Mapping[str, str] = field(default_factory=dict)


def read_figures(metrics: Mapping[str, Any], task: str) -> TaskFigures:
    """A task's figures; empty where the study has none of it."""
    mine = metrics.get("tasks", {}).get(task, {})
    clips = {name: _groups(clip) for name, clip in mine.get("clips", {}).items()}
    pooled = mine.get("pooled", {})
    return TaskFigures(clips, _groups(pooled), _groups(mine.get("mean", {})), pooled.get("over", {}))


def _groups(groups: Mapping[str, Any]) -> Groups:
    spans = groups.get("intervals", {})
    return {
        group: {name: _figure(value, spans.get(group, {}).get(name)) for name, value in measures.items()}
        for group, measures in groups.items()
        if isinstance(measures, Mapping) and group not in ("intervals", "over")
    }


def _figure(value: Any, span: Sequence[float] | None) -> Figure:
    low, high = span or (None, None)
    return Figure(_number(value), _number(low), _number(high))


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


UNDRAWN = ("location",)
"""Groups whose plot says no more than their table."""


def groups_of(figures: TaskFigures) -> list[str]:
    """The groups that any clip has, in the page's order."""
    having = dict.fromkeys(group for clip in figures.clips.values() for group in clip)
    return [*(g for g in GROUPS if g in having), *(g for g in having if g not in GROUPS)]


def shown(figures: TaskFigures, group: str) -> list[str]:
    """The measures of a group's table that any clip has a value of."""
    pairs = [pair for clip in figures.clips.values() for pair in clip.get(group, {}).items()]
    having = dict.fromkeys(name for name, figure in pairs if math.isfinite(figure.value))
    if group in GROUPS:
        return [name for name in GROUPS[group].shown if name in having]
    counts = [name for name in having if name.startswith("n_")]
    return [*(name for name in having if name not in counts), *counts]


def measure_table(figures: TaskFigures, group: str, frames: dict[str, int]) -> str:
    """A row a clip, and below them what belongs to all; each figure with its interval."""
    names = shown(figures, group)
    columns = [Column("clip", text=True), Column("frames", "frames scored")]
    columns += [Column(describe(name).title, describe(name).meaning) for name in names]
    rows = [
        [text_cell(clip), number_cell(frames.get(clip)), *(_cell(groups[group].get(name), name) for name in names)]
        for clip, groups in figures.clips.items()
        if group in groups
    ]
    foot = []
    if len(rows) > 1:
        for title, groups in (("pooled", figures.pooled), ("mean over clips", figures.mean)):
            if group in groups:
                foot.append([text_cell(title), Cell(""), *(_cell(groups[group].get(name), name) for name in names)])
    return table(f"{title_of_group(group)}, clip by clip", columns, rows, foot)


def measure_plot(figures: TaskFigures, group: str) -> tuple[str, int]:
    """The group's first measure clip by clip, the worst first, and how many clips are left out; empty for one clip."""
    names = shown(figures, group)
    if not names or group in UNDRAWN:
        return "", 0
    name = names[0]
    known = describe(name)
    rows = [
        Interval(clip, *groups[group][name])
        for clip, groups in figures.clips.items()
        if name in groups.get(group, {}) and math.isfinite(groups[group][name].value)
    ]
    if not rows:
        return "", 0
    rows.sort(key=lambda row: -row.value if known.better < 0 else row.value)
    whole = figures.pooled.get(group, {}).get(name, Figure(math.nan))
    title = f"{known.title}, {title_of_group(group)}"
    all_of_them = Interval("pooled", *whole) if len(rows) > 1 else None
    span = (0.0, 1.0 if known.is_share else 0.0)
    return interval_chart(title, rows, all_of_them, span), max(len(rows) - MOST_ROWS, 0)


def _cell(value: Figure | None, name: str) -> Cell:
    if value is None:
        return number_cell(None)
    digits = describe(name).digits
    return number_cell(value.value, digits, (value.low, value.high))
