"""Measures of tracks: HOTA, CLEAR (MOTA), identity (IDF1) and the source's accuracy ratio AR_K, pooled over clips."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.metrics.matching import EPSILON, LEAST, Paired, pair
from torchvision_dddas.lab.evaluation.metrics.pixels import ratio
from torchvision_dddas.lab.evaluation.metrics.truth import Ignoring, TrackTable
from torchvision_dddas.types import Int

ONE_TARGET_LEAST = 0.3
"""IoU from which a box counts as the one labelled target: moving-target detections seldom fit as tightly as labels."""


Each = dict[str, np.ndarray]
"""Counts frame by frame, (F,) float64 each, by name; `frame` holds the frame numbers."""


class Clear(NamedTuple):
    """Counts that may be added over clips.

    tp, fn, fp: boxes found, missed, false. switches: a target is found under another identity than before.
    fragmentations: a target is found again after frames without it, also if the truth itself has a gap. mostly_tracked,
    partly_tracked, mostly_lost: targets found in over 80 %, in 20 to 80 %, in under 20 % of their frames. overlap: sum
    of the IoU.
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
"""The nineteen IoUs from which a box counts as found, equal to TrackEval's to the last bit."""

_NONE = np.zeros(len(ALPHA))


class Hota(NamedTuple):
    """Sums that may be added over clips, each (19,), one for each value of ALPHA.

    tp, fn, fp: boxes found, missed, false. association, recall, precision: sums over the found boxes of how well the
    two identities agree over the whole clip. overlap: sum of the IoU of the found boxes.
    """

    tp: np.ndarray = _NONE
    fn: np.ndarray = _NONE
    fp: np.ndarray = _NONE
    association: np.ndarray = _NONE
    recall: np.ndarray = _NONE
    precision: np.ndarray = _NONE
    overlap: np.ndarray = _NONE


class Identity(NamedTuple):
    """Numbers of boxes with the right identity, of true boxes without it, and of found boxes without it."""

    idtp: int = 0
    idfn: int = 0
    idfp: int = 0


class Windows(NamedTuple):
    """Number of windows with any found target, and the sum of their accuracy ratios."""

    windows: int = 0
    total: float = 0.0

    @classmethod
    def of(cls, ratios: dict[int, float]) -> "Windows":
        """Return the windows of a clip together, in the order of their frames."""
        return cls(len(ratios), sum(ratios.values(), 0.0))

    @property
    def mean(self) -> float:
        """Mean accuracy ratio; NaN without windows."""
        return ratio(self.total, self.windows)


class TrackCounts(NamedTuple):
    """The counts of clips, pooled as TrackEval combines sequences. true, found: numbers of identities.

    links_2, links_3: the source's accuracy ratio over two and three frames.
    """

    clear: Clear = Clear()
    identity: Identity = Identity()
    hota: Hota = Hota()
    true: int = 0
    found: int = 0
    links_2: Windows = Windows()
    links_3: Windows = Windows()

    def by_name(self) -> dict[str, int]:
        """Return the counts of boxes and identities, without those of HOTA, which are curves."""
        whole = {name: n for name, n in self.clear._asdict().items() if name != "overlap"}
        return {**whole, **self.identity._asdict(), "true": self.true, "found": self.found}


def count(
    truth: TrackTable,
    found: TrackTable,
    ignored: TrackTable | None = None,
    ignoring: Ignoring = "dropped",
    interval: int = 1,
    least: float = LEAST,
) -> tuple[TrackCounts, Each]:
    """Count one clip's tracks, of every interval-th frame, against the truth; also for each frame that has any box.

    For each frame: the counts of CLEAR; windows_K: whether a window of K frames ends there; ar_K: its ratio. The counts
    of HOTA and IDF1 belong to whole tracks. ignored, ignoring: see `matching.pair`. least: the IoU for CLEAR and IDF1.
    """
    clip = pair(truth, found, ignored, ignoring)
    clear, each = count_clear(clip, least)
    columns: Each = {"frame": clip.numbers, **dict(zip(PER_FRAME, each.T, strict=True))}
    links = []
    for size in (2, 3):
        ratios = link_ratios(clip, interval, size)
        links.append(Windows.of(ratios))
        columns[f"windows_{size}"] = np.array([frame in ratios for frame in clip.numbers.tolist()], float)
        columns[f"ar_{size}"] = np.array([ratios.get(frame, 0.0) for frame in clip.numbers.tolist()], float)
    sizes = len(clip.true_boxes), len(clip.found_boxes)
    return TrackCounts(clear, count_identity(clip, least), count_hota(clip), *sizes, *links), columns


