"""Two studies of the same clips compared: what changed, and whether it is beyond noise."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics import bootstrap
from torchvision_dddas.evaluation.metrics.bootstrap import FEWEST, Effect, Stratum
from torchvision_dddas.evaluation.metrics.registry import GROUPS, is_lower_better
from torchvision_dddas.evaluation.studies import estimates
from torchvision_dddas.evaluation.studies.estimates import Estimate
from torchvision_dddas.evaluation.studies.results import Scored, ScoredStudy
from torchvision_dddas.evaluation.studies.summary import measures

LEVEL = 0.05

Pairs = dict[str, tuple[Scored, Scored]]


def compare_studies(first: ScoredStudy, second: ScoredStudy) -> dict[str, Any]:
    """What changed from the first study to the second, on the clips that both have.

    {"first", "second": names, "tasks": {task: {"same": clips whose counts are alike to the last digit, "pooled":
    {group: {measure: {"first", "second", "change", "over_clips", "over_frames", "says"}}}, "clips": {name: {group:
    {measure: {"first", "second", "change", "over_frames", "says"}}}}}}, "notes": [...]}. over_clips and over_frames,
    {"interval", "p", "p_holm", "enough"} or None, hold for other clips like these, and for other frames of the same
    clips. p_holm is corrected for all tests of a task's pooled figures, or of all its clips. Not enough: so few clips
    or blocks of frames could not make it small, whatever changed. Raises InputError where no task has a clip in
    both.
    """
    by_key = [{(case.task, case.clip): case.scored for case in study.cases} for study in (first, second)]
    both = sorted(by_key[0].keys() & by_key[1].keys())
    notes = [
        f"{clip}, {task}: only in {'the first' if place == 0 else 'the second'} study, {study.name}"
        for place, study in enumerate((first, second))
        for task, clip in sorted(by_key[place].keys() - by_key[1 - place].keys())
    ]
    if not both:
        has = [", ".join(sorted({f"{clip} ({task})" for task, clip in keys})[:3]) or "nothing" for keys in by_key]
        raise InputError(
            f"the studies {first.name} and {second.name} have no clip of the same task and name in common: "
            f"the first has {has[0]}, the second {has[1]}"
        )
    tasks: dict[str, Any] = {}
    for task in dict.fromkeys(task for task, _ in both):
        pairs: Pairs = {}
        for clip in (clip for of, clip in both if of == task):
            one, other = (keys[task, clip] for keys in by_key)
            if unlike := _unlike(one, other):
                notes.append(f"{clip}, {task}: {unlike}; not compared")
            else:
                pairs[clip] = one, other
        if pairs:
            tasks[task] = _task(pairs)
    if not tasks:
        raise InputError(f"no clip can be compared; {notes[-1]}")
    return {"first": first.name, "second": second.name, "tasks": tasks, "notes": notes}


def _task(pairs: Pairs) -> dict[str, Any]:
    same = [clip for clip, (one, other) in pairs.items() if _same(one, other)]
    clips = {clip: _clip(*pair) for clip, pair in pairs.items() if clip not in same}
    _correct([clip[group][name] for clip in clips.values() for group in clip for name in clip[group]], "over_frames")
    pooled = _pooled([one for one, _ in pairs.values()], [other for _, other in pairs.values()])
    asked = [pooled[group][name] for group in pooled for name in pooled[group]]
    for over in ("over_clips", "over_frames"):
        _correct(asked, over)
    for entries in (pooled, *clips.values()):
        for group in entries:
            for name, entry in entries[group].items():
                entry["says"] = _verdict(entry, name)
    return {"same": same, "pooled": pooled, "clips": clips}


def _clip(one: Scored, other: Scored) -> dict[str, dict[str, Any]]:
    asked = {name: group.compared[:1] for name, group in GROUPS.items()}
    return _entries([one], [other], asked, {"over_frames": _over_frames([one], [other])})


def _pooled(first: Sequence[Scored], second: Sequence[Scored]) -> dict[str, dict[str, Any]]:
    ways = {"over_clips": _over_clips(first, second), "over_frames": _over_frames(first, second)}
    return _entries(first, second, {name: group.compared for name, group in GROUPS.items()}, ways)


def _entries(
    first: Sequence[Scored],
    second: Sequence[Scored],
    asked: Mapping[str, Sequence[str]],
    ways: Mapping[str, Mapping[str, dict[str, Effect]]],
) -> dict[str, dict[str, Any]]:
    before, after = measures(first), measures(second)
    found: dict[str, dict[str, Any]] = {}
    for group in before:
        for name in asked.get(group, ()):
            change = after[group][name] - before[group][name]
            entry: dict[str, Any] = {"first": before[group][name], "second": after[group][name], "change": change}
            for way, effects in ways.items():
                effect = effects.get(group, {}).get(name)
                entry[way] = None if effect is None or math.isnan(effect.p) else _describe(effect)
            if not (math.isnan(before[group][name]) and math.isnan(after[group][name])):
                found.setdefault(group, {})[name] = entry
    return found


def _describe(effect: Effect) -> dict[str, Any]:
    interval = None if effect.interval is None else list(effect.interval)
    return {"interval": interval, "p": effect.p, "least": effect.least}


def _over_clips(first: Sequence[Scored], second: Sequence[Scored]) -> dict[str, dict[str, Effect]]:
    if len(first) < FEWEST:
        return {}
    found = {}
    for group, estimate in estimates.over_clips([*first, *second]).items():
        clips = estimate.strata[0].units // 2
        if clips >= FEWEST:
            found[group] = bootstrap.effects(estimate.statistic, (Stratum(clips),), estimate.seed(group))
    return found


def _over_frames(first: Sequence[Scored], second: Sequence[Scored]) -> dict[str, dict[str, Effect]]:
    found = {}
    for group, estimate in estimates.over_frames([*first, *second]).items():
        if strata := _paired_strata(estimate):
            found[group] = bootstrap.effects(estimate.statistic, strata, estimate.seed(group))
    return found


def _paired_strata(estimate: Estimate) -> tuple[Stratum, ...]:
    """A clip's frames are drawn in the longer of the blocks that its two results ask for."""
    half = len(estimate.strata) // 2
    halves = zip(estimate.strata[:half], estimate.strata[half:], strict=True)
    return tuple(Stratum(one.units, max(one.block, other.block)) for one, other in halves)


