"""report.html of a study: how good, how sure, where it fails, what it cost; one page that opens offline."""

import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.report.measures import (
    GROUPS,
    HEADLINES,
    TITLES,
    TaskFigures,
    groups_of,
    measure,
    measure_plot,
    measure_table,
    read_figures,
    shown,
)
from torchvision_dddas.evaluation.report.task_charts import course_charts, error_clouds, maps, ranked_charts
from torchvision_dddas.evaluation.report.worst_frames import KEY, Worst, drawn, worst_frames
from torchvision_dddas.evaluation.studies.results import Case, Results
from torchvision_dddas.evaluation.studies.spec import TASKS, Task
from torchvision_dddas.io.images import IMAGE_SUFFIXES, read_image
from torchvision_dddas.io.output.run_record import finite, versions
from torchvision_dddas.io.report import (
    Axis,
    Cell,
    Column,
    Dots,
    chart,
    data_url,
    format_number,
    number_cell,
    render_page,
    table,
    text_cell,
)
from torchvision_dddas.io.sources import open_source

MOST_LEFT_OUT = 200
"""Lines; run.json has them all."""


_ELSEWHERE = ("faults", "notes")  # facts that have a place of their own
_NAVIGATION = '<nav><a href="#costs">costs</a><a href="#settings">what was run, settings, versions</a></nav>'


def report(metrics: Mapping[str, Any], results: Results) -> str:
    """The HTML. metrics: as `studies.summary.summary` has it; pictures are drawn of the clips' files."""
    by_task = {task: [case for case in results.cases if case.task == task] for task in TASKS}
    figures_by_task = {task: read_figures(metrics, task) for task, cases in by_task.items() if cases}
    costs = costs_of(results.cases)
    title = f"{results.spec.name}: study"
    scored = [case for case in results.cases if case.scored is not None]
    clips = len({str(case.clip.place) + case.clip.name for case in scored})
    failed = [case for case in results.cases if case.cause]
    state = f"{_many(clips, 'clip')}, {_many(len(figures_by_task), 'task')}; in all {summed(costs) or 'no times kept'}"
    heading = f"<h1>{escape(results.spec.name)} <span>study</span></h1>"
    parts = [heading, f'<p class="soft">{escape(state)}</p>', _NAVIGATION, '<div class="cards">']
    for task, mine in figures_by_task.items():
        parts.append(card(task, mine, costs, sum(case.cause != "" for case in by_task[task])))
    parts.append("</div>")
    parts += [_left_out(failed, results.left_out), _notes(results.facts.get("notes", ()))]
    for task, mine in figures_by_task.items():
        parts += _task(task, mine, by_task[task])
    parts += _costs(costs)
    parts += _facts(results)
    return render_page("page.html", title=title, parts=[part for part in parts if part])


def _task(task: str, mine: TaskFigures, cases: Sequence[Case]) -> list[str]:
    parts = [f'<h2 id="{task}">{TITLES[task]}</h2>', f'<p class="soft">{escape(TASKS[task])}</p>']  # type: ignore[index]
    frames = {case.clip.name: len(case.scored.frames) for case in cases if case.scored is not None}
    plots = []
    for group in groups_of(mine):
        plot, more = measure_plot(mine, group)
        note = f"the worst {len(mine.clips) - more}; {more} better ones are in the table" if more else ""
        plots += [_plot(plot, note)] if plot else []
    plots += [_plot(chart) for chart in ranked_charts(cases)]
    parts += ['<div class="plots">', *plots, "</div>"] if plots else []
    for group in groups_of(mine):
        parts += [f"<h3>{escape(_capital(GROUPS.get(group, group)))}</h3>", measure_table(mine, group, frames)]
    chosen, others = worst_frames(cases)
    if chosen:
        parts += _pictures(chosen, others)
    ordered = sorted(cases, key=lambda case: _rank(case, chosen))
    if courses := course_charts(ordered):
        more = len([case for case in cases if case.scored is not None]) - len(courses)
        note = f'<p class="note">{_many(more, "other clip")} not drawn.</p>' if more > 0 else ""
        parts += ["<h3>As the clips go on</h3>", '<div class="plots">', *(_plot(c) for c in courses), "</div>", note]
    if seen := [*maps(cases), *error_clouds(cases)]:
        parts += ["<h3>Maps</h3>", '<div class="plots">', *(_plot(one) for one in seen), "</div>"]
    notes = [f"{case.clip.name}: {note}" for case in cases if case.scored for note in case.scored.notes]
    parts.append(_notes(notes))
    return parts


