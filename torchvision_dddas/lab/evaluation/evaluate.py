"""Compare results with the truth, for one clip or many: each clip, pooled over the counts, and the mean over clips."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, reduce
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.detection_tables import is_mot_text
from torchvision_dddas.io.images import decode_image
from torchvision_dddas.lab.evaluation.metrics import boxes, pixels, tracking
from torchvision_dddas.lab.evaluation.metrics.matching import LEAST
from torchvision_dddas.lab.evaluation.metrics.pixels import add_counts
from torchvision_dddas.lab.evaluation.metrics.registry import Counts, figures, mean, pooled
from torchvision_dddas.lab.evaluation.metrics.tracking import Each, TargetTrack, TrackCounts
from torchvision_dddas.lab.evaluation.metrics.truth import (
    ClipTruth,
    Ignoring,
    MotRows,
    TrackTable,
    check_identities,
    find_truth,
    labels_of,
    load_truth,
    read_boxes,
    read_rows,
)
from torchvision_dddas.memory import MASK

DETECTIONS, TRACKS = ("detections.txt", "detections.csv"), ("tracks.txt", "tracks.csv")
_ENDINGS = (".txt", ".csv", ".json", ".xml", ".parquet")
_LABELS = ("*.txt", "*.png", "masks/*.png")  # files of YOLO's labels and DAVIS masks
# True boxes of a median size below _SMALL_PX are matched at an IoU of _LOOSE too, to see how many only fit badly.
_SMALL_PX, _LOOSE, _MANY = 16, 0.2, 0.1


def evaluate(
    truth: Path,
    result: Path,
    first_frame: int | None = None,
    interval: int = 1,
    ignoring: Ignoring = "dropped",
    least: float = LEAST,
) -> dict[str, Any]:
    """Score results: {"clips": {name: measures}, "pooled": measures, "mean": measures, "notes": [...]}.

    truth and result belong to one clip (masks, boxes, tracks; a folder that dddas detect or dddas track wrote, or a
    file that `read_detections` reads), or are folders of clips by name. Measures are grouped as in registry.GROUPS.
    least: the IoU from which a box counts as found; HOTA always uses all thresholds. Raise InputError if truth and
    result do not fit together.
    """
    notes: list[str] = []
    clips = score_files(truth, result, notes, first_frame, interval, ignoring, least)
    scored = {name: {"frames": clip.frames, **figures(clip.counts)} for name, clip in clips.items()}
    report = {"clips": scored, "notes": notes}
    if len(clips) > 1:
        report["pooled"] = figures(pooled([clip.counts for clip in clips.values()]))
        report["mean"] = mean(list(scored.values()))
    return report


def score_files(
    truth: Path,
    result: Path,
    notes: list[str],
    first_frame: int | None = None,
    interval: int = 1,
    ignoring: Ignoring = "dropped",
    least: float = LEAST,
) -> "dict[str, ClipScore]":
    """Score the clips of a result by name. Arguments and errors are those of `evaluate`."""
    if interval < 1:
        raise InputError(f"interval must be at least 1 frame, got {interval}")
    if not 0 < least <= 1:
        raise InputError(f"the IoU from which a box counts as found must be above 0 and at most 1, got {least:g}")
    notes += [f"boxes count as found from IoU {least:g} on; HOTA takes all"] if least != LEAST else []
    scored = {}
    for name, (true_place, found_place) in _pairs(truth, result, notes).items():
        true, found = load_truth(true_place, first_frame), load_result(found_place)
        scored[name] = score_clip(true, found, notes, interval, ignoring, least)
    return scored


def _pairs(truth: Path, result: Path, notes: list[str]) -> dict[str, tuple[Path, Path]]:
    """Return the clips to score by name: (truth, result)."""
    for place, what in ((truth, "truth"), (result, "result")):
        if not place.exists():
            raise InputError(f"no {what} at {place}")
    if find_truth(truth) is not None or _is_result(result):
        name = result.resolve()
        return {name.stem if result.is_file() else name.name: (truth, result)}
    names = sorted(p.name for p in truth.iterdir() if p.is_dir()) if truth.is_dir() else []
    places = {n: p for n in names for p in (*(result / f"{n}{e}" for e in _ENDINGS), result / n) if _is_result(p)}
    pairs = {n: (truth / n, p) for n, p in places.items() if find_truth(truth / n) is not None}
    if not pairs:
        raise InputError(
            f"no clip to score: no folder in {truth} that holds masks, boxes or tracks has a counterpart in {result} "
            f"with a {' or '.join(DETECTIONS + TRACKS)}"
        )
    notes += [f"{n}: no result, not scored" for n in names if n not in places]
    notes += [f"{n}: no truth, not scored" for n in places if n not in pairs]
    return pairs


def _is_result(place: Path) -> bool:
    """Return whether a place looks like a result: a file, or a folder that dddas detect or dddas track wrote."""
    return place.is_file() or any((place / name).is_file() for name in DETECTIONS + TRACKS)


@dataclass(frozen=True)
class Result:
    """A result. frames: number of the run's last frame, 0 if unknown. state: state of the run.

    place: the folder or file. detected: (N, 4) boxes of each frame with targets; None if only tracks were written.
    tracks: the boxes with identities; None if there are none. notes: how a file was read.
    """

    place: Path
    frames: int
    detected: dict[int, np.ndarray] | None
    has_masks: bool
    state: str
    tracks: TrackTable | None = None
    notes: tuple[str, ...] = field(default=(), kw_only=True)

    @property
    def name(self) -> str:
        """The name in reports: the folder's name, or the file's name without its ending."""
        place = self.place.resolve()
        return place.stem if place.is_file() else place.name

    def boxes_at(self, frame: int) -> np.ndarray:
        """Return the boxes of a frame, (N, 4): the detections, or the boxes of tracks if there are no detections."""
        if self.detected is not None:
            return self.detected.get(frame, np.zeros((0, 4)))
        return self._tracked.get(frame, np.zeros((0, 4)))

    @cached_property
    def _tracked(self) -> dict[int, np.ndarray]:
        return {} if self.tracks is None else self.tracks.boxes_by_frame()

    def mask_at(self, frame: int) -> np.ndarray:
        """Return the mask of a frame, (H, W). Raise InputError if it is missing."""
        path = self.place / "masks" / f"{frame:06d}.png"
        mask = decode_image(path.read_bytes(), cv2.IMREAD_UNCHANGED, path, MASK) if path.is_file() else None
        if mask is None:
            raise InputError(f"{path} is missing or not a picture; run dddas detect again with --save masks")
        return mask if mask.ndim == 2 else mask.max(axis=2)


def load_result(place: Path) -> Result:
    """Read a result folder, or a file or folder that `read_detections` reads. Raise InputError if it is neither."""
    rows: MotRows | None
    if place.is_file() or (not _is_result(place) and any(any(place.glob(end)) for end in _LABELS)):
        rows, notes = _read_boxes(place)
        if not rows.named:
            return Result(place, 0, rows.table.boxes_by_frame(), False, "complete", notes=notes)
        check_identities(rows.table, rows.line, place)
        return Result(place, 0, None, False, "complete", rows.table, notes=notes)
    if not _is_result(place):
        raise InputError(
            f"{place} is not a result of dddas detect or dddas track: it holds neither {DETECTIONS[0]} nor "
            f"{TRACKS[0]}, nor one of them as .csv"
        )
    detected = tracks = None
    _, rows, said = _read_first(place, DETECTIONS)
    if rows is not None:
        detected = rows.table.boxes_by_frame()
    path, rows, more = _read_first(place, TRACKS)
    if rows is not None:
        check_identities(rows.table, rows.line, path)
        tracks = rows.table
    try:
        record = json.loads((place / "run.json").read_text(encoding="utf-8"))
        written, state, outputs = int(record["frames"]["written"]), str(record["state"]), list(record["outputs"])
        # dddas detect writes every frame; dddas track writes every interval-th frame, from the first frame of its
        # table.
        counted = max(written - 1, 0) * int(record.get("interval_frames", 1)) + min(written, 1)
        frames = int(record.get("last_frame", counted)) if written else 0
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        # Tables of other programs do not state the length of the clip. If there are masks, there is one for each frame.
        numbers = [int(p.stem) for p in (place / "masks").glob("*.png") if p.stem.isdecimal()]
        frames, state, outputs = max(numbers, default=0), "complete", ["masks"] if numbers else []
    return Result(place, frames, detected, "masks" in outputs, state, tracks, notes=(*said, *more))


def _read_first(folder: Path, names: Sequence[str]) -> tuple[Path, MotRows | None, tuple[str, ...]]:
    """Return the place, the boxes and the notes of the first table that a folder holds; no boxes if it holds none."""
    place = next((folder / name for name in names if (folder / name).is_file()), folder)
    if place.suffix == ".txt":
        return place, read_rows(place, place.stem), ()
    return (place, None, ()) if place == folder else (place, *read_boxes(place))


def _read_boxes(place: Path) -> tuple[MotRows, tuple[str, ...]]:
    """The boxes of a result in any format that dddas convert reads, and notes. Raises InputError."""
    if is_mot_text(place):
        return read_rows(place, "result"), ()
    return read_boxes(place)


@dataclass(frozen=True)
class ClipScore:
    """The counts of a clip by group. frames: number of scored frames. each: the counts of single frames, by group."""

    frames: int
    counts: Counts
    each: dict[str, Each]


def score_clip(
    truth: ClipTruth,
    result: Result,
    notes: list[str],
    interval: int = 1,
    ignoring: Ignoring = "dropped",
    least: float = LEAST,
) -> ClipScore:
    """Count everything that a clip's truth and result allow. Notes name what is left out.

    interval: score only frames 1, 1 + interval, ... ignoring: see matching.pair. least: as for `evaluate`. Raise
    InputError if truth and result share no frame, or if the result lacks data that the truth needs.
    """
    frames: list[int] = []
    notes += [f"the truth of {result.name}: {note}" for note in truth.notes]
    notes += [f"{result.name}: {note}" for note in result.notes]
    of_frames: dict[str, list[Any]] = {}
    has_tracks = truth.tracks is not None and result.tracks is not None
    if truth.kind == "masks":
        if result.tracks is not None:
            notes.append(f"{result.name}: tracks are not scored, because masks hold no identities")
        frames = _labelled(truth, result, interval, notes)
        of_frames = _count_masks(truth, result, frames, least)
    elif truth.kind == "one target":
        if result.has_masks:
            frames = _labelled(truth, result, interval, notes)
            counted = [boxes.one_target(result.mask_at(f), result.boxes_at(f), truth.boxes[f][0]) for f in frames]
            of_frames = {"target": counted}
        elif not has_tracks:
            raise InputError(
                f"{result.place} has no masks, which the hit rate needs; run dddas detect with --save masks"
            )
    elif result.detected is not None or not has_tracks:
        frames = _labelled(truth, result, interval, notes)
        of_frames = {"boxes": [boxes.match(result.boxes_at(f), truth.boxes[f], least) for f in frames]}
    counts: Counts = {}
    each: dict[str, Each] = {}
    for group, counted in of_frames.items():
        counts[group] = whole = reduce(add_counts, counted)
        columns = dict(zip(whole._fields, np.array(counted, float).T, strict=True))
        each[group] = {"frame": np.array(frames, np.int64), **columns}
    scored = len(frames)
    if truth.tracks is not None and result.tracks is not None:
        length, name, found, by_frame = _count_tracks(
            truth, truth.tracks, result, result.tracks, notes, interval, ignoring, least
        )
        scored, counts[name], each[name] = max(scored, length), found, by_frame
    if truth.kind == "boxes":
        notes += _note_small(truth, result, interval, least)
    return ClipScore(scored, counts, each)


def _note_small(truth: ClipTruth, result: Result, interval: int, least: float) -> list[str]:
    """Return a note if true boxes are so small that many are missed by their IoU alone."""
    frames = [f for f in truth.frames if (f - 1) % interval == 0]
    sides_px = np.sqrt(np.concatenate([truth.boxes[f][:, 2:].prod(axis=1) for f in frames] or [np.zeros(0)]))
    if not len(sides_px) or (median_px := np.median(sides_px)) >= _SMALL_PX or least <= _LOOSE:
        return []
    loose, hit = (
        sum(boxes.match(result.boxes_at(f), truth.boxes[f], iou).hit for f in frames) for iou in (_LOOSE, least)
    )
    if loose - hit <= _MANY * len(sides_px):
        return []
    size = f"the median true box is as large as a square of {median_px:.0f} px, which an offset of few pixels misses"
    more = f"IoU {_LOOSE} finds {loose - hit} more of {len(sides_px)} boxes than IoU {least:g}"
    return [f"{result.name}: {size}: {more}; --iou {_LOOSE} counts them as found"]


def _labelled(truth: ClipTruth, result: Result, interval: int, notes: list[str]) -> list[int]:
    """Return the labelled frames that the result has."""
    end = result.frames or truth.frames[-1]
    frames = [f for f in truth.frames if 1 <= f <= end and (f - 1) % interval == 0]
    beyond = [f for f in truth.frames if not 1 <= f <= end]
    if not frames:
        raise InputError(
            f"{truth.place} and {result.place} share no frame{_of(interval)}: truth {truth.frames[0]} to "
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
        notes.append(f"{result.name}: truth ends at frame {beyond[-1]}, the result at {end}; the rest is not scored")
    return frames


def _count_masks(truth: ClipTruth, result: Result, frames: list[int], least: float) -> dict[str, list[Any]]:
    if not result.has_masks:
        raise InputError(f"{result.place} has no masks to compare; run dddas detect with --save masks")
    counted: dict[str, list[Any]] = {"pixels": [], "boxes": []} if truth.labels.separate else {"pixels": []}
    for f in frames:
        labels, mask = labels_of(truth, f), result.mask_at(f)
        if labels.shape != mask.shape:
            raise InputError(
                f"frame {f}: the truth is {labels.shape[1]}×{labels.shape[0]} pixels ({truth.masks[f]}), "
                f"the result {mask.shape[1]}×{mask.shape[0]} ({result.place})"
            )
        counted["pixels"].append(pixels.count(mask, labels))
        if truth.labels.separate:
            counted["boxes"].append(boxes.match(result.boxes_at(f), boxes.boxes_of(labels), least))
    return counted


def _count_tracks(
    truth: ClipTruth,
    true: TrackTable,
    result: Result,
    found: TrackTable,
    notes: list[str],
    interval: int,
    ignoring: Ignoring,
    least: float,
) -> tuple[int, str, TrackCounts | TargetTrack, Each]:
    """Count tracks on every frame of the clip, labelled or not: a box in a frame without labels is false."""
    labelled = max(truth.frames[-1], truth.length)
    end = labelled if result.state == "complete" else min(labelled, result.frames)
    last = int(found.frame.max(initial=0))
    if len(found.frame) and (found.frame.min() > labelled or last < truth.frames[0]):
        raise InputError(
            f"{truth.place} and {result.place} share no frame: truth {truth.frames[0]} to {labelled}, "
            f"result {found.frame.min()} to {last}"
        )
    if len(true.frame) and not ((true.frame - 1) % interval == 0).any():
        raise InputError(f"{truth.place} has no box{_of(interval)}")
    if last > labelled:
        notes.append(f"{result.name}: tracks end at frame {last}, the truth at {labelled}; later frames are not scored")
    if end < labelled:
        note = f"{result.name}: the run is {result.state} after frame {end}; later frames are not scored"
        notes += [note] if note not in notes else []
    step = int(np.gcd.reduce(found.frame - 1)) if len(found.frame) else 0
    if step > interval:
        notes.append(f"{result.name}: the tracks have only every {step}th frame; --interval {step} scores only these")

    def cut(table: TrackTable) -> TrackTable:
        return table.at((table.frame <= end) & ((table.frame - 1) % interval == 0))

    frames = len(range(1, end + 1, interval))
    if truth.kind == "one target":
        return frames, "target_track", *tracking.count_one_target(cut(true), cut(found))
    ignored = None if truth.ignored is None else cut(truth.ignored)
    return frames, "tracks", *tracking.count(cut(true), cut(found), ignored, ignoring, interval, least)


def _of(interval: int) -> str:
    return f" of every {interval}th" if interval > 1 else ""
