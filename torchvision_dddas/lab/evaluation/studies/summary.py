"""The measures of a study with their intervals, as in metrics.json; its costs; the goal of a sweep.

metrics.json has nothing about machine, time or folders: the same data, code and settings give the same bytes.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from torchvision_dddas.config import nearest
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.metrics import bootstrap, metres, tracking
from torchvision_dddas.lab.evaluation.metrics.bootstrap import Statistic, Stratum, seed_of
from torchvision_dddas.lab.evaluation.metrics.boxes import Ranking, ranking
from torchvision_dddas.lab.evaluation.metrics.pixels import ratio
from torchvision_dddas.lab.evaluation.metrics.registry import (
    GROUPS,
    METRES,
    RANKED,
    figures,
    groups_of_task,
    is_lower_better,
    mean,
    measure,
    measure_names,
    pooled,
)
from torchvision_dddas.lab.evaluation.metrics.tracking import Clear
from torchvision_dddas.lab.evaluation.studies.records import TASKS, Case, Results, Scored, Task

FORMAT = 1


def summarize(results: Results) -> dict[str, Any]:
    """Return by task: "clips" by name, "pooled" over all counts, "mean" over clips, "worst" clip of each measure.

    {"tasks": {task: {"clips": {name: {"frames": F, group: {measure: value}, "intervals": {group: {measure: [low, high]
    or None}}}}, "pooled": {group: ..., "intervals": ..., "over": {group: "clips" or "frames"}}, "mean": {group:
    {measure: value}}, "worst": {group: {measure: {"clip": name, "value": value}}}, "notes": [...]}}, "left_out":
    [...]}. `dddas evaluate` has the same groups, measures and n_ counts, except the groups ranking, still, location and
    metres. The interval of a clip comes from resampling blocks of its frames. The interval of all clips comes from
    resampling clips; with too few clips it comes from blocks of frames, and holds for these clips only.
    """
    tasks: dict[str, Any] = {}
    for task, meaning in TASKS.items():
        scored = {case.clip.name: case.scored for case in _by_name(results, task) if case.scored is not None}
        if not scored:
            continue
        clips: dict[str, dict[str, Any]] = {}
        for name, one in scored.items():
            intervals = {group: _intervals(estimate) for group, estimate in over_frames([one]).items()}
            clips[name] = {"frames": len(one.frames), **measures([one]), "intervals": intervals}
        tasks[task] = {
            "what": meaning,
            "clips": clips,
            "pooled": _pooled_measures(list(scored.values())),
            "mean": mean(list(clips.values())),
            "worst": _worst(clips),
            "notes": [_without_folders(note) for one in scored.values() for note in one.notes],
        }
    left_out = [
        {"clip": case.clip.name, "task": case.task, "cause": _without_folders(case.cause)}
        for case in sorted(results.cases, key=lambda case: (case.clip.name, case.task))
        if case.scored is None
    ]
    return {"format": FORMAT, "name": results.spec.name, "tasks": tasks, "left_out": left_out}


def _by_name(results: Results, task: Task) -> list[Case]:
    return sorted((case for case in results.cases if case.task == task), key=lambda case: case.clip.name)


def _pooled_measures(cases: Sequence[Scored]) -> dict[str, Any]:
    """Return the measures of all counts together. Sort cases by name first, because sums depend on the order."""
    by_frame = over_frames(cases)
    spread, over = {}, {}
    for group, estimate in over_clips(cases).items():
        enough = bootstrap.parts(estimate.strata) >= bootstrap.FEWEST
        over[group] = "clips" if enough else "frames"
        if enough or group in by_frame:
            spread[group] = _intervals(estimate if enough else by_frame[group])
    return {**measures(cases), "intervals": spread, "over": over}


def measures(cases: Sequence[Scored]) -> dict[str, dict[str, float]]:
    """Return the figures of one case, or of several cases together, by group."""
    found = figures(pooled([scored.counts for scored in cases]))
    if having := [scored for scored in cases if "boxes" in scored.ranked]:
        ranked = rank(having)
        counts = {"n_true": int(ranked.true.sum()), "n_found": len(ranked.right), "n_images": int(ranked.images.sum())}
        found[RANKED] = {**ranked.measures(), **counts}
    if having := [scored for scored in cases if "error_m" in scored.samples]:
        samples = _samples_of(having)
        found[METRES] = {**metres.measures(samples), "n_places": len(samples["error_m"])}
    return {group: found[group] for group in GROUPS if group in found}


def _worst(clips: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    worst: dict[str, dict[str, dict[str, Any]]] = {}
    for group in GROUPS:
        for name, clip in clips.items():
            for figure, value in clip.get(group, {}).items():
                if figure.startswith("n_") or math.isnan(value):
                    continue
                known = worst.setdefault(group, {}).get(figure)
                sign = -1 if is_lower_better(figure) else 1
                if known is None or sign * value < sign * known["value"]:
                    worst[group][figure] = {"clip": name, "value": value}
    return worst


def _without_folders(text: str) -> str:
    """Return the text with only the last part of each path, because folders belong to this machine."""
    return re.sub(r"(?:(?<=[\s('\"])|^)(?:[A-Za-z]:)?[\\/](?:[^\s:;,'\"()]*[\\/])?([^\s:;,'\"()\\/]*)", r"\1", text)


def summarize_costs(results: Results) -> dict[str, Any]:
    """Return the costs of a study for run.json: by task "clips" by name, and "all" of them together.

    {task: {"clips": {name: {"frames": processed, "seconds": in all stages, "frames_per_s": .., "ms_per_frame": {stage:
    ..}, "peak_mb": ..}}, "all": the same over all clips; peak_mb is the largest}}. Times were measured when the stages
    were computed, and are stored with their results. A stage that two tasks share counts in both.
    """
    found: dict[str, Any] = {}
    for task in TASKS:
        if cases := [case for case in _by_name(results, task) if case.found is not None]:
            found[task] = {"clips": {case.clip.name: sum_costs([case]) for case in cases}, "all": sum_costs(cases)}
    return found


def sum_costs(cases: Sequence[Case]) -> dict[str, Any]:
    """Return the cost of all cases that have a result; see `summarize_costs`."""
    results = [case.found for case in cases if case.found is not None]
    seconds: Counter[str] = Counter()
    for found in results:
        seconds.update(dict(found.seconds))
    frames, total = sum(len(found.looked) for found in results), sum(seconds.values())
    return {
        "frames": frames,
        "seconds": total,
        "frames_per_s": ratio(frames, total),
        "ms_per_frame": {stage: 1000 * ratio(spent, frames) for stage, spent in sorted(seconds.items())},
        "peak_mb": max((found.peak_mb for found in results if np.isfinite(found.peak_mb)), default=math.nan),
    }


class Estimate(NamedTuple):
    """Measures of a group as a function of how often each unit counts, for resampling.

    seed: seed of the resampling, which depends only on the group and the content.
    """

    statistic: Statistic
    strata: tuple[Stratum, ...]
    seed: int


def _intervals(estimate: Estimate) -> dict[str, list[float] | None]:
    found = bootstrap.intervals(*estimate)
    return {name: None if span is None else list(span) for name, span in found.items()}


def over_frames(cases: Sequence[Scored]) -> dict[str, Estimate]:
    """Return estimates whose units are frames, in blocks within each clip; they hold for these clips.

    HOTA and IDF1 belong to whole tracks and have no such estimate.
    """
    found = {}
    for group in dict.fromkeys(group for scored in cases for group in scored.per_frame):
        names, of_sums = _columns(group)
        tables = [_table(scored, group, names) for scored in cases if group in scored.per_frame]
        blocks = [bootstrap.block_length(_influence(table, of_sums)) for table in tables]
        strata = tuple(Stratum(len(t), block) for t, block in zip(tables, blocks, strict=True) if len(t))
        if strata:
            found[group] = Estimate(_of_sums(np.concatenate(tables), of_sums), strata, seed_of(group, *tables))
    if having := [scored for scored in cases if "boxes" in scored.ranked]:
        found[RANKED] = _of_ranking(rank(having, by_frame=True), found["boxes"].strata)
    if having := [scored for scored in cases if "error_m" in scored.samples]:
        units: list[np.ndarray] = []
        clips: list[Stratum] = []
        for scored in having:
            row, count, series = np.searchsorted(scored.frames, scored.samples["frame"]), len(scored.frames), []
            for name in ("error_m", "inside", "relative_error_m", "relative_inside"):
                value = scored.samples[name]
                known = np.isfinite(value)
                apart = np.where(known, value - (value[known].mean() if known.any() else 0.0), 0.0)
                series.append(np.bincount(row, apart, count))
            units.append(row + sum(stratum.units for stratum in clips))
            clips.append(Stratum(count, bootstrap.block_length(np.stack(series, axis=1))))
        found[METRES] = _of_samples(_samples_of(having), np.concatenate(units), tuple(clips))
    return found


def over_clips(cases: Sequence[Scored]) -> dict[str, Estimate]:
    """Return estimates whose units are whole clips; they hold for clips like these."""
    found = {}
    for group in dict.fromkeys(group for scored in cases for group in scored.counts):
        counts = [scored.counts[group] for scored in cases if group in scored.counts]
        table = np.stack([flat(one) for one in counts])

        def of_sums(sums: np.ndarray, like: Any = counts[0], group: str = group) -> dict[str, float]:
            return measure(group, _shaped(sums, like))

        found[group] = Estimate(_of_sums(table, of_sums), (Stratum(len(table)),), seed_of(group, table))
    if having := [scored for scored in cases if "boxes" in scored.ranked]:
        found[RANKED] = _of_ranking(rank(having), (Stratum(len(having)),))
    if having := [scored for scored in cases if "error_m" in scored.samples]:
        unit = np.repeat(np.arange(len(having)), [len(scored.samples["error_m"]) for scored in having])
        found[METRES] = _of_samples(_samples_of(having), unit, (Stratum(len(having)),))
    return found


def _of_sums(table: np.ndarray, measure_sums: Callable[[np.ndarray], dict[str, float]]) -> Statistic:
    return lambda weight: measure_sums(weight @ table)


def _of_ranking(ranked: Ranking, strata: tuple[Stratum, ...]) -> Estimate:
    return Estimate(ranked.measures, strata, seed_of(RANKED, ranked.right, ranked.unit, ranked.score, ranked.true))


def _of_samples(samples: dict[str, np.ndarray], unit: np.ndarray, strata: tuple[Stratum, ...]) -> Estimate:
    seed = seed_of(METRES, samples["error_m"], samples["inside"], unit)
    return Estimate(lambda weight: metres.measures(samples, weight[unit]), strata, seed)


def _samples_of(cases: Sequence[Scored]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([scored.samples[name] for scored in cases]) for name in cases[0].samples}


def rank(cases: Sequence[Scored], by_frame: bool = False) -> Ranking:
    """Pool the scored detections of all cases into one ranking, grouped by case or by frame."""
    rows = np.concatenate([scored.ranked["boxes"] for scored in cases])
    unit: list[np.ndarray] = []
    true: list[np.ndarray] = []
    images: list[np.ndarray] = []
    for scored in cases:
        first, numbers = sum(map(len, true)), scored.ranked["boxes"][:, 2].astype(np.int64)
        of_frames = _table(scored, "boxes", ("hit", "missed")).sum(axis=1)
        frames = scored.frames[_known(scored, "boxes")]
        unit.append(first + (np.searchsorted(frames, numbers) if by_frame else np.zeros(len(numbers), np.int64)))
        true.append(of_frames if by_frame else of_frames.sum(keepdims=True))
        images.append(np.ones(len(frames)) if by_frame else np.array([float(len(frames))]))
    return ranking(rows[:, 0], rows[:, 1], *map(np.concatenate, (unit, true, images)))


def flat(counts: Any) -> np.ndarray:
    """Return counts, which may contain counts or curves, as one row."""
    if isinstance(counts, tuple):
        return np.concatenate([flat(part) for part in counts])
    return np.atleast_1d(np.asarray(counts, float))


def _shaped(row: np.ndarray, like: Any) -> Any:
    """Return a row of `flat` as counts in the form of `like`."""
    parts, at = [], 0
    for part in like:
        size = len(flat(part))
        values = row[at : at + size]
        parts.append(
            _shaped(values, part) if isinstance(part, tuple) else values if np.ndim(part) else float(values[0])
        )
        at += size
    return type(like)(*parts)


def _columns(group: str) -> tuple[tuple[str, ...], Callable[[np.ndarray], dict[str, float]]]:
    """Return the counts of frames that a group's measures need, and the function from their sums (C,) to measures."""
    if group == "tracks":
        return (*tracking.PER_FRAME, "windows_2", "ar_2", "windows_3", "ar_3"), _of_tracks
    if group == "target_track":
        return ("frames", "found"), lambda sums: {"found": ratio(sums[1], sums[0])}
    kind = type(GROUPS[group].counts)
    return kind._fields, lambda sums: measure(group, kind(*sums.tolist()))


