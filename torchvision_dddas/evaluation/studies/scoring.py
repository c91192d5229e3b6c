"""The scores of one clip: the counts of `dddas evaluate` frame by frame, ranked boxes, errors in metres."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics import boxes, metres
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.clip import How, Result, score_clip
from torchvision_dddas.evaluation.metrics.matching import WITHIN, counted
from torchvision_dddas.evaluation.metrics.metres import GroundLocations
from torchvision_dddas.evaluation.metrics.pixels import Still
from torchvision_dddas.evaluation.metrics.registry import Counts
from torchvision_dddas.evaluation.metrics.tracking import Each
from torchvision_dddas.evaluation.metrics.truth import Positions, TrackTable, Truth
from torchvision_dddas.evaluation.studies.results import Found, Scored, round_as_written
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.io.ground_tables import read_landmarks
from torchvision_dddas.io.images import decode_image

_NOBODY, _NOT_ASKED = -1, -2
"""In place of a row: a place that belongs to no target; one of a target that does not count."""


def score(clip: Clip, task: Task, found: Found, interval: int = 1) -> Scored:
    """Score one case. interval: of tracking and association, as `dddas evaluate --interval`.

    Boxes that count neither as right nor as false (see `matching.counted`) are left out. Raises InputError if
    the truth is missing, or does not fit what was found.
    """
    if task == "location":
        return score_places(clip, found)
    if task == "motion" and clip.still:
        return _still(found)
    if clip.truth is None:
        raise InputError(f"{clip.name} has no truth; nothing can be scored")
    followed = task in ("tracking", "association")
    truth = judged = clip.truth
    if followed and truth.kind == "masks":
        # A simulated clip has both masks and boxes; only its boxes have identities, but for the ground vehicles'.
        vehicles = _fleet(truth)
        truth = replace(truth, kind="boxes")
        judged = replace(truth, ignored=vehicles, regions=vehicles, ignoring="removed")
    box_px = round_as_written(found.box_px)
    counts = counted(judged, found.frame, box_px) & ~_unlabelled(clip.truth, found.frame, box_px)
    rows = counts & (found.identity != -1) if followed else counts
    table = TrackTable(found.frame[rows], found.identity[rows], box_px[rows])
    last = int(found.looked.max(initial=0))
    result = _Held(
        clip.place,
        last,
        None if followed else {int(f): table.box_px[table.frame == f] for f in np.unique(table.frame)},
        bool(found.masks) and not followed,
        "complete",
        table if followed else None,
        found.masks,
        clip.name,
    )
    notes: list[str] = []
    scored = score_clip(truth, result, How(interval if followed else 1), notes)
    whole = 1 + interval * np.arange(scored.frames) if followed else np.zeros(0, np.int64)
    frames, per_frame = _beside(scored.each, whole)
    ranked = {}
    if "boxes" in scored.counts:
        rows = np.isin(found.frame, scored.each["boxes"]["frame"])
        ranked["boxes"] = _ranked(clip.truth, found.frame[rows], box_px[rows], found.score[rows], counts[rows])
    return Scored(frames, scored.counts, per_frame, ranked, {}, tuple(notes))


@dataclass(frozen=True)
class _Held(Result):
    """A result that is held, not read back. masks: PNG bytes by frame."""

    masks: Mapping[int, bytes] = field(default_factory=dict)
    called: str = ""

    @property
    def name(self) -> str:
        """The clip's."""
        return self.called

    def mask_at(self, frame: int) -> np.ndarray:
        """(H, W) mask of a frame. Raises InputError if it is not there."""
        mask = decode_image(self.masks[frame], cv2.IMREAD_UNCHANGED) if frame in self.masks else None
        if mask is None:
            raise InputError(f"{self.called}: frame {frame} is labelled, but has no result; was the clip cut short?")
        return mask if mask.ndim == 2 else mask.max(axis=2)


def _still(found: Found) -> Scored:
    frames = np.unique(found.looked)
    blobs = np.array([np.count_nonzero(found.frame == f) for f in frames], float).reshape(-1)
    each = {"frames": np.ones(len(frames)), "alarmed": (blobs > 0).astype(float), "blobs": blobs}
    counts: Counts = {"still": Still(len(frames), int((blobs > 0).sum()), int(blobs.sum()))}
    return Scored(frames, counts, {"still": each})


