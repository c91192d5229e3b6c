"""Measures of tracks: HOTA, CLEAR (MOTA) and identity (IDF1), pooled over clips."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.evaluation.metrics import accuracy_ratio
from torchvision_dddas.evaluation.metrics.accuracy_ratio import Windows
from torchvision_dddas.evaluation.metrics.matching import EPSILON, LEAST, Paired, pair
from torchvision_dddas.evaluation.metrics.pixels import ratio
from torchvision_dddas.evaluation.metrics.truth import Ignoring, TrackTable

ONE_TARGET_LEAST = 0.3
"""IoU from which a box counts as the one labelled target: moving-target detections seldom fit as tightly as labels."""


Each = dict[str, np.ndarray]
"""Counts frame by frame, (F,) float64 each, by name; `frame` has the frames."""


class Clear(NamedTuple):
    """Counts that may be added over clips.

    tp, fn, fp: boxes found, missed, false. switches: a target is found under another identity than the last time.
    fragmentations: a target is found again after frames without, also those in which the truth itself has a gap.
    mostly_tracked, partly_tracked, mostly_lost: targets found in over 80 %, in 20 to 80 %, in under 20 % of their
    frames. overlap: sum of the IoU.
    """

    tp: int = 0
    fn: int = 0
    fp: int = 0
    switches: int = 0
    fragmentations: int = 0
    mostly_tracked: int = 0
    partly_tracked: int = 0
    mostly_lost: int = 0
    overlap: float = 0.0


ALPHA = np.arange(0.05, 0.99, 0.05)
"""The nineteen IoUs from which a box counts as found; the same numbers to the last bit as TrackEval's."""

_NONE = np.zeros(len(ALPHA))


class Hota(NamedTuple):
    """Sums that may be added over clips, each (19,): one a value of ALPHA.

    tp, fn, fp: boxes found, missed, false. association, recall, precision: sums over the boxes found of how well the
    two identities go together over the whole clip. overlap: sum of the IoU of the boxes found.
    """

    tp: np.ndarray = _NONE
    fn: np.ndarray = _NONE
    fp: np.ndarray = _NONE
    association: np.ndarray = _NONE
    recall: np.ndarray = _NONE
    precision: np.ndarray = _NONE
    overlap: np.ndarray = _NONE


class Identity(NamedTuple):
    """Boxes with the right identity, true boxes without it, found boxes without it."""

    idtp: int = 0
    idfn: int = 0
    idfp: int = 0


class TrackCounts(NamedTuple):
    """The counts of clips, pooled as TrackEval combines sequences. true, found: how many identities there are.

    links_2, links_3: the source's accuracy ratio over two and three looks.
    """

    clear: Clear = Clear()
    identity: Identity = Identity()
    hota: Hota = Hota()
    true: int = 0
    found: int = 0
    links_2: Windows = Windows()
    links_3: Windows = Windows()

    def by_name(self) -> dict[str, int]:
        """The counts of boxes and identities; those of HOTA are curves and stay out."""
        whole = {name: n for name, n in self.clear._asdict().items() if name != "overlap"}
        return {**whole, **self.identity._asdict(), "true": self.true, "found": self.found}


def count(
    truth: TrackTable,
    found: TrackTable,
    ignored: TrackTable | None = None,
    ignoring: Ignoring = "dropped",
    interval: int = 1,
) -> TrackCounts:
    """Count one clip's tracks, of every interval-th frame, against the truth.

    `matching.pair` tells what becomes of boxes that do not count.
    """
    return by_frame(truth, found, ignored, ignoring, interval)[0]


def by_frame(
    truth: TrackTable,
    found: TrackTable,
    ignored: TrackTable | None = None,
    ignoring: Ignoring = "dropped",
    interval: int = 1,
) -> tuple[TrackCounts, Each]:
    """The same, and what of it belongs to single frames, of frames with any box.

    Of CLEAR the counts; windows_K: whether a window of K looks ends there, ar_K: its ratio. What HOTA and IDF1 count
    belongs to whole tracks.
    """
    clip = pair(truth, found, ignored, ignoring)
    sizes = len(clip.true_boxes), len(clip.found_boxes)
    whole, each = clear_by_frame(clip)
    ratios = {size: accuracy_ratio.by_frame(clip, interval, size) for size in (2, 3)}
    links = [accuracy_ratio.summed(by) for by in ratios.values()]
    columns: Each = {"frame": clip.numbers, **dict(zip(PER_FRAME, each.T, strict=True))}
    for size, by in ratios.items():
        ends = [by.get(frame) for frame in clip.numbers.tolist()]
        columns[f"windows_{size}"] = np.array([ratio is not None for ratio in ends], float)
        columns[f"ar_{size}"] = np.array([ratio or 0.0 for ratio in ends], float)
    return TrackCounts(whole, count_identity(clip), count_hota(clip), *sizes, *links), columns


