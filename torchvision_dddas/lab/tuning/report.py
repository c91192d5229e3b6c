"""report.html of a tuning run: loss and parameters at each step, and the measures before and after."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from torchvision_dddas.io.report import Cell, ReportColumn, format_number, number_cell, render_page, table, text_cell
from torchvision_dddas.io.report.charts import Axis, Dots, Line, chart
from torchvision_dddas.lab.evaluation.metrics.registry import describe, title_of_group
from torchvision_dddas.lab.evaluation.studies.comparison import MEANING, comparison_section

SIDES = {"tuned": "Clips tuned on", "held_out": "Clips held out"}


def tuning_report(run: Mapping[str, Any]) -> str:
    """Return the HTML. run: the content of run.json of `dddas tune`, with None for NaN."""
    parameters, verdict = run["knobs"], run.get("verdict")
    _, group, name = verdict["measure"].split(".", 2) if verdict else ("", "", "f")
    return render_page(
        "tuning.html",
        title=f"Tuning of {len(parameters)} parameter{'s' * (len(parameters) != 1)} by gradient",
        run=run,
        measure=describe(name),
        group=title_of_group(group),
        sides=[_side(side, heading, verdict[side], group, name) for side, heading in SIDES.items() if verdict],
        charts=_charts(run),
        parameters=_parameter_table(parameters),
        meaning=MEANING,
    )


def _side(anchor: str, heading: str, side: Mapping[str, Any] | None, group: str, name: str) -> dict[str, Any]:
    """Return the card and the section of one set of clips."""
    if side is None:
        return {"anchor": anchor, "heading": heading, "gain": None}
    clips, changes = side["clips"], side["changes"] or {}
    title = f"{heading}: {', '.join(clips)}" if len(clips) <= 6 else f"{heading} ({len(clips)})"
    tasks = list(changes.get("tasks", {}).values())
    sections = [comparison_section(anchor, title, mine, "before", "after") for mine in tasks]
    if not sections:
        sections = [Markup('<h2 id="{}">{}</h2><p>Nothing to compare.</p>').format(anchor, title)]
    return {
        "anchor": anchor,
        "heading": heading,
        "gain": _gain(side, tasks[0]["pooled"].get(group, {}).get(name) if tasks else None, describe(name).digits),
        "comparison": Markup("\n".join(sections)),
        "notes": [*side["notes"], *changes.get("notes", [])],
    }


def _gain(side: Mapping[str, Any], entry: Mapping[str, Any] | None, digits: int) -> dict[str, Any]:
    """Return the texts of a card. entry: the goal in the comparison."""

    def signed(value: float) -> str:
        text = format_number(value, digits)
        return f"+{text}" if value > 0 and not text.startswith("−") else text

    def arrow(pair: Mapping[str, float | None], digits: int) -> str:
        ends = [end for end in (pair["before"], pair["after"]) if end is not None]
        return " → ".join(format_number(end, digits) for end in ends) if len(ends) == 2 else ""

    before, after = side["pooled"]["before"], side["pooled"]["after"]
    if before is None or after is None:
        return {"figure": ""}
    ways = [way["interval"] for over in ("over_clips", "over_frames") if entry and (way := entry.get(over))]
    span = next((interval for interval in ways if interval), None)
    interval = "" if span is None else f", 95 %: {signed(span[0])} to {signed(span[1])}"
    return {
        "before": format_number(before, digits),
        "after": format_number(after, digits),
        "figure": f"{signed(after - before)}{interval}",
        "says": side["says"],
        "clips": side["clips"],
        "means": arrow(side["mean"], digits) if len(side["clips"]) > 1 else "",
        "frame_ms": arrow(side["frame_ms"], 1),
    }


def _charts(run: Mapping[str, Any]) -> list[Markup]:
    history = run["history"]
    steps, across = _column(history, "step"), Axis("step")
    watched = [step for step in history if step["watched"] is not None]
    kept = [step for step in watched if step["step"] == run["best"]]
    losses = [
        Line("batch", steps, _column(history, "loss"), 6, faint=True),
        Line("watched", _column(watched, "step"), _column(watched, "watched"), 1),
    ]
    ring = Dots("kept", _column(kept, "step"), _column(kept, "watched"), 2, is_ring=True)
    charts = [chart("Loss", across, Axis("loss"), losses, [ring])]
    for name, parameter in run["knobs"].items() if history else ():
        values, mark = np.array([step["knobs"][name] for step in history], float), steps == run["best"]
        lines = [
            Line("as it was", steps, np.full(len(values), values[0]), 6, dashed=True),
            Line("value", steps, values, 1),
        ]
        axis, middle, spread = Axis(parameter["unit"].strip("-") or "value"), float(values.mean()), np.ptp(values)
        if spread < 0.04 * abs(middle):  # avoid exaggerating the movement of a nearly constant parameter
            reach = max(0.55 * float(spread), 0.02 * abs(middle), 1e-6)
            axis = Axis(axis.name, middle - reach, middle + reach)
        charts.append(chart(name, across, axis, lines, [Dots("kept", steps[mark], values[mark], 2, is_ring=True)]))
    if len({step["softness"] for step in history}) > 1:
        charts.append(chart("Softness", across, Axis("softness"), [Line("", steps, _column(history, "softness"), 3)]))
    return [Markup(svg) for svg in charts]


def _column(steps: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    return np.array([math.nan if step[name] is None else step[name] for step in steps], float)


def _parameter_table(parameters: Mapping[str, Mapping[str, Any]]) -> Markup:
    words = [ReportColumn(name, text=True) for name in ("unit", "range", "meaning")]
    columns = [
        ReportColumn("parameter", text=True),
        ReportColumn("before"),
        ReportColumn("after"),
        ReportColumn("times"),
        *words,
    ]
    rows = []
    for name, parameter in parameters.items():
        before, after = float(parameter["before"]), float(parameter["after"])
        idle = "no effect on the loss. " if parameter["idle"] else ""
        cells = [Cell(f"{value:g}".replace("-", "−"), value) for value in (before, after)]
        texts = map(text_cell, (parameter["unit"], parameter["range"], idle + parameter["meaning"]))
        rows.append([text_cell(name), *cells, number_cell(after / before if before else None, 2), *texts])
    return table("parameters before and after", columns, rows)
