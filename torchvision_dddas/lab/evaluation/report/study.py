"""report.html of a study: results, uncertainty, worst frames and costs, on one page for offline use."""

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from torchvision_dddas.io.output import finite, versions
from torchvision_dddas.io.report import (
    Cell,
    ReportColumn,
    ReportTable,
    format_count,
    format_number,
    number_cell,
    render_page,
    table,
    text_cell,
)
from torchvision_dddas.io.report.charts import MOST_ROWS, Interval, interval_chart
from torchvision_dddas.lab.evaluation.metrics.registry import GROUPS, HEADLINES, describe, title_of_group
from torchvision_dddas.lab.evaluation.report.task_charts import error_clouds, maps, ranked_charts
from torchvision_dddas.lab.evaluation.report.worst_frames import draw_pictures, find_worst_frames
from torchvision_dddas.lab.evaluation.studies.records import TASKS, Case, Results, Task
from torchvision_dddas.lab.evaluation.studies.summary import sum_costs

MAX_STAGES = 8
"""Columns of the table of costs."""

Groups = Mapping[str, Any]
"""Measures by group, and their "intervals", as metrics.json has them for a clip, pooled and in the mean."""


def study_report(metrics: Mapping[str, Any], results: Results) -> str:
    """Return the HTML. metrics: result of `summarize`, with None for NaN. Pictures are read from the clips' files."""
    by_task = {task: [case for case in results.cases if case.task == task] for task in TASKS}
    tasks = [_task(task, metrics["tasks"].get(task, {}), cases) for task, cases in by_task.items() if cases]
    n_clips = len({str(case.clip.place) + case.clip.name for case in results.cases if case.scored is not None})
    state = f"{format_count(n_clips, 'clip')}, {format_count(len(tasks), 'task')}; "
    left_out = list(results.left_out)
    for case in results.cases:
        if case.cause and not any(case.cause in line for line in left_out):
            left_out.append(f"{case.clip.name}, {case.task}: {case.cause}")
    timed = [case for case in results.cases if case.found is not None and case.found.seconds]
    return render_page(
        "study.html",
        title=f"{results.spec.name}: study",
        name=results.spec.name,
        state=f"{state}in all {_format_cost(results.cases) or 'no times kept'}",
        tasks=tasks,
        left_out=left_out,
        notes=_unique(results.facts.get("notes", ())),
        costs=_cost_table(timed) if timed else "",
        facts=_fact_table(results),
        settings=json.dumps(finite(results.settings.model_dump(mode="json")), indent=2),
    )


def _task(task: Task, metrics: Mapping[str, Any], cases: Sequence[Case]) -> dict[str, Any]:
    """Return the card and the section of a task."""
    clips: Mapping[str, Groups] = metrics.get("clips", {})
    groups = [group for group in GROUPS if any(group in clip for clip in clips.values())]
    worst, n_other_faults = find_worst_frames(cases)
    titles = {group: title_of_group(group) for group in groups}
    return {
        "id": task,
        "title": task.capitalize(),
        "meaning": TASKS[task],
        "headline": _headline(task, metrics, groups) if groups else None,
        "cost": _format_cost(cases),
        "n_left_out": sum(case.cause != "" for case in cases),
        "plots": [*(plot for group in groups for plot in _measure_plot(metrics, group)), *ranked_charts(cases)],
        "tables": [
            (title[:1].upper() + title[1:], _measure_table(metrics, group).markup) for group, title in titles.items()
        ],
        "worst": draw_pictures(worst),
        "n_other_faults": n_other_faults,
        "maps": [*maps(cases), *error_clouds(cases)],
        "notes": _unique(f"{case.clip.name}: {note}" for case in cases if case.scored for note in case.scored.notes),
    }


def figure_of(groups: Groups, group: str, measure: str, name: str = "") -> Interval:
    """Return a measure with its interval, NaN if unknown. name: name of the clip or set that it belongs to."""
    low, high = groups.get("intervals", {}).get(group, {}).get(measure) or (None, None)
    value, low, high = (
        math.nan if number is None else float(number) for number in (groups.get(group, {}).get(measure), low, high)
    )
    return Interval(name, value, low, high)


