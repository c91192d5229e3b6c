"""How the pictures of a clip lie on the ground, frame by frame, by what all frames so far have told of the errors."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.geo.bias_filter import BiasFilter, ErrorPersistence, error_rows, linearize_image
from torchvision_dddas.geo.landmark_faults import LandmarkCheck, check_landmarks, passes, reorder_pixels
from torchvision_dddas.geo.plane_homography import LEAST, Solver, describe_one_line, describe_too_few, fix_by_homography
from torchvision_dddas.geo.pose_estimation import (
    Prior,
    Solution,
    find_pose,
    focal_prior,
    independent_expectation,
    pose_prior,
    rows,
)
from torchvision_dddas.geo.projection import undistort_pixels
from torchvision_dddas.types import Camera, Fix, Flight, LandmarkObservations

Degrees = tuple[np.ndarray, tuple[float, float]]
"""Longitudes and latitudes of landmarks (n, 2), and of the origin of the local metres."""

OF_POSE = ("heading", "heading", "heading", "place", "place", "altitude", "focal length")

BELIEFS = (
    ErrorPersistence(),
    ErrorPersistence(pace=5.0),
    ErrorPersistence(pace=25.0),
    ErrorPersistence(telemetry=0.5),
    ErrorPersistence(telemetry=0.0),
    ErrorPersistence(landmarks=0.0),
    ErrorPersistence(telemetry=0.0, landmarks=0.0, pace=np.inf),
)
"""Nobody says which errors of a vehicle and its landmarks last. The belief that foretells the pictures best counts."""

REMEMBERS = 0.95
"""Share of what spoke for a belief that still does a frame later."""

MOST_SURPRISED = 15.0
"""A frame that a belief foretells worse than another by more than this counts for this much: a report may jump."""


@dataclass(frozen=True)
class _Habit:
    """The repair of the frame before: whose pixels landmarks had, and which were left out."""

    pixels_of: dict[int, int]
    without: frozenset[int]


class Georeferencer:
    """Lays the frames of one clip on the ground; told of them in order.

    solver: of a back end, for the bare homography. focal_known: the camera's focal length is given, not guessed.
    names: of the landmarks, for the words. ground_up_m: height of the ground that altitudes are measured from.
    """

    def __init__(
        self,
        camera: Camera,
        settings: Settings,
        solver: Solver,
        focal_known: bool = True,
        names: tuple[str, ...] = (),
        ground_up_m: float = 0.0,
    ) -> None:
        self.camera, self.settings, self.solver = camera, settings, solver
        self.focal_known, self.names, self.ground_up_m = focal_known, names, ground_up_m
        beliefs = BELIEFS if settings.aerial.correlation_s > 0 else BELIEFS[-1:]
        self.memories = [BiasFilter(lasting=belief) for belief in beliefs]
        self.credit = np.zeros(len(beliefs))
        self.habit = _Habit({}, frozenset())

    def update(
        self,
        frame: int,
        time_s: float,
        flight: Flight | None,
        marks: LandmarkObservations,
        degrees: Degrees | None = None,
    ) -> Fix:
        """How one frame lies on the ground; by = "" and a cause where nothing tells it.

        flight: what telemetry says then, its place in local metres; None without telemetry. marks: the landmarks,
        places in local metres; rows without pixel or place do not count. degrees, for aerial.mode = paper.
        """
        parameters = self.settings.aerial
        usable, changes = self._usable(marks)
        if degrees is not None:
            degrees = (np.asarray(degrees[0], float)[usable], degrees[1])
        seen = rows(marks, usable)
        prior = pose_prior(flight, self.camera, parameters, self.ground_up_m, self.focal_known)
        if parameters.mode == "pose":
            fix = self._by_pose(frame, time_s, prior, seen)
        else:
            fix = self._by_homography(frame, prior, seen, degrees)
        return _with_unusable(fix, marks, usable, changes)

    def _by_pose(self, frame: int, time_s: float, prior: Prior | None, marks: LandmarkObservations) -> Fix:
        parameters, n = self.settings.aerial, len(marks)
        cause = _refused(frame, prior, marks, parameters.least_spread)
        bare = focal_prior(self.camera, parameters, self.focal_known)
        self.memories = [memory.at(time_s, prior or bare, marks, parameters.correlation_s) for memory in self.memories]
        believed = int(self.credit.argmax())
        before = self.memories[believed]
        if cause:
            return _nothing(frame, marks, cause)
        if prior is None:
            # By landmarks alone a tilt and its mirror are hard to tell apart: remembered, a wrong one would last.
            before = before.anew(np.arange(len(before.mean)))
        verdict, before = self._judged(before, prior or bare, marks, None if prior is None else bare)
        solution = verdict.solution
        if solution is None:
            no_pose = f"no pose of the camera shows the landmarks of frame {frame} where the picture has them"
            cause = verdict.cause or no_pose
            return _nothing(frame, marks, cause)
        if prior is not None and verdict.passed and not verdict.alone:
            self._learn(prior, reorder_pixels(marks, verdict.order), verdict.used, solution)
            self.memories[believed] = before.after(prior, marks, verdict.used, solution)
        count = int(verdict.used.sum())
        cause = verdict.cause
        if not cause and count < LEAST:
            cause = (
                f"frame {frame} has no landmark: by telemetry alone" if count == 0 else describe_too_few(frame, count)
            )
        return Fix(
            frame,
            "pose" if count else "telemetry",
            solution.pose,
            solution.covariance[:7, :7],
            landmark=marks.landmark,
            state=verdict.state,
            chi2=solution.cost if n else float("nan"),
            freedom=solution.freedom if n else 0,
            changes=verdict.changes,
            cause=cause,
        )

    def _learn(self, prior: Prior, marks: LandmarkObservations, used: np.ndarray, solution: Solution) -> None:
        """Hold what each belief foretold against what the picture shows, and let it learn from it."""
        if len(self.memories) == 1 or not (prior.known.all() and used.any()):
            return
        glimpse = linearize_image(marks, self.camera, used, solution)
        told = [memory.foretold(marks, glimpse) for memory in self.memories]
        density = np.array([density for density, _ in told])
        self.credit = REMEMBERS * self.credit + np.maximum(density - density.max(), -MOST_SURPRISED)
        self.memories = [memory for _, memory in told]

    def _judged(
        self, before: BiasFilter, prior: Prior, marks: LandmarkObservations, bare: Prior | None
    ) -> tuple[LandmarkCheck, BiasFilter]:
        """The landmarks tested against what is remembered, and what is to be remembered of the past then."""
        gate, n = self.settings.aerial.gate_probability, len(marks)
        everyone, itself = np.ones(n, bool), np.arange(n)
        solution = find_pose(marks, self.camera, before.expected(prior, marks))
        if passes(solution, gate):
            self.habit = _Habit({}, frozenset())
            return LandmarkCheck(solution, itself, everyone), before
        alone = None if bare is None else independent_expectation(bare, marks.sigma_m)
        names = tuple(self._name(identity) for identity in marks.landmark.tolist())
        known = self._as_before(marks)
        if known is not None:
            verdict = check_landmarks(
                marks, self.camera, before.expected(prior, marks), gate, names, known=known, only=True
            )
            if verdict.passed:
                return verdict, before
        for memory in self._less_and_less(before, prior, marks):
            expected = memory.expected(prior, marks)
            solution = find_pose(marks, self.camera, expected)
            if passes(solution, gate):
                return LandmarkCheck(solution, itself, everyone), memory
        for memory in (before, before.anew(np.arange(len(before.mean)))):
            verdict = check_landmarks(marks, self.camera, memory.expected(prior, marks), gate, names, alone)
            if verdict.passed:
                break
        identities = marks.landmark.tolist()
        self.habit = _Habit(
            {a: identities[b] for a, b in zip(identities, verdict.order.tolist(), strict=True) if a != identities[b]},
            frozenset(marks.landmark[~verdict.used].tolist()),
        )
        return verdict, memory

    def _less_and_less(self, before: BiasFilter, prior: Prior, marks: LandmarkObservations) -> Iterator[BiasFilter]:
        """What else to remember where all of it does not fit: a report may jump within its errors."""
        if not before.told:
            return
        yield before.anew(np.arange(7))
        for identity in marks.landmark:
            yield before.anew(error_rows(before.ids, np.array([identity])))
        yield before.anew(np.arange(len(before.mean)))

    def _by_homography(
        self, frame: int, prior: Prior | None, marks: LandmarkObservations, degrees: Degrees | None
    ) -> Fix:
        """By landmarks alone; telemetry, where there is any, only tells whether they are what they are said to be."""
        parameters, n = self.settings.aerial, len(marks)
        paper = parameters.mode == "paper"
        if paper or prior is None or not prior.known.all() or n == 0:
            seen = marks if paper else self._unbent(marks)
            return fix_by_homography(frame, seen, self.solver, parameters.least_spread, degrees, paper)
        names = tuple(self._name(identity) for identity in marks.landmark.tolist())
        expected = independent_expectation(prior, marks.sigma_m)
        verdict = check_landmarks(marks, self.camera, expected, parameters.gate_probability, names)
        # Where nothing explains the disagreement the telemetry may be wrong: the landmarks are taken at their word.
        kept = rows(reorder_pixels(marks, verdict.order), verdict.used) if verdict.passed else marks
        fix = fix_by_homography(frame, self._unbent(kept), self.solver, parameters.least_spread)
        solution = verdict.solution
        return replace(
            fix,
            landmark=marks.landmark,
            state=(verdict.state if verdict.passed else ("used",) * n) if fix.by else ("excluded",) * n,
            chi2=float("nan") if solution is None else solution.cost,
            freedom=0 if solution is None else solution.freedom,
            changes=verdict.changes,
            cause=fix.cause or verdict.cause,
        )

    def _unbent(self, marks: LandmarkObservations) -> LandmarkObservations:
        """As a lens without distortion would show them: a bent picture of a plane is no homography's."""
        return replace(marks, image_px=undistort_pixels(marks.image_px, self.camera))

    def _usable(self, marks: LandmarkObservations) -> tuple[np.ndarray, tuple[str, ...]]:
        """Which rows count: those with pixel and place, each landmark once; and of those that do not, why."""
        in_picture = np.isfinite(marks.image_px).all(axis=1)
        placed = np.isfinite(marks.east_north_m).all(axis=1) & np.isfinite(marks.sigma_m)
        usable, unplaced = in_picture & placed, marks.landmark[in_picture & ~placed].tolist()
        changes = [f"{self._name(identity)} left out: its place is not known" for identity in unplaced]
        first: set[int] = set()
        for row in np.flatnonzero(usable):
            identity = int(marks.landmark[row])
            if identity in first:
                usable[row] = False
                changes.append(f"{self._name(identity)} left out where it is seen a second time")
            first.add(identity)
        return usable, tuple(changes)

    def _as_before(self, marks: LandmarkObservations) -> tuple[np.ndarray, np.ndarray] | None:
        """The repair of the frame before, for this frame's rows; None where there was none or it does not apply."""
        row = {identity: k for k, identity in enumerate(marks.landmark.tolist())}
        if not (self.habit.pixels_of or self.habit.without):
            return None
        order = [row.get(self.habit.pixels_of.get(identity, identity), -1) for identity in row]
        if sorted(order) != list(range(len(row))):
            return None
        return np.array(order), ~np.isin(marks.landmark, list(self.habit.without))

    def _name(self, identity: int) -> str:
        return self.names[identity] if 0 <= identity < len(self.names) else f"landmark {identity}"


