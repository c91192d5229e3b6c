"""Results against the truth, for one clip or many: per clip, pooled over the counts, and the mean over clips."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.metrics import detection, results, segmentation, tracking
from torchvision_dddas.metrics import truth as truths
from torchvision_dddas.metrics.clip import Counts, How, score_clip
from torchvision_dddas.metrics.detection import Boxes
from torchvision_dddas.metrics.matching import Ignoring
from torchvision_dddas.metrics.segmentation import Pixels
from torchvision_dddas.metrics.tracking import TargetTrack, TrackCounts

GROUPS = ("pixels", "boxes", "target", "tracks", "target_track")


def evaluate(
    truth: Path,
    result: Path,
    first_frame: int | None = None,
    interval: int = 1,
    ignoring: Ignoring = "dropped",
) -> dict[str, Any]:
    """Score results: {"clips": {name: measures}, "pooled": measures, "mean": measures, "notes": [...]}.

    truth and result are one clip's (masks, boxes, tracks; a folder that dddas detect or dddas track wrote, or
    MOTChallenge text), or folders of clips by name. Measures come in GROUPS. Raises InputError where the two do not
    fit together.
    """
    if interval < 1:
        raise InputError(f"the interval is {interval} frames; wanted 1 or more")
    how = How(interval, ignoring)
    notes: list[str] = []
    clips = {}
    for name, (true_place, found_place) in _pairs(truth, result, notes).items():
        clips[name] = score_clip(truths.load(true_place, first_frame), results.load(found_place), how, notes)
    pooled: Counts = {}
    for _, counts in clips.values():
        for group, value in counts.items():
            pooled[group] = pooled[group].plus(value) if group in pooled else value  # type: ignore[arg-type]
    scored = {name: {"frames": frames, **_measures(counts)} for name, (frames, counts) in clips.items()}
    report = {"clips": scored, "notes": notes}
    if len(clips) > 1:
        report["pooled"] = _measures(pooled)
        report["mean"] = _mean(list(scored.values()))
    return report


def _pairs(truth: Path, result: Path, notes: list[str]) -> dict[str, tuple[Path, Path]]:
    """The clips to score by name: (truth, result)."""
    for place, what in ((truth, "truth"), (result, "result")):
        if not place.exists():
            raise InputError(f"no {what} at {place}")
    if truths.find(truth) is not None or results.is_result(result):
        name = result.resolve()
        return {name.stem if result.is_file() else name.name: (truth, result)}
    names = sorted(p.name for p in truth.iterdir() if p.is_dir()) if truth.is_dir() else []
    places = {n: p for n in names for p in (result / f"{n}.txt", result / n) if results.is_result(p)}
    pairs = {n: (truth / n, p) for n, p in places.items() if truths.find(truth / n) is not None}
    if not pairs:
        raise InputError(
            f"no clip to score: no folder in {truth} that holds masks, boxes or tracks has its like in {result} "
            f"with a {results.DETECTIONS} or {results.TRACKS}"
        )
    notes += [f"{n}: no result, not scored" for n in names if n not in places]
    notes += [f"{n}: no truth, not scored" for n in places if n not in pairs]
    return pairs


def _measures(counts: Counts) -> dict[str, dict[str, float]]:
    """The measures of each group, with the counts that they come from."""
    groups: dict[str, dict[str, float]] = {}
    for group, value in counts.items():
        by_name: dict[str, int] = value.by_name() if isinstance(value, TrackCounts) else value._asdict()
        if isinstance(value, Pixels):
            found = segmentation.measures(value)
        elif isinstance(value, Boxes):
            found = detection.measures(value)
        elif isinstance(value, TrackCounts):
            found = tracking.measures(value)
        elif isinstance(value, TargetTrack):
            found = tracking.one_target_measures(value)
        else:
            found = detection.one_target_measures(value)
        groups[group] = {**found, **{f"n_{k}": v for k, v in by_name.items()}}
    return groups


def _mean(clips: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """The mean of each measure over the clips that have it, and of F, F1 and IDF1 the worst."""
    means: dict[str, dict[str, float]] = {}
    for group in GROUPS:
        having = [clip[group] for clip in clips if group in clip]
        for measure in having[0] if having else ():
            values = [v for clip in having if not math.isnan(v := clip[measure])]
            if measure.startswith("n_") or not values:
                continue
            means.setdefault(group, {})[measure] = float(np.mean(values))
            if measure in ("f", "f1", "idf1"):
                means[group][f"worst_{measure}"] = min(values)
    return means
