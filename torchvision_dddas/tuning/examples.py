"""Examples to learn from: batches and watched shares, boxes and masks of clips, owners of detections."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.matching import EPSILON, LEAST, TrackTable, pair
from torchvision_dddas.evaluation.metrics.truth import Truth, labels_of
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.types import DetectionTable


def parted(examples: Sequence[Example], watched: float, most: int) -> tuple[list[Example], list[Example]]:
    """The examples to learn from, and those to watch: of each clip its last ones.

    Of a clip of three and more at least one is learned from and one watched. most: to watch; of more, some that lie
    evenly among them. Neighbours in time are alike, so that a part in one piece tells more than single frames. Where no
    clip has three, or none is to be watched, all are learned from and watched.
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


def batch_of(step: int, clips: Sequence[str], batch: int, seed: int) -> list[int]:
    """Which examples a step takes, from step 0; clips: of which clip each example is.

    Every clip has the same say, whatever number of its frames is labelled: all examples come in an order of chance,
    those of clips with fewer several times, then all in another order. It depends on nothing else, so that a descent
    can be taken up at any step.
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
            orders[turn] = _order(list(mine.values()), seed, turn)
        found.append(orders[turn][here])
    return found


def shares(clips: Sequence[str]) -> list[float]:
    """What each example counts in a mean of which every clip has the same share; clips: of which clip each is."""
    count = Counter(clips)
    return [1 / (len(count) * count[clip]) for clip in clips]


def _order(clips: Sequence[Sequence[int]], seed: int, turn: int) -> list[int]:
    """A turn: as many examples of each clip as the largest has."""
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


class Boxed(NamedTuple):
    """A look. identity: (n,). box_px: (n, 4) float. image: (H, W[, 3]) uint8, None of a clip without pictures."""

    number: int
    identity: np.ndarray
    box_px: np.ndarray
    image: np.ndarray | None


def boxed(clip: Clip, table: TrackTable, interval: int) -> Iterator[Boxed]:
    """Every `interval`-th frame to the last with boxes; from the first of the pictures, else from those with boxes."""

    def at(number: int, image: np.ndarray | None) -> Boxed:
        rows = table.frame == number
        return Boxed(number, table.identity[rows], np.asarray(table.box_px[rows], float), image)

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
    """Raises InputError for clips without masks. still: those in which nothing moves will do."""
    masked = [clip.truth is not None and bool(clip.truth.masks) for clip in clips]
    bare = [clip.name for clip, has in zip(clips, masked, strict=True) if not (has or (still and clip.still))]
    if bare:
        lack = "have" if len(bare) > 1 else "has"
        raise InputError(f"{', '.join(bare)} {lack} no masks of what moves; choose with --clips such as have")


def labels_at(truth: Truth, frame: int, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) as `labels_of`. shape: (H, W, ...) of the frame itself. Raises InputError where it is another."""
    labels = labels_of(truth, frame)
    if labels.shape != shape[:2]:
        mask, picture = (f"{width}x{height}" for height, width in (labels.shape, shape[:2]))
        raise InputError(f"{truth.masks[frame]} is {mask}, the frame itself {picture}")
    return labels


class Owned(NamedTuple):
    """Boxes by who they are of, ordered by frame. table: identities, (N,) below 0 for a false alarm, each another.

    score: (N,), 1 for one that is certain. size: (width, height) that holds nearly all, None where too few tell.
    own: whether they are of moving targets that were found in the clip.
    """

    table: TrackTable
    score: np.ndarray
    size: tuple[float, float] | None = None
    own: bool = False


def owned(found: DetectionTable, truth: Truth, interval: int, min_score: float) -> Owned:
    """The detections of frames 1, 1 + interval, ... that count, matched in each frame as the measures match: IoU ≥ 0.5.

    min_score: of those that count, where scores are probabilities. Who does not count for the measures is nevertheless
    somebody to the tracker, and owns boxes as well. Raises InputError if an identity stands twice in a frame.
    """
    score = np.ones(len(found)) if found.certain else found.score
    rows = np.flatnonzero(((found.frame - 1) % interval == 0) & (score >= min_score))
    boxes = TrackTable(found.frame[rows], np.arange(len(rows)), found.box_px[rows])
    identity = -1 - np.arange(len(rows))
    everybody = _everybody(truth).every(interval)
    named = np.unique(everybody.identity)
    for true, here, overlap in pair(everybody, boxes).frames:
        overlap = np.where(overlap >= LEAST - EPSILON, overlap, 0)
        i, j = linear_sum_assignment(overlap, maximize=True)
        sure = overlap[i, j] > 0
        identity[here[j[sure]]] = named[true[i[sure]]]
    return Owned(boxes._replace(identity=identity), score[rows], found.extent, found.own)


def _everybody(truth: Truth) -> TrackTable:
    """The tracks, and where found boxes on others are taken out, those of the others; their numbers are not shared."""
    assert truth.tracks is not None, "asked for where there is truth"
    more = [t for t in (truth.ignored, truth.others) if t is not None] if truth.ignoring == "removed" else []
    parts = [truth.tracks, *more]
    first, columns = 0, []
    for part in parts:
        _, number = np.unique(part.identity, return_inverse=True)
        columns.append(part._replace(identity=number + first))
        first += int(number.max(initial=-1)) + 1
    frame, identity, box_px = (np.concatenate(values) for values in zip(*columns, strict=True))
    return TrackTable(frame, identity, np.asarray(box_px, float))
