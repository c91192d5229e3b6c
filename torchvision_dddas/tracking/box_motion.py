"""Estimate the camera's motion between looks from boxes alone, as the shift that most tracks have in common.

The velocities of tracks contain the camera's steady motion. This module finds changes of that motion, and the motion at
the first looks, when velocities are unknown. Candidates are shifts that bring many tracks onto detections. A candidate
is accepted only if it makes the links much likelier. Otherwise rows of vehicles would alias, with each vehicle in the
place of the next one.
"""

from collections.abc import Sequence

import numpy as np

from torchvision_dddas.geometry import best_pairs

_REACH, _CELL = 4.0, 0.2  # largest shift, and size of the cells for votes, in median heights
_AXIS = np.arange(-np.ceil(_REACH / _CELL) - 1, np.ceil(_REACH / _CELL) + 2) * _CELL  # centres of the cells
_AWAY = np.hypot(_AXIS[:, None], _AXIS)  # length of the shift of each cell
_AROUND = np.array([[row * len(_AXIS) + column] for row in (-1, 0, 1) for column in (-1, 0, 1)])  # a block of 3 x 3
# If more than _STILL_SHARE of the tracks lie within _STILL median heights of a detection, no shift is searched for.
_STILL, _STILL_SHARE = 0.15, 0.7
_MOST = 3  # largest number of candidates
FEWEST, _SHARE = 3, 0.3  # smallest number, and smallest share, of the tracks that must vote for a candidate
_LARGEST_SIZE_CHANGE = 0.35
_FAR_PRICE = 0.02  # votes subtracted from a shift for each track and each median height of its length
_GAIN, _GAIN_EACH, _GAIN_EACH_NEWBORN = 3.0, 2.0, 1.5  # required gain of scores: constant, per track, per newborn


def candidate_shifts(
    place_px: np.ndarray, height_px: np.ndarray, centre_px: np.ndarray, box_height_px: np.ndarray
) -> list[np.ndarray]:
    """Return shifts (2,) in pixels that bring many predicted positions onto detections, the most votes first.

    place_px: (N, 2) and height_px: (N,), of the tracks. centre_px: (M, 2) and box_height_px: (M,), of the detections.
    """
    if len(place_px) < FEWEST or len(centre_px) < FEWEST:
        return []
    unit = float(medians(height_px))
    across, down = ((centre_px[:, axis] - place_px[:, axis, None]) / unit for axis in (0, 1))
    alike = np.abs(np.log(box_height_px / height_px[:, None])) < _LARGEST_SIZE_CHANGE
    away = np.where(alike, np.maximum(np.abs(across), np.abs(down)), np.inf)
    if (away.min(axis=1) < _STILL).mean() > _STILL_SHARE:
        return []
    near = (away < _REACH).nonzero()
    votes = np.stack([across[near], down[near]], axis=1)
    # A vote counts for its cell and the cells around it. A track votes at most once for a cell.
    side = len(_AXIS)
    row, column = np.rint(votes / _CELL).astype(int).T + side // 2
    voted = np.zeros(len(place_px) * side**2, bool)
    voted[(near[0] * side**2 + row * side + column) + _AROUND] = True
    count = np.bincount(voted.nonzero()[0] % side**2, minlength=side**2).reshape(side, side)
    left = count - _FAR_PRICE * len(place_px) * _AWAY
    found = []
    for _ in range(_MOST):
        row, column = np.unravel_index(left.argmax(), left.shape)
        if count[row, column] < max(FEWEST, _SHARE * len(place_px)):
            break
        shift = np.array([_AXIS[row], _AXIS[column]])
        for width in (1.5 * _CELL, _CELL, _CELL):
            close = (np.abs(votes - shift) < width).all(axis=1)
            if close.sum() >= FEWEST:
                shift = medians(votes[close])
        if np.abs(shift).max() > _STILL:
            found.append(shift * unit)
        left[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = -1.0
    return found


def medians(values: np.ndarray) -> np.ndarray:
    """Return the medians over the first axis of finite values (K, ...), K > 0. For small K, np.median is 10x slower."""
    ordered, count = np.sort(values, axis=0), len(values)
    return (ordered[(count - 1) // 2] + ordered[count // 2]) / 2


def likelier_shift(still: np.ndarray, moved: Sequence[np.ndarray], newborn: bool) -> int | None:
    """Return the index of the shift that makes the links likelier by the required gain; None if no shift does.

    still: (N, M) association scores without a shift. moved: the scores under each shift. newborn: whether no track has
    a velocity yet, which changes the required gain.
    """
    before, *after = (float(score[tuple(best_pairs(score).T)].sum()) for score in (still, *moved))
    best = int(np.argmax(after))
    least_each = _GAIN_EACH_NEWBORN if newborn else _GAIN_EACH
    return best if after[best] - before > _GAIN + least_each * len(still) else None
