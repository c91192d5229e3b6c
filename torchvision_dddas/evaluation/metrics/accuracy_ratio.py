"""The source's accuracy ratio AR_K of windows and of whole tracks (appendix C, eq. 11)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.matching import LEAST, Paired
from torchvision_dddas.evaluation.metrics.pixels import ratio
from torchvision_dddas.types import Int


def accuracy_ratio(rows: Int[np.ndarray, "Z K"], identities: Sequence[Int[np.ndarray, "N"]]) -> float:
    """1 - mismatches / ((K - 1) · the largest number of targets in a frame), in [0, 1]; 1 for empty frames.

    rows: what was associated, newest frame first, counted from 1, 0 for the dummy. identities: the true ones of each
    frame's targets, newest frame first.
    """
    most = max(len(known) for known in identities)
    return 1.0 - mismatches(rows, identities) / ((len(identities) - 1) * most) if most else 1.0


def mismatches(rows: Int[np.ndarray, "Z K"], identities: Sequence[Int[np.ndarray, "N"]]) -> int:
    """The number of mismatches, mme; at most one for each target of an older frame and the link from it to the next.

    A target is mismatched when its successor is another one, when it has the dummy although it is there, or when the
    frame between is bridged to another one. A bridge that was not made is no mismatch.
    Raises InputError if a row has not one column a frame, or if a frame's real target is not in exactly one row.
    """
    _check(rows, identities)
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


def _check(rows: np.ndarray, identities: Sequence[np.ndarray]) -> None:
    if rows.ndim != 2 or rows.shape[1] != len(identities):
        raise InputError(f"an association of {len(identities)} frames needs as many columns; got shape {rows.shape}.")
    for column, known in enumerate(identities):
        real = np.sort(rows[rows[:, column] > 0, column])
        if not np.array_equal(real, np.arange(1, len(known) + 1)):
            raise InputError(
                f"frame {column} of the window, newest first, has {len(known)} targets, each in one row; "
                f"got rows for {real.tolist()}."
            )


class Windows(NamedTuple):
    """Windows that hold any found target, and the sum of their accuracy ratios."""

    windows: int = 0
    total: float = 0.0

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