def _pictures(chosen: Sequence[Worst], others: int) -> list[str]:
    left = f"; {_many(others, 'other frame')} with a fault left out" if others else ""
    key = "".join(
        f'<li><svg viewBox="0 0 26 16" aria-hidden="true">{sign}</svg>{escape(name)}</li>' for name, sign in KEY
    )
    figures = [_figure(one) for one in drawn(chosen)]
    return [
        "<h3>Where it went worst</h3>",
        f'<p class="note">{_many(len(chosen), "frame")}, at most three of a clip{left}.</p>',
        f'<ul class="key">{key}</ul>',
        '<div class="pictures">',
        *figures,
        "</div>",
    ]


def _figure(one: Worst) -> str:
    when = f"{one.case.clip.name}, frame {one.frame}"
    bare = "" if one.case.clip.pictures else " (a clip without pictures)"
    words_of_it = f"<figcaption><b>{escape(when)}</b>: {escape(one.words)}{bare}</figcaption>"
    if one.pair is None:
        return (
            f'<figure><p class="note">no picture: {escape(one.trouble or "nothing to draw")}</p>{words_of_it}</figure>'
        )
    sides = "".join(
        f'<div><span>{what}</span><img loading="lazy" alt="{escape(f"{what} of {when}: {one.words}")}" '
        f'src="{data_url(jpeg)}"></div>'
        for what, jpeg in (("truth", one.pair.truth), ("result", one.pair.result))
    )
    return f'<figure><div class="pair">{sides}</div>{words_of_it}</figure>'


def _notes(notes: Sequence[str]) -> str:
    if not notes:
        return ""
    items = "".join(f"<li>{escape(line)}</li>" for line in dict.fromkeys(notes))
    return f"<details><summary>Notes ({len(dict.fromkeys(notes))})</summary><ul>{items}</ul></details>"


def _left_out(failed: Sequence[Case], left_out: Sequence[str]) -> str:
    lines = list(left_out)
    lines += [f"{c.clip.name}, {c.task}: {c.cause}" for c in failed if not any(c.cause in line for line in lines)]
    if not lines:
        return ""
    items = "".join(f"<li>{escape(line)}</li>" for line in lines[:MOST_LEFT_OUT])
    more = f'<p class="note">and {len(lines) - MOST_LEFT_OUT} more</p>' if len(lines) > MOST_LEFT_OUT else ""
    folded = "" if len(lines) > 8 else " open"
    head = f'<summary class="bad">Left out ({len(lines)})</summary>'
    return f'<details id="left-out"{folded}>{head}<ul>{items}</ul>{more}</details>'


def _costs(costs: Sequence[Any]) -> list[str]:
    if not costs:
        return []
    plots = [_plot(one) for one in cost_charts(costs)]
    return [
        '<h2 id="costs">Costs</h2>',
        '<p class="soft">Seconds of computing, when and where it was done; a result that was kept has its own.</p>',
        *(['<div class="plots">', *plots, "</div>"] if plots else []),
        cost_table(costs),
    ]


def _facts(results: Results) -> list[str]:
    spec = results.spec
    said = {
        "datasets": [f"{source.kind}: {', '.join(source.clips)}" for source in spec.sources],
        "tasks": spec.tasks or ["all that each clip allows"],
        "configuration": spec.config or "defaults",
        "set": spec.overrides or "nothing",
        "interval": f"{spec.interval} frames, of tracking and association",
        **{name.replace("backend", "back end"): fact for name, fact in results.facts.items() if name not in _ELSEWHERE},
        "versions": versions(),
    }
    said["datasets"] = [_of_set(one) for one in results.facts.get("datasets", ())] or said["datasets"]
    said = {name: value for name, value in said.items() if value not in ("", [], (), None)}
    rows = [[text_cell(name.replace("_", " ")), text_cell(_in_words(value))] for name, value in said.items()]
    settings = json.dumps(finite(results.settings.model_dump(mode="json")), indent=2)
    return [
        '<h2 id="settings">What was run</h2>',
        table("what was run", [Column("what", text=True), Column("value", text=True)], rows, sorts=False),
        f'<details><summary>Settings in force</summary><pre tabindex="0">{escape(settings)}</pre></details>',
    ]


