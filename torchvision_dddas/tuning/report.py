"""report.html of tuning: the loss and the knobs over the steps, and what it was worth: before, after, intervals."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from torchvision_dddas.evaluation.report.comparison import MEANING, comparison_section
from torchvision_dddas.evaluation.report.measures import GROUPS, measure
from torchvision_dddas.io.report import (
    Axis,
    Cell,
    Column,
    Dots,
    Line,
    chart,
    format_number,
    number_cell,
    render_page,
    table,
    text_cell,
)

SIDES = {"tuned": "Clips tuned on", "held_out": "Clips held out"}


def tuning_report(told: Mapping[str, Any]) -> str:
    """The HTML. told: the content of run.json of `dddas tune`, NaN as None."""
    parameters = told["knobs"]
    title = f"Tuning of {len(parameters)} parameter{'s' * (len(parameters) != 1)} by gradient"
    loss = f", loss {told['loss']}," if told.get("loss") else ""
    about = f"{told['family']}{loss} on {told['study']['name']}; seed {told['plan']['seed']}"
    parts = [f"<h1>{escape(title)} <span>{escape(about)}</span></h1>"]
    if told["failed"]:
        parts.append(f'<p class="bad">Stopped: {escape(told["failed"])}. The parameters are the last good ones.</p>')
    verdict = told.get("verdict")
    parts += ['<div class="cards">', *_cards(told, verdict), "</div>"]
    parts += ["<h2>Descent</h2>", _descent_note(told), '<div class="plots">', *_plots(told), "</div>"]
    parts += ["<h3>Parameters</h3>", _parameters(parameters)]
    if told.get("cost"):
        parts += _cost(told["cost"])
    if verdict:
        for side, heading in SIDES.items():
            parts += _side(side, heading, verdict)
        parts.append(f'<p class="soft">{MEANING} All figures here are of hard operations.</p>')
    return render_page("page.html", title=title, parts=parts)


def _cards(told: Mapping[str, Any], verdict: Mapping[str, Any] | None) -> list[str]:
    cards = []
    for side, heading in SIDES.items() if verdict else ():
        assert verdict is not None
        found = verdict[side]
        if found is None:
            inner = "<p>none; give --holdout to see what tuning is worth elsewhere</p>"
        else:
            inner = _gain(verdict["measure"], found)
        cards.append(f'<section class="card"><h3><a href="#{side}">{heading}</a></h3>{inner}</section>')
    steps = told["history"][-1]["step"] if told["history"] else 0
    # Of a run that was taken up, the steps that it took itself.
    pace = f"{format_number(told['seconds']['descent'] / told['taken'], 2)} s a step, " if told["taken"] else ""
    cards.append(
        '<section class="card"><h3>Descent</h3>'
        f'<div class="big">{steps} <span>steps, the best state after step {told["best"]}</span></div>'
        f"<p>{escape(told['ended'])}</p><p>{pace}{told['examples']} examples</p></section>"
    )
    return cards


def _gain(name: str, side: Mapping[str, Any]) -> str:
    """What the pooled goal was and is, and what the comparison says of it."""
    _, group, short = name.split(".", 2)
    before, after = side["pooled"]["before"], side["pooled"]["after"]
    digits = measure(short).digits
    parts = []
    if before is None or after is None:
        return f"<p>no {escape(measure(short).name)} before and after</p>"
    parts.append(
        f'<div class="big">{format_number(after, digits)} <span>{escape(measure(short).name)}, '
        f"{escape(GROUPS.get(group, group))}, all together; before {format_number(before, digits)}</span></div>"
    )
    tasks = list(((side["changes"] or {}).get("tasks") or {}).values())
    entry = tasks[0]["pooled"].get(group, {}).get(short) if tasks else None
    spans = [way["interval"] for over in ("over_clips", "over_frames") if entry and (way := entry.get(over))]
    span = next((span for span in spans if span), None)
    interval = "" if span is None else f", 95 %: {_signed(span[0], digits)} to {_signed(span[1], digits)}"
    parts.append(f"<p>{_signed(after - before, digits)}{interval}: <b>{escape(side['says'])}</b></p>")
    mean = side["mean"]
    if mean["before"] is not None and mean["after"] is not None and len(side["clips"]) > 1:
        means = [format_number(mean[when], digits) for when in ("before", "after")]
        parts.append(f"<p>mean of {len(side['clips'])} clips: {means[0]} → {means[1]}</p>")
    took = side["frame_ms"]
    if took["before"] is not None and took["after"] is not None:
        parts.append(f"<p>{format_number(took['before'], 1)} → {format_number(took['after'], 1)} ms a frame</p>")
    return "".join(parts)


def _descent_note(told: Mapping[str, Any]) -> str:
    plan = told["plan"]
    which = (
        f"The watched ones are the last {plan['watched']:.0%} of each clip that has three or more: nothing is "
        "learned from them."
        if plan["watched"]
        else "What is learned from is watched as well."
    )
    count = min(plan["batch"], told["examples"])
    return (
        f'<p class="soft">Each step learns from {count} examples, softened. {which} They are looked at as hard as '
        "at the last step, and their least loss decides which state is kept.</p>"
    )


def _plots(told: Mapping[str, Any]) -> list[str]:
    history, best = told["history"], told["best"]
    steps = np.array([step["step"] for step in history], float)
    across = Axis("step")
    looks = [step for step in history if step["watched"] is not None]
    x, y = _column(looks, "step"), _column(looks, "watched")
    kept = [step for step in looks if step["step"] == best]
    charts = [
        chart(
            "Loss",
            across,
            Axis("loss"),
            [Line("batch", steps, _column(history, "loss"), 6, faint=True), Line("watched", x, y, 1)],
            [Dots("kept", _column(kept, "step"), _column(kept, "watched"), 2, sign="ring")],
        )
    ]
    for name in told["knobs"]:
        values = np.array([step["knobs"][name] for step in history], float)
        mark = steps == best
        dots = [Dots("kept", steps[mark], values[mark], 2, sign="ring")]
        start = Line("as it was", steps, np.full(len(steps), values[0] if len(values) else math.nan), 6, dashed=True)
        unit = told["knobs"][name]["unit"]
        # A parameter that hardly moves is not to look as if it did.
        middle = float(values.mean()) if len(values) else 0.0
        reach = max(float(np.ptp(values)) * 0.55 if len(values) else 0.0, 0.02 * abs(middle), 1e-6)
        axis = Axis(unit if unit not in ("", "-") else "value")
        if len(values) and np.ptp(values) < 0.04 * abs(middle):
            axis = Axis(axis.name, middle - reach, middle + reach)
        charts.append(chart(name, across, axis, [start, Line("value", steps, values, 1)], dots))
    if len({step["softness"] for step in history}) > 1:
        charts.append(chart("Softness", across, Axis("softness"), [Line("", steps, _column(history, "softness"), 3)]))
    return [f"<figure>{svg}</figure>" for svg in charts]


def _column(steps: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    return np.array([math.nan if step[name] is None else step[name] for step in steps], float)


def _parameters(parameters: Mapping[str, Mapping[str, Any]]) -> str:
    columns = [
        Column("knob", text=True),
        Column("before"),
        Column("after"),
        Column("times"),
        Column("unit", text=True),
        Column("range", text=True),
        Column("meaning", text=True),
    ]
    rows = []
    for name, parameter in parameters.items():
        before, after = float(parameter["before"]), float(parameter["after"])
        times = after / before if before else None
        text = "no slope: the loss did not depend on it. " if parameter["idle"] else ""
        value = Cell(f"{after:g}".replace("-", "−"), after)
        first = Cell(f"{before:g}".replace("-", "−"), before)
        rows.append(
            [
                text_cell(name),
                first,
                value,
                number_cell(times, 2),
                *map(text_cell, (parameter["unit"], parameter["range"], text + parameter["meaning"])),
            ]
        )
    return table("knobs before and after", columns, rows)


def _cost(cost: Mapping[str, Any]) -> list[str]:
    """What a frame is expected to take, and what was measured of each parameter."""
    before, after = 1000 * cost["seconds"], 1000 * cost["expected"]
    said = (
        f"A frame of twice the time costs as much as a loss of {cost['weight']:g}. Expected: "
        f"{format_number(before, 1)} → {format_number(after, 1)} ms a frame."
    )
    if not cost["curves"]:
        said += " No parameter changed the time by more than repeats differ."
    listed = [
        (curve["knob"], *(", ".join(f"{v:.3g}" for v in curve[part]) for part in ("values", "times")))
        for curve in cost["curves"]
    ]
    rows = [[text_cell(text) for text in row] for row in listed]
    parts = ["<h3>What time costs</h3>", f"<p>{said}</p>"]
    columns = [Column("knob", text=True), Column("values", text=True), Column("times as long", text=True)]
    return [*parts, table("time by knob", columns, rows)] if rows else parts


def _side(side: str, heading: str, verdict: Mapping[str, Any]) -> list[str]:
    found = verdict[side]
    if found is None:
        return []
    said = (
        f"{heading}: {', '.join(found['clips'])}" if len(found["clips"]) <= 6 else f"{heading} ({len(found['clips'])})"
    )
    tasks = (found["changes"] or {}).get("tasks", {})
    parts: list[str] = [comparison_section(side, said, mine, "before", "after") for mine in tasks.values()]
    if not tasks:
        parts.append(f'<h2 id="{side}">{escape(said)}</h2><p>Nothing to compare.</p>')
    notes = [*found["notes"], *((found["changes"] or {}).get("notes", []))]
    if notes:
        parts.append(f"<ul>{''.join(f'<li>{escape(note)}</li>' for note in notes)}</ul>")
    return parts


def _signed(value: float, digits: int) -> str:
    text = format_number(value, digits)
    return f"+{text}" if value > 0 and not text.startswith("−") else text
