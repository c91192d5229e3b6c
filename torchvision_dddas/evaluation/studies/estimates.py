"""The measures of cases as functions of how often each frame, or each clip, counts: what resampling asks for."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from torchvision_dddas.evaluation.metrics import bootstrap, metres, tracking
from torchvision_dddas.evaluation.metrics.bootstrap import Statistic, Stratum
from torchvision_dddas.evaluation.metrics.boxes import Boxes, Ranking, ranking
from torchvision_dddas.evaluation.metrics.pixels import ratio
from torchvision_dddas.evaluation.metrics.registry import GROUPS, METRES, RANKED, measure
from torchvision_dddas.evaluation.metrics.tracking import Clear
from torchvision_dddas.evaluation.studies.results import Scored

Measure = Callable[[np.ndarray], dict[str, float]]
"""Sums (C,) of a group's counts to its measures."""


class Estimate(NamedTuple):
    """Measures of a group by the weights of units. content: what they come from, which seeds the resampling."""

    statistic: Statistic
    strata: tuple[Stratum, ...]
    content: tuple[np.ndarray, ...]

    def seed(self, group: str) -> int:
        """Of the resampling."""
        return bootstrap.seed_of(group, *self.content)


def over_frames(cases: Sequence[Scored]) -> dict[str, Estimate]:
    """Units are frames, in blocks within each clip: what these very clips tell.

    HOTA and IDF1 are of whole tracks and have no such estimate.
    """
    found = {}
    groups = dict.fromkeys(group for scored in cases for group in scored.per_frame)
    blocks: dict[str, list[int]] = {}
    for group in groups:
        names, of_sums = _columns(group)
        having = [scored for scored in cases if group in scored.per_frame]
        tables = [_table(scored, group, names) for scored in having]
        blocks[group] = [bootstrap.block_length(_influence(table, of_sums)) for table in tables]
        strata = tuple(Stratum(len(t), block) for t, block in zip(tables, blocks[group], strict=True) if len(t))
        if strata:
            found[group] = Estimate(_of_sums(np.concatenate(tables), of_sums), strata, tuple(tables))
    if having := [scored for scored in cases if "boxes" in scored.ranked]:
        true: list[np.ndarray] = []
        unit: list[np.ndarray] = []
        for scored in having:
            of_each = _known(scored, "boxes")
            rows = scored.ranked["boxes"]
            unit.append(
                sum(len(one) for one in true) + np.searchsorted(scored.frames[of_each], rows[:, 2].astype(np.int64))
            )
            true.append(_table(scored, "boxes", ("hit", "missed")).sum(axis=1))
        rows = np.concatenate([scored.ranked["boxes"] for scored in having])
        ranked = ranking(rows[:, 0], rows[:, 1], np.concatenate(unit), np.concatenate(true))
        found[RANKED] = Estimate(ranked.measures, found["boxes"].strata, _content(ranked))
    if having := [scored for scored in cases if "error_m" in scored.samples]:
        found[METRES] = _metres_over_frames(having)
    return found


def over_clips(cases: Sequence[Scored]) -> dict[str, Estimate]:
    """Units are whole clips: what clips like these tell."""
    found = {}
    for group in dict.fromkeys(group for scored in cases for group in scored.counts):
        counts = [scored.counts[group] for scored in cases if group in scored.counts]
        table = np.stack([flat(one) for one in counts])

        def measure_sums(sums: np.ndarray, like: Any = counts[0], group: str = group) -> dict[str, float]:
            return measure(group, shaped(sums, like))

        found[group] = Estimate(_of_sums(table, measure_sums), (Stratum(len(table)),), (table,))
    if having := [scored for scored in cases if "boxes" in scored.ranked]:
        ranked = ranking_of(having)
        found[RANKED] = Estimate(ranked.measures, (Stratum(len(having)),), _content(ranked))
    if having := [scored for scored in cases if "error_m" in scored.samples]:
        unit = np.repeat(np.arange(len(having)), [len(scored.samples["error_m"]) for scored in having])
        samples = samples_of(having)
        found[METRES] = Estimate(_of_samples(samples, unit), (Stratum(len(having)),), _metres_content(samples, unit))
    return found


