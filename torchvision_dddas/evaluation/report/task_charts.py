"""The charts of a task: ranked curves, course over the frames, maps, errors on the ground."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchvision_dddas.evaluation.metrics.boxes import precision_recall, ranking
from torchvision_dddas.evaluation.studies.results import Case, Scored
from torchvision_dddas.io.report import Axis, Dots, Line, chart

_GROUPS = ("pixels", "tracks", "boxes", "target_track", "target", "still")
_NAMES = {"right": ("tp", "hit", "found"), "false": ("fp", "false", "blobs"), "missed": ("fn", "missed")}


class Tally(NamedTuple):
    """Of each frame (F,): what is right, false, missed, changed identity, and the rest (of pixels) that is right too.

    unit: what is counted. measure: what 2 right / (2 right + false + missed) is called.
    """

    right: np.ndarray
    false: np.ndarray
    missed: np.ndarray
    switched: np.ndarray
    rest: np.ndarray
    unit: str
    measure: str


def main_group(scored: Scored) -> str | None:
    """The group that shows best where a clip goes wrong."""
    return next((group for group in _GROUPS if group in scored.per_frame), None)


def tally(scored: Scored, group: str) -> Tally:
    """The counts of each frame; 0 where a group has no use for the frame."""
    mine = scored.per_frame[group]

    def of(*names: str) -> np.ndarray:
        known = [np.nan_to_num(np.asarray(mine[name], float)) for name in names if name in mine]
        return known[0] if known else np.zeros(len(scored.frames))

    right, false, missed = (of(*names) for names in _NAMES.values())
    if group in ("target", "target_track"):  # in a frame with the target it is found or missed
        missed = np.maximum(of("frames") - right, 0)
    rest, unit = (of("tn"), "pixels") if group == "pixels" else (np.zeros(len(right)), "boxes")
    measure = "F" if group == "pixels" else "hit" if group in ("target", "target_track") else "F1"
    return Tally(right, false, missed, of("switches"), rest, unit, measure)


MOST_CLIPS = 6
"""Clips whose accuracy over the frames is drawn."""
MOST_FAINT = 40
"""Curves of single clips behind that of all."""
_BINS = 80
_LEAST, _MOST = 0.01, 10.0
"""False positives an image from which and up to which misses are drawn."""
_ALL = "all clips"


def ranked_charts(cases: Sequence[Case]) -> list[str]:
    """Precision against recall, and the miss rate against false positives an image, of each group with scores."""
    charts: list[str] = []
    for group in dict.fromkeys(g for case in cases if case.scored for g in case.scored.ranked):
        mine = [(case.clip.name, case.scored) for case in cases if case.scored and group in case.scored.ranked]
        each = [(name, scored) for name, scored in mine if _true(scored, group)]
        if not each:
            continue
        exact, missing = [], []
        some = each[:MOST_FAINT]
        several = "each clip" if len(some) == len(each) else f"{len(some)} of {len(each)} clips"
        for k, (name, scored) in enumerate([*some, (_ALL, None)] if len(each) > 1 else each):
            whole = scored is None or len(each) == 1
            taken = [one for _, one in each] if scored is None else [scored]
            label = name if whole else several if k == 0 else ""
            colour = 1 if whole else 6
            precision, recall, false = _rates(taken, group)
            # Both curves go on to where nothing is found, and the second to where no more can be had.
            start, end = precision[:1], recall[-1:]
            exact.append(Line(label, np.r_[np.zeros(len(start)), recall], np.r_[start, precision], colour, not whole))
            ways = np.r_[_LEAST, np.maximum(false, _LEAST), _MOST], 1 - np.r_[0.0, recall, end if len(end) else 0.0]
            missing.append(Line(label, *ways, colour, not whole, steps=True))
        up, misses = Axis("precision", 0, 1), Axis("miss rate", 0, 1)
        across = Axis("false positives an image", _LEAST, _MOST, log=True)
        charts.append(chart("Precision and recall", Axis("recall", 0, 1), up, exact))
        charts.append(chart("Misses and false alarms", across, misses, missing))
    return charts


def course_charts(cases: Sequence[Case]) -> list[str]:
    """The accuracy over the frames of each of the first MOST_CLIPS clips that have it."""
    charts: list[str] = []
    for case in cases:
        if case.scored is None or len(charts) == MOST_CLIPS:
            continue
        drawn = _metres(case.clip.name, case.scored) if "error_m" in case.scored.samples else None
        drawn = drawn or _course(case.clip.name, case.scored)
        charts += [drawn] if drawn else []
    return charts


def _true(scored: Scored, group: str) -> int:
    counts = scored.counts.get(group)
    return getattr(counts, "hit", 0) + getattr(counts, "missed", 0)


def _rates(clips: Sequence[Scored], group: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(K,) precision, recall and false positives an image of clips together, as ever lower scores are taken."""
    rows = np.concatenate([scored.ranked[group] for scored in clips])
    unit = np.repeat(np.arange(len(clips)), [len(scored.ranked[group]) for scored in clips])
    true = np.array([_true(scored, group) for scored in clips], float)
    curve = ranking(rows[:, 0], rows[:, 1], unit, true).curve()
    precision, recall = precision_recall(curve, float(true.sum()))
    return precision, recall, curve.false / sum(len(scored.frames) for scored in clips)


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