def _of_set(source: Mapping[str, Any]) -> str:
    """A data set in words: kind, folder, clips, terms of use."""
    where = f"{source.get('kind')} in {source.get('folder')}, {_many(int(source.get('clips', 0)), 'clip')}"
    return where + (f" ({source['terms']})" if source.get("terms") else "")


def _plot(svg: str, note: str = "") -> str:
    return f"<figure>{svg}{f'<figcaption>{escape(note)}</figcaption>' if note else ''}</figure>"


def _rank(case: Case, chosen: Sequence[Worst]) -> int:
    """Clips with a worst frame first, in the order of these."""
    return next((k for k, one in enumerate(chosen) if one.case is case), len(chosen))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _many(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _in_words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_in_words(v)}" for name, v in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(_in_words(v) for v in value)
    return "unknown" if value is None else str(value)


MOST_STAGES = 8


class Cost(NamedTuple):
    """Of a case: seconds in all and by stage, pictures looked at, megabytes, megapixels of a picture (NaN: unknown)."""

    case: Case
    seconds: float
    stages: dict[str, float]
    images: int
    peak_mb: float
    megapixels: float


def costs_of(cases: Sequence[Case]) -> list[Cost]:
    """What each case that has times cost; the size of a clip's pictures is read off the first of them."""
    sizes: dict[str, float] = {}
    costs = []
    for case in cases:
        if case.found is None or not case.found.seconds:
            continue
        name = str(case.clip.place) + case.clip.name
        if name not in sizes:
            sizes[name] = _megapixels(case)
        stages = dict(case.found.seconds)
        costs.append(Cost(case, sum(stages.values()), stages, len(case.found.looked), case.found.peak_mb, sizes[name]))
    return costs


def summed(costs: Sequence[Cost], task: Task | None = None) -> str:
    """In words: images a second, and the memory, of one task or all."""
    mine = [cost for cost in costs if task is None or cost.case.task == task]
    seconds, images = sum(cost.seconds for cost in mine), sum(cost.images for cost in mine)
    if not seconds or not images:
        return ""
    peaks = [cost.peak_mb for cost in mine if np.isfinite(cost.peak_mb)]
    memory = f", at most {format_number(round(max(peaks)))} MB" if peaks else ""
    return f"{_rate(images / seconds)} frames/s ({format_number(seconds, 1)} s){memory}"


def cost_table(costs: Sequence[Cost]) -> str:
    """A row a case: time, rate, memory, and the time of its longest stages a frame."""
    total: dict[str, float] = {}
    for cost in costs:
        for stage, spent in cost.stages.items():
            total[stage] = total.get(stage, 0.0) + spent
    stages = sorted(total, key=lambda stage: -total[stage])[:MOST_STAGES]
    columns = [
        Column("clip", text=True),
        Column("task", text=True),
        Column("frames", "pictures looked at"),
        Column("Mpx", "millions of pixels of a picture"),
        Column("s", "seconds in all"),
        Column("frames/s", "pictures looked at in a second"),
        Column("MB", "the most memory that the process held"),
        *(Column(f"{stage}, ms", "milliseconds a frame") for stage in stages),
    ]
    rows = []
    for cost in costs:
        each = max(cost.images, 1)
        rows.append(
            [
                text_cell(cost.case.clip.name),
                text_cell(TITLES[cost.case.task]),
                number_cell(cost.images),
                number_cell(cost.megapixels, 2),
                number_cell(cost.seconds, 2),
                Cell(_rate(cost.images / cost.seconds), cost.images / cost.seconds) if cost.seconds else Cell("–"),
                number_cell(cost.peak_mb, 0),
                *(number_cell(1000 * cost.stages[s] / each if s in cost.stages else None, 2) for s in stages),
            ]
        )
    return table("what each clip cost", columns, rows)


