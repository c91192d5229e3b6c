"""report.html of a study: how good, how sure, where it fails, what it cost; one page that opens offline."""

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.registry import HEADLINES, describe, title_of_group
from torchvision_dddas.evaluation.report.measures import (
    TITLES,
    TaskFigures,
    groups_of,
    measure_plot,
    measure_table,
    read_figures,
    shown,
)
from torchvision_dddas.evaluation.report.task_charts import course_charts, error_clouds, maps, ranked_charts
from torchvision_dddas.evaluation.report.worst_frames import Worst, draw_pictures, find_worst_frames
from torchvision_dddas.evaluation.studies.results import Case, Results
from torchvision_dddas.evaluation.studies.spec import TASKS, Task
from torchvision_dddas.evaluation.studies.summary import sum_costs
from torchvision_dddas.io.images import IMAGE_SUFFIXES, read_image
from torchvision_dddas.io.output.run_record import finite, versions
from torchvision_dddas.io.report import (
    Axis,
    Cell,
    Column,
    Dots,
    chart,
    format_count,
    format_number,
    number_cell,
    render_page,
    table,
    text_cell,
)
from torchvision_dddas.io.sources import open_source

MAX_STAGES = 8
"""Columns of the table of costs."""


def study_report(metrics: Mapping[str, Any], results: Results) -> str:
    """The HTML. metrics: as `summarize` returns them, NaN as None; pictures are read from the clips' files."""
    by_task = {task: [case for case in results.cases if case.task == task] for task in TASKS}
    tasks = [_task(task, read_figures(metrics, task), cases) for task, cases in by_task.items() if cases]
    n_clips = len({str(case.clip.place) + case.clip.name for case in results.cases if case.scored is not None})
    state = f"{format_count(n_clips, 'clip')}, {format_count(len(tasks), 'task')}; "
    left_out = list(results.left_out)
    for case in results.cases:
        if case.cause and not any(case.cause in line for line in left_out):
            left_out.append(f"{case.clip.name}, {case.task}: {case.cause}")
    costs = _costs(results.cases)
    return render_page(
        "study.html",
        title=f"{results.spec.name}: study",
        name=results.spec.name,
        state=f"{state}in all {_format_cost(results.cases) or 'no times kept'}",
        tasks=tasks,
        left_out=left_out,
        notes=_unique(results.facts.get("notes", ())),
        costs=_cost_table(costs) if costs else "",
        cost_plots=_cost_plots(costs),
        facts=_fact_table(results),
        settings=json.dumps(finite(results.settings.model_dump(mode="json")), indent=2),
    )


def _task(task: Task, figures: TaskFigures, cases: Sequence[Case]) -> dict[str, Any]:
    """What the page shows of a task: its card and its section."""
    frames = {case.clip.name: len(case.scored.frames) for case in cases if case.scored is not None}
    groups = groups_of(figures)
    plots: list[Any] = []
    for group in groups:
        plot, more = measure_plot(figures, group)
        note = f"the worst {len(figures.clips) - more}; {more} better ones are in the table" if more else ""
        plots += [(plot, note)] if plot else []
    worst, n_other_faults = find_worst_frames(cases)
    courses = course_charts(sorted(cases, key=lambda case: _rank(case, worst)))
    return {
        "id": task,
        "title": TITLES[task],
        "meaning": TASKS[task],
        "headline": _headline(task, figures),
        "cost": _format_cost(cases),
        "n_left_out": sum(case.cause != "" for case in cases),
        "plots": [*plots, *ranked_charts(cases)],
        "tables": [(_capital(title_of_group(group)), measure_table(figures, group, frames)) for group in groups],
        "worst": draw_pictures(worst),
        "n_other_faults": n_other_faults,
        "courses": courses,
        "n_courses_left_out": len(frames) - len(courses),
        "maps": [*maps(cases), *error_clouds(cases)],
        "notes": _unique(f"{case.clip.name}: {note}" for case in cases if case.scored for note in case.scored.notes),
    }


