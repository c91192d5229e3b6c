"""What tuning was worth: the study before and after, hard operations, on the clips tuned on and on those held out."""

import glob
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torchvision_dddas.evaluation.studies.comparison import LEVEL, compare_studies
from torchvision_dddas.evaluation.studies.jobs import Event, Workers
from torchvision_dddas.evaluation.studies.records import Case, ScoredCase, ScoredStudy, Spec
from torchvision_dddas.evaluation.studies.runner import Plan, run_study
from torchvision_dddas.evaluation.studies.summary import Goal, goal_value
from torchvision_dddas.evaluation.studies.sweep import format_value, toml_value

BEFORE, AFTER = "before", "after"

Shown = Callable[[], AbstractContextManager[tuple[Callable[[Plan], object], Callable[[Event], object]]]]
"""How far a study is: what to call as it begins, and for each of its events."""


@dataclass(frozen=True)
class Side:
    """One set of clips. pooled, mean: the goal before and after, over all counts and over the clips' values.

    says: of the pooled goal, the one question that was asked: better or worse beyond noise, or not. changes: every
    measure and clip, as `compare_studies` tells it, corrected for all of them; None where nothing can be compared.
    frame_ms: what a frame took before and after, where it was computed. notes: clips without a result, and why.
    """

    clips: tuple[str, ...]
    pooled: tuple[float, float]
    mean: tuple[float, float]
    says: str
    changes: Mapping[str, Any] | None
    frame_ms: tuple[float, float]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """What tuning was worth on the clips tuned on, and on those held out; None where none were."""

    goal: Goal
    tuned: Side
    held: Side | None

    def lines(self) -> list[str]:
        """What tuning was worth, a line for each set of clips."""
        sides = {"Tuned on": self.tuned, "Held out": self.held}
        return [self._line(name, side) for name, side in sides.items() if side is not None]

    def _line(self, name: str, side: Side) -> str:
        pooled, mean = (" -> ".join(map(format_value, pair)) for pair in (side.pooled, side.mean))
        mean = f", mean of clips {mean}" if len(side.clips) > 1 else ""
        says = f": {side.says}" if side.says else ""
        return f"{name} ({count_clips(side.clips)}): {self.goal.measure} {pooled}{mean}{says}"

    def told(self) -> dict[str, Any]:
        """As JSON has it."""
        sides = {"tuned": _told(self.tuned), "held_out": None if self.held is None else _told(self.held)}
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
    """Run a study as it is and with other values of some parameters. tuned, held: names of clips.

    spec, base, cache: as `run_study` takes them; jobs: as `Workers`. Raises InputError as they do, and where no clip
    can have the goal's measure.
    """
    changed = tuple(f"{name}={toml_value(value)}" for name, value in parameters.items())
    specs = [replace(spec, tasks=(goal.task,), overrides=(*spec.overrides, *more)) for more in ((), changed)]
    names = [glob.escape(name) for name in (*tuned, *held)]
    cases = []
    with Workers(jobs) as workers:
        for one in specs:
            with shown() as (begun, tell):
                cases.append(run_study(one, base, workers, cache, names, tell, begun).cases)
    sides = [_side(goal, _of(cases[0], clips), _of(cases[1], clips), clips) for clips in (tuned, held) if clips]
    return Verdict(goal, sides[0], sides[1] if len(sides) > 1 else None)


def _of(cases: Sequence[Case], clips: Sequence[str]) -> list[Case]:
    return [case for case in cases if case.clip.name in clips]


def _side(goal: Goal, before: Sequence[Case], after: Sequence[Case], clips: Sequence[str]) -> Side:
    notes = {
        f"{case.clip.name}, {when}: {case.cause}"
        for when, cases in ((BEFORE, before), (AFTER, after))
        for case in cases
        if case.cause
    }
    # A clip that fails with one of the two settings has no say in either: its loss is told beside.
    good = [{case.clip.name for case in cases if case.scored is not None} for cases in (before, after)]
    both = good[0] & good[1]
    pairs = [[case for case in cases if case.clip.name in both] for cases in (before, after)]
    pooled, mean = (
        [_value(replace(goal, by=by), cases) if both else math.nan for cases in pairs] for by in ("pooled", "mean")
    )
    studies = [
        ScoredStudy(when, tuple(ScoredCase(c.task, c.clip.name, c.scored) for c in cases if c.scored is not None))
        for when, cases in zip((BEFORE, AFTER), pairs, strict=True)
    ]
    took = [_frame_ms(cases) for cases in pairs]
    changes = compare_studies(*studies) if both else None
    return Side(
        tuple(clips),
        (pooled[0], pooled[1]),
        (mean[0], mean[1]),
        _says(goal, changes),
        changes,
        (took[0], took[1]),
        tuple(sorted(notes)),
    )


def _says(goal: Goal, changes: Mapping[str, Any] | None) -> str:
    """As `compare_studies` says it, but not corrected for measures that nobody asked about."""
    entry = (changes or {"tasks": {}})["tasks"].get(goal.task, {"pooled": {}})["pooled"].get(goal.group, {})
    entry = entry.get(goal.measure)
    if entry is None or not entry["change"]:
        return "the same" if entry else ""
    word = "better" if (entry["change"] < 0) == goal.minimize else "worse"
    ways = [(over, way) for over in ("over_clips", "over_frames") if (way := entry.get(over)) is not None]
    for over, way in ways:
        if way["p"] < LEVEL:
            return word if over == "over_clips" else f"{word} on these clips"
    return "within noise" if any(way["enough"] for _, way in ways) else "too little to tell"


def _value(goal: Goal, cases: Sequence[Case]) -> float:
    return goal_value(goal, cases)[0]


def _frame_ms(cases: Sequence[Case]) -> float:
    seconds = sum(sum(case.found.seconds.values()) for case in cases if case.found is not None)
    frames = sum(len(case.found.looked) for case in cases if case.found is not None)
    return 1000 * seconds / frames if frames else math.nan


def _told(side: Side) -> dict[str, Any]:
    return {
        "clips": side.clips,
        "pooled": dict(zip((BEFORE, AFTER), side.pooled, strict=True)),
        "mean": dict(zip((BEFORE, AFTER), side.mean, strict=True)),
        "says": side.says,
        "frame_ms": dict(zip((BEFORE, AFTER), side.frame_ms, strict=True)),
        "changes": side.changes,
        "notes": side.notes,
    }


def count_clips(clips: Sequence[str]) -> str:
    """`1 clip`, `2 clips`."""
    return f"{len(clips)} clip{'s' * (len(clips) != 1)}"
