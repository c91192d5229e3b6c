"""Scoring one clip: which measures its truth and its result allow, over which frames."""

import json
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics import boxes, pixels, tracking, truth
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.pixels import add_counts
from torchvision_dddas.evaluation.metrics.registry import Counts
from torchvision_dddas.evaluation.metrics.tracking import Each, TargetTrack, TrackCounts
from torchvision_dddas.evaluation.metrics.truth import Ignoring, TrackTable, Truth
from torchvision_dddas.io.images import decode_image


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


@dataclass(frozen=True)
class Result:
    """A result. frames: the last one of the run, 0 where nothing says. state: of the run.

    place: the folder or file. detected: (N, 4) boxes of each frame with targets, None where only tracks were written.
    tracks: the boxes with identities, None where there are none.
    """

    place: Path
    frames: int
    detected: dict[int, np.ndarray] | None
    has_masks: bool
    state: str
    tracks: TrackTable | None = None

    @property
    def name(self) -> str:
        """What to call it: the folder's name, or the file's without its ending."""
        place = self.place.resolve()
        return place.stem if place.is_file() else place.name

    def boxes_at(self, frame: int) -> np.ndarray:
        """(N, 4) boxes of a frame: the detections, or the tracks' where there are none."""
        if self.detected is not None:
            return self.detected.get(frame, np.zeros((0, 4)))
        return np.zeros((0, 4)) if self.tracks is None else self.tracks.box_px[self.tracks.frame == frame]

    def mask_at(self, frame: int) -> np.ndarray:
        """(H, W) mask of a frame. Raises InputError if it is not there."""
        path = self.place / "masks" / f"{frame:06d}.png"
        mask = decode_image(path.read_bytes(), cv2.IMREAD_UNCHANGED) if path.is_file() else None
        if mask is None:
            raise InputError(f"{path} is missing or no picture; run dddas detect again with --save masks")
        return mask if mask.ndim == 2 else mask.max(axis=2)


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
        matched = [boxes.match(result.boxes_at(f), truth.boxes[f]) for f in frames]
        counts, each = _summed(frames, {"boxes": matched})
    if truth.tracks is not None and result.tracks is not None:
        scored, name, found, of_each = _by_tracks(truth, truth.tracks, result, result.tracks, how, notes)
        return ClipScore(max(len(frames), scored), {**counts, name: found}, {**each, name: of_each})
    return ClipScore(len(frames), counts, each)


def _summed(frames: list[int], groups: dict[str, list[Any]]) -> tuple[Counts, dict[str, Each]]:
    """The counts of a clip and of its frames, from a group's counts of each of the frames."""
    counts: Counts = {}
    each: dict[str, Each] = {}
    for group, of_frames in groups.items():
        counts[group] = whole = reduce(add_counts, of_frames)
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
    one = boxes.one_target
    return {"target": [one(result.mask_at(f), result.boxes_at(f), truth.boxes[f][0]) for f in frames]}


def _by_masks(truth: Truth, result: Result, frames: list[int]) -> dict[str, list[Any]]:
    pixel_counts, box_counts = [], []
    if not result.has_masks:
        raise InputError(f"{result.place} has no masks to compare; run dddas detect with --save masks")
    for f in frames:
        labels, mask = truths.labels_of(truth, f), result.mask_at(f)
        if labels.shape != mask.shape:
            raise InputError(
                f"frame {f}: the truth is {labels.shape[1]}×{labels.shape[0]} pixels ({truth.masks[f]}), "
                f"the result {mask.shape[1]}×{mask.shape[0]} ({result.place})"
            )
        pixel_counts.append(pixels.count(mask, labels))
        if truth.labels.separate:
            box_counts.append(boxes.match(result.boxes_at(f), boxes.boxes_of(labels)))
    found: dict[str, list[Any]] = {"pixels": pixel_counts}
    return found | {"boxes": box_counts} if truth.labels.separate else found


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


DETECTIONS, TRACKS = "detections.txt", "tracks.txt"


def is_result(place: Path) -> bool:
    """Whether a place looks like a result: a file, or a folder that dddas detect or dddas track wrote."""
    return place.is_file() or any((place / name).is_file() for name in (DETECTIONS, TRACKS))


def load(place: Path) -> Result:
    """Read a result folder, or a file of MOTChallenge text. Raises InputError if it is none."""
    if place.is_file():
        rows = truth.read_rows(place, "result")
        if rows.named:
            truth.check_identities(rows.table, rows.line, place)
            return Result(place, 0, None, False, "complete", rows.table)
        return Result(place, 0, _by_frame(rows.table), False, "complete")
    if not is_result(place):
        raise InputError(
            f"{place} is no result of dddas detect: it holds no {DETECTIONS}; nor of dddas track: no {TRACKS}"
        )
    detected = tracks = None
    if (place / DETECTIONS).is_file():
        detected = _by_frame(truth.read_rows(place / DETECTIONS, "detections").table)
    if (place / TRACKS).is_file():
        rows = truth.read_rows(place / TRACKS, "tracks")
        truth.check_identities(rows.table, rows.line, place / TRACKS)
        tracks = rows.table
    try:
        record = json.loads((place / "run.json").read_text(encoding="utf-8"))
        looks, state, outputs = int(record["frames"]["written"]), str(record["state"]), list(record["outputs"])
        # dddas track writes every interval-th frame, from wherever its table begins; dddas detect each.
        counted = max(looks - 1, 0) * int(record.get("interval_frames", 1)) + min(looks, 1)
        frames = int(record.get("last_frame", counted)) if looks else 0
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        # Tables of another program: only masks can say how long the clip is, as there is one for each frame.
        numbers = [int(p.stem) for p in (place / "masks").glob("*.png") if p.stem.isdecimal()]
        frames, state, outputs = max(numbers, default=0), "complete", ["masks"] if numbers else []
    return Result(place, frames, detected, "masks" in outputs, state, tracks)


def _by_frame(table: TrackTable) -> dict[int, np.ndarray]:
    return {int(f): table.box_px[table.frame == f] for f in np.unique(table.frame)}