def ranking_of(cases: Sequence[Scored]) -> Ranking:
    """All detections of cases that have scores, pooled; a unit a case."""
    rows = np.concatenate([scored.ranked["boxes"] for scored in cases])
    unit = np.repeat(np.arange(len(cases)), [len(scored.ranked["boxes"]) for scored in cases])
    true, images = [], []
    for scored in cases:
        boxes = scored.counts["boxes"]
        assert isinstance(boxes, Boxes)
        true.append(float(boxes.hit + boxes.missed))
        images.append(float(_known(scored, "boxes").sum()))
    return ranking(rows[:, 0], rows[:, 1], unit, np.array(true), np.array(images))


def samples_of(cases: Sequence[Scored]) -> dict[str, np.ndarray]:
    """The errors of all cases together."""
    return {name: np.concatenate([scored.samples[name] for scored in cases]) for name in cases[0].samples}


def flat(counts: Any) -> np.ndarray:
    """Counts, of counts or of curves, as one row."""
    if isinstance(counts, tuple):
        return np.concatenate([flat(part) for part in counts])
    return np.atleast_1d(np.asarray(counts, float))


def shaped(row: np.ndarray, like: Any) -> Any:
    """The counts of such a row, as those of another one are."""
    parts, at = [], 0
    for part in like:
        size = len(flat(part))
        here = row[at : at + size]
        parts.append(shaped(here, part) if isinstance(part, tuple) else here if np.ndim(part) else float(here[0]))
        at += size
    return type(like)(*parts)


def _of_sums(table: np.ndarray, measure: Measure) -> Statistic:
    return lambda weight: measure(weight @ table)


def _of_samples(samples: dict[str, np.ndarray], unit: np.ndarray) -> Statistic:
    return lambda weight: metres.measures(samples, weight[unit])


def _columns(group: str) -> tuple[tuple[str, ...], Measure]:
    """The counts of frames that a group's measures come of, and how."""
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
    """(F,) bool: the frames that a group has a use for."""
    first: np.ndarray = next(iter(scored.per_frame[group].values()))
    return ~np.isnan(first)


def _table(scored: Scored, group: str, names: Sequence[str]) -> np.ndarray:
    """(U, C) the counts of the frames that the group has a use for."""
    known = _known(scored, group)
    return np.stack([scored.per_frame[group][name][known] for name in names], axis=1)


def _influence(table: np.ndarray, measure: Measure) -> np.ndarray:
    """(U, K) what each frame adds to each measure, to the first order."""
    whole = table.sum(axis=0)
    steps = 1e-4 * np.maximum(np.abs(whole), 1)
    slopes = []
    for step in np.diag(steps):
        up, down = measure(whole + step), measure(np.maximum(whole - step, 0))
        slopes.append([(up[name] - down[name]) / step.max() for name in up])
    series: np.ndarray = table @ np.array(slopes)
    return series


def _metres_over_frames(cases: Sequence[Scored]) -> Estimate:
    units: list[np.ndarray] = []
    strata: list[Stratum] = []
    for scored in cases:
        row, count, series = np.searchsorted(scored.frames, scored.samples["frame"]), len(scored.frames), []
        for name in ("error_m", "inside", "relative_error_m", "relative_inside"):
            value = scored.samples[name]
            known = np.isfinite(value)
            apart = np.where(known, value - (value[known].mean() if known.any() else 0.0), 0.0)
            series.append(np.bincount(row, apart, count))
        units.append(row + sum(stratum.units for stratum in strata))
        strata.append(Stratum(count, bootstrap.block_length(np.stack(series, axis=1))))
    samples, unit = samples_of(cases), np.concatenate(units)
    return Estimate(_of_samples(samples, unit), tuple(strata), _metres_content(samples, unit))


def _metres_content(samples: dict[str, np.ndarray], unit: np.ndarray) -> tuple[np.ndarray, ...]:
    return samples["error_m"], samples["inside"], unit


def _content(ranked: Ranking) -> tuple[np.ndarray, ...]:
    return ranked.right, ranked.unit, ranked.score, ranked.true