def _known_figures(metrics: Mapping[str, Any], group: str, measure: str) -> list[Interval]:
    """Return the figures of all clips that have the measure."""
    figures = [figure_of(clip, group, measure, name) for name, clip in metrics["clips"].items()]
    return [figure for figure in figures if math.isfinite(figure.value)]


def _shown(metrics: Mapping[str, Any], group: str) -> list[str]:
    """Return the measures of a group's table for which any clip has a value."""
    return [name for name in GROUPS[group].shown if _known_figures(metrics, group, name)]


def study_tables(metrics: Mapping[str, Any]) -> dict[str, ReportTable]:
    """Return the tables of measures by TASK-GROUP. metrics: as for `study_report`."""
    return {
        f"{task}-{group}": _measure_table(mine, group)
        for task, mine in metrics["tasks"].items()
        for group in GROUPS
        if any(group in clip for clip in mine["clips"].values())
    }


def _measure_table(metrics: Mapping[str, Any], group: str) -> ReportTable:
    """Return a row for each clip, then rows for all clips together; each figure with its interval."""
    names = _shown(metrics, group)
    known = [describe(name) for name in names]
    columns = [ReportColumn("clip", text=True), ReportColumn("frames", "frames scored")]
    columns += [ReportColumn(metric.title, metric.meaning) for metric in known]

    def cells(groups: Groups) -> list[Cell]:
        figures = [figure_of(groups, group, name) for name in names]
        return [number_cell(f.value, m.digits, (f.low, f.high)) for f, m in zip(figures, known, strict=True)]

    clips = {name: groups for name, groups in metrics["clips"].items() if group in groups}
    rows = [[text_cell(name), number_cell(groups["frames"]), *cells(groups)] for name, groups in clips.items()]
    whole = {"pooled": metrics["pooled"], "mean over clips": metrics["mean"]} if len(rows) > 1 else {}
    foot = [[text_cell(title), Cell(""), *cells(groups)] for title, groups in whole.items() if group in groups]
    return ReportTable(f"{title_of_group(group)}, clip by clip", columns, rows, foot)


def _measure_plot(metrics: Mapping[str, Any], group: str) -> list[tuple[Markup, str]]:
    """Return a plot of the group's first measure for each clip, worst first, and a note; empty if no clip has it."""
    names = _shown(metrics, group)
    if not names or group == "location":  # its plot would show no more than its table
        return []
    known, rows = describe(names[0]), _known_figures(metrics, group, names[0])
    rows.sort(key=lambda row: -row.value if known.better < 0 else row.value)
    whole = figure_of(metrics["pooled"], group, names[0], "pooled") if len(rows) > 1 else None
    title, span = f"{known.title}, {title_of_group(group)}", (0.0, 1.0 if known.is_share else 0.0)
    more = max(len(rows) - MOST_ROWS, 0)
    note = f"the worst {len(metrics['clips']) - more}; {more} better clips are in the table" if more else ""
    return [(interval_chart(title, rows, whole, span), note)]


def _headline(task: Task, metrics: Mapping[str, Any], groups: Sequence[str]) -> dict[str, str] | None:
    """Return the card of the measure that sums up a task: the measure of HEADLINES that most clips have.

    If no clip has any of them, use the first measure that a clip has; None if there is none.
    """
    of_clips, pooled = metrics["clips"].values(), metrics["pooled"]
    counts = {(group, name): sum(name in clip.get(group, {}) for clip in of_clips) for group, name in HEADLINES[task]}
    named = [pair for pair in counts if counts[pair] == max(counts.values()) > 0]
    named += [(group, name) for group in groups for name in _shown(metrics, group)]
    if not named:
        return None
    group, name = named[0]
    known, figures, whole = describe(name), _known_figures(metrics, group, name), figure_of(pooled, group, name)
    clips = f"one clip: {figures[0].name if figures else 'none'}"
    if len(figures) > 1:
        worst = (max if known.better < 0 else min)(figures, key=lambda figure: figure.value)
        clips = f"pooled over {len(figures)} clips; worst: {worst.name}, {format_number(worst.value, known.digits)}"
    interval = "no interval: too few clips or frames"
    if math.isfinite(whole.low) and math.isfinite(whole.high):
        over = "clips" if pooled["over"].get(group) == "clips" else "blocks of frames"
        ends = (format_number(end, known.digits) for end in (whole.low, whole.high))
        interval = f"95 % interval over {over}: {' to '.join(ends)}"
    is_metres = known.unit == "m"
    return {
        "value": format_number(whole.value, known.digits) if name in pooled.get(group, {}) else "",
        "metric": f"m, {known.meaning.removesuffix(', metres')}"
        if is_metres
        else f"{known.title}, {title_of_group(group)}",
        "meaning": known.meaning,
        "interval": interval,
        "clips": clips,
    }


