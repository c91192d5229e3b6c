"""Compare two studies of the same clips: the changes, whether they are beyond noise, and the page compare.html."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.report import (
    Cell,
    ReportColumn,
    ReportTable,
    format_number,
    number_cell,
    render_page,
    text_cell,
)
from torchvision_dddas.io.report.charts import MOST_ROWS, Interval, interval_chart
from torchvision_dddas.lab.evaluation.metrics import bootstrap
from torchvision_dddas.lab.evaluation.metrics.bootstrap import FEWEST, Effect, Stratum
from torchvision_dddas.lab.evaluation.metrics.effect_size import count_needed, paired_effect_size
from torchvision_dddas.lab.evaluation.metrics.registry import GROUPS, describe, is_lower_better, title_of_group
from torchvision_dddas.lab.evaluation.studies.records import TASKS, Scored, ScoredStudy
from torchvision_dddas.lab.evaluation.studies.summary import Estimate, flat, measures, over_clips, over_frames

LEVEL = 0.05

MEANING = (
    "Better and worse are beyond noise: corrected p below 0.05, by Holm's method for all tests of one kind of a task. "
    "“On these clips”: significant over blocks of their frames, which holds only for these clips. "
    "“Within noise”: neither a change nor its absence is shown. "
    "“Too little to tell”: too few frames or clips to show any change. “The same”: equal figures. "
    "Effect size: the mean of the clips' changes over their standard deviation (Cohen's d_z). "
    "Clips needed: this number shows an effect of this size in 4 of 5 studies (power 0.8), by a paired t test at 0.05 "
    "divided by the number of tests. The effect of few clips is uncertain, and so is the number of clips needed."
)

WAYS = ("over_clips", "over_frames")

Entry = dict[str, Any]
Pairs = dict[str, tuple[Scored, Scored]]


def compare_studies(first: ScoredStudy, second: ScoredStudy) -> dict[str, Any]:
    """Return the changes from the first study to the second, on the clips that both have.

    {"first", "second": names, "tasks": {task: {"same": clips whose counts are equal, "pooled": {group: {measure:
    {"first", "second", "change", "over_clips", "over_frames", "says"}}}, "clips": {name: {group: {measure: {"first",
    "second", "change", "over_frames", "says"}}}}}}, "notes": [...]}. over_clips and over_frames are {"interval", "p",
    "p_holm", "enough"} or None. They hold for other clips like these, and for other frames of the same clips. p_holm is
    corrected for all tests of a task's pooled figures, or of all its clips. enough is False if so few clips or blocks
    of frames cannot give a small p_holm, whatever changed. Pooled entries also have "effect_size" and "clips_needed",
    see `effect_size`. Raise InputError if no task has a clip in both studies.
    """
    return compare_methods((first, second))[0]


def compare_methods(studies: Sequence[ScoredStudy]) -> list[dict[str, Any]]:
    """Compare each study with the first, as `compare_studies` does; p_holm covers the tests of all of them."""
    found = [_compare(studies[0], other) for other in studies[1:]]
    for task in TASKS:
        _correct([one["tasks"][task] for one in found if task in one["tasks"]])
    return found


def _compare(first: ScoredStudy, second: ScoredStudy) -> dict[str, Any]:
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
    pairs: dict[str, Pairs] = {}
    for task, clip in both:
        one, other = (keys[task, clip] for keys in by_key)
        if unlike := _unlike(one, other):
            notes.append(f"{clip}, {task}: {unlike}; not compared")
        else:
            pairs.setdefault(task, {})[clip] = one, other
    if not pairs:
        raise InputError(f"no clip can be compared; {notes[-1]}")
    tasks = {task: _compare_task(of_task) for task, of_task in pairs.items()}
    return {"first": first.name, "second": second.name, "tasks": tasks, "notes": notes}


def differing_settings(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Return {"group.parameter": [first, second]} of settings that differ. first, second: by group, as in run.json."""
    flat = [
        {f"{group}.{name}": value for group in side for name, value in side[group].items()} for side in (first, second)
    ]
    names = dict.fromkeys([*flat[0], *flat[1]])
    return {name: [side.get(name) for side in flat] for name in names if flat[0].get(name) != flat[1].get(name)}


