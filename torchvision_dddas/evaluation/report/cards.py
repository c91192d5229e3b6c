"""What the page says first: of each task how good, how sure, where it fails, and what it cost."""

import math
from collections.abc import Mapping, Sequence
from html import escape

from torchvision_dddas.evaluation.report.costs import Cost, summed
from torchvision_dddas.evaluation.report.figures import Told
from torchvision_dddas.evaluation.report.measures import groups_of, shown
from torchvision_dddas.evaluation.report.words import GROUPS, HEADLINES, TITLES, measure
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.io.report import format_number


def card(task: Task, told: Told, costs: Sequence[Cost], left_out: int) -> str:
    """A task at a glance; it leads to the task's section."""
    parts = [f'<h3><a href="#{task}">{TITLES[task]}</a></h3>']
    chosen = headline(task, told)
    if chosen is None:
        parts.append("<p>no measure</p>")
    else:
        group, name = chosen
        known = measure(name)
        whole = told.pooled.get(group, {}).get(name)
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
                over = "clips" if told.over.get(group) == "clips" else "blocks of frames"
                parts.append(f"<p>95 % interval over {over}: {ends}</p>")
            else:
                parts.append("<p>no interval: too few clips or frames</p>")
        parts.append(f"<p>{_over(told, group, name)}</p>")
    if cost := summed(costs, task):
        parts.append(f'<p class="soft">{escape(cost)}</p>')
    if left_out:
        parts.append(f'<p class="bad">{left_out} left out, see <a href="#left-out">below</a></p>')
    return f'<section class="card">{"".join(parts)}</section>'


def headline(task: Task, told: Told) -> tuple[str, str] | None:
    """The group and measure that a task is judged by: the first of HEADLINES that most clips have."""
    wanted = [pair for pair in HEADLINES[task] if any(pair[1] in clip.get(pair[0], {}) for clip in told.clips.values())]
    if wanted:
        return max(wanted, key=lambda pair: sum(pair[1] in clip.get(pair[0], {}) for clip in told.clips.values()))
    for group in groups_of(told):
        if names := shown(told, group):
            return group, names[0]
    return None


def _over(told: Told, group: str, name: str) -> str:
    """Over how many clips, and which is the worst."""
    values: Mapping[str, float] = {
        clip: groups[group][name].value
        for clip, groups in told.clips.items()
        if name in groups.get(group, {}) and math.isfinite(groups[group][name].value)
    }
    if len(values) < 2:
        return f"one clip: {escape(next(iter(values), 'none'))}"
    known = measure(name)
    worst = (max if known.better < 0 else min)(values, key=lambda clip: values[clip])
    return f"pooled over {len(values)} clips; worst: {escape(worst)}, {format_number(values[worst], known.digits)}"
