"""How right what was found in a clip is: the same counts as `dddas evaluate`, frame by frame, and what it has not."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics import boxes
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.clip import Counts, How, Result, score_clip
from torchvision_dddas.evaluation.metrics.ignored_regions import WITHIN, counted
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.metrics.pixels import Still
from torchvision_dddas.evaluation.metrics.tracking import Each
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.evaluation.studies.scored import Scored
from torchvision_dddas.io.images import decode_image

if TYPE_CHECKING:
    from torchvision_dddas.evaluation.datasets.record import Clip
    from torchvision_dddas.evaluation.studies.record import Found, Task


def score(clip: "Clip", task: "Task", found: "Found", interval: int = 1) -> Scored:
    """Score one case. interval: of tracking and association, as `dddas evaluate --interval`.

    Boxes that count neither as right nor as false (see `ignored_regions.counted`) are left out. Raises
    InputError where the truth is missing, or does not fit what was found.
    """
    if task == "location":
        from torchvision_dddas.evaluation.studies.placing_score import score_places

        return score_places(clip, found)
    if task == "motion" and clip.still:
        return _still(found)
    if clip.truth is None:
        raise InputError(f"{clip.name} has no truth; nothing can be scored")
    followed = task in ("tracking", "association")
    truth = judged = clip.truth
    if followed and truth.kind == "masks":
        # A simulated clip has both: masks tell pixels, boxes tell identities, but of the ground vehicles.
        vehicles = _fleet(truth)
        truth = replace(truth, kind="boxes")
        judged = replace(truth, ignored=vehicles, regions=vehicles, ignoring="removed")
    box_px = as_written(found.box_px)
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


def as_written(box_px: np.ndarray) -> np.ndarray:
    """(N, 4) boxes as tables have them, to a hundredth of a pixel: figures must be those of the files."""
    hundredths = box_px * 100
    written = np.round(hundredths) / 100
    # Half a hundredth goes where the decimal text of the number goes, which is not always where the product goes.
    for i, j in np.argwhere(np.abs(np.abs(hundredths - np.floor(hundredths)) - 0.5) < 1e-6):
        written[i, j] = float(f"{box_px[i, j]:.2f}")
    return written


def _still(found: "Found") -> Scored:
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
    """(N,) bool: boxes more than half of whose pixels nobody labelled, in masks that say so."""
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