def settings_lines(settings: Mapping[str, Sequence[Any]] | None) -> list[str]:
    """Return a line for each setting that differs. None: unknown settings."""
    if settings is None:
        return ["settings: unknown, as a run.json lacks them"]
    return [f"{name}: {one} in A, {other} in B" for name, (one, other) in settings.items()] or ["settings: the same"]


def _compare_task(pairs: Pairs) -> dict[str, Any]:
    same = [clip for clip, (one, other) in pairs.items() if _same(one, other)]
    clips = {clip: _changes([pair], 1, {}) for clip, pair in pairs.items() if clip not in same}
    every = [scored for side in zip(*pairs.values(), strict=True) for scored in side]
    pooled = _changes(list(pairs.values()), None, {"over_clips": over_clips(every) if len(pairs) >= FEWEST else {}})
    by_clip = [[measures([scored]) for scored in pair] for pair in pairs.values()]
    for group, name, entry in entries_of(pooled):
        ends = [[side.get(group, {}).get(name, math.nan) for side in sides] for sides in by_clip]
        entry["effect_size"] = paired_effect_size(np.array(ends))
    return {"same": same, "pooled": pooled, "clips": clips}


def _correct(tasks: Sequence[Mapping[str, Any]]) -> None:
    """Add the corrected p values and the verdicts. tasks: the changes of one task, from one or several comparisons."""
    of_clips = [entry for task in tasks for clip in task["clips"].values() for _, _, entry in entries_of(clip)]
    of_pooled = [entry for task in tasks for _, _, entry in entries_of(task["pooled"])]
    for entries, way in ((of_clips, "over_frames"), (of_pooled, "over_clips"), (of_pooled, "over_frames")):
        # Holm's correction covers all p values of one kind of test.
        effects = [entry[way] for entry in entries if entry[way] is not None]
        adjusted = bootstrap.holm({str(i): one["p"] for i, one in enumerate(effects)})
        for i, one in enumerate(effects):
            one["p_holm"] = adjusted[str(i)]
            one["enough"] = one.pop("least") * len(effects) < LEVEL
    n_tests = max(1, len(of_pooled))
    for entry in of_pooled:
        count = count_needed(entry["effect_size"], LEVEL / n_tests)
        # The exchange test of n clips gives no p below 2 / 2**n.
        entry["clips_needed"] = count and max(count, math.floor(1 + math.log2(n_tests / LEVEL)) + 1)
    for task in tasks:
        for groups in (task["pooled"], *task["clips"].values()):
            for _, name, entry in entries_of(groups):
                entry["says"] = verdict(entry, name)


def _changes(
    pairs: Sequence[tuple[Scored, Scored]], most: int | None, estimates: Mapping[str, Mapping[str, Estimate]]
) -> dict[str, dict[str, Entry]]:
    """Return each measure before and after, by group. most: measures of a group. estimates: besides over_frames."""
    sides = [list(side) for side in zip(*pairs, strict=True)]
    before, after = (measures(side) for side in sides)
    estimates = {**estimates, "over_frames": over_frames([*sides[0], *sides[1]])}
    effects = {
        way: {group: found for group, one in groups.items() if (found := _effects(one))}
        for way, groups in estimates.items()
    }
    changes: dict[str, dict[str, Entry]] = {}
    for group in before:
        for name in GROUPS[group].compared[:most]:
            one, other = before[group][name], after[group][name]
            entry: Entry = {"first": one, "second": other, "change": other - one}
            for way, groups in effects.items():
                effect = groups.get(group, {}).get(name)
                entry[way] = None
                if effect is not None and not math.isnan(effect.p):
                    interval = None if effect.interval is None else list(effect.interval)
                    entry[way] = {"interval": interval, "p": effect.p, "least": effect.least}
            if not (math.isnan(one) and math.isnan(other)):
                changes.setdefault(group, {})[name] = entry
    return changes


