"""The scores of one clip: the counts of `dddas evaluate` frame by frame, ranked boxes, errors in metres."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.ground_tables import read_landmarks
from torchvision_dddas.io.images import decode_image
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.evaluate import ClipScore, Result, score_clip
from torchvision_dddas.lab.evaluation.metrics import boxes, metres
from torchvision_dddas.lab.evaluation.metrics import truth as truths
from torchvision_dddas.lab.evaluation.metrics.matching import WITHIN, counted
from torchvision_dddas.lab.evaluation.metrics.metres import LocatedCounts
from torchvision_dddas.lab.evaluation.metrics.pixels import Still
from torchvision_dddas.lab.evaluation.metrics.registry import GROUPS
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth, TrackTable, TruePositions
from torchvision_dddas.lab.evaluation.studies.records import Findings, Scored, Task, round_as_written

_NOBODY, _NOT_ASKED = -1, -2
"""Values in place of a row: the place belongs to no target, or to a target that does not count."""


def score(clip: Clip, task: Task, found: Findings, interval: int = 1) -> Scored:
    """Score one case. interval: interval of tracking and association, as `dddas evaluate --interval`.

    Boxes that count neither as right nor as false (see `matching.counted`) are left out. Raise InputError if
    the truth is missing, or does not fit the findings.
    """
    if task == "location":
        return _score_places(clip, found)
    if task == "motion" and clip.still:
        frames = np.unique(found.looked)
        blobs = _per_frame(frames, found.frame)
        each = {"frames": np.ones(len(frames)), "alarmed": (blobs > 0).astype(float), "blobs": blobs}
        still = Still(len(frames), int((blobs > 0).sum()), int(blobs.sum()))
        return Scored(frames, {"still": still}, {"still": each})
    if clip.truth is None:
        raise InputError(f"{clip.name} has no truth, so that it cannot be scored")
    is_tracked = task in ("tracking", "association")
    truth = judged = clip.truth
    if is_tracked and truth.kind == "masks":
        # A simulated clip has both masks and boxes, but only boxes have identities, and ground vehicles have no boxes.
        vehicles = _fleet(truth)
        truth = replace(truth, kind="boxes")
        judged = replace(truth, ignored=vehicles, regions=vehicles, ignoring="removed")
    box_px = round_as_written(found.box_px)
    counts = counted(judged, found.frame, box_px) & ~_unlabelled(clip.truth, found.frame, box_px)
    rows = counts & (found.identity != -1) if is_tracked else counts
    table = TrackTable(found.frame[rows], found.identity[rows], box_px[rows])
    result = _Held(
        clip.place,
        int(found.looked.max(initial=0)),
        None if is_tracked else table.boxes_by_frame(),
        bool(found.masks) and not is_tracked,
        "complete",
        table if is_tracked else None,
        found.masks,
        clip.name,
    )
    notes: list[str] = []
    scored = score_clip(truth, result, notes, interval if is_tracked else 1)
    frames, per_frame = _spread(scored, interval if is_tracked else 0)
    ranked = {}
    if "boxes" in scored.counts:
        rows = np.isin(found.frame, scored.each["boxes"]["frame"])
        ranked["boxes"] = _ranked(clip.truth, found.frame[rows], box_px[rows], found.score[rows], counts[rows])
    return Scored(frames, scored.counts, per_frame, ranked, {}, tuple(notes))


def by_task(clip: ClipScore, interval: int = 1) -> dict[Task, Scored]:
    """Return the counts of a clip that was scored from files, by their task: motion or tracking."""
    found: dict[Task, Scored] = {}
    steps: dict[Task, int] = {"motion": 0, "tracking": interval}
    for task, step in steps.items():
        if mine := [group for group in clip.counts if task in GROUPS[group].tasks]:
            frames, per_frame = _spread(replace(clip, each={group: clip.each[group] for group in mine}), step)
            found[task] = Scored(frames, {group: clip.counts[group] for group in mine}, per_frame)
    return found


def _spread(clip: ClipScore, interval: int) -> tuple[np.ndarray, dict[str, dict[str, np.ndarray]]]:
    """Return the scored frames (F,) and their counts (F,), by group and name. interval: of tracks, else 0.

    Tracks are also scored on frames without boxes. Such frames have counts of 0, which is a result.
    """
    whole = 1 + interval * np.arange(clip.frames) if interval else np.zeros(0, np.int64)
    frames = np.unique(np.concatenate([whole, *(columns["frame"] for columns in clip.each.values())])).astype(np.int64)
    per_frame: dict[str, dict[str, np.ndarray]] = {}
    for group, columns in clip.each.items():
        per_frame[group] = {name: np.where(np.isin(frames, whole), 0.0, np.nan) for name in columns if name != "frame"}
        for name, values in per_frame[group].items():
            values[np.searchsorted(frames, columns["frame"])] = columns[name]
    return frames, per_frame


@dataclass(frozen=True)
class _Held(Result):
    """A result in memory. masks: PNG bytes by frame."""

    masks: Mapping[int, bytes] = field(default_factory=dict)
    clip_name: str = ""

    @property
    def name(self) -> str:
        """The name of the clip."""
        return self.clip_name

    def mask_at(self, frame: int) -> np.ndarray:
        """Return the mask of a frame, (H, W). Raise InputError if it is missing."""
        mask = decode_image(self.masks[frame], cv2.IMREAD_UNCHANGED) if frame in self.masks else None
        if mask is None:
            raise InputError(f"{self.clip_name}: frame {frame} is labelled, but has no result; was the clip cut short?")
        return mask if mask.ndim == 2 else mask.max(axis=2)


def _fleet(truth: ClipTruth) -> TrackTable:
    """Return the boxes of the ground vehicles, which masks show by their numbers."""
    rows: list[tuple[float, ...]] = []
    fleet = np.zeros(0) if truth.fleet is None else truth.fleet.identity
    for frame in truth.frames if len(fleet) else ():
        labels = truths.labels_of(truth, frame)
        rows += [(frame, n, *cv2.boundingRect((labels == n).astype(np.uint8))) for n in np.intersect1d(labels, fleet)]
    table = np.array(rows, float).reshape(-1, 6)
    return TrackTable.of(table[:, 0], table[:, 1], table[:, 2:])


def _unlabelled(truth: ClipTruth, frame: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """Return (N,) bool: boxes with more than half of their pixels marked as unlabelled in the masks."""
    out = np.zeros(len(frame), bool)
    if truth.kind != "masks" or not truth.labels.unscored:
        return out
    labelled = set(truth.frames)
    for number, rows in truths.rows_by_frame(frame).items():
        if number not in labelled:
            continue
        unknown = truths.labels_of(truth, number) < 0
        for row in rows.tolist():
            x, y, w, h = (round(float(v)) for v in box_px[row])
            inside = unknown[max(y, 0) : max(y + h, 0), max(x, 0) : max(x + w, 0)]
            out[row] = bool(inside.size) and inside.mean() > WITHIN
    return out


def _ranked(
    truth: ClipTruth, frame: np.ndarray, box_px: np.ndarray, score: np.ndarray, counts: np.ndarray
) -> np.ndarray:
    """Return (N, 3) score, right or not, frame; see Scored."""
    right = np.full(len(frame), np.nan)
    for number, there in truths.rows_by_frame(frame).items():
        rows = there[counts[there]]
        true = truth.boxes[number] if truth.kind == "boxes" else boxes.boxes_of(truths.labels_of(truth, number))
        right[rows] = boxes.judged(box_px[rows], score[rows], true)
    return np.stack([score, right, frame], axis=1)


def _per_frame(frames: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Return how often each of the sorted frames is among `found`, (F,)."""
    return np.bincount(np.searchsorted(frames, found), minlength=len(frames))[: len(frames)].astype(float)