def measures(counts: TrackCounts) -> dict[str, float]:
    """Return HOTA, CLEAR and identity measures by name, and the source's AR_2 and AR_3."""
    hota = {name: float(curve.mean()) for name, curve in curves(counts.hota).items()}
    field = {**hota, **clear_measures(counts.clear), **identity_measures(counts.identity)}
    return {**field, "ar_2": counts.links_2.mean, "ar_3": counts.links_3.mean}


class TargetTrack(NamedTuple):
    """Counts of one labelled target among others: frames, found, switches, gaps, frames under its main identity."""

    frames: int = 0
    found: int = 0
    switches: int = 0
    fragmentations: int = 0
    same: int = 0


def count_one_target(truth: TrackTable, found: TrackTable) -> tuple[TargetTrack, Each]:
    """Count the track of the one labelled target (IoU ≥ 0.3). Boxes elsewhere may belong to targets without a label.

    For each frame with any box: whether the target is present, is found, and is found under a new identity.
    """
    clip = pair(truth, found)
    counts, each = count_clear(clip, ONE_TARGET_LEAST)
    right = count_identity(clip, ONE_TARGET_LEAST)
    tp, fn, _, switches, _ = each.T
    columns = {"frame": clip.numbers, "frames": tp + fn, "found": tp, "switches": switches}
    whole = int(clip.true_boxes.sum()), counts.tp, counts.switches, counts.fragmentations, right.idtp
    return TargetTrack(*whole), columns


def one_target_measures(counts: TargetTrack) -> dict[str, float]:
    """Return the share of frames in which the target has a box, and in which it has its most frequent identity."""
    return {"found": ratio(counts.found, counts.frames), "same_identity": ratio(counts.same, counts.frames)}


PER_FRAME = ("tp", "fn", "fp", "switches", "overlap")
"""The counts that can be given for single frames."""


def count_clear(clip: Paired, least: float = LEAST) -> tuple[Clear, np.ndarray]:
    """Return the counts, and (F, 5) the contribution of each frame, in the order of PER_FRAME.

    Match each frame's boxes at an IoU of at least `least`: keep the pairs of the previous frame, then decide by IoU.
    The previous frame is the last frame with both true and found boxes, as in TrackEval. A switch is seen over any gap.
    Source: Bernardin and Stiefelhagen, 2008, with TrackEval's matching.
    """
    targets = len(clip.true_boxes)
    last = np.full(targets, -1)  # the last identity under which each target was found, at any time
    before = np.full(targets, -1)  # the same, only in the previous frame
    found_boxes, begun = np.zeros(targets, int), np.zeros(targets, int)
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
        begun[target] += before[target] < 0
        last[target] = identity
        before[:] = -1
        before[target] = identity
        found_boxes[target] += 1
        row[:] = len(i), len(true) - len(i), len(found) - len(i), switched, score[i, j].sum()
    share = found_boxes / clip.true_boxes
    mostly, hardly = int((share > 0.8).sum()), int((share < 0.2).sum())
    tp = int(found_boxes.sum())
    whole = Clear(
        tp=tp,
        fn=int(clip.true_boxes.sum()) - tp,
        fp=int(clip.found_boxes.sum()) - tp,
        switches=int(each[:, 3].sum()),
        fragmentations=int(np.maximum(begun - 1, 0).sum()),
        mostly_tracked=mostly,
        partly_tracked=targets - mostly - hardly,
        mostly_lost=hardly,
        overlap=sum(each[:, 4].tolist(), 0.0),
    )
    return whole, each


def clear_measures(counts: Clear) -> dict[str, float]:
    """Return MOTA, MOTP (mean IoU of the found boxes), recall, precision, shares of mostly tracked and lost targets.

    NaN if a clip has no true box; 0 if it has some and nothing was found, as in TrackEval.
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
    """Match each frame's boxes by IoU times how well their identities agree over the clip.

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
    """Return HOTA, its parts DetA and AssA, LocA, recall and precision of both parts, (19,) each over ALPHA.

    The measures are their means. LocA is 1 if nothing is found, as in TrackEval. All are NaN without truth.
    """
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


def count_identity(clip: Paired, least: float = LEAST) -> Identity:
    """Assign found identities to targets so that most boxes agree (IoU of at least `least`).

    This also minimises the false and missing boxes, because each pair that agrees removes one of both. Source: Ristani
    et al., 2016.
    """
    together = np.zeros((len(clip.true_boxes), len(clip.found_boxes)))
    for true, found, score in clip.frames:
        i, j = np.nonzero(score >= least)
        together[true[i], found[j]] += 1
    right = int(together[linear_sum_assignment(together, maximize=True)].sum())
    return Identity(right, int(clip.true_boxes.sum()) - right, int(clip.found_boxes.sum()) - right)