def _effects(estimate: Estimate) -> dict[str, Effect]:
    """Return the effects between the two halves of an estimate's units; empty for fewer than FEWEST clips."""
    half = len(estimate.strata) // 2
    if half:  # the frames of a clip are drawn in blocks of the larger length of its two results
        halves = zip(estimate.strata[:half], estimate.strata[half:], strict=True)
        strata = [Stratum(one.units, max(one.block, other.block)) for one, other in halves]
    else:
        strata = [Stratum(estimate.strata[0].units // 2)]
        if strata[0].units < FEWEST:
            return {}
    return bootstrap.effects(estimate.statistic, tuple(strata), estimate.seed)


def verdict(entry: Mapping[str, Any], name: str, p: str = "p_holm") -> str:
    """Return the verdict on a change of a measure, in words. p: the key of the p value, single or corrected."""
    change = entry["change"]
    if not change:
        return "the same"
    word = "better" if (change < 0) == is_lower_better(name) else "worse"
    ways = [way for over in WAYS if (way := entry.get(over)) is not None]
    for way in ways:
        if way[p] < LEVEL:
            return f"{word} on these clips" if "over_clips" in entry and way is not entry["over_clips"] else word
    return "within noise" if any(way["enough"] for way in ways) else "too little to tell"


def _same(one: Scored, other: Scored) -> bool:
    return all(np.array_equal(flat(one.counts[group]), flat(other.counts[group])) for group in one.counts) and all(
        np.array_equal(one.samples[name], other.samples[name], equal_nan=True) for name in one.samples
    )


def _unlike(one: Scored, other: Scored) -> str:
    """Return the reason why two results of a clip cannot be compared; empty if they can."""
    if one.counts.keys() != other.counts.keys():
        return f"one has {', '.join(one.counts)}, the other {', '.join(other.counts)}"
    if not np.array_equal(one.frames, other.frames):
        return f"other frames were scored, {len(one.frames)} and {len(other.frames)}"
    names = {"pixels": ("tp", "fn"), "boxes": ("hit", "missed"), "tracks": ("tp", "fn"), "location": ("targets",)}
    for group in one.counts:
        columns = names.get(group, ("frames",))  # the truth of each frame: pixels, boxes, the target, places
        true = [sum(np.nan_to_num(scored.per_frame[group][name]) for name in columns) for scored in (one, other)]
        if not np.array_equal(true[0], true[1]):
            return f"its truth differs, {np.sum(true[0]):g} and {np.sum(true[1]):g} in {group}"
    return ""


def comparison_report(comparison: Mapping[str, Any]) -> str:
    """Return compare.html. comparison: from `compare_studies`, with None for NaN and the "settings" that differ."""
    first, second = str(comparison["first"]), str(comparison["second"])
    tasks = []
    for task, changes in comparison["tasks"].items():
        verdicts = [rows[0][2]["says"] for groups in changes["clips"].values() if (rows := entries_of(groups))]
        n_better, n_worse = (sum(text.startswith(word) for text in verdicts) for word in ("better", "worse"))
        card = {
            "id": task,
            "title": task.capitalize(),
            "change": "",
            "n_better": n_better,
            "n_worse": n_worse,
            "n_others": len(verdicts) - n_better - n_worse,
            "n_same": len(changes["same"]),
            "section": comparison_section(task, task.capitalize(), changes, first, second),
        }
        if pooled := entries_of(changes["pooled"]):
            group, name, entry = pooled[0]
            before, after = (number_cell(entry[end], describe(name).digits).text for end in ("first", "second"))
            card |= {
                "change": signed_change(entry, name),
                "metric": measure_title(group, name),
                "before": before,
                "after": after,
            }
            card["verdict"] = entry["says"]
        tasks.append(card)
    return render_page(
        "comparison.html",
        title=f"{first} and {second}: comparison",
        first=first,
        second=second,
        meaning=MEANING,
        tasks=tasks,
        notes=comparison["notes"],
        settings=settings_lines(comparison.get("settings")),
    )


def comparison_section(anchor: str, title: str, changes: Mapping[str, Any], first: str, second: str) -> Markup:
    """Return the section of a task: plots clip by clip, all clips together, single clips.

    anchor: the target of links. changes: of this task, as in `compare_studies`. first, second: names of columns.
    """
    columns = [ReportColumn("clip", text=True), *_columns(first, second, {WAYS[1]: ""})]
    by_clip = [
        [text_cell(clip), *_cells(group, name, entry, WAYS[1:])]
        for clip, groups in changes["clips"].items()
        for group, name, entry in entries_of(groups)
    ]
    section = render_page(
        "comparison_section.html",
        id=anchor,
        title=title,
        charts=_charts(changes["clips"]),
        pooled=pooled_changes(changes, first, second).markup,
        by_clip=by_clip and ReportTable("clip by clip", columns, by_clip).markup,
        same=changes["same"],
    )
    return Markup(section)


def pooled_changes(changes: Mapping[str, Any], first: str, second: str) -> ReportTable:
    """Return the table of the changes over all clips. The arguments are those of `comparison_section`."""
    columns = _columns(first, second, {WAYS[0]: ", clips", WAYS[1]: ", frames"})
    columns += [ReportColumn("effect size", "Cohen's d_z"), ReportColumn("clips needed", "for a power of 0.8")]
    rows = []
    for group, name, entry in entries_of(changes["pooled"]):
        needed = [number_cell(entry.get("effect_size"), 2), number_cell(entry.get("clips_needed"))]
        rows.append([*_cells(group, name, entry, WAYS), *needed])
    return ReportTable("all clips together", columns, rows)


def _columns(first: str, second: str, ways: Mapping[str, str]) -> list[ReportColumn]:
    tests = [ReportColumn(f"{p}{over}") for over in ways.values() for p in ("raw p", "corrected p")]
    ends = [
        ReportColumn("measure", text=True),
        ReportColumn(first),
        ReportColumn(second),
        ReportColumn("change", "with its 95 % interval"),
    ]
    return [*ends, ReportColumn("verdict", text=True), *tests]


def _charts(clips: Mapping[str, Mapping[str, Any]]) -> list[tuple[Markup, str]]:
    """Return the change of each group's first measure for each clip, the largest loss first, and a note."""
    charts = []
    for group in dict.fromkeys(group for groups in clips.values() for group in groups):
        changed = {clip: next(iter(groups[group].items())) for clip, groups in clips.items() if groups.get(group)}
        rows = [Interval(clip, *_change(entry)) for clip, (_, entry) in changed.items() if entry["change"] is not None]
        if not rows:
            continue
        name = next(iter(changed.values()))[0]
        rows.sort(key=lambda row: row.value * (-1 if describe(name).better < 0 else 1))
        reach = max(abs(v) for row in rows for v in (row.value, row.low, row.high) if math.isfinite(v)) or 1.0
        svg = interval_chart(
            f"Change of {measure_title(group, name)}", rows, Interval("no change", 0.0), (-reach, reach)
        )
        charts.append((svg, f"{len(rows) - MOST_ROWS} more in the table" if len(rows) > MOST_ROWS else ""))
    return charts


def _cells(group: str, name: str, entry: Mapping[str, Any], ways: Sequence[str]) -> list[Cell]:
    digits = describe(name).digits
    small = number_cell(entry["change"], digits, _change(entry)[1:]).small
    cells = [number_cell(entry["first"], digits), number_cell(entry["second"], digits)]
    cells += [Cell(signed_change(entry, name), entry["change"], small), text_cell(str(entry["says"]))]
    cells += [number_cell((entry.get(way) or {}).get(p)) for way in ways for p in ("p", "p_holm")]
    return [text_cell(measure_title(group, name)), *cells]


def entries_of(groups: Mapping[str, Mapping[str, Entry]]) -> list[tuple[str, str, Entry]]:
    """Return group, measure and entry of each change."""
    return [(group, name, entry) for group, names in groups.items() for name, entry in names.items()]


def _change(entry: Mapping[str, Any]) -> tuple[float, float, float]:
    """Return the change and the ends of its interval: over clips if there is one, else over frames."""
    spans = [effect["interval"] for way in WAYS if (effect := entry.get(way)) is not None and effect["interval"]]
    low, high = spans[0] if spans else (math.nan, math.nan)
    return math.nan if entry["change"] is None else float(entry["change"]), low, high


def signed_change(entry: Mapping[str, Any], name: str) -> str:
    """Return the change of a measure with its sign and its decimals."""
    change = entry["change"]
    text = format_number(math.nan if change is None else change, describe(name).digits)
    return f"+{text}" if change and change > 0 else text


def measure_title(group: str, name: str) -> str:
    """Return the measure and its group in words."""
    return f"{describe(name).title}, {title_of_group(group)}"
