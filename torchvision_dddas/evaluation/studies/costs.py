"""What a study cost: time of each stage, frames a second, memory. It belongs to run.json: it is another each time."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from torchvision_dddas.evaluation.metrics.pixels import ratio
from torchvision_dddas.evaluation.studies.record import TASKS, Case, Results


def costs(results: Results) -> dict[str, Any]:
    """By task: "clips" by name, and all of them together.

    {task: {"clips": {name: {"frames": looked at, "seconds": in all stages, "frames_per_s": .., "ms_per_frame": {stage:
    ..}, "peak_mb": ..}}, "all": the same, of all clips; peak_mb the most}}. Times are those that the stages took where
    they were computed, kept with their results; a stage that another task shares is in the cost of both.
    """
    found: dict[str, Any] = {}
    for task in TASKS:
        cases = sorted((c for c in results.cases if c.task == task and c.found is not None), key=lambda c: c.clip.name)
        if cases:
            found[task] = {"clips": {case.clip.name: _cost([case]) for case in cases}, "all": _cost(cases)}
    return found


def _cost(cases: Sequence[Case]) -> dict[str, Any]:
    seconds: Counter[str] = Counter()
    frames, peaks = 0, [float("nan")]
    for case in cases:
        assert case.found is not None
        seconds.update(case.found.seconds)
        frames += len(case.found.looked)
        peaks.append(case.found.peak_mb)
    total = sum(seconds.values())
    known = [peak for peak in peaks if np.isfinite(peak)]
    return {
        "frames": frames,
        "seconds": total,
        "frames_per_s": ratio(frames, total),
        "ms_per_frame": {stage: 1000 * ratio(spent, frames) for stage, spent in sorted(seconds.items())},
        "peak_mb": max(known) if known else float("nan"),
    }