def _score_places(clip: Clip, found: Findings) -> Scored:
    """Score the places of a clip in processed frames.

    A place belongs to the target whose true box matches its box; without boxes, to the nearest target. Degrees are
    compared if both sides have them, because the metres of each side may have another origin. The error relative to the
    landmarks is the error minus the mean error of the landmarks' own reports, if the truth contains their positions.
    Raise InputError if the truth has no places, or none of a processed frame.
    """
    truth = clip.truth
    if truth is None or truth.positions is None:
        raise InputError(f"{clip.name} has no true places, so that errors in metres cannot be computed")
    true = truth.positions
    origin: tuple[float, float] | None = None  # longitude and latitude; None: compare the metres of both sides
    if true.lonlat_deg is not None and len(true.lonlat_deg) and "lonlat_deg" in found.more:
        origin = (float(true.lonlat_deg[0, 0]), float(true.lonlat_deg[0, 1]))
    true_m = _in_metres(true, origin)
    place_m = found.east_north_m if origin is None else geometry.east_north(found.more["lonlat_deg"], origin)
    seen = np.isin(true.frame, found.looked)
    if not seen.any():
        raise InputError(f"{clip.name}: no processed frame has a true place")
    rows = np.flatnonzero(np.isfinite(place_m).all(axis=1))
    frame, notes = found.frame[rows], []
    owner, visible = whose_places(truth, true, true_m, frame, found.box_px[rows], place_m[rows])
    if visible is None:
        wanted = np.flatnonzero(seen)
        notes.append(
            f"{clip.name}: no boxes assign places to targets; the nearest target within {metres.FARTHEST_M:g} m is used"
        )
    else:
        wanted = visible[seen[visible]]  # targets that no picture shows cannot be located
    mine, true_row, strays = rows[owner >= 0], owner[owner >= 0], frame[owner == _NOBODY]
    off = place_m[mine] - true_m[true_row]
    relative, ellipse = np.full_like(off, np.nan), np.full((len(mine), 2, 2), np.nan)
    at, shift = _team_error(clip, truth.fleet, origin)
    if len(at):
        relative = off - np.stack([np.interp(found.frame[mine], at, shift[:, k]) for k in range(2)], axis=1)
        ellipse = found.more["relative_m2"][mine] if "relative_m2" in found.more else ellipse
    frames = np.unique(found.looked)
    by_count: dict[str, Any] = {"targets": true.frame[wanted], "told": found.frame[mine], "strays": strays}
    each = {name: _per_frame(frames, numbers) for name, numbers in by_count.items()}
    samples = {
        "frame": found.frame[mine],
        "identity": true.identity[true_row],
        "error_m": np.hypot(*off.T),
        "inside": metres.inside(off, found.covariance_m2[mine]),
        "relative_error_m": np.hypot(*relative.T),
        "relative_inside": metres.inside(relative, ellipse),
        "east_m": off[:, 0],
        "north_m": off[:, 1],
    }
    counts = LocatedCounts(len(wanted), len(mine), len(strays))
    return Scored(frames, {"location": counts}, {"location": each}, {}, samples, tuple(notes))