def _of_tracks(sums: np.ndarray) -> dict[str, float]:
    tp, fn, fp, switches, overlap, windows_2, ar_2, windows_3, ar_3 = sums.tolist()
    found = tracking.clear_measures(Clear(tp=tp, fn=fn, fp=fp, switches=switches, overlap=overlap))
    shares = {name: found[name] for name in ("mota", "motp", "recall", "precision")}
    return {**shares, "ar_2": ratio(ar_2, windows_2), "ar_3": ratio(ar_3, windows_3)}


def _known(scored: Scored, group: str) -> np.ndarray:
    """Return the frames that a group uses, (F,) bool."""
    first: np.ndarray = next(iter(scored.per_frame[group].values()))
    return ~np.isnan(first)


def _table(scored: Scored, group: str, names: Sequence[str]) -> np.ndarray:
    """Return the counts of the frames that the group uses, (U, C)."""
    known = _known(scored, group)
    return np.stack([scored.per_frame[group][name][known] for name in names], axis=1)


def _influence(table: np.ndarray, of_sums: Callable[[np.ndarray], dict[str, float]]) -> np.ndarray:
    """Return the contribution of each frame to each measure, to first order, (U, K)."""
    whole = table.sum(axis=0)
    slopes = []
    for step in np.diag(1e-4 * np.maximum(np.abs(whole), 1)):
        up, down = of_sums(whole + step), of_sums(np.maximum(whole - step, 0))
        slopes.append([(up[name] - down[name]) / step.max() for name in up])
    series: np.ndarray = table @ np.array(slopes)
    return series


