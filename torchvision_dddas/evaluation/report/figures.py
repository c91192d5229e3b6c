"""The measures of a study's metrics.json as figures with their intervals."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple


class Figure(NamedTuple):
    """A value and the ends of its interval, NaN where unknown."""

    value: float
    low: float = math.nan
    high: float = math.nan


Groups = Mapping[str, Mapping[str, Figure]]
"""Figures by group and measure."""


@dataclass(frozen=True)
class Told:
    """A task's figures: of each clip by name, of all counts together, and the mean over clips.

    over: by group, what the intervals of all together are over: "clips", or "frames", which says nothing of others.
    """

    clips: Mapping[str, Groups] = field(default_factory=dict)
    pooled: Groups = field(default_factory=dict)
    mean: Groups = field(default_factory=dict)
    over: Mapping[str, str] = field(default_factory=dict)


def told(metrics: Mapping[str, Any], task: str) -> Told:
    """A task's figures; empty where the study has none of it."""
    mine = metrics.get("tasks", {}).get(task, {})
    clips = {name: _groups(clip) for name, clip in mine.get("clips", {}).items()}
    pooled = mine.get("pooled", {})
    return Told(clips, _groups(pooled), _groups(mine.get("mean", {})), pooled.get("over", {}))


def _groups(groups: Mapping[str, Any]) -> Groups:
    spans = groups.get("intervals", {})
    return {
        group: {name: _figure(value, spans.get(group, {}).get(name)) for name, value in measures.items()}
        for group, measures in groups.items()
        if isinstance(measures, Mapping) and group not in ("intervals", "over")
    }


def _figure(value: Any, span: Sequence[float] | None) -> Figure:
    low, high = span or (None, None)
    return Figure(_number(value), _number(low), _number(high))


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan
