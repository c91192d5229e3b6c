"""The measures on a study's page: their figures with intervals, names and meanings, plots and tables."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from torchvision_dddas.io.report import MOST_ROWS, Cell, Column, Interval, interval_chart, number_cell, table, text_cell

TITLES = {
    "motion": "Motion",
    "tracking": "Tracking",
    "association": "Association",
    "people": "People",
    "location": "Location",
}

GROUPS = {
    "pixels": "pixels",
    "boxes": "boxes, IoU ≥ 0.5",
    "target": "one labelled target",
    "tracks": "tracks",
    "target_track": "the labelled target's track, IoU ≥ 0.3",
    "still": "false alarms where nothing moves",
    "ranking": "boxes ranked by score",
    "location": "targets that were located",
    "metres": "errors on the ground",
}


class Measure(NamedTuple):
    """A measure's name and meaning; better: 1 where more is, -1 where less is, 0 where neither; digits: decimals."""

    name: str
    meaning: str = ""
    better: int = 1
    digits: int = 3
    share: bool = True


MEASURES = {
    "f": Measure("F", "harmonic mean of precision and recall, of pixels"),
    "f1": Measure("F1", "harmonic mean of precision and recall"),
    "precision": Measure("precision", "share of what was found that is true"),
    "recall": Measure("recall", "share of what is true that was found"),
    "specificity": Measure("specificity", "share of the background that was left alone"),
    "accuracy": Measure("accuracy", "share of all that was judged rightly"),
    "gmean": Measure("Gmean", "geometric mean of recall and specificity"),
    "ap": Measure("AP", "average precision: area below precision over recall"),
    "log_average_miss_rate": Measure("LAMR", "log-average miss rate, 0.01 to 1 false positives an image", -1),
    "miss_rate_at_0.1": Measure("missed at 0.1", "share missed at 0.1 false positives an image", -1),
    "miss_rate_at_1": Measure("missed at 1", "share missed at 1 false positive an image", -1),
    "hit": Measure("hit", "share of frames in which the target is hit"),
    "iou_0.3": Measure("IoU ≥ 0.3", "share of frames in which a box meets the target at IoU 0.3"),
    "other_blobs_per_frame": Measure("other blobs", "boxes elsewhere, a frame", 0, 2, False),
    "hota": Measure("HOTA", "detection and association weighed evenly, over all IoUs"),
    "deta": Measure("DetA", "detection accuracy of HOTA"),
    "assa": Measure("AssA", "association accuracy of HOTA"),
    "mota": Measure("MOTA", "1 less misses, false boxes and switches, for each true box"),
    "motp": Measure("MOTP", "mean IoU of the boxes found"),
    "idf1": Measure("IDF1", "share of boxes that carry the right identity"),
    "ar_2": Measure("AR₂", "accuracy ratio of links over two looks"),
    "ar_3": Measure("AR₃", "accuracy ratio of links over three looks"),
    "mostly_tracked": Measure("mostly tracked", "share of targets found in over 80 % of their frames"),
    "mostly_lost": Measure("mostly lost", "share of targets found in under 20 % of their frames", -1),
    "found": Measure("found", "share of frames in which the target has a box"),
    "same_identity": Measure("same identity", "share of frames in which the target has the identity it has most"),
    "n_switches": Measure("switches", "changes of identity", -1, 0, False),
    "n_fragmentations": Measure("fragments", "interruptions of a track", -1, 0, False),
    "false_blobs_per_frame": Measure("false blobs", "a frame", -1, 2, False),
    "alarmed": Measure("alarmed", "share of frames with any false blob", -1),
    "located": Measure("located", "share of the true places that were found"),
    "belongs": Measure("belongs", "share of the found places that belong to a target"),
    "mean_m": Measure("mean, m", "mean error on the Earth, metres", -1, 2, False),
    "median_m": Measure("median, m", "median error on the Earth, metres", -1, 2, False),
    "p95_m": Measure("95 %, m", "error that 95 % of the places stay below, metres", -1, 2, False),
    "rms_m": Measure("RMS, m", "root mean square of the errors, metres", -1, 2, False),
    "in_ellipse": Measure("in ellipse", "share of the places whose 95 % ellipse holds the true one", 0),
    "relative_mean_m": Measure("team mean, m", "mean error relative to the team, metres", -1, 2, False),
    "relative_median_m": Measure("team median, m", "median error relative to the team, metres", -1, 2, False),
    "relative_p95_m": Measure("team 95 %, m", "error relative to the team that 95 % stay below, metres", -1, 2, False),
    "relative_rms_m": Measure("team RMS, m", "root mean square of the errors relative to the team", -1, 2, False),
    "relative_in_ellipse": Measure("team in ellipse", "share whose ellipse relative to the team holds the place", 0),
}

