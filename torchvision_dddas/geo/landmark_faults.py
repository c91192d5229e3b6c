"""Test of the landmarks: swapped identities and wrong places are found and repaired.

The sum of squares of the likeliest pose is chi-square where all is right: it weighs the landmarks' pixels against what
telemetry and reports expect, with the errors of both. Above the gate something is wrong. Tried are then, in this order,
and the likeliest that passes is taken:
  one change: two identities swapped, or one landmark left out;
  identities by assignment of the pixels to where they are expected, less the shift that all have in common;
  two landmarks left out, or one with identities by assignment; without telemetry where ENOUGH_ALONE remain;
  the telemetry left out, where five landmarks or more, not on one line, agree among themselves.
Where nothing passes the errors are taken to be as much larger as they were seen to be.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from torchvision_dddas.geo.pose_estimation import Expected, Solution, find_pose, move_pose
from torchvision_dddas.geo.projection import project_with_slopes
from torchvision_dddas.geometry import cheapest
from torchvision_dddas.types import Bool, Camera, Int, LandmarkObservations

Hypothesis = tuple[Int[np.ndarray, "n"], Bool[np.ndarray, "n"]]
"""The landmark whose pixel each one gets, and which landmarks are used."""

# This many changes, the best to first order, are tried in full.
FITTED = 6
# Fewest landmarks that may overrule the telemetry: fewer fit any pose too easily.
ENOUGH_ALONE = 5
# Without telemetry, landmarks that fit only with errors this many times as large are not used at
# all. Beside telemetry, which may be wrong itself, they are.
HOPELESS = 8.0
# Landmarks overrule the telemetry only if they are this many standard deviations off one line, on the ground and in the
# picture: a row of them agrees with poses of all kinds.
APART = 3.0


@dataclass(frozen=True)
class LandmarkCheck:
    """Result of the test. order: (n,) the landmark whose pixel each one gets; used: (n,) whether it is used.

    solution: None where no pose explains anything, or all fit hopelessly. changes: in words. cause: why the result is
    not to be trusted.
    passed: the test, with or without a repair. alone: the telemetry was left out.
    """

    solution: Solution | None
    order: np.ndarray
    used: np.ndarray
    changes: tuple[str, ...] = ()
    cause: str = ""
    passed: bool = True
    alone: bool = False

    @property
    def state(self) -> tuple[str, ...]:
        """State of each landmark: used, reassigned or excluded."""
        moved_away = self.order != np.arange(len(self.order))
        return tuple(np.where(self.used, np.where(moved_away, "reassigned", "used"), "excluded").tolist())


def passes(solution: Solution | None, probability: float) -> bool:
    """Whether a pose explains the landmarks; without degrees of freedom it always does."""
    if solution is None:
        return False
    return solution.freedom <= 0 or _chance_above(solution.freedom, solution.cost) >= 1 - probability


def _chance_above(freedom: int, value: float) -> float:
    """Probability that a chi-squared variable exceeds a value."""
    from scipy.special import chdtrc  # 25 MB that only landmarks need

    return float(chdtrc(freedom, value))


def check_landmarks(
    marks: LandmarkObservations,
    camera: Camera,
    expected: Expected,
    probability: float,
    names: tuple[str, ...],
    alone: Expected | None = None,
    known: Hypothesis | None = None,
    only: bool = False,
) -> LandmarkCheck:
    """Test the landmarks of a frame and repair what is wrong.

    names: (n,) of the landmarks, for the words. probability: share of right landmarks that pass. alone: what is
    expected without telemetry; None where `expected` is that already. known: a repair to try before all others;
    only: and instead of them.
    """
    n = len(marks)
    everyone, itself = np.ones(n, bool), np.arange(n)
    first = find_pose(marks, camera, expected)
    if passes(first, probability):
        return LandmarkCheck(first, itself, everyone)
    as_before: list[Hypothesis] = [] if known is None else [known]
    others = () if only else (_one_change, _assignment, _two_changes)
    for hypotheses in (lambda *_: iter(as_before), *others):
        tried = []
        for order, used in hypotheses(marks, camera, expected):
            if not expected.known[:6].any() and used.sum() < min(ENOUGH_ALONE, n - 1):
                # Of six with all names wrong, some four fit a wrong pose.
                continue
            solution = find_pose(reorder_pixels(marks, order), camera, expected, used)
            if solution is not None and solution.freedom > 0 and passes(solution, probability):
                tried.append((_chance_above(solution.freedom, solution.cost), solution, order, used))
        if tried:
            _, solution, order, used = max(tried, key=lambda one: one[0])
            return LandmarkCheck(solution, order, used, _words(order, used, first, names))
    if alone is not None and n >= ENOUGH_ALONE and _spread_out(marks):
        solution = find_pose(marks, camera, alone)
        if passes(solution, probability):
            words = f"telemetry left out: the {n} landmarks agree with one another, not with it{_odds(first)}"
            return LandmarkCheck(solution, itself, everyone, (words,), alone=True)
    beside = bool(expected.known[:6].any())
    cause = (
        f"{'landmarks and telemetry' if beside else 'the landmarks'} disagree{_odds(first)}, and no change explains it"
    )
    if first is not None:
        worse = first.cost / first.freedom
        if not beside and worse > HOPELESS**2:
            cause += f": their errors would have to be {np.sqrt(worse):.0f} times as large"
            return LandmarkCheck(None, itself, ~everyone, cause=cause, passed=False)
        first = replace(first, covariance=first.covariance * worse)
        cause += f": errors taken {np.sqrt(worse):.1f} times as large"
    return LandmarkCheck(first, itself, everyone if first is not None else ~everyone, cause=cause, passed=False)


def reorder_pixels(marks: LandmarkObservations, order: Int[np.ndarray, "n"]) -> LandmarkObservations:
    """The landmarks with their pixels exchanged."""
    return replace(marks, image_px=marks.image_px[order], pixel_sigma=marks.pixel_sigma[order])


# What may be wrong.


def _one_change(marks: LandmarkObservations, camera: Camera, expected: Expected) -> Iterator[Hypothesis]:
    n = len(marks)
    swaps = [_swapped(n, pair) for pair in combinations(range(n), 2)]
    drops = [_without(n, {one}) for one in range(n)]
    return _best_first(swaps + drops, marks, camera, expected)


def _assignment(marks: LandmarkObservations, camera: Camera, expected: Expected) -> Iterator[Hypothesis]:
    order = _assigned(marks, camera, expected)
    if order is not None:
        yield order, np.ones(len(marks), bool)


def _two_changes(marks: LandmarkObservations, camera: Camera, expected: Expected) -> Iterator[Hypothesis]:
    n = len(marks)
    drops = [_without(n, set(pair)) for pair in combinations(range(n), 2)]
    one_out = [_without(n, {one})[1] for one in range(n)]
    both = [(order, used) for order, _ in _assignment(marks, camera, expected) for used in one_out]
    return _best_first(drops + both, marks, camera, expected)


def _swapped(n: int, pair: tuple[int, int]) -> Hypothesis:
    order = np.arange(n)
    order[list(pair)] = pair[::-1]
    return order, np.ones(n, bool)


def _without(n: int, rows: set[int]) -> Hypothesis:
    return np.arange(n), ~np.isin(np.arange(n), list(rows))


def _assigned(marks: LandmarkObservations, camera: Camera, expected: Expected) -> np.ndarray | None:
    """Assignment of pixels to landmarks after their common shift is removed."""
    seen = _predicted(marks, camera, expected)[0]
    if not expected.known.all() or not np.isfinite(seen).all():
        return None
    apart = marks.image_px - marks.image_px.mean(axis=0), seen - seen.mean(axis=0)
    distance = np.linalg.norm(apart[1][:, None] - apart[0][None], axis=2)
    return cheapest(distance**2)[1]


def _spread_out(marks: LandmarkObservations) -> bool:
    """Whether landmarks lie off one line by clearly more than their errors: on the ground and in the picture."""
    return all(
        np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] > APART * np.linalg.norm(sigma)
        for points, sigma in ((marks.east_north_m, marks.sigma_m), (marks.image_px, marks.pixel_sigma))
    )


def _predicted(marks: LandmarkObservations, camera: Camera, expected: Expected) -> tuple[np.ndarray, np.ndarray]:
    """Where the landmarks are expected in the picture (n, 2), with derivatives by pose and places (2n, 7 + 2n)."""
    n = len(marks)
    places = marks.east_north_m + expected.mean[7:].reshape(n, 2)
    pose = move_pose(expected.reference, expected.mean[:7])
    seen, by_pose, by_point = project_with_slopes(np.column_stack([places, marks.up_m]), pose, camera)
    slopes = np.zeros((2 * n, 7 + 2 * n))
    slopes[:, :7] = by_pose.reshape(-1, 7)
    rows = np.arange(2 * n)[:, None]
    slopes[rows, 7 + 2 * (rows // 2) + [0, 1]] = by_point[:, :, :2].reshape(-1, 2)
    return seen, slopes


def _best_first(
    hypotheses: list[Hypothesis], marks: LandmarkObservations, camera: Camera, expected: Expected
) -> Iterator[Hypothesis]:
    """The hypotheses with the least sum of squares to first order, best first."""
    if len(hypotheses) <= FITTED or not expected.known.all():
        # No prediction, as without a heading: all are fitted in full.
        yield from hypotheses
        return
    seen, slopes = _predicted(marks, camera, expected)
    if not np.isfinite(seen).all():
        yield from hypotheses
        return
    weight = 1 / np.repeat(marks.pixel_sigma, 2) ** 2
    weighed = slopes.T * weight
    kept = np.diag(weight) - weighed.T @ np.linalg.solve(expected.information + weighed @ slopes, weighed)
    score = []
    for order, used in hypotheses:
        missing = (marks.image_px[order] - seen).ravel()
        pull = kept @ missing
        out = np.flatnonzero(np.repeat(~used, 2))
        cost = missing @ pull
        if len(out):
            cost -= pull[out] @ np.linalg.solve(kept[np.ix_(out, out)], pull[out])
        score.append(_chance_above(2 * int(used.sum()), max(float(cost), 0.0)) - 1e-9 * float(cost))
    for row in np.argsort(score)[::-1][:FITTED]:
        yield hypotheses[row]


# Words.


def _words(order: np.ndarray, used: np.ndarray, first: Solution | None, names: tuple[str, ...]) -> tuple[str, ...]:
    odds, words = _odds(first), []
    changed = np.flatnonzero(used & (order != np.arange(len(order))))
    if len(changed) == 2 and order[order[changed[0]]] == changed[0]:
        words.append(f"identities of {names[changed[0]]} and {names[changed[1]]} swapped back{odds}")
    elif len(changed):
        pairs = ", ".join(f"{names[row]} where {names[order[row]]} was said to be" for row in changed)
        words.append(f"identities reassigned{odds}: {pairs}")
    words += [f"{names[row]} left out: not where it is expected{odds}" for row in np.flatnonzero(~used)]
    return tuple(words)


def _odds(first: Solution | None) -> str:
    return "" if first is None else f" (chi-square {first.cost:.1f} with {first.freedom} degrees of freedom)"