BY = ("pooled", "mean", "worst")


@dataclass(frozen=True)
class Goal:
    """One measure of one task. by: over all clips' counts (pooled), the mean of the clips' values, or the worst."""

    task: Task
    group: str
    measure: str
    by: str = "pooled"

    @property
    def minimize(self) -> bool:
        """Whether smaller values are better."""
        return is_lower_better(self.measure)

    @property
    def name(self) -> str:
        """The text that `parse_goal` reads."""
        return f"{self.task}.{self.group}.{self.measure}"


def parse_goal(text: str, by: str = "pooled") -> Goal:
    """Return a goal from `task.group.measure`. Raise InputError for an unknown name, and for a mere count."""
    parts = text.split(".", 2)
    if len(parts) != 3 or not all(parts):
        names = [
            f"{task}.{group}.{m}" for task in TASKS for group in groups_of_task(task) for m in measure_names(group)
        ]
        own = [name for name in names if name.startswith(f"{parts[0]}.")]
        hint = nearest(text, own or names, "such as motion.pixels.f; docs/tuning.md lists the measures")
        raise InputError(f"'{text}' is not a measure; wanted task.group.measure: {hint}")
    named, group, measure = parts
    task = next((known for known in TASKS if known == named), None)
    if task is None:
        raise InputError(f"'{named}' is not a task of a study; wanted {', '.join(TASKS)}")
    if by not in BY:
        raise InputError(f"a goal combines clips by {', '.join(BY)}; got '{by}'")
    if group not in groups_of_task(task):
        raise InputError(f"'{group}' is not a group of measures of {task}; wanted {', '.join(groups_of_task(task))}")
    if measure.startswith("n_") and not is_lower_better(measure):
        raise InputError(f"{measure} is a count, for which neither more nor less is better; wanted a measure")
    if measure not in measure_names(group):
        raise InputError(f"'{measure}' is not a measure of {task}.{group}; wanted {', '.join(measure_names(group))}")
    return Goal(task, group, measure, by)