def measures(counts: TrackCounts) -> dict[str, float]:
    """HOTA, CLEAR and identity measures by name, and the source's AR_2 and AR_3."""
    field = {**hota_measures(counts.hota), **clear_measures(counts.clear), **identity_measures(counts.identity)}
    return {**field, "ar_2": counts.links_2.mean, "ar_3": counts.links_3.mean}


class TargetTrack(NamedTuple):
    """One labelled target among others that are not: frames, those found, switches, gaps, most under one identity."""

    frames: int = 0
    found: int = 0
    switches: int = 0
    fragmentations: int = 0
    same: int = 0


def count_one_target(truth: TrackTable, found: TrackTable) -> TargetTrack:
    """Follow the one labelled target (IoU ≥ 0.3). Boxes elsewhere say nothing: other targets are not labelled."""
    return one_target_by_frame(truth, found)[0]


def one_target_by_frame(truth: TrackTable, found: TrackTable) -> tuple[TargetTrack, Each]:
    """The same, and of frames with any box whether the target is there, is found, and is found under a new identity."""
    clip = pair(truth, found)
    counts, each = clear_by_frame(clip, ONE_TARGET_LEAST)
    right = count_identity(clip, ONE_TARGET_LEAST)
    tp, fn, _, switches, _ = each.T
    columns = {"frame": clip.numbers, "frames": tp + fn, "found": tp, "switches": switches}
    whole = int(clip.true_boxes.sum()), counts.tp, counts.switches, counts.fragmentations, right.idtp
    return TargetTrack(*whole), columns


def one_target_measures(counts: TargetTrack) -> dict[str, float]:
    """Share of frames in which the target has a box, and in which it has the identity that it has most."""
    return {"found": ratio(counts.found, counts.frames), "same_identity": ratio(counts.same, counts.frames)}


PER_FRAME = ("tp", "fn", "fp", "switches", "overlap")
"""The counts that are those of single frames."""


def count_clear(clip: Paired, least: float = LEAST) -> Clear:
    """Match each frame's boxes at an IoU of at least `least`: pairs of the frame before are kept, then IoU decides.

    The frame before is the last in which there were both true and found boxes, as TrackEval has it; a switch is seen
    over any gap. Source: Bernardin and Stiefelhagen, 2008, with TrackEval's matching.
    """
    return clear_by_frame(clip, least)[0]


def clear_by_frame(clip: Paired, least: float = LEAST) -> tuple[Clear, np.ndarray]:
    """The same, and (F, 5) what of it each of the clip's frames adds, in the order of PER_FRAME."""
    targets = len(clip.true_boxes)
    last = np.full(targets, -1)  # the identity that each target was last found under, whenever that was
    before = np.full(targets, -1)  # the same, of the frame before alone
    found_boxes, begun = np.zeros(targets, int), np.zeros(targets, int)
    switches, overlap = 0, 0.0
    each = np.zeros((len(clip.frames), len(PER_FRAME)))
    for row, (true, found, score) in zip(each, clip.frames, strict=True):
        row[1:3] = len(true), len(found)
        if len(true) == 0 or len(found) == 0:
            continue
        kept = before[true][:, None] == found[None]
        worth = np.where(score >= least - EPSILON, 1000.0 * kept + score, 0.0)
        i, j = linear_sum_assignment(worth, maximize=True)
        hit = worth[i, j] > EPSILON
        i, j = i[hit], j[hit]
        target, identity = true[i], found[j]
        switched = int(((last[target] >= 0) & (last[target] != identity)).sum())
        switches += switched
        begun[target] += before[target] < 0
        last[target] = identity
        before[:] = -1
        before[target] = identity
        found_boxes[target] += 1
        shared = float(score[i, j].sum())
        overlap += shared
        row[:] = len(i), len(true) - len(i), len(found) - len(i), switched, shared
    share = found_boxes / clip.true_boxes
    mostly, hardly = int((share > 0.8).sum()), int((share < 0.2).sum())
    tp = int(found_boxes.sum())
    whole = Clear(
        tp=tp,
        fn=int(clip.true_boxes.sum()) - tp,
        fp=int(clip.found_boxes.sum()) - tp,
        switches=switches,
        fragmentations=int(np.maximum(begun - 1, 0).sum()),
        mostly_tracked=mostly,
        partly_tracked=targets - mostly - hardly,
        mostly_lost=hardly,
        overlap=overlap,
    )
    return whole, each


