"""Examples to learn from: batches and watched shares, labelled boxes and masks of clips, owners of detections."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.matching import EPSILON, LEAST, pair
from torchvision_dddas.evaluation.metrics.truth import TrackTable, Truth, labels_of
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.types import DetectionTable


def split_examples(examples: Sequence[Example], watched: float, most: int) -> tuple[list[Example], list[Example]]:
    """The examples to learn from, and those to watch: the last ones of each clip.

    Of a clip of three or more at least one is learned from and one watched. most: to watch; of more, some evenly among
    them. Neighbouring frames are alike, so that one piece in time says more than single frames. Where no clip has
    three, or watched is 0, all are learned from and watched.
    """
    clips: dict[str, list[Example]] = {}
    for example in examples:
        clips.setdefault(example.clip, []).append(example)
    learned, kept = list[Example](), list[Example]()
    for mine in clips.values():
        count = min(max(1, round(watched * len(mine))), len(mine) - 1) if watched and len(mine) >= 3 else 0
        learned += mine[: len(mine) - count]
        kept += mine[len(mine) - count :]
    kept = kept or learned
    if len(kept) > most:
        kept = [kept[i * len(kept) // most] for i in range(most)]
    return learned, kept


def draw_batch(step: int, clips: Sequence[str], batch: int, seed: int) -> list[int]:
    """The places of the examples that a step takes, from step 0; clips: the clip of each example.

    All examples come in a random order, those of clips with fewer several times, so that every clip has the same
    weight; then all in another order. The result depends on the arguments alone, so that a descent can be resumed.
    """
    batch = min(batch, len(clips))
    mine: dict[str, list[int]] = {}
    for place, clip in enumerate(clips):
        mine.setdefault(clip, []).append(place)
    count = len(mine) * max(len(places) for places in mine.values())
    first = step * batch
    orders: dict[int, list[int]] = {}
    found = []
    for place in range(first, first + batch):
        turn, here = divmod(place, count)
        if turn not in orders:
            orders[turn] = _draw_order(list(mine.values()), seed, turn)
        found.append(orders[turn][here])
    return found


def clip_shares(clips: Sequence[str]) -> list[float]:
    """The weight of each example in a mean in which every clip has the same weight; clips: the clip of each."""
    count = Counter(clips)
    return [1 / (len(count) * count[clip]) for clip in clips]


def _draw_order(clips: Sequence[Sequence[int]], seed: int, turn: int) -> list[int]:
    """One turn: as many examples of each clip as the largest has."""
    generator = torch.Generator().manual_seed((seed * 1_000_003 + turn) % 2**63)
    most = max(len(places) for places in clips)
    drawn = [
        places[i]
        for places in clips
        for i in [i for _ in range(-(-most // len(places))) for i in _shuffled(len(places), generator)][:most]
    ]
    return [drawn[i] for i in _shuffled(len(drawn), generator)]


def _shuffled(count: int, generator: torch.Generator) -> list[int]:
    order: list[int] = torch.randperm(count, generator=generator).tolist()
    return order


class BoxedFrame(NamedTuple):
    """The boxes of a frame. identity: (n,). box_px: (n, 4). image: (H, W[, 3]) uint8, None without pictures."""

    number: int
    identity: np.ndarray
    box_px: np.ndarray
    image: np.ndarray | None


def boxed_frames(clip: Clip, table: TrackTable, interval: int) -> Iterator[BoxedFrame]:
    """Every `interval`-th frame to the last with boxes, from the first picture, or without pictures the first box."""

    def at(number: int, image: np.ndarray | None) -> BoxedFrame:
        rows = table.frame == number
        return BoxedFrame(number, table.identity[rows], np.asarray(table.box_px[rows], float), image)

    if not len(table.frame):
        return
    last = int(table.frame.max())
    if not clip.pictures:
        for number in range(int(table.frame.min()), last + 1, interval):
            yield at(number, None)
        return
    for frame in open_clip(clip).every(interval):
        if frame.number > last:
            return
        yield at(frame.number, frame.image)


def check_masks(clips: Sequence[Clip], still: bool = False) -> None:
    """Raises InputError for clips without masks. still: clips in which nothing moves need none."""
    masked = [clip.truth is not None and bool(clip.truth.masks) for clip in clips]
    bare = [clip.name for clip, has in zip(clips, masked, strict=True) if not (has or (still and clip.still))]
    if bare:
        lack = "have" if len(bare) > 1 else "has"
        raise InputError(f"{', '.join(bare)} {lack} no masks of what moves; choose clips that have them with --clips")


def labels_at(truth: Truth, frame: int, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) as `labels_of`. shape: (H, W, ...) of the frame. Raises InputError where the mask has another size."""
    labels = labels_of(truth, frame)
    if labels.shape != shape[:2]:
        mask, picture = (f"{width}x{height}" for height, width in (labels.shape, shape[:2]))
        raise InputError(f"{truth.masks[frame]} is {mask}, the frame itself {picture}")
    return labels


