"""The goal of a sweep: one measure of one task, over the clips."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.registry import groups_of_task, is_lower_better, measure_names
from torchvision_dddas.evaluation.studies.results import Case
from torchvision_dddas.evaluation.studies.spec import TASKS, Task
from torchvision_dddas.evaluation.studies.summary import measures

BY = ("pooled", "mean", "worst")


@dataclass(frozen=True)
class Goal:
    """by: over the counts of all clips (pooled), the mean of the clips' values, or the worst of them."""

    task: Task
    group: str
    measure: str
    by: str = "pooled"

    @property
    def minimize(self) -> bool:
        """Whether less is better."""
        return is_lower_better(self.measure)

    @property
    def name(self) -> str:
        """As `parse_goal` takes it."""
        return f"{self.task}.{self.group}.{self.measure}"


def parse_goal(text: str, by: str = "pooled") -> Goal:
    """A goal from `task.group.measure`. Raises InputError if there is none of that name, or it is a mere count."""
    parts = text.split(".", 2)
    if len(parts) != 3 or not all(parts):
        raise InputError(f"'{text}' is no measure; wanted task.group.measure, such as motion.pixels.f")
    named, group, measure = parts
    task = next((known for known in TASKS if known == named), None)
    if task is None:
        raise InputError(f"'{named}' is no task of a study; wanted {', '.join(TASKS)}")
    if by not in BY:
        raise InputError(f"a goal is over all clips by {', '.join(BY)}; got '{by}'")
    if group not in groups_of_task(task):
        raise InputError(f"'{group}' is no group of measures of {task}; wanted {', '.join(groups_of_task(task))}")
    if measure.startswith("n_") and not is_lower_better(measure):
        raise InputError(f"{measure} is a count, of which neither more nor less is better; wanted a measure")
    if measure not in measure_names(group):
        raise InputError(f"'{measure}' is no measure of {task}.{group}; wanted {', '.join(measure_names(group))}")
    return Goal(task, group, measure, by)


def possible_groups(clip: Clip, task: Task) -> tuple[str, ...]:
    """The groups of measures that a clip's truth allows, of a task that the clip allows."""
    truth = clip.truth
    if task == "motion" and clip.still:
        return ("still",)
    if truth is None or task in ("association", "people", "location"):
        return groups_of_task(task)
    alone = truth.kind == "one target"
    if task == "tracking":
        return ("target_track",) if alone else ("tracks",)
    if truth.kind == "masks":
        return ("pixels", "boxes", "ranking") if truth.labels.separate else ("pixels",)
    return ("target",) if alone else ("boxes", "ranking")


def check_possible(goal: Goal, clips: Sequence[Clip]) -> None:
    """Raises InputError if no clip's truth has the goal's group of measures."""
    having = dict.fromkeys(group for clip in clips for group in possible_groups(clip, goal.task))
    if goal.group not in having:
        there = ", ".join(f"{goal.task}.{group}" for group in having)
        raise InputError(f"no clip has truth for {goal.name}; there is truth for {there or 'nothing'}")


def goal_value(goal: Goal, cases: Sequence[Case]) -> tuple[float, str]:
    """The goal's value; if it has none NaN, and why. Raises InputError if no clip can have such a measure."""
    cases = sorted((case for case in cases if case.task == goal.task), key=lambda case: case.clip.name)
    if lost := [case for case in cases if case.scored is None]:
        # Without its worst clip any setting would look better.
        return math.nan, f"{lost[0].clip.name}: {lost[0].cause}"
    scored = [case.scored for case in cases if case.scored is not None]
    by_clip = [measures([one]) for one in scored]
    if not any(goal.measure in clip.get(goal.group, {}) for clip in by_clip):
        raise InputError(f"no clip has {goal.name}; there are {_known(by_clip) or 'none'}")
    if goal.by == "pooled":
        value = _value(measures(scored), goal)
    else:
        values = [value for clip in by_clip if not math.isnan(value := _value(clip, goal))]
        if not values:
            value = math.nan
        elif goal.by == "mean":
            value = math.fsum(values) / len(values)
        else:
            value = max(values) if goal.minimize else min(values)
    return value, "the measure is not defined here" if math.isnan(value) else ""


def _value(found: Mapping[str, Mapping[str, Any]], goal: Goal) -> float:
    return float(found.get(goal.group, {}).get(goal.measure, math.nan))


def _known(clips: Sequence[Mapping[str, Mapping[str, Any]]]) -> str:
    names = dict.fromkeys(
        f"{group}.{name}"
        for clip in clips
        for group, found in clip.items()
        for name in found
        if not name.startswith("n_") or is_lower_better(name)
    )
    return ", ".join(names)
