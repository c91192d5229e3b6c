"""Curves of a task: precision over recall, misses against false alarms, and how right it is as a clip goes on."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchvision_dddas.sinks.charts import Axis, Dots, Line, chart
from torchvision_dddas.sinks.study_report.tallies import main_group, tally
from torchvision_dddas.studies.record import Case
from torchvision_dddas.studies.scored import Scored

MOST_CLIPS = 6
"""Clips whose course is drawn."""
_BINS = 80
_LEAST = 1e-3


class Ranked(NamedTuple):
    """A clip's detections that count, best first: (M,) score and right; how many are true, and pictures looked at."""

    name: str
    score: np.ndarray
    right: np.ndarray
    true: int
    images: int


def ranked_charts(cases: Sequence[Case]) -> list[str]:
    """Precision against recall, and the miss rate against false positives an image, of each group with scores."""
    charts: list[str] = []
    for group in dict.fromkeys(g for case in cases if case.scored for g in case.scored.ranked):
        each = [one for case in cases if (one := _ranked(case, group)) is not None and one.true]
        if not each:
            continue
        whole = Ranked(
            "all clips" if len(each) > 1 else each[0].name,
            np.concatenate([one.score for one in each]),
            np.concatenate([one.right for one in each]),
            sum(one.true for one in each),
            sum(one.images for one in each),
        )
        pairs = [(one, True) for one in each if len(each) > 1] + [(whole, False)]
        exact, missing = [], []
        for k, (one, faint) in enumerate(pairs):
            precision, recall, false_per_image = rates(one)
            name = ("each clip" if k == 0 else "") if faint else one.name
            colour = 6 if faint else 1
            exact.append(Line(name, recall, precision, colour, faint))
            missing.append(Line(name, np.maximum(false_per_image, _LEAST), 1 - recall, colour, faint))
        up, misses = Axis("precision", 0, 1), Axis("miss rate", 0, 1)
        charts.append(chart("Precision and recall", Axis("recall", 0, 1), up, exact))
        charts.append(chart("Misses and false alarms", Axis("false positives an image", log=True), misses, missing))
    return charts


def rates(one: Ranked) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(K,) precision, recall and false positives an image as ever lower scores are taken; equal scores go together."""
    order = np.argsort(-one.score, kind="stable")
    score, right = one.score[order], one.right[order]
    hits, false = np.cumsum(right), np.cumsum(1 - right)
    last = np.flatnonzero(np.r_[np.diff(score) != 0, np.ones(min(len(score), 1), bool)])
    hits, false = hits[last], false[last]
    return hits / np.maximum(hits + false, 1), hits / max(one.true, 1), false / max(one.images, 1)


def course_charts(cases: Sequence[Case]) -> list[str]:
    """How right each clip is as it goes on, of the first MOST_CLIPS that have any course."""
    charts: list[str] = []
    for case in cases:
        if case.scored is None or len(charts) == MOST_CLIPS:
            continue
        drawn = _metres(case.clip.name, case.scored) if "error_m" in case.scored.samples else None
        drawn = drawn or _course(case.clip.name, case.scored)
        charts += [drawn] if drawn else []
    return charts


def _ranked(case: Case, group: str) -> Ranked | None:
    scored = case.scored
    if scored is None or group not in scored.ranked:
        return None
    rows = scored.ranked[group]
    rows = rows[np.isfinite(rows[:, 1])]
    counts = scored.counts.get(group)
    true = getattr(counts, "hit", 0) + getattr(counts, "missed", 0)
    return Ranked(case.clip.name, rows[:, 0], rows[:, 1], true, len(scored.frames))


def _course(name: str, scored: Scored) -> str | None:
    """F or F1 in bins of frames; crosses where identities change."""
    group = main_group(scored)
    if group is None or len(scored.frames) < 2:
        return None
    parts = tally(scored, group)
    size = max(1, -(-len(scored.frames) // _BINS))
    starts = np.arange(0, len(scored.frames), size)
    right, wrong = (np.add.reduceat(x, starts) for x in (parts.right, parts.false + parts.missed))
    whole = 2 * right + wrong
    share = np.divide(2 * right, whole, out=np.full(len(starts), np.nan), where=whole > 0)
    at = np.add.reduceat(scored.frames.astype(float), starts) / np.diff(np.r_[starts, len(scored.frames)])
    measure = parts.measure
    changed = scored.frames[parts.switched > 0]
    words = [f"frame {frame}" for frame in changed.tolist()]
    dots = [Dots("change of identity", changed.astype(float), np.zeros(len(changed)), 2, words, "cross")]
    line = Line(measure, at, share, 1)
    return chart(name, Axis("frame"), Axis(measure, 0, 1), [line], dots if len(changed) else [])


def _metres(name: str, scored: Scored) -> str | None:
    frame, error = scored.samples.get("frame"), scored.samples["error_m"]
    if frame is None or not np.isfinite(error).any():
        return None
    known = np.isfinite(error)
    numbers = np.unique(frame[known])
    groups = np.array_split(numbers, max(1, min(_BINS, len(numbers))))
    middle, high, at = [], [], []
    for group in groups:
        mine = error[known & (frame >= group[0]) & (frame <= group[-1])]
        at.append(float(np.mean(group)))
        middle.append(float(np.median(mine)))
        high.append(float(np.percentile(mine, 95)))
    lines = [
        Line("95 % of the targets", np.array(at), np.array(high), 6, dashed=True),
        Line("median", np.array(at), np.array(middle), 1),
    ]
    return chart(name, Axis("frame"), Axis("error, m", 0), lines)