def _refused(frame: int, prior: Prior | None, marks: LandmarkObservations, least_spread: float) -> str:
    """Why nothing can tell where the camera is; empty where something can."""
    n = len(marks)
    if prior is None:
        if n < LEAST:
            return describe_too_few(frame, n, " and no telemetry")
        return describe_one_line(frame, marks, least_spread)
    if 2 * n < int((~prior.known).sum()) or (n < 2 and not prior.known[2]):
        lacking = " and ".join(dict.fromkeys(np.array(OF_POSE)[~prior.known].tolist()))
        has = f"{n} landmark{'s' * (n != 1)}" if n else "no landmark"
        return f"frame {frame} has {has}, too few where the telemetry does not say {lacking}"
    return ""


def _nothing(frame: int, marks: LandmarkObservations, cause: str) -> Fix:
    return Fix(frame, "", landmark=marks.landmark, state=("excluded",) * len(marks), cause=cause)


def _with_unusable(fix: Fix, marks: LandmarkObservations, usable: np.ndarray, changes: tuple[str, ...]) -> Fix:
    """With the landmarks that are in the picture but could not be used."""
    seen = np.flatnonzero(usable | np.isfinite(marks.image_px).all(axis=1))
    told = dict(zip(np.flatnonzero(usable).tolist(), fix.state, strict=True))
    state = tuple(told.get(row, "excluded") for row in seen.tolist())
    return replace(fix, landmark=marks.landmark[seen], state=state, changes=changes + fix.changes)
