"""The effect of tuning: the study before and after, with hard operations, on tuned and on held-out clips."""

import glob
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torchvision_dddas.config import load_config, with_parameters
from torchvision_dddas.lab.evaluation.studies.comparison import compare_studies, verdict
from torchvision_dddas.lab.evaluation.studies.jobs import JobEvent, Workers
from torchvision_dddas.lab.evaluation.studies.records import Case, ScoredCase, ScoredStudy, Spec
from torchvision_dddas.lab.evaluation.studies.runner import StudyPlan, run_study
from torchvision_dddas.lab.evaluation.studies.summary import Goal, goal_value
from torchvision_dddas.lab.evaluation.studies.sweep import format_value, toml_value

TIMES = "before", "after"

Shown = Callable[[], AbstractContextManager[tuple[Callable[[StudyPlan], object], Callable[[JobEvent], object]]]]
"""Shows the progress of a study: functions to call at its beginning and at each of its events."""


@dataclass(frozen=True)
class Side:
    """One set of clips. pooled, mean: the goal before and after, over all counts and over the clips' values.

    says: whether the pooled goal is better or worse beyond noise, or neither; no other question is asked. changes:
    every measure and clip, as from `compare_studies`, corrected for the number of comparisons; None if nothing can be
    compared. frame_ms: time for a frame before and after, if it was computed. notes: clips without a result, and why.
    """

    clips: tuple[str, ...]
    pooled: tuple[float, float]
    mean: tuple[float, float]
    says: str
    changes: Mapping[str, Any] | None
    frame_ms: tuple[float, float]
    notes: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the dictionary that run.json holds."""
        pairs = {name: dict(zip(TIMES, getattr(self, name), strict=True)) for name in ("pooled", "mean", "frame_ms")}
        return vars(self) | pairs


@dataclass(frozen=True)
class Verdict:
    """The effect of tuning on the clips that were tuned on, and on the held-out clips; None without held-out clips."""

    goal: Goal
    tuned: Side
    held: Side | None

    def lines(self) -> list[str]:
        """Return the effect of tuning, one line for each set of clips."""
        lines = []
        for name, side in {"Tuned on": self.tuned, "Held out": self.held}.items():
            if side is not None:
                pooled, mean = (" -> ".join(map(format_value, pair)) for pair in (side.pooled, side.mean))
                mean = f", mean of clips {mean}" if len(side.clips) > 1 else ""
                says = f": {side.says}" if side.says else ""
                lines.append(f"{name} ({count_clips(side.clips)}): {self.goal.measure} {pooled}{mean}{says}")
        return lines

    def as_json(self) -> dict[str, Any]:
        """Return the dictionary that run.json holds."""
        sides = {"tuned": self.tuned.as_json(), "held_out": None if self.held is None else self.held.as_json()}
        return {"measure": self.goal.name, "better": "less" if self.goal.minimize else "more", **sides}


def judge(
    spec: Spec,
    base: Path,
    goal: Goal,
    parameters: Mapping[str, object],
    tuned: Sequence[str],
    held: Sequence[str] = (),
    jobs: int | None = None,
    cache: Path | None = None,
    shown: Shown = lambda: nullcontext((lambda planned: None, lambda event: None)),
) -> Verdict:
    """Run a study with its own and with other values of some parameters; once if no value changed. tuned, held: clips.

    spec, base, cache: as for `run_study`. jobs: as for `Workers`. Raise InputError as they do, and if no clip can have
    the goal's measure.
    """
    settings = load_config(spec.config, spec.overrides)
    is_changed = with_parameters(settings, parameters) != settings
    changed = tuple(f"{name}={toml_value(value)}" for name, value in parameters.items())
    names, cases = [glob.escape(name) for name in (*tuned, *held)], []
    with Workers(jobs) as workers:
        for more in ((), changed)[: 1 + is_changed]:
            one = replace(spec, tasks=(goal.task,), overrides=(*spec.overrides, *more))
            with shown() as (begun, tell):
                cases.append(run_study(one, base, workers, cache, names, tell, begun).cases)
    cases = cases if is_changed else 2 * cases
    sides = [
        _compare(goal, [[case for case in found if case.clip.name in clips] for found in cases], tuple(clips))
        for clips in (tuned, held)
        if clips
    ]
    if not is_changed:
        sides = [replace(side, says="no change", frame_ms=(side.frame_ms[0], math.nan)) for side in sides]
    return Verdict(goal, sides[0], sides[1] if len(sides) > 1 else None)


def _compare(goal: Goal, cases: Sequence[Sequence[Case]], clips: tuple[str, ...]) -> Side:
    """Compare the goal before and after. cases: results of these clips, before and after."""
    notes = {
        f"{case.clip.name}, {when}: {case.cause}"
        for when, found in zip(TIMES, cases, strict=True)
        for case in found
        if case.cause
    }
    # Leave out a clip from both sides if it fails with one of the two settings.
    good = set.intersection(*({case.clip.name for case in found if case.scored is not None} for found in cases))
    pairs = [[case for case in found if case.clip.name in good] for found in cases]
    pooled, mean = (
        [goal_value(replace(goal, by=by), found)[0] if good else math.nan for found in pairs]
        for by in ("pooled", "mean")
    )
    studies = [
        ScoredStudy(when, tuple(ScoredCase(c.task, c.clip.name, c.scored) for c in found if c.scored is not None))
        for when, found in zip(TIMES, pairs, strict=True)
    ]
    frame_ms = []
    for found in pairs:
        results = [case.found for case in found if case.found is not None]
        seconds, frames = sum(sum(r.seconds.values()) for r in results), sum(len(r.looked) for r in results)
        frame_ms.append(1000 * seconds / frames if frames else math.nan)
    changes = compare_studies(*studies) if good else None
    says = _say_change(goal, changes)
    return Side(
        clips,
        (pooled[0], pooled[1]),
        (mean[0], mean[1]),
        says,
        changes,
        (frame_ms[0], frame_ms[1]),
        tuple(sorted(notes)),
    )


def _say_change(goal: Goal, changes: Mapping[str, Any] | None) -> str:
    """Return the verdict of `compare_studies` on the goal's measure, without the correction for many measures."""
    entry = (changes or {"tasks": {}})["tasks"].get(goal.task, {"pooled": {}})["pooled"].get(goal.group, {})
    entry = entry.get(goal.measure)
    return "" if entry is None else verdict(entry, goal.measure, "p")


def count_clips(clips: Sequence[str]) -> str:
    """Return `1 clip`, `2 clips`, ..."""
    return f"{len(clips)} clip{'s' * (len(clips) != 1)}"