def whose_places(
    truth: ClipTruth,
    places: TruePositions,
    true_m: np.ndarray,
    frame: np.ndarray,
    box_px: np.ndarray,
    place_m: np.ndarray,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the row of each located box's true place, (N,), below 0: none, and the rows whose boxes count, in order.

    The second result is None if the truth has no boxes; the nearest places are then used. true_m: of all places, (P,
    2), in the metres of place_m, (N, 2).
    """
    labelled = truth.tracks
    if labelled is None or not len(labelled.frame) or not np.isfinite(box_px).all():
        return metres.by_places(frame, place_m, places.frame, true_m), None
    row = {key: i for i, key in enumerate(zip(places.frame.tolist(), places.identity.tolist(), strict=True))}
    row_of = [row.get(key, _NOBODY) for key in zip(labelled.frame.tolist(), labelled.identity.tolist(), strict=True)]
    if truth.ignored is not None:
        row_of += [_NOT_ASKED] * len(truth.ignored.frame)
        labelled = TrackTable(*(np.concatenate(pair) for pair in zip(labelled, truth.ignored, strict=True)))
    of_place = np.array([*row_of, _NOBODY], np.int64)  # index -1, the last entry, stands for boxes that match no truth
    return of_place[metres.by_boxes(frame, box_px, labelled)], np.unique(of_place[of_place >= 0])


def _in_metres(true: TruePositions, origin: tuple[float, float] | None) -> np.ndarray:
    if origin is None or true.lonlat_deg is None:
        return true.east_north_m
    return geometry.east_north(true.lonlat_deg, origin)


def _team_error(
    clip: Clip, fleet: TruePositions | None, origin: tuple[float, float] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return frames, and the error that the landmarks' reports share in each; empty if it is unknown."""
    if clip.landmarks is not None and fleet is not None:
        table = read_landmarks(clip.landmarks, rate_hz=clip.rate_hz)
        if table.geographic == (origin is not None):
            kept = ~table.planned & np.isfinite(table.place).all(axis=1) & (table.frame == np.round(table.frame))
            reported = table.place[kept] if origin is None else geometry.east_north(table.place[kept], origin)
            marks = table.frame[kept], table.landmark[kept], reported
            return metres.shared_error(*marks, fleet.frame, fleet.identity, _in_metres(fleet, origin))
    return np.zeros(0), np.zeros((0, 2))