def _format_cost(cases: Sequence[Case]) -> str:
    """Return the pictures per second, seconds and memory of all cases together; empty if unknown."""
    cost = sum_costs([case for case in cases if case.found is not None and case.found.seconds])
    if not cost["seconds"] or not cost["frames"]:
        return ""
    memory = f", at most {format_number(round(cost['peak_mb']))} MB" if math.isfinite(cost["peak_mb"]) else ""
    return f"{_format_rate(cost['frames_per_s'])} frames/s ({format_number(cost['seconds'], 1)} s){memory}"


def _cost_table(cases: Sequence[Case]) -> Markup:
    """Return a row for each case: time, rate, memory, and the time per frame of the longest stages."""
    costs = [(case, sum_costs([case])) for case in cases]
    total: Counter[str] = Counter()
    for _, cost in costs:
        total.update({stage: ms * cost["frames"] for stage, ms in cost["ms_per_frame"].items()})
    stages = [stage for stage, _ in total.most_common(MAX_STAGES)]
    columns = [
        ReportColumn("clip", text=True),
        ReportColumn("task", text=True),
        ReportColumn("frames", "processed pictures"),
        ReportColumn("s", "seconds in all"),
        ReportColumn("frames/s", "processed pictures per second"),
        ReportColumn("MB", "the largest memory of the process"),
        *(ReportColumn(f"{stage}, ms", "milliseconds a frame") for stage in stages),
    ]
    rows = [
        [
            text_cell(case.clip.name),
            text_cell(case.task.capitalize()),
            number_cell(cost["frames"]),
            number_cell(cost["seconds"], 2),
            Cell(_format_rate(cost["frames_per_s"]), cost["frames_per_s"]) if cost["seconds"] else Cell("–"),
            number_cell(cost["peak_mb"], 0),
            *(number_cell(cost["ms_per_frame"].get(stage), 2) for stage in stages),
        ]
        for case, cost in costs
    ]
    return table("the cost of each clip", columns, rows)


def _format_rate(per_s: float) -> str:
    return format_number(per_s, 0 if per_s >= 100 else 1)


def _fact_table(results: Results) -> Markup:
    """Return the table of data, settings and engine of the study, and the versions of the libraries."""
    spec = results.spec
    facts: dict[str, Any] = {
        "datasets": [f"{source.kind}: {', '.join(source.clips)}" for source in spec.sources],
        "tasks": spec.tasks or ["all tasks that each clip allows"],
        "configuration": spec.config or "defaults",
        "set": spec.overrides or "nothing",
        "interval": f"{spec.interval} frames, of tracking and association",
    }
    for name, fact in results.facts.items():
        if name not in ("faults", "notes"):
            facts[name.replace("backend", "back end")] = fact
    if sets := results.facts.get("datasets"):
        facts["datasets"] = [
            f"{one['kind']} in {one['folder']}, {format_count(int(one['clips']), 'clip')}"
            + (f" ({one['terms']})" if one["terms"] else "")
            for one in sets
        ]
    facts["versions"] = versions()
    rows = [
        [text_cell(name.replace("_", " ")), text_cell(_in_words(value))]
        for name, value in facts.items()
        if value not in ("", [], (), None)
    ]
    return table("what was run", [ReportColumn("what", text=True), ReportColumn("value", text=True)], rows, sorts=False)


def _in_words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_in_words(v)}" for name, v in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(_in_words(v) for v in value)
    return "unknown" if value is None else str(value)


def _unique(lines: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(lines))