def _headline(task: Task, figures: TaskFigures) -> dict[str, str] | None:
    """The measure that a task is judged by, as its card shows it; None if the task has none."""
    chosen = _headline_measure(task, figures)
    if chosen is None:
        return None
    group, name = chosen
    known, pooled = describe(name), figures.pooled.get(group, {}).get(name)
    found = {"value": "", "clips": _clips_in_words(figures, group, name), "meaning": known.meaning}
    if pooled is not None:
        found["value"] = format_number(pooled.value, known.digits)
        found["metric"] = f"{known.title}, {title_of_group(group)}"
        if known.unit == "m":
            found["metric"] = f"m, {known.meaning.removesuffix(', metres')}"
        found["interval"] = "no interval: too few clips or frames"
        if math.isfinite(pooled.low) and math.isfinite(pooled.high):
            over = "clips" if figures.over.get(group) == "clips" else "blocks of frames"
            ends = (format_number(end, known.digits) for end in (pooled.low, pooled.high))
            found["interval"] = f"95 % interval over {over}: {' to '.join(ends)}"
    return found


def _headline_measure(task: Task, figures: TaskFigures) -> tuple[str, str] | None:
    """The group and name of that of HEADLINES that most clips have, else of the first measure that any has."""
    count = {
        (group, name): sum(name in clip.get(group, {}) for clip in figures.clips.values())
        for group, name in HEADLINES[task]
    }
    if any(count.values()):
        return max(count, key=lambda pair: count[pair])
    for group in groups_of(figures):
        if names := shown(figures, group):
            return group, names[0]
    return None


def _clips_in_words(figures: TaskFigures, group: str, name: str) -> str:
    """How many clips have a measure, and which is the worst."""
    values: Mapping[str, float] = {
        clip: groups[group][name].value
        for clip, groups in figures.clips.items()
        if name in groups.get(group, {}) and math.isfinite(groups[group][name].value)
    }
    if len(values) < 2:
        return f"one clip: {next(iter(values), 'none')}"
    known = describe(name)
    worst = (max if known.better < 0 else min)(values, key=lambda clip: values[clip])
    return f"pooled over {len(values)} clips; worst: {worst}, {format_number(values[worst], known.digits)}"


def _rank(case: Case, worst: Sequence[Worst]) -> int:
    """Clips with a worst frame first, in the order of these."""
    return next((k for k, one in enumerate(worst) if one.case is case), len(worst))


def _costs(cases: Sequence[Case]) -> list[tuple[Case, dict[str, Any], float]]:
    """Each case that has times, its cost, and the megapixels of its pictures (NaN: unknown)."""
    sizes: dict[str, float] = {}
    costs = []
    for case in cases:
        if case.found is not None and case.found.seconds:
            name = str(case.clip.place) + case.clip.name
            if name not in sizes:
                sizes[name] = _megapixels(case)
            costs.append((case, sum_costs([case]), sizes[name]))
    return costs


def _format_cost(cases: Sequence[Case]) -> str:
    """The images a second, seconds and memory of all cases together; empty if unknown."""
    cost = sum_costs([case for case in cases if case.found is not None and case.found.seconds])
    if not cost["seconds"] or not cost["frames"]:
        return ""
    memory = f", at most {format_number(round(cost['peak_mb']))} MB" if math.isfinite(cost["peak_mb"]) else ""
    return f"{_format_rate(cost['frames_per_s'])} frames/s ({format_number(cost['seconds'], 1)} s){memory}"