def clear_measures(counts: Clear) -> dict[str, float]:
    """MOTA, MOTP (mean IoU of the boxes found), recall, precision, shares of targets mostly tracked and lost.

    NaN where a clip has no true box; 0 where there are some and nothing was found, as in TrackEval.
    """
    true = counts.tp + counts.fn
    targets = counts.mostly_tracked + counts.partly_tracked + counts.mostly_lost
    return {
        "mota": ratio(counts.tp - counts.fp - counts.switches, true),
        "motp": ratio(counts.overlap, max(counts.tp, min(1, true))),
        "recall": ratio(counts.tp, true),
        "precision": ratio(counts.tp, max(counts.tp + counts.fp, min(1, true))),
        "mostly_tracked": ratio(counts.mostly_tracked, targets),
        "mostly_lost": ratio(counts.mostly_lost, targets),
    }


def count_hota(clip: Paired) -> Hota:
    """Match each frame's boxes by IoU times how well their identities go together over the clip.

    Source: Luiten et al., 2021, with TrackEval's matching, which is the same for every alpha.
    """
    true_boxes, found_boxes = clip.true_boxes[:, None], clip.found_boxes[None]
    likely = np.zeros((len(clip.true_boxes), len(clip.found_boxes)))
    for true, found, score in clip.frames:
        rivals = score.sum(axis=0)[None] + score.sum(axis=1)[:, None] - score
        likely[true[:, None], found[None]] += np.divide(score, rivals, out=np.zeros_like(score), where=rivals > EPSILON)
    likely = likely / (true_boxes + found_boxes - likely)

    together = np.zeros((len(ALPHA), *likely.shape))
    overlap = np.zeros(len(ALPHA))
    for true, found, score in clip.frames:
        i, j = linear_sum_assignment(likely[true[:, None], found[None]] * score, maximize=True)
        fits = score[i, j] >= ALPHA[:, None] - EPSILON
        together[:, true[i], found[j]] += fits
        overlap += fits @ score[i, j]
    tp = together.sum(axis=(1, 2))
    return Hota(
        tp=tp,
        fn=clip.true_boxes.sum() - tp,
        fp=clip.found_boxes.sum() - tp,
        association=(together**2 / (true_boxes + found_boxes - together)).sum(axis=(1, 2)),
        recall=(together**2 / true_boxes).sum(axis=(1, 2)),
        precision=(together**2 / found_boxes).sum(axis=(1, 2)),
        overlap=overlap,
    )


def curves(sums: Hota) -> dict[str, np.ndarray]:
    """Each measure (19,) over ALPHA. LocA is 1 where nothing is found, as in TrackEval; all are NaN without truth."""
    tp, fn, fp, association, recall, precision, overlap = sums
    known = np.where(tp + fn > 0, 1.0, np.nan)
    some = np.maximum(tp, 1)
    detection = tp / np.maximum(tp + fn + fp, 1)
    return {
        "hota": known * np.sqrt(detection * association / some),
        "deta": known * detection,
        "assa": known * association / some,
        "loca": known * np.where(tp > 0, overlap / some, 1.0),
        "detre": known * tp / np.maximum(tp + fn, 1),
        "detpr": known * tp / np.maximum(tp + fp, 1),
        "assre": known * recall / some,
        "asspr": known * precision / some,
    }


def hota_measures(sums: Hota) -> dict[str, float]:
    """HOTA, its parts DetA and AssA, LocA, and recall and precision of both parts: means over ALPHA."""
    return {name: float(curve.mean()) for name, curve in curves(sums).items()}


def count_identity(clip: Paired, least: float = LEAST) -> Identity:
    """Name found identities after targets so that most boxes agree (IoU of at least `least`).

    Maximising the agreeing boxes is the same as minimising false and missing ones, since each pair that agrees takes
    one off both. Source: Ristani et al., 2016.
    """
    together = np.zeros((len(clip.true_boxes), len(clip.found_boxes)))
    for true, found, score in clip.frames:
        i, j = np.nonzero(score >= least)
        together[true[i], found[j]] += 1
    right = int(together[linear_sum_assignment(together, maximize=True)].sum())
    return Identity(right, int(clip.true_boxes.sum()) - right, int(clip.found_boxes.sum()) - right)


def identity_measures(counts: Identity) -> dict[str, float]:
    """IDF1, IDP and IDR. NaN where a clip has no true box; 0 where there are some and nothing was found."""
    idtp, idfn, idfp = counts
    true = idtp + idfn
    return {
        "idf1": ratio(2 * idtp, 2 * idtp + idfn + idfp) if true else float("nan"),
        "idp": ratio(idtp, max(idtp + idfp, min(1, true))),
        "idr": ratio(idtp, true),
    }
