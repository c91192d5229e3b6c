"""The truth of clips as families need it: masks, boxes with identities, owners of detections, padded batches."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.config import TrackParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.metrics.matching import EPSILON, LEAST, pair
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth, TrackTable, labels_of
from torchvision_dddas.lab.evaluation.studies.stages import open_clip
from torchvision_dddas.tracking.score_tracker import DoubtRule
from torchvision_dddas.types import DetectionTable, is_sampled


def check_masks(clips: Sequence[Clip], still: bool = False) -> None:
    """Raise InputError for clips without masks. still: accept clips without motion, which need no masks."""
    bare = [c.name for c in clips if not (c.truth is not None and c.truth.masks) and not (still and c.still)]
    if bare:
        lack = "have" if len(bare) > 1 else "has"
        raise InputError(f"{', '.join(bare)} {lack} no masks of moving targets; choose clips with masks by --clips")


def labels_at(truth: ClipTruth, frame: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return (H, W) labels by `labels_of`. shape: (H, W, ...) of the frame. Raise InputError if the sizes differ."""
    labels = labels_of(truth, frame)
    if labels.shape != shape[:2]:
        mask, picture = (f"{width}x{height}" for height, width in (labels.shape, shape[:2]))
        raise InputError(f"{truth.masks[frame]} is {mask}, but the frame is {picture}")
    return labels


def true_tracks(clip: Clip, interval: int) -> TrackTable:
    """Return the true boxes of frames 1, 1 + interval, ... Raise InputError for a clip without identities."""
    if clip.truth is None or clip.truth.tracks is None or not len(clip.truth.tracks.frame):
        raise InputError(f"{clip.name} has no true identities, which tuning the tracker needs; leave it out")
    return clip.truth.tracks.every(interval)


def boxed_frames(
    clip: Clip, table: TrackTable, interval: int
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray | None]]:
    """Yield number, identities (n,), boxes (n, 4) and picture of every `interval`-th frame, up to the last with boxes.

    Frames are counted from the first picture. Without pictures, begin at the first frame with boxes, and yield None.
    """
    if not len(table.frame):
        return
    last = int(table.frame.max())
    frames: Iterator[tuple[int, np.ndarray | None]]
    if clip.pictures:
        frames = ((frame.number, frame.image) for frame in open_clip(clip).every(interval))
    else:
        frames = ((number, None) for number in range(int(table.frame.min()), last + 1, interval))
    for number, image in frames:
        if number > last:
            return
        rows = table.frame == number
        yield number, table.identity[rows], np.asarray(table.box_px[rows], float), image


class OwnedBoxes(NamedTuple):
    """Boxes with their true identities, ordered by frame. Each false alarm has its own identity below 0.

    score: (N,), 1 for a certain box. begins: (N,) whether a box may begin a track. size: (width, height) of an area
    with nearly all boxes; None if there are too few. own: whether they are moving targets that `dddas detect` found.
    """

    table: TrackTable
    score: np.ndarray
    begins: np.ndarray
    size: tuple[float, float] | None
    own: bool = False


def match_owners(found: DetectionTable, truth: ClipTruth, interval: int, parameters: TrackParameters) -> OwnedBoxes:
    """Match the detections of frames 1, 1 + interval, ... with the truth as the measures do, by IoU of 0.5 or more.

    Detections that are too doubtful for the tracker are left out. Ignored targets may own boxes too. Raise InputError
    if an identity occurs twice in a frame.
    """
    assert truth.tracks is not None
    parts = [truth.tracks]
    if truth.ignoring == "removed":
        parts += [table for table in (truth.ignored, truth.others) if table is not None]
    frame, identity, true_px = (np.concatenate(column) for column in zip(*parts, strict=True))
    # The same identity in two tables denotes two targets.
    table = np.repeat(np.arange(len(parts)), [len(part.frame) for part in parts])
    _, number = np.unique(np.stack([table, identity]), axis=1, return_inverse=True)
    tracks = TrackTable(frame, number.reshape(-1), true_px.astype(float)).every(interval)
    named = np.unique(tracks.identity)

    score = np.ones(len(found)) if found.certain else found.score
    counts, begins, rule = np.zeros(len(found), bool), np.zeros(len(found), bool), DoubtRule(parameters)
    for number in np.unique(found.frame[is_sampled(found.frame, interval)]).tolist():
        at = found.rows(number)
        counts[at], begins[at] = rule.apply(score[at])
    rows = np.flatnonzero(counts)
    boxes = TrackTable(found.frame[rows], np.arange(len(rows)), found.box_px[rows])
    owner = -1 - np.arange(len(rows))
    for true, here, overlap in pair(tracks, boxes).frames:
        overlap = np.where(overlap >= LEAST - EPSILON, overlap, 0)
        i, j = linear_sum_assignment(overlap, maximize=True)
        sure = overlap[i, j] > 0
        owner[here[j[sure]]] = named[true[i[sure]]]
    return OwnedBoxes(boxes._replace(identity=owner), score[rows], begins[rows], found.extent, found.own)


_Record = TypeVar("_Record")


def stack_padded(
    kind: type[_Record], rows: Sequence[Mapping[str, np.ndarray]], device: torch.device | str = "cpu", pad: str = "zero"
) -> _Record:
    """Return a dataclass of tensors whose first axis is the row; shorter arrays are padded at the end of each axis.

    rows: an array for each field of `kind`. pad: "zero", or "edge" to repeat the last number. Pad bools with False.
    """
    batch: dict[str, Any] = {}
    for field in fields(kind):  # type: ignore[arg-type]
        arrays = [np.asarray(row[field.name]) for row in rows]
        if arrays[0].ndim:
            shape = [max(sizes) for sizes in zip(*(array.shape for array in arrays), strict=True)]
            for place, array in enumerate(arrays):
                wider = [(0, size - own) for size, own in zip(shape, array.shape, strict=True)]
                if pad == "zero" or array.dtype == bool:
                    arrays[place] = np.pad(array, wider)
                elif array.size:
                    arrays[place] = np.pad(array, wider, mode="edge")
                else:  # there is nothing to repeat; any value is right, because no target is there
                    arrays[place] = np.pad(array, wider, constant_values=1.0)
        batch[field.name] = torch.as_tensor(np.stack(arrays), device=device)
    return kind(**batch)
