"""report.html of a study: how good, how sure, where it fails, what it cost; one page that opens offline."""

import json
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from torchvision_dddas.evaluation.report.cards import card
from torchvision_dddas.evaluation.report.costs import cost_charts, cost_table, costs_of, summed
from torchvision_dddas.evaluation.report.curves import course_charts, ranked_charts
from torchvision_dddas.evaluation.report.figures import Told, told
from torchvision_dddas.evaluation.report.maps import error_clouds, maps
from torchvision_dddas.evaluation.report.measures import groups_of, measure_plot, measure_table
from torchvision_dddas.evaluation.report.pictures import KEY
from torchvision_dddas.evaluation.report.words import GROUPS, TITLES
from torchvision_dddas.evaluation.report.worst import Worst, drawn, worst_frames
from torchvision_dddas.evaluation.studies.results import Case, Results
from torchvision_dddas.evaluation.studies.spec import TASKS
from torchvision_dddas.io.output.run_record import finite, versions
from torchvision_dddas.io.report import Column, data_url, render_page, table, text_cell

MOST_LEFT_OUT = 200
"""Lines; run.json has them all."""


_ELSEWHERE = ("faults", "notes")  # facts that are not told among the others
_NAVIGATION = '<nav><a href="#costs">costs</a><a href="#settings">what was run, settings, versions</a></nav>'


def report(metrics: Mapping[str, Any], results: Results) -> str:
    """The HTML. metrics: as `studies.summary.summary` has it; pictures are drawn of the clips' files."""
    by_task = {task: [case for case in results.cases if case.task == task] for task in TASKS}
    told_of = {task: told(metrics, task) for task, cases in by_task.items() if cases}
    costs = costs_of(results.cases)
    title = f"{results.spec.name}: study"
    scored = [case for case in results.cases if case.scored is not None]
    clips = len({str(case.clip.place) + case.clip.name for case in scored})
    failed = [case for case in results.cases if case.cause]
    state = f"{_many(clips, 'clip')}, {_many(len(told_of), 'task')}; in all {summed(costs) or 'no times kept'}"
    heading = f"<h1>{escape(results.spec.name)} <span>study</span></h1>"
    parts = [heading, f'<p class="soft">{escape(state)}</p>', _NAVIGATION, '<div class="cards">']
    for task, mine in told_of.items():
        parts.append(card(task, mine, costs, sum(case.cause != "" for case in by_task[task])))
    parts.append("</div>")
    parts += [_left_out(failed, results.left_out), _notes(results.facts.get("notes", ()))]
    for task, mine in told_of.items():
        parts += _task(task, mine, by_task[task])
    parts += _costs(costs)
    parts += _facts(results)
    return render_page("page.html", title=title, parts=[part for part in parts if part])


def _task(task: str, mine: Told, cases: Sequence[Case]) -> list[str]:
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


def _of_set(told: Mapping[str, Any]) -> str:
    """A data set in words: kind, folder, clips, terms of use."""
    where = f"{told.get('kind')} in {told.get('folder')}, {_many(int(told.get('clips', 0)), 'clip')}"
    return where + (f" ({told['terms']})" if told.get("terms") else "")


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
