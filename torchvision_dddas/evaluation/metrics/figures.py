"""From counts to figures: the measures of each group, and their mean over clips."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from torchvision_dddas.evaluation.metrics import boxes, metres, pixels, tracking
from torchvision_dddas.evaluation.metrics.boxes import Boxes
from torchvision_dddas.evaluation.metrics.clip import Counts
from torchvision_dddas.evaluation.metrics.metres import GroundLocations
from torchvision_dddas.evaluation.metrics.pixels import Pixels, Still
from torchvision_dddas.evaluation.metrics.tracking import TargetTrack, TrackCounts

GROUPS = ("pixels", "boxes", "target", "tracks", "target_track")


def figures(counts: Counts) -> dict[str, dict[str, float]]:
    """The measures of each group, with the counts that they come from."""
    groups: dict[str, dict[str, float]] = {}
    for group, value in counts.items():
        by_name: dict[str, int] = value.by_name() if isinstance(value, TrackCounts) else value._asdict()
        groups[group] = {**of_group(value), **{f"n_{k}": v for k, v in by_name.items()}}
    return groups


def of_group(value: Any) -> dict[str, float]:
    """The measures that come of one group's counts."""
    if isinstance(value, Pixels):
        return pixels.measures(value)
    if isinstance(value, Boxes):
        return boxes.measures(value)
    if isinstance(value, TrackCounts):
        return tracking.measures(value)
    if isinstance(value, TargetTrack):
        return tracking.one_target_measures(value)
    if isinstance(value, Still):
        return pixels.still_measures(value)
    if isinstance(value, GroundLocations):
        return metres.located_measures(value)
    return boxes.one_target_measures(value)


def pooled(clips: Sequence[Counts]) -> Counts:
    """The counts of all clips together, in their order."""
    whole: Counts = {}
    for counts in clips:
        for group, value in counts.items():
            whole[group] = whole[group].plus(value) if group in whole else value  # type: ignore[arg-type]
    return whole


def mean(clips: Sequence[dict[str, Any]], groups: Sequence[str] = GROUPS) -> dict[str, dict[str, float]]:
    """The mean of each measure over the clips that have it, and of F, F1 and IDF1 the worst."""
    means: dict[str, dict[str, float]] = {}
    for group in groups:
        having = [clip[group] for clip in clips if group in clip]
        for measure in having[0] if having else ():
            values = [v for clip in having if not math.isnan(v := clip[measure])]
            if measure.startswith("n_") or not values:
                continue
            means.setdefault(group, {})[measure] = float(np.mean(values))
            if measure in ("f", "f1", "idf1"):
                means[group][f"worst_{measure}"] = min(values)
    return means