def _correct(entries: Sequence[dict[str, Any]], way: str) -> None:
    """Add p_holm to all entries that are tested together, and whether it could be below LEVEL at all."""
    effects = [entry[way] for entry in entries if entry.get(way) is not None]
    adjusted = bootstrap.holm({str(i): one["p"] for i, one in enumerate(effects)})
    for i, one in enumerate(effects):
        one["p_holm"] = adjusted[str(i)]
        one["enough"] = one.pop("least") * len(effects) < LEVEL


def _verdict(entry: Mapping[str, Any], name: str) -> str:
    change = entry["change"]
    if not change:
        return "the same"
    better = (change < 0) == is_lower_better(name)
    word = "better" if better else "worse"
    ways = [way for name in ("over_clips", "over_frames") if (way := entry.get(name)) is not None]
    for way in ways:
        if way["p_holm"] < LEVEL:
            return f"{word} on these clips" if "over_clips" in entry and way is not entry["over_clips"] else word
    return "within noise" if any(way["enough"] for way in ways) else "too little to tell"


def _same(one: Scored, other: Scored) -> bool:
    return all(
        np.array_equal(estimates.flat(one.counts[group]), estimates.flat(other.counts[group])) for group in one.counts
    ) and all(np.array_equal(one.samples[name], other.samples[name], equal_nan=True) for name in one.samples)


def _unlike(one: Scored, other: Scored) -> str:
    """Why two results of a clip cannot be compared; empty where they can."""
    if one.counts.keys() != other.counts.keys():
        return f"one has {', '.join(one.counts)}, the other {', '.join(other.counts)}"
    if not np.array_equal(one.frames, other.frames):
        return f"other frames were scored, {len(one.frames)} and {len(other.frames)}"
    for group in one.counts:
        true = [_true(scored, group) for scored in (one, other)]
        if not np.array_equal(true[0], true[1]):
            return f"its truth is another, {true[0].sum():g} and {true[1].sum():g} in {group}"
    return ""


def _true(scored: Scored, group: str) -> np.ndarray:
    """(F,) how much there truly is in each frame: pixels, boxes, the target, places."""
    names = {"pixels": ("tp", "fn"), "boxes": ("hit", "missed"), "tracks": ("tp", "fn"), "location": ("targets",)}
    columns = [np.nan_to_num(scored.per_frame[group][name]) for name in names.get(group, ("frames",))]
    total: np.ndarray = np.sum(columns, axis=0)
    return total
