"""All measures of tracks: their counts, which add over clips, and the figures that come of them."""

from typing import NamedTuple

import numpy as np

from torchvision_dddas.evaluation.metrics import clear, hota, identity, windows
from torchvision_dddas.evaluation.metrics.clear import Clear
from torchvision_dddas.evaluation.metrics.hota import Hota
from torchvision_dddas.evaluation.metrics.identity import Identity
from torchvision_dddas.evaluation.metrics.matching import Ignoring, TrackTable, pair
from torchvision_dddas.evaluation.metrics.segmentation import ratio
from torchvision_dddas.evaluation.metrics.windows import Windows

ONE_TARGET_LEAST = 0.3
"""IoU from which a box counts as the one labelled target: moving-target detections seldom fit as tightly as labels."""


Each = dict[str, np.ndarray]
"""Counts frame by frame, (F,) float64 each, by name; `frame` has the frames."""


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

    def plus(self, other: "TrackCounts") -> "TrackCounts":
        """The counts of both."""
        return TrackCounts(
            self.clear.plus(other.clear),
            self.identity.plus(other.identity),
            self.hota.plus(other.hota),
            self.true + other.true,
            self.found + other.found,
            self.links_2.plus(other.links_2),
            self.links_3.plus(other.links_3),
        )

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
    whole, each = clear.by_frame(clip)
    ratios = {size: windows.by_frame(clip, interval, size) for size in (2, 3)}
    links = [windows.summed(by) for by in ratios.values()]
    columns: Each = {"frame": clip.numbers, **dict(zip(clear.PER_FRAME, each.T, strict=True))}
    for size, by in ratios.items():
        ends = [by.get(frame) for frame in clip.numbers.tolist()]
        columns[f"windows_{size}"] = np.array([ratio is not None for ratio in ends], float)
        columns[f"ar_{size}"] = np.array([ratio or 0.0 for ratio in ends], float)
    return TrackCounts(whole, identity.count(clip), hota.count(clip), *sizes, *links), columns


def measures(counts: TrackCounts) -> dict[str, float]:
    """HOTA, CLEAR and identity measures by name, and the source's AR_2 and AR_3."""
    field = {**hota.measures(counts.hota), **clear.measures(counts.clear), **identity.measures(counts.identity)}
    return {**field, "ar_2": counts.links_2.mean, "ar_3": counts.links_3.mean}


class TargetTrack(NamedTuple):
    """One labelled target among others that are not: frames, those found, switches, gaps, most under one identity."""

    frames: int = 0
    found: int = 0
    switches: int = 0
    fragmentations: int = 0
    same: int = 0

    def plus(self, other: "TargetTrack") -> "TargetTrack":
        """The counts of both."""
        return TargetTrack(*(a + b for a, b in zip(self, other, strict=True)))


def count_one_target(truth: TrackTable, found: TrackTable) -> TargetTrack:
    """Follow the one labelled target (IoU ≥ 0.3). Boxes elsewhere say nothing: other targets are not labelled."""
    return one_target_by_frame(truth, found)[0]


def one_target_by_frame(truth: TrackTable, found: TrackTable) -> tuple[TargetTrack, Each]:
    """The same, and of frames with any box whether the target is there, is found, and is found under a new identity."""
    clip = pair(truth, found)
    counts, each = clear.by_frame(clip, ONE_TARGET_LEAST)
    right = identity.count(clip, ONE_TARGET_LEAST)
    tp, fn, _, switches, _ = each.T
    columns = {"frame": clip.numbers, "frames": tp + fn, "found": tp, "switches": switches}
    whole = int(clip.true_boxes.sum()), counts.tp, counts.switches, counts.fragmentations, right.idtp
    return TargetTrack(*whole), columns


def one_target_measures(counts: TargetTrack) -> dict[str, float]:
    """Share of frames in which the target has a box, and in which it has the identity that it has most."""
    return {"found": ratio(counts.found, counts.frames), "same_identity": ratio(counts.same, counts.frames)}