def possible_groups(clip: Clip, task: Task) -> tuple[str, ...]:
    """Return the groups of measures that a clip's truth allows for a task."""
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
    """Raise InputError if no clip's truth has the goal's group of measures."""
    having = dict.fromkeys(group for clip in clips for group in possible_groups(clip, goal.task))
    if goal.group not in having:
        there = ", ".join(f"{goal.task}.{group}" for group in having)
        raise InputError(f"no clip has truth for {goal.name}; there is truth for {there or 'nothing'}")


def goal_value(goal: Goal, cases: Sequence[Case]) -> tuple[float, str]:
    """Return the goal's value and "", or NaN and the reason. Raise InputError if no clip can have such a measure."""
    scored: list[Scored] = []
    for case in sorted((case for case in cases if case.task == goal.task), key=lambda case: case.clip.name):
        if case.scored is None:  # without its worst clip, any setting would seem better
            return math.nan, f"{case.clip.name}: {case.cause}"
        scored.append(case.scored)

    def value_of(found: Mapping[str, Mapping[str, float]]) -> float:
        return float(found.get(goal.group, {}).get(goal.measure, math.nan))

    by_clip = [measures([one]) for one in scored]
    if not any(goal.measure in clip.get(goal.group, {}) for clip in by_clip):
        known = {f"{group}.{name}": name for clip in by_clip for group, found in clip.items() for name in found}
        named = [full for full, name in known.items() if not name.startswith("n_") or is_lower_better(name)]
        raise InputError(f"no clip has {goal.name}; there are {', '.join(named) or 'none'}")
    if goal.by == "pooled":
        value = value_of(measures(scored))
    elif values := [value for clip in by_clip if not math.isnan(value := value_of(clip))]:
        worst = max if goal.minimize else min
        value = math.fsum(values) / len(values) if goal.by == "mean" else worst(values)
    else:
        value = math.nan
    return value, "the measure is not defined here" if math.isnan(value) else ""