SHOWN = {
    "pixels": ("f", "precision", "recall", "specificity", "accuracy", "gmean"),
    "boxes": ("f1", "precision", "recall"),
    "ranking": ("ap", "log_average_miss_rate", "miss_rate_at_0.1", "miss_rate_at_1"),
    "still": ("false_blobs_per_frame", "alarmed"),
    "location": ("located", "belongs", "n_targets", "n_told", "n_strays"),
    "metres": (
        *("median_m", "mean_m", "rms_m", "p95_m", "in_ellipse", "relative_median_m", "relative_mean_m"),
        *("relative_rms_m", "relative_p95_m", "relative_in_ellipse"),
    ),
    "target": ("hit", "iou_0.3", "other_blobs_per_frame"),
    "tracks": ("hota", "idf1", "mota", "deta", "assa", "recall", "precision", "n_switches", "ar_2", "ar_3"),
    "target_track": ("found", "same_identity", "n_switches", "n_fragmentations"),
}
"""The measures of a group's table in order; the others are in metrics.json. A group that is not here shows all."""

HEADLINES = {
    "motion": (("pixels", "f"), ("boxes", "f1"), ("target", "hit"), ("still", "false_blobs_per_frame")),
    "tracking": (("tracks", "hota"), ("target_track", "same_identity")),
    "association": (("tracks", "ar_3"), ("tracks", "idf1")),
    "people": (("ranking", "ap"), ("boxes", "f1")),
    "location": (("metres", "median_m"), ("location", "located")),
}
"""What a task is judged by at a glance, the first that there is."""


def measure(name: str) -> Measure:
    """What is known of a measure; its name alone where that is all."""
    if name in MEASURES:
        return MEASURES[name]
    if name.endswith("_m"):
        return Measure(name.removesuffix("_m").replace("_", " ") + ", m", "metres", -1, 2, False)
    if name.startswith("n_"):
        return Measure(name.removeprefix("n_").replace("_", " "), "how many", 0, 0, False)
    return Measure(name.replace("_", " "), "", 0)


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
    if group in SHOWN:
        return [name for name in SHOWN[group] if name in having]
    counts = [name for name in having if name.startswith("n_")]
    return [*(name for name in having if name not in counts), *counts]


def measure_table(figures: TaskFigures, group: str, frames: dict[str, int]) -> str:
    """A row a clip, and below them what belongs to all; each figure with its interval."""
    names = shown(figures, group)
    columns = [Column("clip", text=True), Column("frames", "frames scored")]
    columns += [Column(measure(name).name, measure(name).meaning) for name in names]
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
    return table(f"{GROUPS.get(group, group)}, clip by clip", columns, rows, foot)


def measure_plot(figures: TaskFigures, group: str) -> tuple[str, int]:
    """The group's first measure clip by clip, the worst first, and how many clips are left out; empty for one clip."""
    names = shown(figures, group)
    if not names or group in UNDRAWN:
        return "", 0
    name = names[0]
    known = measure(name)
    rows = [
        Interval(clip, *groups[group][name])
        for clip, groups in figures.clips.items()
        if name in groups.get(group, {}) and math.isfinite(groups[group][name].value)
    ]
    if not rows:
        return "", 0
    rows.sort(key=lambda row: -row.value if known.better < 0 else row.value)
    whole = figures.pooled.get(group, {}).get(name, Figure(math.nan))
    title = f"{known.name}, {GROUPS.get(group, group)}"
    all_of_them = Interval("pooled", *whole) if len(rows) > 1 else None
    span = (0.0, 1.0 if known.share else 0.0)
    return interval_chart(title, rows, all_of_them, span), max(len(rows) - MOST_ROWS, 0)


def _cell(value: Figure | None, name: str) -> Cell:
    if value is None:
        return number_cell(None)
    digits = measure(name).digits
    return number_cell(value.value, digits, (value.low, value.high))
