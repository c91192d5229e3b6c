"""Results against the truth, for one clip or many: per clip, pooled over pixels and boxes, and the mean over clips."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.metrics import detection, results, segmentation
from torchvision_dddas.metrics import truth as truths
from torchvision_dddas.metrics.detection import Boxes, OneTarget
from torchvision_dddas.metrics.results import Result
from torchvision_dddas.metrics.segmentation import Pixels
from torchvision_dddas.metrics.truth import Truth

Counts = dict[str, Pixels | Boxes | OneTarget]


def evaluate(truth: Path, result: Path, first_frame: int | None = None) -> dict[str, Any]:
    """Score results: {"clips": {name: measures}, "pooled": measures, "mean": measures, "notes": [...]}.

    truth and result are one clip's (masks, boxes; a folder that dddas detect wrote), or folders of clips by name.
    Measures come in groups: `pixels`, `boxes`, `target`. Raises InputError where the two do not fit together.
    """
    notes: list[str] = []
    clips = {}
    for name, (true_place, found_folder) in _pairs(truth, result, notes).items():
        clips[name] = _clip(truths.load(true_place, first_frame), results.load(found_folder), notes)
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
        return {result.resolve().name: (truth, result)}
    names = sorted(p.name for p in truth.iterdir() if p.is_dir()) if truth.is_dir() else []
    there = [n for n in names if results.is_result(result / n)]
    pairs = {n: (truth / n, result / n) for n in there if truths.find(truth / n) is not None}
    if not pairs:
        raise InputError(
            f"no clip to score: no folder in {truth} that holds masks or boxes has its like in {result} "
            "with a detections.txt"
        )
    notes += [f"{n}: no result, not scored" for n in names if n not in there]
    notes += [f"{n}: no truth, not scored" for n in there if n not in pairs]
    return pairs


def _clip(truth: Truth, result: Result, notes: list[str]) -> tuple[int, Counts]:
    """Frames scored and counts of one clip."""
    name = result.folder.resolve().name
    frames = [f for f in truth.frames if 1 <= f <= result.frames]
    beyond = [f for f in truth.frames if f not in frames]
    if not frames:
        raise InputError(
            f"{truth.place} and {result.folder} share no frame: truth {truth.frames[0]} to {truth.frames[-1]}, "
            f"result 1 to {result.frames}"
        )
    if result.state != "complete":
        notes.append(f"{name}: the run is {result.state} after frame {result.frames}; later frames are not scored")
    elif beyond and truth.kind == "masks":
        raise InputError(
            f"{result.folder} has {result.frames} frames, but {truth.place} labels frame {beyond[-1]}; "
            "is it the same clip? See --first-frame"
        )
    elif beyond:
        notes.append(f"{name}: truth goes to frame {beyond[-1]}, the result to {result.frames}; the rest is not scored")
    if truth.kind == "masks":
        return len(frames), _by_masks(truth, result, frames)
    if truth.kind == "one target":
        if not result.has_masks:
            raise InputError(
                f"{result.folder} has no masks, which the hit rate needs; run dddas detect with --save masks"
            )
        target = OneTarget()
        for f in frames:
            target = target.plus(detection.one_target(result.mask_at(f), result.boxes_at(f), truth.boxes[f][0]))
        return target.frames, {"target": target}
    boxes = Boxes()
    for f in frames:
        boxes = boxes.plus(detection.match(result.boxes_at(f), truth.boxes[f]))
    return len(frames), {"boxes": boxes}


def _by_masks(truth: Truth, result: Result, frames: list[int]) -> Counts:
    pixels, boxes = Pixels(), Boxes()
    if not result.has_masks:
        raise InputError(f"{result.folder} has no masks to compare; run dddas detect with --save masks")
    for f in frames:
        labels, mask = truths.read_mask(truth.masks[f]), result.mask_at(f)
        if labels.shape != mask.shape:
            raise InputError(
                f"frame {f}: the truth is {labels.shape[1]}×{labels.shape[0]} pixels ({truth.masks[f]}), "
                f"the result {mask.shape[1]}×{mask.shape[0]} ({result.folder})"
            )
        pixels = pixels.plus(segmentation.count(mask, labels))
        boxes = boxes.plus(detection.match(result.boxes_at(f), detection.boxes_of(labels)))
    return {"pixels": pixels, "boxes": boxes}


def _measures(counts: Counts) -> dict[str, dict[str, float]]:
    """The measures of each group, with the counts that they come from."""
    groups = {}
    for group, value in counts.items():
        if isinstance(value, Pixels):
            found = segmentation.measures(value)
        elif isinstance(value, Boxes):
            found = detection.measures(value)
        else:
            found = detection.one_target_measures(value)
        groups[group] = {**found, **{f"n_{k}": v for k, v in value._asdict().items()}}
    return groups


def _mean(clips: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """The mean of each measure over the clips that have it, and of F and F1 the worst."""
    means: dict[str, dict[str, float]] = {}
    for group in ("pixels", "boxes", "target"):
        having = [clip[group] for clip in clips if group in clip]
        for measure in having[0] if having else ():
            values = [v for clip in having if not math.isnan(v := clip[measure])]
            if measure.startswith("n_") or not values:
                continue
            means.setdefault(group, {})[measure] = float(np.mean(values))
            if measure in ("f", "f1"):
                means[group][f"worst_{measure}"] = min(values)
    return means