def identity_measures(counts: Identity) -> dict[str, float]:
    """Return IDF1, IDP and IDR. NaN if a clip has no true box; 0 if it has some and nothing was found."""
    idtp, idfn, idfp = counts
    true = idtp + idfn
    return {
        "idf1": ratio(2 * idtp, 2 * idtp + idfn + idfp) if true else float("nan"),
        "idp": ratio(idtp, max(idtp + idfp, min(1, true))),
        "idr": ratio(idtp, true),
    }


def accuracy_ratio(rows: Int[np.ndarray, "Z K"], identities: Sequence[Int[np.ndarray, "N"]]) -> float:
    """Return 1 - mismatches / ((K - 1) · largest number of targets in a frame), in [0, 1]; 1 for empty frames.

    rows: the associations, newest frame first, counted from 1, 0 for the dummy. identities: the true identities of each
    frame's targets, newest frame first.
    """
    most = max(len(known) for known in identities)
    return 1.0 - mismatches(rows, identities) / ((len(identities) - 1) * most) if most else 1.0


def mismatches(rows: Int[np.ndarray, "Z K"], identities: Sequence[Int[np.ndarray, "N"]]) -> int:
    """Return the number of mismatches, mme: at most one for each target of an older frame and its link to the next.

    A target is mismatched if its successor is another target, if it has the dummy although it is present, or if the
    frame between is bridged to another target. A missing bridge is not a mismatch.
    Raise InputError if a row has another number of columns than frames, or if a real target is not in exactly one row.
    """
    if rows.ndim != 2 or rows.shape[1] != len(identities):
        raise InputError(f"an association of {len(identities)} frames needs as many columns; got shape {rows.shape}.")
    for column, known in enumerate(identities):
        real = np.sort(rows[rows[:, column] > 0, column])
        if not np.array_equal(real, np.arange(1, len(known) + 1)):
            raise InputError(
                f"frame {column} of the window, newest first, has {len(known)} targets, each in one row; "
                f"got rows for {real.tolist()}."
            )
    total = 0
    for older in range(1, len(identities)):
        known, newer = identities[older], identities[older - 1]
        row = np.zeros(len(known), np.int64)
        of_older = rows[rows[:, older] > 0]
        row[of_older[:, older] - 1] = np.arange(len(of_older))
        follower = of_older[row, older - 1]
        named = np.append(newer, 0)[follower - 1]
        wrong = np.where(follower > 0, named != known, np.isin(known, newer))
        for skipped in range(older - 2, -1, -1):
            far = of_older[row, skipped]
            bridged = (far > 0) & (of_older[row, skipped + 1 : older] == 0).all(axis=1)
            wrong |= bridged & (np.append(identities[skipped], 0)[far - 1] != known)
        total += int(wrong.sum())
    return total


def link_ratios(clip: Paired, interval: int, size: int) -> dict[int, float]:
    """Return AR_K by the newest frame, in order, of all windows of `size` frames, `interval` apart, with a target.

    A frame's targets are the true boxes that were found (IoU ≥ 0.5): the ratio is about links, not about boxes. Boxes
    of one found identity are linked. An identity that is absent from a look within the window is a bridge.
    Source: appendix C, eq. 11.
    """
    looks = {}
    for frame, (true, found, score) in zip(clip.numbers.tolist(), clip.frames, strict=True):
        i, j = linear_sum_assignment(np.where(score >= LEAST, score, 0.0), maximize=True)
        hit = score[i, j] >= LEAST
        looks[frame] = true[i[hit]] + 1, found[j[hit]]
    nobody = np.zeros(0, np.int64), np.zeros(0, np.int64)
    whole = range(min(looks, default=1) + (size - 1) * interval, max(looks, default=0) + 1, interval)
    # Frames may have any numbers, and be far apart: visit only the windows that contain a look.
    held = {frame + age * interval for frame in looks for age in range(size)}
    ratios = {}
    for newest in sorted(frame for frame in held if frame in whole):
        window = [looks.get(newest - age * interval, nobody) for age in range(size)]
        if not any(len(true) for true, _ in window):
            continue
        names = np.unique(np.concatenate([found for _, found in window]))
        rows = np.zeros((len(names), size), np.int64)
        for column, (_, found) in enumerate(window):
            rows[np.searchsorted(names, found), column] = np.arange(len(found)) + 1
        ratios[newest] = accuracy_ratio(rows, [true for true, _ in window])
    return ratios
