"""The measures of a study's metrics.json as figures with their intervals."""

import math
from collections.abc import Mapping
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
    """A task's figures: of each clip by name, of all counts together, the mean over clips, and the worst of a clip."""

    clips: Mapping[str, Groups] = field(default_factory=dict)
    pooled: Groups = field(default_factory=dict)
    mean: Groups = field(default_factory=dict)


def told(metrics: Mapping[str, Any], task: str) -> Told:
    """A task's figures; empty where the study has none of it."""
    mine = metrics.get("tasks", {}).get(task, {})
    clips = {name: _groups(clip) for name, clip in mine.get("clips", {}).items()}
    return Told(clips, _groups(mine.get("pooled", {})), _groups(mine.get("mean", {})))


def _groups(groups: Mapping[str, Any]) -> Groups:
    return {
        group: {name: _figure(value) for name, value in measures.items()}
        for group, measures in groups.items()
        if isinstance(measures, Mapping)
    }


def _figure(value: Any) -> Figure:
    if isinstance(value, Mapping):
        low, high = value.get("interval") or (value.get("low"), value.get("high"))
        return Figure(_number(value.get("value")), _number(low), _number(high))
    if isinstance(value, (list, tuple)) and len(value) == 3:
        return Figure(*(_number(v) for v in value))
    return Figure(_number(value))


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan
