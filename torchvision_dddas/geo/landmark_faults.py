"""Test the landmarks of a frame, and find and repair swapped identities and wrong places.

If all landmarks are right, the sum of squares of the likeliest pose is chi-squared distributed: it compares the
landmarks' pixels with the pixels expected from telemetry and reports, with the errors of both. A sum above the gate
means a fault. Then these repairs are tried in order, and the likeliest that passes is taken:
  one change: two identities swapped, or one landmark left out;
  identities from an assignment of the pixels to the expected pixels, after their common shift is removed;
  two landmarks left out, or one together with an assignment; without telemetry only if _ENOUGH_ALONE remain;
  the telemetry left out, if at least five landmarks, not on one line, agree among themselves.
If no repair passes, the errors are scaled up to the observed residuals.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from torchvision_dddas.geo.landmark_misfit import student_factor
from torchvision_dddas.geo.pose_estimation import Expected, PoseSolution, find_pose, move_pose, project_landmarks
from torchvision_dddas.geometry import cheapest
from torchvision_dddas.types import Bool, Camera, Int, LandmarkObservations

Hypothesis = tuple[Int[np.ndarray, "n"], Bool[np.ndarray, "n"]]
"""The landmark whose pixel each landmark gets, and which landmarks are used."""

# Of the changes that are best to first order, this many are fitted fully.
_FITTED = 6
# Fewest landmarks that may overrule the telemetry: a smaller number fits any pose too easily.
_ENOUGH_ALONE = 5
# Without telemetry, landmarks that fit only with errors this many times larger are not used at all. With telemetry they
# are used, because the telemetry may be wrong instead.
_HOPELESS = 8.0
# Prior probability that some landmarks of a frame are exchanged or misplaced. The prior probability that all errors are
# larger than stated by a factor is one over its square.
_FAULTY, _LARGER = 0.01, 2.0
# Landmarks overrule the telemetry only if they lie this many standard deviations off one line, on the ground and in the
# picture: landmarks in a row agree with many poses.
_APART = 3.0


@dataclass(frozen=True)
class LandmarkCheck:
    """Result of the test. order: (n,) the landmark whose pixel each landmark gets; used: (n,) whether it is used.

    solution: None if no pose explains the landmarks, or all fit hopelessly. changes: repairs in words. cause: why the
    result is unreliable. passed: whether the test passed, with or without a repair. alone: the telemetry was left out.
    """

    solution: PoseSolution | None
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


def passes(solution: PoseSolution | None, probability: float) -> bool:
    """Return whether a pose explains the landmarks; without degrees of freedom it always does."""
    if solution is None:
        return False
    return solution.freedom <= 0 or _chance_above(solution.freedom, solution.cost) >= 1 - probability


def _chance_above(freedom: int, value: float) -> float:
    """Return the probability that a chi-squared variable exceeds a value."""
    from scipy.special import chdtrc  # imported here because only landmarks need these 25 MB

    return float(chdtrc(freedom, value))


def check_landmarks(
    marks: LandmarkObservations,
    camera: Camera,
    expected: Expected,
    probability: float,
    names: tuple[str, ...],
    alone: Expected | None = None,
) -> LandmarkCheck:
    """Test the landmarks of a frame and repair faults.

    names: (n,) names of the landmarks, for messages. probability: share of correct landmarks that pass. alone: the
    expectation without telemetry; None if `expected` is already without it.
    """
    n = len(marks)
    everyone, itself = np.ones(n, bool), np.arange(n)
    first = find_pose(marks, camera, expected)
    if passes(first, probability):
        return LandmarkCheck(first, itself, everyone)
    for hypotheses in (_one_change, _assignment, _two_changes):
        tried = hypotheses(marks, camera, expected)
        if repaired := try_repairs(tried, first, marks, camera, expected, probability, names):
            return repaired
    if alone is not None and n >= _ENOUGH_ALONE and _spread_out(marks):
        solution = find_pose(marks, camera, alone)
        if passes(solution, probability):
            words = f"telemetry left out: the {n} landmarks agree with one another, not with it{_odds(first)}"
            return LandmarkCheck(solution, itself, everyone, (words,), alone=True)
    helped = bool(expected.known[:6].any())
    who = "landmarks and telemetry" if helped else "the landmarks"
    cause = f"{who} disagree{_odds(first)}, and no change explains it"
    if first is None:
        return LandmarkCheck(None, itself, ~everyone, cause=cause, passed=False)
    worse = first.cost / first.freedom
    if not helped and worse > _HOPELESS**2:
        cause += f": their errors would have to be {np.sqrt(worse):.0f} times as large"
        return LandmarkCheck(None, itself, ~everyone, cause=cause, passed=False)
    worse *= student_factor(first.freedom)
    cause += f": errors taken {np.sqrt(worse):.1f} times as large"
    wider = replace(first, covariance=first.covariance * worse)
    return LandmarkCheck(wider, itself, everyone, cause=cause, passed=False)


def try_repairs(
    hypotheses: Iterable[Hypothesis],
    first: PoseSolution | None,
    marks: LandmarkObservations,
    camera: Camera,
    expected: Expected,
    probability: float,
    names: tuple[str, ...],
) -> LandmarkCheck | None:
    """Return the likeliest of the repairs that pass; None without any. first: the pose without a repair."""
    best: tuple[float, PoseSolution, np.ndarray, np.ndarray] | None = None
    for order, used in hypotheses:
        if not expected.known[:6].any() and used.sum() < min(_ENOUGH_ALONE, len(marks) - 1):
            continue  # of six landmarks with wrong names, some group of four fits a wrong pose
        solution = find_pose(reorder_pixels(marks, order), camera, expected, used)
        if solution is not None and solution.freedom > 0 and passes(solution, probability):
            chance = _chance_above(solution.freedom, solution.cost)
            if best is None or chance > best[0]:
                best = chance, solution, order, used
    if best is None:
        return None
    _, solution, order, used = best
    if first is not None and _log_odds_of_repair(first, solution, used, marks, camera) < 0:
        return None
    odds, words = _odds(first), []
    changed = np.flatnonzero(used & (order != np.arange(len(order))))
    if len(changed) == 2 and order[order[changed[0]]] == changed[0]:
        words.append(f"identities of {names[changed[0]]} and {names[changed[1]]} swapped back{odds}")
    elif len(changed):
        pairs = ", ".join(f"{names[row]} where {names[order[row]]} was said to be" for row in changed)
        words.append(f"identities reassigned{odds}: {pairs}")
    words += [f"{names[row]} left out: not where it is expected{odds}" for row in np.flatnonzero(~used)]
    return LandmarkCheck(solution, order, used, tuple(words))


def _log_odds_of_repair(
    first: PoseSolution, repaired: PoseSolution, used: np.ndarray, marks: LandmarkObservations, camera: Camera
) -> float:
    """Return the log odds that a repair is right, against the case that all errors are larger than stated.

    A landmark that is left out may be anywhere in the picture. Otherwise its pixel varies by its stated errors.
    """
    larger = np.log(first.cost / first.freedom)  # as a variance
    worse = -first.freedom / 2 * (1 + larger) - _LARGER / 2 * max(larger, 0.0)
    m_per_px = np.linalg.norm(first.slopes[:, 7:].reshape(len(marks), 2, len(marks), 2), axis=(1, 3)).diagonal()
    expected_px2 = 2 * np.pi * (marks.pixel_sigma**2 + (marks.sigma_m * m_per_px) ** 2 / 2)
    elsewhere = np.log(np.minimum(expected_px2 / np.prod(camera.size_px), 1.0))
    return float(np.log(_FAULTY) - repaired.cost / 2 + elsewhere[~used].sum() - worse)


def _odds(first: PoseSolution | None) -> str:
    return "" if first is None else f" (chi-square {first.cost:.1f} with {first.freedom} degrees of freedom)"


def reorder_pixels(marks: LandmarkObservations, order: Int[np.ndarray, "n"]) -> LandmarkObservations:
    """Return the landmarks with their pixels exchanged."""
    return replace(marks, image_px=marks.image_px[order], pixel_sigma=marks.pixel_sigma[order])


def _spread_out(marks: LandmarkObservations) -> bool:
    """Return whether landmarks lie off one line by clearly more than their errors: on the ground and in the picture."""
    return all(
        np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] > _APART * np.linalg.norm(sigma)
        for points, sigma in ((marks.east_north_m, marks.sigma_m), (marks.image_px, marks.pixel_sigma))
    )


# Hypotheses of faults.


def _one_change(marks: LandmarkObservations, camera: Camera, expected: Expected) -> Iterator[Hypothesis]:
    n = len(marks)
    swaps: list[Hypothesis] = []
    for pair in combinations(range(n), 2):
        order = np.arange(n)
        order[list(pair)] = pair[::-1]
        swaps.append((order, np.ones(n, bool)))
    return _best_first(swaps + _left_out(n, 1), marks, camera, expected)


def _assignment(marks: LandmarkObservations, camera: Camera, expected: Expected) -> Iterator[Hypothesis]:
    """Assign pixels to landmarks after removing their common shift."""
    seen = _predicted(marks, camera, expected)[0].reshape(-1, 2)
    if expected.known.all() and np.isfinite(seen).all():
        apart, wanted = marks.image_px - marks.image_px.mean(axis=0), seen - seen.mean(axis=0)
        distance = np.linalg.norm(wanted[:, None] - apart[None], axis=2)
        yield cheapest(distance**2)[1], np.ones(len(marks), bool)


def _two_changes(marks: LandmarkObservations, camera: Camera, expected: Expected) -> Iterator[Hypothesis]:
    n = len(marks)
    both = [(order, used) for order, _ in _assignment(marks, camera, expected) for _, used in _left_out(n, 1)]
    return _best_first(_left_out(n, 2) + both, marks, camera, expected)


def _left_out(n: int, count: int) -> list[Hypothesis]:
    return [(np.arange(n), ~np.isin(np.arange(n), rows)) for rows in combinations(range(n), count)]


def _predicted(marks: LandmarkObservations, camera: Camera, expected: Expected) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected pixels of the landmarks (2n,), and derivatives by pose and places (2n, 7 + 2n)."""
    n = len(marks)
    places = marks.east_north_m + expected.mean[7:].reshape(n, 2)
    pose = move_pose(expected.reference, expected.mean[:7])
    return project_landmarks(marks, camera, pose, places, np.ones(n, bool))


