"""The source's measure of a window's association: the accuracy ratio AR_K (appendix C, eq. 11)."""

from collections.abc import Sequence

import numpy as np

from torchvision_dddas.errors import InputError
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
