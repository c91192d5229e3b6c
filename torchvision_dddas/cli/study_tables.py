"""The measures of a study on the terminal: a table for each task and kind of measure, and what was left out."""

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from torchvision_dddas.cli.evaluate import COLUMNS, SHORT, TITLES
from torchvision_dddas.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

MOST_CLIPS = 20
"""Of more clips the worst are shown."""

OF_STUDIES: Mapping[str, tuple[str, ...]] = {
    **COLUMNS,
    "ranking": ("ap", "log_average_miss_rate", "miss_rate_at_0.1", "miss_rate_at_1"),
    "still": ("false_blobs_per_frame", "alarmed"),
    "location": ("located", "belongs"),
    "metres": ("median_m", "p95_m", "in_ellipse", "relative_median_m", "relative_p95_m", "relative_in_ellipse"),
}

HEADS: Mapping[str, str] = {
    **TITLES,
    "ranking": "Ranked boxes, IoU ≥ 0.5",
    "still": "Still clips",
    "location": "Places told",
    "metres": "Errors in metres, and how often 95 % ellipses hold them",
}

WORDS: Mapping[str, str] = {
    **SHORT,
    "ap": "AP",
    "log_average_miss_rate": "LAMR",
    "miss_rate_at_0.1": "miss at 0.1",
    "miss_rate_at_1": "miss at 1",
    "false_blobs_per_frame": "false blobs",
    "median_m": "median",
    "p95_m": "95 %",
    "in_ellipse": "held",
    "relative_median_m": "to team",
    "relative_p95_m": "95 %",
    "relative_in_ellipse": "held",
}


def tables(measures: Mapping[str, Any]) -> "Iterator[Table]":
    """A table for each task and group. measures: as `studies.summary.summary` gives them."""
    for task, told in measures["tasks"].items():
        for group in OF_STUDIES:
            if group in told["pooled"]:
                yield _table(task, group, told)


def _table(task: str, group: str, told: Mapping[str, Any]) -> "Table":
    from rich.markup import escape
    from rich.table import Table

    columns = OF_STUDIES[group]
    having = {name: clip for name, clip in told["clips"].items() if group in clip}
    shown, more = list(having), ""
    if len(having) > MOST_CLIPS:
        worst = sorted(having, key=lambda name: _worth(having[name][group][columns[0]], group))
        shown, more = worst[:MOST_CLIPS], f"; the {MOST_CLIPS} worst of {len(having)} clips"
    table = Table(title=f"{task}: {HEADS[group]}{more}")
    table.add_column("clip", no_wrap=True)
    for column in ("frames", *columns):
        table.add_column(WORDS.get(column, column), justify="right", no_wrap=True)
    for name in shown:
        cells = (cell(having[name][group][c]) for c in columns)
        table.add_row(escape(str(InputError(name))), str(having[name]["frames"]), *cells)
    if len(having) > 1:
        table.add_section()
        table.add_row("pooled", "", *(cell(told["pooled"][group][c]) for c in columns))
        spans = told["pooled"]["intervals"].get(group, {})
        table.add_row("95 % interval", "", *(span(spans.get(c)) for c in columns))
        table.add_row("mean", "", *(cell(told["mean"].get(group, {}).get(c)) for c in columns))
    return table


def _worth(value: float | None, group: str) -> float:
    """Lowest for the worst."""
    if value is None or math.isnan(value):
        return math.inf
    return -value if group in ("still", "metres") else value


def cell(value: float | int | None) -> str:
    """A figure for a reader."""
    if type(value) is int:
        return str(value)
    return "–" if value is None or math.isnan(value) else f"{value:.3f}"


def span(interval: list[float] | None) -> str:
    """From low to high."""
    if interval is None:
        return "–"
    low, high = interval
    return f"{low:.2f} to {high:.2f}" if abs(high) < 100 else f"{low:.0f} to {high:.0f}"