def _best_first(
    hypotheses: list[Hypothesis], marks: LandmarkObservations, camera: Camera, expected: Expected
) -> Iterator[Hypothesis]:
    """Yield the hypotheses with the least sum of squares to first order, best first; all without a prediction."""
    predict = len(hypotheses) > _FITTED and expected.known.all()
    seen, slopes = _predicted(marks, camera, expected) if predict else (np.full(1, np.nan), np.zeros((0, 0)))
    if not np.isfinite(seen).all():
        yield from hypotheses
        return
    weight = 1 / np.repeat(marks.pixel_sigma, 2) ** 2
    weighted = slopes.T * weight
    kept = np.diag(weight) - weighted.T @ np.linalg.solve(expected.information + weighted @ slopes, weighted)
    score = []
    for order, used in hypotheses:
        missing = marks.image_px[order].ravel() - seen
        pull = kept @ missing
        out = np.flatnonzero(np.repeat(~used, 2))
        cost = missing @ pull
        if len(out):
            cost -= pull[out] @ np.linalg.solve(kept[np.ix_(out, out)], pull[out])
        score.append(_chance_above(2 * int(used.sum()), max(float(cost), 0.0)) - 1e-9 * float(cost))
    for row in np.argsort(score)[::-1][:_FITTED]:
        yield hypotheses[row]
