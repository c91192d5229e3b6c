"""Where targets are on the ground, found and true, seen from above; and how far the one is from the other."""

from collections.abc import Sequence

import numpy as np

from torchvision_dddas.evaluation.studies.results import Case
from torchvision_dddas.io.report import Axis, Dots, Line, chart

MOST_CLIPS = 6
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