def _fleet(truth: Truth) -> TrackTable:
    """The boxes of the ground vehicles, which masks show by their numbers."""
    rows: list[tuple[float, ...]] = []
    fleet = np.zeros(0) if truth.fleet is None else truth.fleet.identity
    for frame in truth.frames if len(fleet) else ():
        labels = truths.labels_of(truth, frame)
        rows += [(frame, n, *cv2.boundingRect((labels == n).astype(np.uint8))) for n in np.intersect1d(labels, fleet)]
    table = np.array(rows, float).reshape(-1, 6)
    return TrackTable(table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2:])


def _unlabelled(truth: Truth, frame: np.ndarray, box_px: np.ndarray) -> np.ndarray:
    """(N,) bool: boxes of which more than half the pixels are marked as unlabelled in the masks."""
    out = np.zeros(len(frame), bool)
    if truth.kind != "masks" or not truth.labels.unscored:
        return out
    for number in np.intersect1d(frame, truth.frames):
        unknown = truths.labels_of(truth, int(number)) < 0
        for row in np.flatnonzero(frame == number):
            x, y, w, h = (round(float(v)) for v in box_px[row])
            inside = unknown[max(y, 0) : max(y + h, 0), max(x, 0) : max(x + w, 0)]
            out[row] = bool(inside.size) and inside.mean() > WITHIN
    return out


