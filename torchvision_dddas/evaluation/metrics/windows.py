"""The source's accuracy ratio of whole tracks: each window of K looks read as one association."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.evaluation.metrics.accuracy_ratio import accuracy_ratio
from torchvision_dddas.evaluation.metrics.matching import LEAST, Paired
from torchvision_dddas.evaluation.metrics.segmentation import ratio


class Windows(NamedTuple):
    """Windows that hold any found target, and the sum of their accuracy ratios."""

    windows: int = 0
    total: float = 0.0

    def plus(self, other: "Windows") -> "Windows":
        """The sums of both."""
        return Windows(self.windows + other.windows, self.total + other.total)

    @property
    def mean(self) -> float:
        """Mean accuracy ratio; NaN without windows."""
        return ratio(self.total, self.windows)


def count(clip: Paired, interval: int, size: int) -> Windows:
    """AR_K over a clip, as `by_frame` has it."""
    return summed(by_frame(clip, interval, size))


def summed(ratios: dict[int, float]) -> Windows:
    """The windows of a clip together, in the order of their frames."""
    total = 0.0
    for one in ratios.values():
        total += one
    return Windows(len(ratios), total)


def by_frame(clip: Paired, interval: int, size: int) -> dict[int, float]:
    """AR_K by the newest frame, in order, of all windows of `size` looks, `interval` frames apart, with a target.

    A frame's targets are the true boxes that were found (IoU ≥ 0.5): the ratio is about links, not about boxes. Boxes
    of one found identity are linked; one that is absent from a look within the window is a bridge.
    Source: appendix C, eq. 11.
    """
    looks = {}
    for frame, (true, found, score) in zip(clip.numbers.tolist(), clip.frames, strict=True):
        i, j = linear_sum_assignment(np.where(score >= LEAST, score, 0.0), maximize=True)
        hit = score[i, j] >= LEAST
        looks[frame] = true[i[hit]] + 1, found[j[hit]]
    nobody = np.zeros(0, np.int64), np.zeros(0, np.int64)
    whole = range(min(looks, default=1) + (size - 1) * interval, max(looks, default=0) + 1, interval)
    # Frame numbers may be any, and far apart: only the windows that hold a look are gone through.
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
