"""Which of the landmarks in view are used."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from torchvision_dddas.config import LandmarkParameters
from torchvision_dddas.types import Adjustment, LandmarkObservations

# Landmarks count as well detected again once they are slower than this share of the speed at which they are not.
_CALM = 0.8
# Others are taken for the landmarks in use once they are spread better by this factor.
_BETTER = 1.25
# Of more landmarks than this, only so many that lie far apart are tried.
_TRIED = 12


@dataclass(frozen=True)
class LandmarkUse:
    """Which landmarks are in use, and whether more than `least` of them may be: their detection is poor."""

    landmark: tuple[int, ...] = ()
    poor: bool = False


def chosen(
    frame: int, now: LandmarkUse, marks: LandmarkObservations, speed_m_s: np.ndarray, parameters: LandmarkParameters
) -> tuple[np.ndarray, LandmarkUse, tuple[Adjustment, ...]]:
    """The rows of `marks` to use, of those in view; what is in use from here on; and the record of a change of number.

    speed_m_s: (n,) over the ground, of the landmarks in marks' order; NaN where unknown.
    rule = all: every landmark in view. Our study finds six never worse than four; the source's finding of the contrary
    is one of its numerics. rule = source: more than `least` only where more are in view and their mean speed is above
    poor_speed_m_s, so that they are detected poorly (appendix A, section V); else those `least` that are best spread.
    """
    view = np.flatnonzero(np.isfinite(marks.image_px).all(axis=1) & np.isfinite(marks.east_north_m).all(axis=1))
    if parameters.rule == "all":
        return view, LandmarkUse(tuple(marks.landmark[view].tolist())), ()
    known = np.asarray(speed_m_s, float)[view]
    speed = float(np.mean(known[np.isfinite(known)])) if np.isfinite(known).any() else None
    poor, cause = now.poor, ""
    if speed is not None and poor and speed < _CALM * parameters.poor_speed_m_s:
        poor, cause = False, f"below {_CALM * parameters.poor_speed_m_s:.2g}: they are detected well"
    elif speed is not None and not poor and speed > parameters.poor_speed_m_s and len(view) > parameters.least:
        poor, cause = True, f"above {parameters.poor_speed_m_s:g}: they are detected poorly"
    rows = view if poor or len(view) <= parameters.least else view[_best_spread(marks, view, now, parameters.least)]
    use = LandmarkUse(tuple(marks.landmark[rows].tolist()), poor)
    if not cause or len(rows) == len(now.landmark):
        return rows, use, ()
    why = f"{len(view)} landmarks in view go at {speed:.1f} m/s on average, {cause}"
    return rows, use, (Adjustment(frame, "landmarks.used", len(now.landmark) or parameters.least, len(rows), why),)


def _best_spread(marks: LandmarkObservations, view: np.ndarray, now: LandmarkUse, count: int) -> np.ndarray:
    """Of the rows in view, those `count` that are used already, unless others are spread clearly better."""
    places = marks.east_north_m[view]
    best = best_spread(places, count)
    held = np.flatnonzero(np.isin(marks.landmark[view], now.landmark))
    if len(held) == count and spread_m2(places[best]) <= _BETTER * spread_m2(places[held]):
        return held
    return best


def best_spread(places: np.ndarray, count: int) -> np.ndarray:
    """(count,) rows of (n, 2) places, sorted, whose smallest triangle is the largest: no three are near one line."""
    tried = _far_apart(places, max(count, min(_TRIED, len(places))))
    if len(tried) > _TRIED:
        return np.sort(tried[:count])
    sets = np.array(list(combinations(np.sort(tried), count)))
    smallest = np.full(len(sets), np.inf)
    for triple in combinations(range(count), 3):
        smallest = np.minimum(smallest, _area(places[sets[:, triple]]))
    # Where all lie on one line, those furthest apart.
    ties = np.flatnonzero(smallest >= smallest.max() * (1 - 1e-9))
    widths = np.ptp(places[sets[ties]], axis=1).sum(axis=1)
    return sets[ties[int(widths.argmax())]]


def spread_m2(places: np.ndarray) -> float:
    """The area of the smallest triangle among (n, 2) places; 0 for fewer than three."""
    triples = np.array(list(combinations(range(len(places)), 3)), int).reshape(-1, 3)
    return float(_area(places[triples]).min()) if len(triples) else 0.0


def _area(corners: np.ndarray) -> np.ndarray:
    """(T,) of triangles (T, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


def _far_apart(places: np.ndarray, count: int) -> np.ndarray:
    """(count,) rows of (n, 2) places, each the one furthest from those before it."""
    rows = [int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmax())]
    nearest = np.full(len(places), np.inf)
    while len(rows) < min(count, len(places)):
        nearest = np.minimum(nearest, np.linalg.norm(places - places[rows[-1]], axis=1))
        nearest[rows] = -1.0  # where several are in one place, each is taken once
        rows.append(int(nearest.argmax()))
    return np.array(rows)