def _ranked(truth: Truth, frame: np.ndarray, box_px: np.ndarray, score: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(N, 3) score, right or not, frame; see Scored."""
    right = np.full(len(frame), np.nan)
    for number in np.unique(frame):
        rows = np.flatnonzero((frame == number) & counts)
        true = truth.boxes[number] if truth.kind == "boxes" else boxes.boxes_of(truths.labels_of(truth, number))
        right[rows] = boxes.judged(box_px[rows], score[rows], true)
    return np.stack([score, right, frame], axis=1)


def _beside(each: dict[str, Each], whole: np.ndarray) -> tuple[np.ndarray, dict[str, dict[str, np.ndarray]]]:
    """All groups' counts over all frames that any group has, NaN in the others.

    whole: frames that tracks are scored on; those without any box count nothing, which is a result too.
    """
    frames = np.unique(np.concatenate([whole, *(columns["frame"] for columns in each.values())]))
    per_frame: dict[str, dict[str, np.ndarray]] = {}
    for group, columns in each.items():
        rows = np.searchsorted(frames, columns["frame"])
        spread = np.where(np.isin(frames, whole), 0.0, np.nan)
        per_frame[group] = {name: spread.copy() for name in columns if name != "frame"}
        for name, values in per_frame[group].items():
            values[rows] = columns[name]
    return frames.astype(np.int64), per_frame


def score_places(clip: Clip, found: Found) -> Scored:
    """Score the places of a clip in frames that were processed.

    A place is that of the target whose true box its box is; without boxes, that of the target nearest to it. Degrees
    are compared where both sides have them, for each may count its metres from an origin of its own. The error
    relative to the team is what is left without the mean error of the landmarks' own reports, where the truth knows
    where they were.
    Raises InputError where the truth has no places, or none of a processed frame.
    """
    truth = clip.truth
    if truth is None or truth.positions is None:
        raise InputError(f"{clip.name} has no true places; nothing can be scored in metres")
    origin = _origin(truth.positions, found)
    true_m = _in_metres(truth.positions, origin)
    place_m = found.east_north_m if origin is None else geometry.east_north(found.more["lonlat_deg"], origin)
    seen = np.isin(truth.positions.frame, found.looked)
    if not seen.any():
        raise InputError(f"{clip.name}: no processed frame has a true place")
    rows = np.flatnonzero(np.isfinite(place_m).all(axis=1))
    frame, box_px, notes = found.frame[rows], found.box_px[rows], []
    owner, visible = whose_places(truth, truth.positions, true_m, frame, box_px, place_m[rows])
    if visible is None:
        wanted = np.flatnonzero(seen)
        notes.append(
            f"{clip.name}: no boxes assign places to targets; the nearest target within {metres.FARTHEST_M:g} m is used"
        )
    else:
        wanted = visible[seen[visible]]  # targets that no picture shows cannot be located
    mine, true_row = rows[owner >= 0], owner[owner >= 0]
    off = place_m[mine] - true_m[true_row]
    relative, ellipse = np.full_like(off, np.nan), np.full((len(mine), 2, 2), np.nan)
    at, shift = _shared(clip, truth.fleet, origin)
    if len(at):
        relative = off - np.stack([np.interp(found.frame[mine], at, shift[:, k]) for k in range(2)], axis=1)
        ellipse = found.more.get("relative_m2", np.full((len(found.frame), 2, 2), np.nan))[mine]
    frames = np.unique(found.looked)
    each = {
        "targets": _per_frame(frames, truth.positions.frame[wanted]),
        "told": _per_frame(frames, found.frame[mine]),
        "strays": _per_frame(frames, frame[owner == _NOBODY]),
    }
    samples = {
        "frame": found.frame[mine],
        "identity": truth.positions.identity[true_row],
        "error_m": np.hypot(*off.T),
        "inside": metres.inside(off, found.covariance_m2[mine]),
        "relative_error_m": np.hypot(*relative.T),
        "relative_inside": metres.inside(relative, ellipse),
        "east_m": off[:, 0],
        "north_m": off[:, 1],
    }
    counts = GroundLocations(len(wanted), len(mine), int((owner == _NOBODY).sum()))
    return Scored(frames, {"location": counts}, {"location": each}, {}, samples, tuple(notes))


def whose_places(
    truth: Truth, places: Positions, true_m: np.ndarray, frame: np.ndarray, box_px: np.ndarray, place_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """(N,) the row of the true place of each located box, below 0 for none; and the rows whose boxes count.

    The latter None where the truth has no boxes, and the nearest places are taken. true_m: of all places, (P, 2), in
    the metres of place_m, (N, 2).
    """
    if truth.tracks is not None and len(truth.tracks.frame) and np.isfinite(box_px).all():
        return _by_boxes(truth, truth.tracks, places, frame, box_px)
    return metres.by_places(frame, place_m, places.frame, true_m), None


def _per_frame(frames: np.ndarray, found: np.ndarray) -> np.ndarray:
    return np.bincount(np.searchsorted(frames, found), minlength=len(frames))[: len(frames)].astype(float)


def _by_boxes(
    truth: Truth, boxes: TrackTable, places: Positions, frame: np.ndarray, box_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) the row of the true place of each found box; and the rows of all places whose boxes count, in order."""
    row = {key: i for i, key in enumerate(zip(places.frame.tolist(), places.identity.tolist(), strict=True))}
    row_of = [row.get(key, _NOBODY) for key in zip(boxes.frame.tolist(), boxes.identity.tolist(), strict=True)]
    labelled, ignored = boxes, truth.ignored
    if ignored is not None:
        labelled = TrackTable(*(np.concatenate(pair) for pair in zip(boxes, ignored, strict=True)))
        row_of += [_NOT_ASKED] * len(ignored.frame)
    rows = np.array([*row_of, _NOBODY], np.int64)  # the last is for boxes that are none of them: -1
    return rows[metres.by_boxes(frame, box_px, labelled)], np.unique(rows[rows >= 0])


def _origin(true: Positions, found: Found) -> tuple[float, float] | None:
    """Longitude and latitude from which metres are counted; None where both sides' own metres are compared."""
    if true.lonlat_deg is None or "lonlat_deg" not in found.more or not len(true.lonlat_deg):
        return None
    return float(true.lonlat_deg[0, 0]), float(true.lonlat_deg[0, 1])


def _in_metres(true: Positions, origin: tuple[float, float] | None) -> np.ndarray:
    if origin is None or true.lonlat_deg is None:
        return true.east_north_m
    return geometry.east_north(true.lonlat_deg, origin)


def _shared(clip: Clip, fleet: Positions | None, origin: tuple[float, float] | None) -> tuple[np.ndarray, np.ndarray]:
    """Frames, and how far the landmarks' reports are off in them together; none where it cannot be known."""
    marks = None if fleet is None else _marks(clip)
    if marks is None or fleet is None or marks[3] != (origin is not None):
        return np.zeros(0), np.zeros((0, 2))
    frame, mark, place, _ = marks
    reported = place if origin is None else geometry.east_north(place, origin)
    return metres.shared_error(frame, mark, reported, fleet.frame, fleet.identity, _in_metres(fleet, origin))


def _marks(clip: Clip) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool] | None:
    """What the clip's landmarks report: frames, which, (N, 2) where, and whether in degrees; None without any."""
    if clip.landmarks is None:
        return None
    table = read_landmarks(clip.landmarks, clip.rate_hz)
    kept = ~table.planned & np.isfinite(table.place).all(axis=1) & (table.frame == np.round(table.frame))
    return table.frame[kept], table.landmark[kept], table.place[kept], table.geographic