def _cost_table(costs: Sequence[tuple[Case, dict[str, Any], float]]) -> Markup:
    """A row a case: time, rate, memory, and the time a frame of the longest stages."""
    total: Counter[str] = Counter()
    for _, cost, _ in costs:
        total.update({stage: ms * cost["frames"] for stage, ms in cost["ms_per_frame"].items()})
    stages = [stage for stage, _ in total.most_common(MAX_STAGES)]
    columns = [
        Column("clip", text=True),
        Column("task", text=True),
        Column("frames", "processed pictures"),
        Column("Mpx", "millions of pixels of a picture"),
        Column("s", "seconds in all"),
        Column("frames/s", "processed pictures a second"),
        Column("MB", "the most memory that the process held"),
        *(Column(f"{stage}, ms", "milliseconds a frame") for stage in stages),
    ]
    rows = [
        [
            text_cell(case.clip.name),
            text_cell(TITLES[case.task]),
            number_cell(cost["frames"]),
            number_cell(megapixels, 2),
            number_cell(cost["seconds"], 2),
            Cell(_format_rate(cost["frames_per_s"]), cost["frames_per_s"]) if cost["seconds"] else Cell("–"),
            number_cell(cost["peak_mb"], 0),
            *(number_cell(cost["ms_per_frame"].get(stage), 2) for stage in stages),
        ]
        for case, cost, megapixels in costs
    ]
    return table("what each clip cost", columns, rows)


def _cost_plots(costs: Sequence[tuple[Case, dict[str, Any], float]]) -> list[Markup]:
    """Milliseconds a frame against the size of the pictures, of each task that reads pictures."""
    dots = []
    for k, task in enumerate(TITLES):
        mine = [
            (case.clip.name, megapixels, 1000 * cost["seconds"] / cost["frames"])
            for case, cost, megapixels in costs
            if case.task == task and math.isfinite(megapixels) and cost["frames"]
        ]
        if mine:
            hints = [f"{clip}: {format_number(mpx, 2)} Mpx, {format_number(ms, 1)} ms" for clip, mpx, ms in mine]
            sizes, times = (np.array(values) for values in list(zip(*mine, strict=True))[1:])
            dots.append(Dots(TITLES[task], sizes, times, k % 6 + 1, hints))
    axes = Axis("megapixels of a picture", 0), Axis("ms a frame", log=True)
    return [chart("Time and resolution", *axes, dots=dots)] if dots else []


def _megapixels(case: Case) -> float:
    """The size of a clip's first picture; NaN if it cannot be read."""
    files = case.clip.pictures
    try:
        if not files:
            return math.nan
        if files[0].suffix.lower() in IMAGE_SUFFIXES:
            picture = read_image(files[0])
            return math.nan if picture is None else picture.shape[0] * picture.shape[1] / 1e6
        return math.prod(open_source(files[0]).size) / 1e6
    except InputError:
        return math.nan


def _format_rate(per_s: float) -> str:
    return format_number(per_s, 0 if per_s >= 100 else 1)


def _fact_table(results: Results) -> Markup:
    """What was run on what, and the versions of the libraries."""
    spec = results.spec
    facts: dict[str, Any] = {
        "datasets": [f"{source.kind}: {', '.join(source.clips)}" for source in spec.sources],
        "tasks": spec.tasks or ["all that each clip allows"],
        "configuration": spec.config or "defaults",
        "set": spec.overrides or "nothing",
        "interval": f"{spec.interval} frames, of tracking and association",
    }
    facts |= {
        name.replace("backend", "back end"): fact
        for name, fact in results.facts.items()
        if name not in ("faults", "notes")
    }
    if sets := results.facts.get("datasets"):
        facts["datasets"] = [_format_dataset(one) for one in sets]
    facts["versions"] = versions()
    rows = [
        [text_cell(name.replace("_", " ")), text_cell(_in_words(value))]
        for name, value in facts.items()
        if value not in ("", [], (), None)
    ]
    return table("what was run", [Column("what", text=True), Column("value", text=True)], rows, sorts=False)


def _format_dataset(source: Mapping[str, Any]) -> str:
    """A data set in words: kind, folder, clips, terms of use."""
    where = f"{source.get('kind')} in {source.get('folder')}, {format_count(int(source.get('clips', 0)), 'clip')}"
    return where + (f" ({source['terms']})" if source.get("terms") else "")


def _in_words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_in_words(v)}" for name, v in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(_in_words(v) for v in value)
    return "unknown" if value is None else str(value)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _unique(lines: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(lines))
