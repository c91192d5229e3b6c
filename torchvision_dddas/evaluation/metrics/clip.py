"""Scoring one clip: which measures its truth and its result allow, over which frames."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics import detection, segmentation, tracking
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.detection import Boxes, OneTarget
from torchvision_dddas.evaluation.metrics.matching import Ignoring, TrackTable
from torchvision_dddas.evaluation.metrics.metres import GroundLocations
from torchvision_dddas.evaluation.metrics.results import Result
from torchvision_dddas.evaluation.metrics.segmentation import Pixels
from torchvision_dddas.evaluation.metrics.still import Still
from torchvision_dddas.evaluation.metrics.tracking import Each, TargetTrack, TrackCounts
from torchvision_dddas.evaluation.metrics.truth import Truth

Counts = dict[str, Pixels | Boxes | OneTarget | TrackCounts | TargetTrack | Still | GroundLocations]


@dataclass(frozen=True)
class How:
    """How to score. interval: frames 1, 1 + interval, ... alone. ignoring: see matching.pair."""

    interval: int = 1
    ignoring: Ignoring = "dropped"


@dataclass(frozen=True)
class ClipScore:
    """A clip's counts by group. frames: how many were scored. each: the counts of single frames, by group."""

    frames: int
    counts: Counts
    each: dict[str, Each]


def score_clip(truth: Truth, result: Result, how: How, notes: list[str]) -> ClipScore:
    """Count what a clip's truth and result allow; what is left out is added to the notes.

    Raises InputError where truth and result share no frame, or the result lacks what the truth asks for.
    """
    counts: Counts = {}
    each: dict[str, Each] = {}
    frames: list[int] = []
    followed = truth.tracks is not None and result.tracks is not None
    if truth.kind == "masks" and result.tracks is not None:
        notes.append(f"{result.name}: tracks are not scored, for masks do not tell identities")
    if truth.kind == "one target" and not result.has_masks and not followed:
        raise InputError(f"{result.place} has no masks, which the hit rate needs; run dddas detect with --save masks")
    if truth.kind == "masks" or (truth.kind == "one target" and result.has_masks):
        frames = _labelled(truth, result, how, notes)
        counts, each = _summed(frames, (_by_masks if truth.kind == "masks" else _by_one)(truth, result, frames))
    elif truth.kind == "boxes" and (result.detected is not None or not followed):
        frames = _labelled(truth, result, how, notes)
        boxes: dict[str, list[Any]] = {"boxes": [detection.match(result.boxes_at(f), truth.boxes[f]) for f in frames]}
        counts, each = _summed(frames, boxes)
    if truth.tracks is not None and result.tracks is not None:
        scored, name, found, of_each = _by_tracks(truth, truth.tracks, result, result.tracks, how, notes)
        return ClipScore(max(len(frames), scored), {**counts, name: found}, {**each, name: of_each})
    return ClipScore(len(frames), counts, each)


def _summed(frames: list[int], groups: dict[str, list[Any]]) -> tuple[Counts, dict[str, Each]]:
    """The counts of a clip and of its frames, from a group's counts of each of the frames."""
    counts: Counts = {}
    each: dict[str, Each] = {}
    for group, of_frames in groups.items():
        whole = of_frames[0]
        for one in of_frames[1:]:
            whole = whole.plus(one)
        counts[group] = whole
        columns = dict(zip(whole._fields, np.array(of_frames, float).T, strict=True))
        each[group] = {"frame": np.array(frames, np.int64), **columns}
    return counts, each


def _labelled(truth: Truth, result: Result, how: How, notes: list[str]) -> list[int]:
    """The labelled frames that the result has."""
    end = result.frames or truth.frames[-1]
    frames = [f for f in truth.frames if 1 <= f <= end and (f - 1) % how.interval == 0]
    beyond = [f for f in truth.frames if not 1 <= f <= end]
    if not frames:
        raise InputError(
            f"{truth.place} and {result.place} share no frame{_of(how)}: truth {truth.frames[0]} to "
            f"{truth.frames[-1]}, result 1 to {end}"
        )
    if result.state != "complete":
        notes.append(f"{result.name}: the run is {result.state} after frame {end}; later frames are not scored")
    elif beyond and truth.kind == "masks":
        raise InputError(
            f"{result.place} has {end} frames, but {truth.place} labels frame {beyond[-1]}; "
            "is it the same clip? See --first-frame"
        )
    elif beyond:
        notes.append(f"{result.name}: truth goes to frame {beyond[-1]}, the result to {end}; the rest is not scored")
    return frames


def _by_one(truth: Truth, result: Result, frames: list[int]) -> dict[str, list[Any]]:
    one = detection.one_target
    return {"target": [one(result.mask_at(f), result.boxes_at(f), truth.boxes[f][0]) for f in frames]}


def _by_masks(truth: Truth, result: Result, frames: list[int]) -> dict[str, list[Any]]:
    pixels, boxes = [], []
    if not result.has_masks:
        raise InputError(f"{result.place} has no masks to compare; run dddas detect with --save masks")
    for f in frames:
        labels, mask = truths.labels_of(truth, f), result.mask_at(f)
        if labels.shape != mask.shape:
            raise InputError(
                f"frame {f}: the truth is {labels.shape[1]}×{labels.shape[0]} pixels ({truth.masks[f]}), "
                f"the result {mask.shape[1]}×{mask.shape[0]} ({result.place})"
            )
        pixels.append(segmentation.count(mask, labels))
        if truth.labels.separate:
            boxes.append(detection.match(result.boxes_at(f), detection.boxes_of(labels)))
    return {"pixels": pixels, "boxes": boxes} if truth.labels.separate else {"pixels": pixels}


def _by_tracks(
    truth: Truth, true: TrackTable, result: Result, found: TrackTable, how: How, notes: list[str]
) -> tuple[int, str, TrackCounts | TargetTrack, Each]:
    """Tracks are scored on every frame of the clip, labelled or not: a box where nobody is labelled is false."""
    labelled = max(truth.frames[-1], truth.length)
    end = labelled if result.state == "complete" else min(labelled, result.frames)
    if len(found.frame) and (found.frame.min() > labelled or found.frame.max() < truth.frames[0]):
        raise InputError(
            f"{truth.place} and {result.place} share no frame: truth {truth.frames[0]} to {labelled}, "
            f"result {found.frame.min()} to {found.frame.max()}"
        )
    frames = len(range(1, end + 1, how.interval))
    if not ((true.frame - 1) % how.interval == 0).any() and len(true.frame):
        raise InputError(f"{truth.place} has no box{_of(how)}")
    if len(found.frame) and found.frame.max() > labelled:
        notes.append(f"{result.name}: tracks go to frame {found.frame.max()}, the truth to {labelled}; no more counts")
    if end < labelled:
        said = f"{result.name}: the run is {result.state} after frame {end}; later frames are not scored"
        notes += [said] if said not in notes else []
    step = int(np.gcd.reduce(found.frame - 1)) if len(found.frame) else 0
    if step > how.interval:
        notes.append(f"{result.name}: the tracks have every {step}th frame alone; --interval {step} scores just those")

    def cut(table: TrackTable) -> TrackTable:
        return table.at((table.frame <= end) & ((table.frame - 1) % how.interval == 0))

    if truth.kind == "one target":
        return frames, "target_track", *tracking.one_target_by_frame(cut(true), cut(found))
    ignored = None if truth.ignored is None else cut(truth.ignored)
    return frames, "tracks", *tracking.by_frame(cut(true), cut(found), ignored, how.ignoring, how.interval)


def _of(how: How) -> str:
    return f" of every {how.interval}th" if how.interval > 1 else ""
