"""The measures of a study with their intervals, which are the content of metrics.json; and what it cost.

metrics.json has nothing of the machine, the time or the folders: the same data, code and settings give the same bytes.
"""

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from torchvision_dddas.evaluation.metrics import bootstrap, metres
from torchvision_dddas.evaluation.metrics.pixels import ratio
from torchvision_dddas.evaluation.metrics.registry import GROUPS, METRES, RANKED, figures, is_lower_better, mean, pooled
from torchvision_dddas.evaluation.studies import estimates
from torchvision_dddas.evaluation.studies.estimates import Estimate
from torchvision_dddas.evaluation.studies.results import Case, Results, Scored
from torchvision_dddas.evaluation.studies.spec import TASKS, Task

FORMAT = 1


def summarize(results: Results) -> dict[str, Any]:
    """By task: "clips" by name, "pooled" over all counts, "mean" over clips, "worst" clip of each measure.

    {"tasks": {task: {"clips": {name: {"frames": F, group: {measure: value}, "intervals": {group: {measure:
    [low, high] or None}}}}, "pooled": {group: ..., "intervals": ..., "over": {group: "clips" or "frames"}},
    "mean": {group: {measure: value}}, "worst": {group: {measure: {"clip": name, "value": value}}}, "notes": [...]}},
    "left_out": [...]}. Groups, measures and n_ counts are those of `dddas evaluate`, and ranking, still, location and
    metres beside. Intervals of a clip are over blocks of its frames; of all together over clips, where there are
    enough, else over blocks of frames, which holds for these clips alone.
    """
    tasks = {}
    for task in TASKS:
        cases = [case for case in results.cases if case.task == task and case.scored is not None]
        if cases:
            tasks[task] = _task(task, sorted(cases, key=lambda case: case.clip.name))
    left_out = [
        {"clip": case.clip.name, "task": case.task, "cause": _without_folders(case.cause)}
        for case in sorted(results.cases, key=lambda case: (case.clip.name, case.task))
        if case.scored is None
    ]
    return {"format": FORMAT, "name": results.spec.name, "tasks": tasks, "left_out": left_out}


def _task(task: Task, cases: Sequence[Case]) -> dict[str, Any]:
    scored = [case.scored for case in cases if case.scored is not None]
    clips = {case.clip.name: clip_measures(of_clip) for case, of_clip in zip(cases, scored, strict=True)}
    notes = [_without_folders(note) for one in scored for note in one.notes]
    return {
        "what": TASKS[task],
        "clips": clips,
        "pooled": pooled_measures(scored),
        "mean": mean(list(clips.values())),
        "worst": _worst(clips),
        "notes": notes,
    }


def clip_measures(scored: Scored) -> dict[str, Any]:
    """One clip's measures by group, with their intervals over blocks of its frames."""
    spread = {group: _intervals(group, estimate) for group, estimate in estimates.over_frames([scored]).items()}
    return {"frames": len(scored.frames), **measures([scored]), "intervals": spread}


def pooled_measures(cases: Sequence[Scored]) -> dict[str, Any]:
    """The measures of all counts together. Cases in the order of their names: sums of reals depend on it."""
    by_clip, by_frame = estimates.over_clips(cases), estimates.over_frames(cases)
    spread, over = {}, {}
    for group, estimate in by_clip.items():
        enough = bootstrap.parts(estimate.strata) >= bootstrap.FEWEST
        over[group] = "clips" if enough else "frames"
        if enough or group in by_frame:
            spread[group] = _intervals(group, estimate if enough else by_frame[group])
    return {**measures(cases), "intervals": spread, "over": over}


def measures(cases: Sequence[Scored]) -> dict[str, dict[str, float]]:
    """The figures of one case, or of several together, by group."""
    found = figures(pooled([scored.counts for scored in cases]))
    if having := [scored for scored in cases if "boxes" in scored.ranked]:
        ranked = estimates.ranking_of(having)
        counts = {"n_true": int(ranked.true.sum()), "n_found": len(ranked.right), "n_images": int(ranked.images.sum())}
        found[RANKED] = {**ranked.measures(), **counts}
    if having := [scored for scored in cases if "error_m" in scored.samples]:
        samples = estimates.samples_of(having)
        found[METRES] = {**metres.measures(samples), "n_places": len(samples["error_m"])}
    return {group: found[group] for group in GROUPS if group in found}


def _intervals(group: str, estimate: Estimate) -> dict[str, list[float] | None]:
    found = bootstrap.intervals(estimate.statistic, estimate.strata, estimate.seed(group))
    return {name: None if span is None else list(span) for name, span in found.items()}


def _worst(clips: dict[str, dict[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    worst: dict[str, dict[str, dict[str, Any]]] = {}
    for group in GROUPS:
        for name, clip in clips.items():
            for measure, value in clip.get(group, {}).items():
                if measure.startswith("n_") or math.isnan(value):
                    continue
                known = worst.setdefault(group, {}).get(measure)
                sign = -1 if is_lower_better(measure) else 1
                if known is None or sign * value < sign * known["value"]:
                    worst[group][measure] = {"clip": name, "value": value}
    return worst


def _without_folders(text: str) -> str:
    """The text with only the last part of each path, as folders are this machine's own."""
    return re.sub(r"(?:(?<=[\s('\"])|^)(?:[A-Za-z]:)?[\\/](?:[^\s:;,'\"()]*[\\/])?([^\s:;,'\"()\\/]*)", r"\1", text)


def summarize_costs(results: Results) -> dict[str, Any]:
    """What a study cost, for run.json: by task "clips" by name, and "all" of them together.

    {task: {"clips": {name: {"frames": processed, "seconds": in all stages, "frames_per_s": .., "ms_per_frame": {stage:
    ..}, "peak_mb": ..}}, "all": the same, of all clips; peak_mb the most}}. Times are those that the stages took where
    they were computed, kept with their results; a stage that another task shares is in the cost of both.
    """
    found: dict[str, Any] = {}
    for task in TASKS:
        cases = sorted((c for c in results.cases if c.task == task and c.found is not None), key=lambda c: c.clip.name)
        if cases:
            found[task] = {"clips": {case.clip.name: sum_costs([case]) for case in cases}, "all": sum_costs(cases)}
    return found


def sum_costs(cases: Sequence[Case]) -> dict[str, Any]:
    """The cost of cases together; see `summarize_costs`."""
    seconds: Counter[str] = Counter()
    frames, peaks = 0, [float("nan")]
    for case in cases:
        assert case.found is not None, "only cases with results have a cost"
        seconds.update(case.found.seconds)
        frames += len(case.found.looked)
        peaks.append(case.found.peak_mb)
    total = sum(seconds.values())
    known = [peak for peak in peaks if np.isfinite(peak)]
    return {
        "frames": frames,
        "seconds": total,
        "frames_per_s": ratio(frames, total),
        "ms_per_frame": {stage: 1000 * ratio(spent, frames) for stage, spent in sorted(seconds.items())},
        "peak_mb": max(known) if known else float("nan"),
    }