class OwnedBoxes(NamedTuple):
    """Boxes with their true identities, ordered by frame; each false alarm has an identity of its own below 0.

    score: (N,), 1 for a certain box. size: (width, height) that holds nearly all boxes, None where there are too few.
    own: whether they are moving targets that `dddas detect` found.
    """

    table: TrackTable
    score: np.ndarray
    size: tuple[float, float] | None = None
    own: bool = False


def match_owners(found: DetectionTable, truth: Truth, interval: int, min_score: float) -> OwnedBoxes:
    """Match the detections of frames 1, 1 + interval, ... with the truth as the measures do, by IoU of 0.5 or more.

    min_score: detections below it are left out, where scores are probabilities. Targets that the measures ignore own
    boxes too. Raises InputError if an identity occurs twice in a frame.
    """
    score = np.ones(len(found)) if found.certain else found.score
    rows = np.flatnonzero(((found.frame - 1) % interval == 0) & (score >= min_score))
    boxes = TrackTable(found.frame[rows], np.arange(len(rows)), found.box_px[rows])
    identity = -1 - np.arange(len(rows))
    tracks = _all_tracks(truth).every(interval)
    named = np.unique(tracks.identity)
    for true, here, overlap in pair(tracks, boxes).frames:
        overlap = np.where(overlap >= LEAST - EPSILON, overlap, 0)
        i, j = linear_sum_assignment(overlap, maximize=True)
        sure = overlap[i, j] > 0
        identity[here[j[sure]]] = named[true[i[sure]]]
    return OwnedBoxes(boxes._replace(identity=identity), score[rows], found.extent, found.own)


def _all_tracks(truth: Truth) -> TrackTable:
    """The counted tracks, and the ignored ones where found boxes on them are removed, under numbers of their own."""
    assert truth.tracks is not None
    more = [t for t in (truth.ignored, truth.others) if t is not None] if truth.ignoring == "removed" else []
    parts = [truth.tracks, *more]
    first, columns = 0, []
    for part in parts:
        _, number = np.unique(part.identity, return_inverse=True)
        columns.append(part._replace(identity=number + first))
        first += int(number.max(initial=-1)) + 1
    frame, identity, box_px = (np.concatenate(values) for values in zip(*columns, strict=True))
    return TrackTable(frame, identity, np.asarray(box_px, float))


def check_identities(clips: Sequence[Clip]) -> None:
    """Raises InputError for the first clip without true identities."""
    for clip in clips:
        if clip.truth is None or clip.truth.tracks is None or not len(clip.truth.tracks.frame):
            raise InputError(f"{clip.name} has no true identities, which tuning the tracker needs; leave it out")


_Record = TypeVar("_Record")


def stack_padded(
    kind: type[_Record], rows: Sequence[Mapping[str, np.ndarray]], device: torch.device | str = "cpu", pad: str = "zero"
) -> _Record:
    """A dataclass of tensors whose first axis is the row; shorter arrays are filled up at the end of each axis.

    rows: an array for each field of `kind`. pad: zero, or edge to repeat the last number; bools are always False.
    """
    batch: dict[str, Any] = {}
    for field in fields(kind):  # type: ignore[arg-type]
        arrays = [np.asarray(row[field.name]) for row in rows]
        shape = np.max([array.shape for array in arrays], axis=0).astype(int).tolist() if arrays[0].ndim else []
        batch[field.name] = torch.as_tensor(np.stack([_fill(array, shape, pad) for array in arrays]), device=device)
    return kind(**batch)


def _fill(array: np.ndarray, shape: Sequence[int], pad: str) -> np.ndarray:
    wider = [(0, size - had) for size, had in zip(shape, array.shape, strict=True)]
    if not array.ndim:
        return array
    if pad == "edge" and array.dtype != bool:
        # Where there is nothing to repeat any number will do, as no target is there.
        return np.pad(array, wider, mode="edge") if array.size else np.pad(array, wider, constant_values=1.0)
    return np.pad(array, wider)
