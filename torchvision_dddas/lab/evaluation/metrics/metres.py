"""Errors of located targets in metres, and whether their ellipses contain the errors."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.lab.evaluation.metrics.boxes import iou
from torchvision_dddas.lab.evaluation.metrics.matching import match
from torchvision_dddas.lab.evaluation.metrics.pixels import ratio
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable, rows_by_frame

INSIDE = 5.991
"""The 95 % quantile of chi-square with two degrees of freedom."""

LEAST_IOU = 0.3
"""IoU from which a box is a target's: blobs fit less tightly than labels."""

FARTHEST_M = 10.0
"""Without boxes, a place further than this from a target does not belong to it."""


class LocatedCounts(NamedTuple):
    """Numbers of true places in processed frames, of reported places, and of reported places that match no target."""

    targets: int = 0
    told: int = 0
    strays: int = 0


def located_measures(counts: LocatedCounts) -> dict[str, float]:
    """Return the share of true places that were reported, and the share of reported places that match a target."""
    return {
        "located": ratio(counts.told, counts.targets),
        "belongs": ratio(counts.told, counts.told + counts.strays),
    }


def by_boxes(frame: np.ndarray, box_px: np.ndarray, truth: TrackTable) -> np.ndarray:
    """Return the row of each found box's true box, (N,) int64, one to one at an IoU of LEAST_IOU; -1: none."""
    which = np.full(len(frame), -1)
    for rows, true in _rows_in_both(frame, truth.frame):
        i, j = match(iou(box_px[rows], truth.box_px[true]), LEAST_IOU)
        which[rows[i]] = true[j]
    return which


def by_places(
    frame: np.ndarray, place_m: np.ndarray, true_frame: np.ndarray, true_m: np.ndarray, farthest_m: float = FARTHEST_M
) -> np.ndarray:
    """Return the row of each reported place's true place, (N,) int64, one to one within `farthest_m`; -1: none.

    Places further away match none, so that errors are at most `farthest_m`.
    """
    which = np.full(len(frame), -1)
    for rows, true in _rows_in_both(frame, true_frame):
        away = np.linalg.norm(place_m[rows][:, None] - true_m[true][None], axis=-1)
        worth = np.where(away <= farthest_m, 2 * farthest_m - away, 0.0)
        i, j = linear_sum_assignment(worth, maximize=True)
        hit = worth[i, j] > 0
        which[rows[i[hit]]] = true[j[hit]]
    return which


def _rows_in_both(frame: np.ndarray, other: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the rows of each frame that both tables have, in order."""
    mine, others = rows_by_frame(frame), rows_by_frame(other)
    return ((mine[number], others[number]) for number in mine if number in others)


def inside(off_m: np.ndarray, covariance_m2: np.ndarray) -> np.ndarray:
    """Return 1.0 if the 95 % ellipse of a covariance (N, 2, 2) contains the error (N, 2), else 0.0; NaN if unknown."""
    a, b, c = covariance_m2[:, 0, 0], covariance_m2[:, 0, 1], covariance_m2[:, 1, 1]
    size = a * c - b * b
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = (c * off_m[:, 0] ** 2 - 2 * b * off_m[:, 0] * off_m[:, 1] + a * off_m[:, 1] ** 2) / size
        held: np.ndarray = np.where((size > 0) & np.isfinite(squared), squared <= INSIDE, np.nan)
    return held


def shared_error(
    frame: np.ndarray,
    mark: np.ndarray,
    place_m: np.ndarray,
    true_frame: np.ndarray,
    who: np.ndarray,
    true_m: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return frames (F,), and the error (F, 2) that all landmarks share in each, from their reports.

    frame, mark (N,), place_m (N, 2): the reports. true_frame, who, true_m: the true places of all. Marks are assigned
    to targets one to one by the smallest median distance over the clip. The shared error, the mean over the marks of a
    frame, is subtracted from results that are relative to the landmarks.
    """
    marks, people = np.unique(mark), np.unique(who)
    gaps: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
    cost = np.full((len(marks), len(people)), 1e9)
    for i, one in enumerate(marks.tolist()):
        for j, other in enumerate(people.tolist()):
            mine, theirs = mark == one, who == other
            both, a, b = np.intersect1d(frame[mine], true_frame[theirs], return_indices=True)
            apart = place_m[mine][a] - true_m[theirs][b]
            known = np.isfinite(apart).all(axis=1)
            gaps[i, j] = both[known], apart[known]
            if known.any():
                cost[i, j] = np.median(np.linalg.norm(apart[known], axis=1))
    pairs = [(int(i), int(j)) for i, j in zip(*linear_sum_assignment(cost), strict=True) if cost[i, j] < 1e9]
    if not pairs:
        return np.zeros(0), np.zeros((0, 2))
    frames = np.concatenate([gaps[pair][0] for pair in pairs])
    apart = np.concatenate([gaps[pair][1] for pair in pairs])
    numbers, row, count = np.unique(frames, return_inverse=True, return_counts=True)
    total = np.zeros((len(numbers), 2))
    np.add.at(total, row, apart)
    return numbers, total / count[:, None]


def measures(samples: dict[str, np.ndarray], weight: np.ndarray | None = None) -> dict[str, float]:
    """Return mean, median, 95 % and root mean square of the errors, and how often ellipses contain them; NaN if none.

    samples: error_m, inside, relative_error_m, relative_inside, (S,) each; NaN if unknown. weight: (S,).
    """
    found: dict[str, float] = {}
    for prefix in ("", "relative_"):
        error, held = samples[f"{prefix}error_m"], samples[f"{prefix}inside"]
        of_each = np.ones(len(error)) if weight is None else weight
        known, judged = np.isfinite(error) & (of_each > 0), np.isfinite(held) & (of_each > 0)
        size, heavy = error[known], of_each[known]
        total = float(heavy.sum())
        found[f"{prefix}mean_m"] = ratio(float(heavy @ size), total)
        found[f"{prefix}median_m"] = quantile(size, 0.5, heavy)
        found[f"{prefix}p95_m"] = quantile(size, 0.95, heavy)
        found[f"{prefix}rms_m"] = float(np.sqrt(ratio(float(heavy @ size**2), total)))
        found[f"{prefix}in_ellipse"] = ratio(float(of_each[judged] @ held[judged]), float(of_each[judged].sum()))
    return found


def quantile(value: np.ndarray, share: float, weight: np.ndarray) -> float:
    """Return the smallest value that at least this share of the weight does not exceed; NaN without values."""
    if not len(value):
        return float("nan")
    order = np.argsort(value, kind="stable")
    below = np.cumsum(weight[order])
    return float(value[order][np.searchsorted(below, share * below[-1] * (1 - 1e-12))])