_MOST_TARGETS = 60
_MOST_ERRORS = 500


def maps(cases: Sequence[Case]) -> list[str]:
    """A map a clip with places, of the first MOST_CLIPS: true ways, and those that were found for the same targets."""
    drawn: list[str] = []
    for case in cases:
        scored, truth = case.scored, case.clip.truth
        if scored is None or truth is None or truth.positions is None or len(drawn) == MOST_CLIPS:
            continue
        if not len(scored.samples.get("east_m", ())):
            continue
        true, samples = truth.positions, scored.samples
        seen = np.isin(true.frame, scored.frames)
        keys = zip(true.frame.tolist(), true.identity.tolist(), strict=True)
        row_of = {key: row for row, key in enumerate(keys)}
        whose = zip(samples["frame"].tolist(), samples["identity"].tolist(), strict=True)
        rows = np.array([row_of[int(frame), int(identity)] for frame, identity in whose])
        # The error is added to the true place: each side may count its metres from an origin of its own.
        found_m = true.east_north_m[rows] + np.stack([samples["east_m"], samples["north_m"]], axis=1)
        lines = [
            *_ways("true", true.identity[seen], true.frame[seen], true.east_north_m[seen], 5, True),
            *_ways("found", samples["identity"], samples["frame"], found_m, 1, False),
        ]
        drawn.append(chart(case.clip.name, Axis("east, m"), Axis("north, m"), lines, equal=True))
    return drawn


def error_clouds(cases: Sequence[Case]) -> list[str]:
    """The errors of all clips together, east and north; a cloud off the middle is a bias."""
    having = [case.scored.samples for case in cases if case.scored and len(case.scored.samples.get("east_m", ()))]
    if not having:
        return []
    off = np.concatenate([np.stack([samples["east_m"], samples["north_m"]], axis=1) for samples in having])
    kept = off[np.unique(np.linspace(0, len(off) - 1, _MOST_ERRORS).astype(int))]
    reach = float(np.percentile(np.abs(kept), 99)) * 1.1 or 1.0
    across, up = Axis("error to the east, m", -reach, reach), Axis("error to the north, m", -reach, reach)
    none = [Dots("no error", np.zeros(1), np.zeros(1), 2, sign="ring")]
    return [chart("Errors", across, up, dots=[Dots("found", kept[:, 0], kept[:, 1], 1), *none], equal=True)]


def _ways(
    name: str, identity: np.ndarray, frame: np.ndarray, east_north_m: np.ndarray, colour: int, dashed: bool
) -> list[Line]:
    """A line an identity, the longest first; a single name for all of them."""
    numbers, counts = np.unique(identity, return_counts=True)
    lines: list[Line] = []
    for number in numbers[np.argsort(-counts, kind="stable")][:_MOST_TARGETS].tolist():
        mine = identity == number
        way = east_north_m[mine][np.argsort(frame[mine], kind="stable")]
        lines.append(Line("" if lines else name, way[:, 0], way[:, 1], colour, dashed=dashed))
    return lines
