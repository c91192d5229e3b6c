"""Where targets are on the ground, found and true, seen from above."""

from collections.abc import Sequence

import numpy as np

from torchvision_dddas.sinks.charts import Axis, Line, chart
from torchvision_dddas.studies.record import Case

MOST_CLIPS = 6
_MOST_TARGETS = 60


def maps(cases: Sequence[Case]) -> list[str]:
    """A map a clip with positions, of the first MOST_CLIPS: true ways, and those that were found."""
    drawn: list[str] = []
    for case in cases:
        found, truth = case.found, case.clip.truth
        if found is None or truth is None or truth.positions is None or len(drawn) == MOST_CLIPS:
            continue
        known = np.isfinite(found.east_north_m).all(axis=1)
        if not known.any():
            continue
        true = truth.positions
        looked = np.isin(true.frame, found.frame[known])
        lines = [
            *_ways("true", true.identity[looked], true.frame[looked], true.east_north_m[looked], 5, True),
            *_ways("found", found.identity[known], found.frame[known], found.east_north_m[known], 1, False),
        ]
        drawn.append(chart(case.clip.name, Axis("east, m"), Axis("north, m"), lines, equal=True))
    return drawn


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
