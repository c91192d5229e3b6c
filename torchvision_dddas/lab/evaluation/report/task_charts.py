"""The charts of a task: ranked curves, maps, errors on the ground."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from torchvision_dddas.io.report.charts import Axis, Dots, Line, chart
from torchvision_dddas.lab.evaluation.metrics.boxes import precision_recall
from torchvision_dddas.lab.evaluation.studies.records import Case, Scored
from torchvision_dddas.lab.evaluation.studies.summary import rank

MOST_CLIPS = 6
"""Largest number of clips with a map."""
MOST_FAINT = 40
"""Largest number of curves of single clips behind the curve of all."""
_LEAST, _MOST = 0.01, 10.0
"""Smallest and largest number of false positives per image in the plot of misses."""
_MOST_TARGETS = 60
_MOST_ERRORS = 500


class Tally(NamedTuple):
    """Numbers for each frame (F,): right, false, missed, changed identities, and other right pixels.

    unit: unit of the numbers. measure: name of 2 right / (2 right + false + missed).
    """

    right: np.ndarray
    false: np.ndarray
    missed: np.ndarray
    switched: np.ndarray
    rest: np.ndarray
    unit: str
    measure: str


def tally(scored: Scored) -> Tally | None:
    """Return the counts of each frame in the group that shows errors best; counts that the group lacks are 0.

    None without such a group.
    """
    groups = ("pixels", "tracks", "boxes", "target_track", "target", "still")
    group = next((group for group in groups if group in scored.per_frame), None)
    if group is None:
        return None
    counts = scored.per_frame[group]

    def first_of(*names: str) -> np.ndarray:
        known = [np.nan_to_num(np.asarray(counts[name], float)) for name in names if name in counts]
        return known[0] if known else np.zeros(len(scored.frames))

    right, false = first_of("tp", "hit", "found"), first_of("fp", "false", "blobs")
    missed, switched = first_of("fn", "missed"), first_of("switches")
    if group in ("target", "target_track"):  # in a frame with the target, it is found or missed
        missed = np.maximum(first_of("frames") - right, 0)
        return Tally(right, false, missed, switched, np.zeros(len(right)), "boxes", "hit")
    if group == "pixels":
        return Tally(right, false, missed, switched, first_of("tn"), "pixels", "F")
    return Tally(right, false, missed, switched, np.zeros(len(right)), "boxes", "F1")


def ranked_charts(cases: Sequence[Case]) -> list[Markup]:
    """Return precision against recall, and miss rate against false positives per image, of all clips with scores."""
    having = [(case.clip.name, [case.scored]) for case in cases if case.scored and "boxes" in case.scored.ranked]
    each = [(name, clips) for name, clips in having if rank(clips).true.any()]
    if not each:
        return []
    exact, missing = [], []
    faint = each[:MOST_FAINT] if len(each) > 1 else []
    several = "each clip" if len(faint) == len(each) else f"{len(faint)} of {len(each)} clips"
    whole = ("all clips", [scored for _, (scored,) in each]) if len(each) > 1 else each[0]
    for k, (name, clips) in enumerate([*faint, whole]):
        is_faint = k < len(faint)
        label, colour = (("" if k else several), 6) if is_faint else (name, 1)
        ranked = rank(clips)
        curve = ranked.curve()
        precision, recall = precision_recall(curve, float(ranked.true.sum()))
        false = curve.false / sum(len(scored.frames) for scored in clips)
        # Both curves begin where nothing is found; the second ends where no more can be found.
        start, end = precision[:1], recall[-1:]
        exact.append(Line(label, np.r_[np.zeros(len(start)), recall], np.r_[start, precision], colour, is_faint))
        ways = np.r_[_LEAST, np.maximum(false, _LEAST), _MOST], 1 - np.r_[0.0, recall, end if len(end) else 0.0]
        missing.append(Line(label, *ways, colour, is_faint, steps=True))
    across = Axis("false positives per image", _LEAST, _MOST, log=True)
    return [
        chart("Precision and recall", Axis("recall", 0, 1), Axis("precision", 0, 1), exact),
        chart("Misses and false alarms", across, Axis("miss rate", 0, 1), missing),
    ]


def maps(cases: Sequence[Case]) -> list[Markup]:
    """Return maps of the first MOST_CLIPS clips with places: true paths, and found paths of the same targets."""
    drawn: list[Markup] = []
    for case in cases:
        scored, truth = case.scored, case.clip.truth
        if scored is None or truth is None or truth.positions is None or len(drawn) == MOST_CLIPS:
            continue
        true, samples = truth.positions, scored.samples
        if not len(samples.get("east_m", ())):
            continue
        seen = np.isin(true.frame, scored.frames)
        row_of = {key: row for row, key in enumerate(zip(true.frame.tolist(), true.identity.tolist(), strict=True))}
        whose = zip(samples["frame"].tolist(), samples["identity"].tolist(), strict=True)
        rows = [row_of[int(frame), int(identity)] for frame, identity in whose]
        # Add the error to the true place, because each side may count its metres from another origin.
        found_m = true.east_north_m[rows] + np.stack([samples["east_m"], samples["north_m"]], axis=1)
        lines = [
            *_ways("true", true.identity[seen], true.frame[seen], true.east_north_m[seen], 5, True),
            *_ways("found", samples["identity"], samples["frame"], found_m, 1, False),
        ]
        drawn.append(chart(case.clip.name, Axis("east, m"), Axis("north, m"), lines, equal=True))
    return drawn


def _ways(
    name: str, identity: np.ndarray, frame: np.ndarray, east_north_m: np.ndarray, colour: int, dashed: bool
) -> list[Line]:
    """Return a line for each identity, the longest first, with a single name for all lines."""
    numbers, counts = np.unique(identity, return_counts=True)
    lines: list[Line] = []
    for number in numbers[np.argsort(-counts, kind="stable")][:_MOST_TARGETS].tolist():
        mine = identity == number
        way = east_north_m[mine][np.argsort(frame[mine], kind="stable")]
        lines.append(Line("" if lines else name, way[:, 0], way[:, 1], colour, dashed=dashed))
    return lines


def error_clouds(cases: Sequence[Case]) -> list[Markup]:
    """Return the errors of all clips together, east and north. A cloud off the centre shows a bias."""
    having = [case.scored.samples for case in cases if case.scored and len(case.scored.samples.get("east_m", ()))]
    if not having:
        return []
    off = np.concatenate([np.stack([samples["east_m"], samples["north_m"]], axis=1) for samples in having])
    kept = off[np.unique(np.linspace(0, len(off) - 1, _MOST_ERRORS).astype(int))]
    reach = float(np.percentile(np.abs(kept), 99)) * 1.1 or 1.0
    across, up = Axis("error to the east, m", -reach, reach), Axis("error to the north, m", -reach, reach)
    none = [Dots("no error", np.zeros(1), np.zeros(1), 2, is_ring=True)]
    return [chart("Errors", across, up, dots=[Dots("found", kept[:, 0], kept[:, 1], 1), *none], equal=True)]