def cost_charts(costs: Sequence[Cost]) -> list[str]:
    """Milliseconds a frame against the size of the pictures, of each task that looks at pictures."""
    dots = []
    for k, task in enumerate(TITLES):
        mine = [c for c in costs if c.case.task == task and np.isfinite(c.megapixels) and c.images]
        if mine:
            each_ms = [1000 * c.seconds / c.images for c in mine]
            said = [
                f"{c.case.clip.name}: {format_number(c.megapixels, 2)} Mpx, {format_number(ms, 1)} ms"
                for c, ms in zip(mine, each_ms, strict=True)
            ]
            dots.append(Dots(TITLES[task], np.array([c.megapixels for c in mine]), np.array(each_ms), k % 6 + 1, said))
    if not dots:
        return []
    return [chart("Time and resolution", Axis("megapixels of a picture", 0), Axis("ms a frame", log=True), dots=dots)]


def _rate(each_second: float) -> str:
    return format_number(each_second, 0 if each_second >= 100 else 1)


def _megapixels(case: Case) -> float:
    files = case.clip.pictures
    if not files:
        return float("nan")
    try:
        if files[0].suffix.lower() in IMAGE_SUFFIXES:
            picture = read_image(files[0])
            return float("nan") if picture is None else picture.shape[0] * picture.shape[1] / 1e6
        width, height = open_source(files[0]).size
    except InputError:
        return float("nan")
    return width * height / 1e6


def card(task: Task, figures: TaskFigures, costs: Sequence[Cost], left_out: int) -> str:
    """A task at a glance; it leads to the task's section."""
    parts = [f'<h3><a href="#{task}">{TITLES[task]}</a></h3>']
    chosen = headline(task, figures)
    if chosen is None:
        parts.append("<p>no measure</p>")
    else:
        group, name = chosen
        known = measure(name)
        whole = figures.pooled.get(group, {}).get(name)
        if whole is not None:
            meaning = f' title="{escape(known.meaning)}"' if known.meaning else ""
            metres = name.endswith("_m")
            what = (
                f"m, {known.meaning.removesuffix(', metres')}"
                if metres
                else f"{known.name}, {GROUPS.get(group, group)}"
            )
            big = f"{format_number(whole.value, known.digits)} <span{meaning}>{escape(what)}</span>"
            parts.append(f'<div class="big">{big}</div>')
            if math.isfinite(whole.low) and math.isfinite(whole.high):
                ends = f"{format_number(whole.low, known.digits)} to {format_number(whole.high, known.digits)}"
                over = "clips" if figures.over.get(group) == "clips" else "blocks of frames"
                parts.append(f"<p>95 % interval over {over}: {ends}</p>")
            else:
                parts.append("<p>no interval: too few clips or frames</p>")
        parts.append(f"<p>{_over(figures, group, name)}</p>")
    if cost := summed(costs, task):
        parts.append(f'<p class="soft">{escape(cost)}</p>')
    if left_out:
        parts.append(f'<p class="bad">{left_out} left out, see <a href="#left-out">below</a></p>')
    return f'<section class="card">{"".join(parts)}</section>'


def headline(task: Task, figures: TaskFigures) -> tuple[str, str] | None:
    """The group and measure that a task is judged by: the first of HEADLINES that most clips have."""
    wanted = [
        pair for pair in HEADLINES[task] if any(pair[1] in clip.get(pair[0], {}) for clip in figures.clips.values())
    ]
    if wanted:
        return max(wanted, key=lambda pair: sum(pair[1] in clip.get(pair[0], {}) for clip in figures.clips.values()))
    for group in groups_of(figures):
        if names := shown(figures, group):
            return group, names[0]
    return None


def _over(figures: TaskFigures, group: str, name: str) -> str:
    """Over how many clips, and which is the worst."""
    values: Mapping[str, float] = {
        clip: groups[group][name].value
        for clip, groups in figures.clips.items()
        if name in groups.get(group, {}) and math.isfinite(groups[group][name].value)
    }
    if len(values) < 2:
        return f"one clip: {escape(next(iter(values), 'none'))}"
    known = measure(name)
    worst = (max if known.better < 0 else min)(values, key=lambda clip: values[clip])
    return f"pooled over {len(values)} clips; worst: {escape(worst)}, {format_number(values[worst], known.digits)}"
