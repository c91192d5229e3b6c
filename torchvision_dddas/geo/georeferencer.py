"""How the pictures of a clip map to the ground, frame by frame, with slow errors estimated over all frames so far."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.geo.bias_filter import BiasFilter, ErrorPersistence, error_rows, linearize_image
from torchvision_dddas.geo.landmark_faults import LandmarkCheck, check_landmarks, passes, reorder_pixels
from torchvision_dddas.geo.plane_homography import LEAST, describe_one_line, describe_too_few, fix_by_homography, no_fix
from torchvision_dddas.geo.plane_solvers import PlaneSolver
from torchvision_dddas.geo.pose_estimation import (
    Prior,
    Solution,
    find_pose,
    focal_prior,
    independent_expectation,
    pose_prior,
)
from torchvision_dddas.geo.projection import undistort_pixels
from torchvision_dddas.types import Camera, Fix, Flight, LandmarkObservations

Degrees = tuple[np.ndarray, tuple[float, float]]
"""Longitudes and latitudes of landmarks (n, 2), and of the origin of the local metres."""

_POSE_PARTS = ("heading", "heading", "heading", "place", "place", "altitude", "focal length")
# Which errors of a vehicle and its landmarks persist is unknown: the hypothesis that predicts the pictures best counts.
HYPOTHESES = (
    ErrorPersistence(),
    ErrorPersistence(pace=5.0),
    ErrorPersistence(pace=25.0),
    ErrorPersistence(telemetry=0.5),
    ErrorPersistence(telemetry=0.0),
    ErrorPersistence(landmarks=0.0),
    ErrorPersistence(telemetry=0.0, landmarks=0.0, pace=np.inf),
)

# Share of the log likelihood of a hypothesis that is kept from frame to frame.
_KEPT_LIKELIHOOD = 0.95
# No single frame counts against a hypothesis by more than this: a report may jump.
_MOST_EVIDENCE = 15.0


@dataclass(frozen=True)
class _Repair:
    """The repair of the last frame: whose pixels landmarks had, and which were left out."""

    pixels_of: dict[int, int]
    without: frozenset[int]


class Georeferencer:
    """Finds how each frame of a clip maps to the ground. Call `update` with the frames in order.

    solver: for the plane homography. focal_known: the camera's focal length is given, not guessed. names: of the
    landmarks, for messages. ground_up_m: height of the ground that altitudes are measured from.
    """

    def __init__(
        self,
        camera: Camera,
        settings: Settings,
        solver: PlaneSolver,
        focal_known: bool = True,
        names: tuple[str, ...] = (),
        ground_up_m: float = 0.0,
    ) -> None:
        self.camera, self.settings, self.solver = camera, settings, solver
        self.focal_known, self.names, self.ground_up_m = focal_known, names, ground_up_m
        hypotheses = HYPOTHESES if settings.aerial.correlation_s > 0 else HYPOTHESES[-1:]
        self.filters = [BiasFilter(persistence=hypothesis) for hypothesis in hypotheses]
        self.likelihood = np.zeros(len(hypotheses))
        self.repair = _Repair({}, frozenset())

    def update(
        self,
        frame: int,
        time_s: float,
        flight: Flight | None,
        marks: LandmarkObservations,
        degrees: Degrees | None = None,
    ) -> Fix:
        """How one frame maps to the ground; by = "" and a cause where it is unknown.

        flight: the telemetry at the frame, its place in local metres; None without telemetry. marks: the landmarks,
        places in local metres; rows without pixel or place do not count. degrees, for aerial.mode = paper.
        """
        parameters = self.settings.aerial
        usable, changes = self._usable(marks)
        if degrees is not None:
            degrees = (np.asarray(degrees[0], float)[usable], degrees[1])
        seen = marks[usable]
        prior = pose_prior(flight, self.camera, parameters, self.ground_up_m, self.focal_known)
        if parameters.mode == "pose":
            fix = self._by_pose(frame, time_s, prior, seen)
        else:
            fix = self._by_homography(frame, prior, seen, degrees)
        return _with_unusable(fix, marks, usable, changes)

    def _by_pose(self, frame: int, time_s: float, prior: Prior | None, marks: LandmarkObservations) -> Fix:
        parameters, n = self.settings.aerial, len(marks)
        cause = _describe_refusal(frame, prior, marks, parameters.least_spread)
        bare = focal_prior(self.camera, parameters, self.focal_known)
        self.filters = [bias.at(time_s, prior or bare, marks, parameters.correlation_s) for bias in self.filters]
        best = int(self.likelihood.argmax())
        before = self.filters[best]
        if cause:
            return no_fix(frame, marks, cause)
        if prior is None:
            # By landmarks alone a tilt and its mirror are hard to tell apart: in the filter a wrong one would persist.
            before = before.forget(np.arange(len(before.mean)))
        check, before = self._check(before, prior or bare, marks, None if prior is None else bare)
        solution = check.solution
        if solution is None:
            no_pose = f"no pose of the camera shows the landmarks of frame {frame} where the picture has them"
            cause = check.cause or no_pose
            return no_fix(frame, marks, cause)
        if prior is not None and check.passed and not check.alone:
            self._update_filters(prior, reorder_pixels(marks, check.order), check.used, solution)
            self.filters[best] = before.after(prior, marks, check.used, solution)
        count = int(check.used.sum())
        cause = check.cause
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
            state=check.state,
            chi2=solution.cost if n else float("nan"),
            freedom=solution.freedom if n else 0,
            changes=check.changes,
            cause=cause,
        )

    def _update_filters(self, prior: Prior, marks: LandmarkObservations, used: np.ndarray, solution: Solution) -> None:
        """Compare the prediction of each hypothesis with the picture, and update its filter."""
        if len(self.filters) == 1 or not (prior.known.all() and used.any()):
            return
        linear = linearize_image(marks, self.camera, used, solution)
        updated = [bias.predict(marks, linear) for bias in self.filters]
        density = np.array([density for density, _ in updated])
        self.likelihood = _KEPT_LIKELIHOOD * self.likelihood + np.maximum(density - density.max(), -_MOST_EVIDENCE)
        self.filters = [bias for _, bias in updated]

    def _check(
        self, before: BiasFilter, prior: Prior, marks: LandmarkObservations, bare: Prior | None
    ) -> tuple[LandmarkCheck, BiasFilter]:
        """The landmarks tested against the filter, and the filter to go on with."""
        gate, n = self.settings.aerial.gate_probability, len(marks)
        everyone, itself = np.ones(n, bool), np.arange(n)
        solution = find_pose(marks, self.camera, before.expected(prior, marks))
        if passes(solution, gate):
            self.repair = _Repair({}, frozenset())
            return LandmarkCheck(solution, itself, everyone), before
        alone = None if bare is None else independent_expectation(bare, marks.sigma_m)
        names = tuple(self._name(identity) for identity in marks.landmark.tolist())
        known = self._last_repair(marks)
        if known is not None:
            check = check_landmarks(
                marks, self.camera, before.expected(prior, marks), gate, names, known=known, only=True
            )
            if check.passed:
                return check, before
        for bias in self._forgetting(before, prior, marks):
            expected = bias.expected(prior, marks)
            solution = find_pose(marks, self.camera, expected)
            if passes(solution, gate):
                return LandmarkCheck(solution, itself, everyone), bias
        for bias in (before, before.forget(np.arange(len(before.mean)))):
            check = check_landmarks(marks, self.camera, bias.expected(prior, marks), gate, names, alone)
            if check.passed:
                break
        identities = marks.landmark.tolist()
        self.repair = _Repair(
            {a: identities[b] for a, b in zip(identities, check.order.tolist(), strict=True) if a != identities[b]},
            frozenset(marks.landmark[~check.used].tolist()),
        )
        return check, bias

    def _forgetting(self, before: BiasFilter, prior: Prior, marks: LandmarkObservations) -> Iterator[BiasFilter]:
        """Filters with part of the past forgotten, for a report that jumps within its errors."""
        if not before.is_updated:
            return
        yield before.forget(np.arange(7))
        for identity in marks.landmark:
            yield before.forget(error_rows(before.ids, np.array([identity])))
        yield before.forget(np.arange(len(before.mean)))

    def _by_homography(
        self, frame: int, prior: Prior | None, marks: LandmarkObservations, degrees: Degrees | None
    ) -> Fix:
        """By landmarks alone; telemetry, where there is any, only tests their identities and places."""
        parameters, n = self.settings.aerial, len(marks)
        paper = parameters.mode == "paper"
        if paper or prior is None or not prior.known.all() or n == 0:
            seen = marks if paper else self._undistorted(marks)
            return fix_by_homography(frame, seen, self.solver, parameters.least_spread, degrees, paper)
        names = tuple(self._name(identity) for identity in marks.landmark.tolist())
        expected = independent_expectation(prior, marks.sigma_m)
        check = check_landmarks(marks, self.camera, expected, parameters.gate_probability, names)
        # Where no change explains the disagreement the telemetry may be wrong: the landmarks are used as reported.
        kept = reorder_pixels(marks, check.order)[check.used] if check.passed else marks
        fix = fix_by_homography(frame, self._undistorted(kept), self.solver, parameters.least_spread)
        solution = check.solution
        return replace(
            fix,
            landmark=marks.landmark,
            state=(check.state if check.passed else ("used",) * n) if fix.by else ("excluded",) * n,
            chi2=float("nan") if solution is None else solution.cost,
            freedom=0 if solution is None else solution.freedom,
            changes=check.changes,
            cause=fix.cause or check.cause,
        )

    def _undistorted(self, marks: LandmarkObservations) -> LandmarkObservations:
        """The landmarks as a lens without distortion shows them: only such a picture of a plane is a homography."""
        return replace(marks, image_px=undistort_pixels(marks.image_px, self.camera))

    def _usable(self, marks: LandmarkObservations) -> tuple[np.ndarray, tuple[str, ...]]:
        """The rows with pixel and place, each landmark once; and why others are left out."""
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

    def _last_repair(self, marks: LandmarkObservations) -> tuple[np.ndarray, np.ndarray] | None:
        """The repair of the last frame, for this frame's rows; None without one that applies."""
        row = {identity: k for k, identity in enumerate(marks.landmark.tolist())}
        if not (self.repair.pixels_of or self.repair.without):
            return None
        order = [row.get(self.repair.pixels_of.get(identity, identity), -1) for identity in row]
        if sorted(order) != list(range(len(row))):
            return None
        return np.array(order), ~np.isin(marks.landmark, list(self.repair.without))

    def _name(self, identity: int) -> str:
        return self.names[identity] if 0 <= identity < len(self.names) else f"landmark {identity}"


def _describe_refusal(frame: int, prior: Prior | None, marks: LandmarkObservations, least_spread: float) -> str:
    """Why the pose cannot be determined, in words; empty where it can."""
    n = len(marks)
    if prior is None:
        if n < LEAST:
            return describe_too_few(frame, n, " and no telemetry")
        return describe_one_line(frame, marks, least_spread)
    if 2 * n < int((~prior.known).sum()) or (n < 2 and not prior.known[2]):
        lacking = " and ".join(dict.fromkeys(np.array(_POSE_PARTS)[~prior.known].tolist()))
        has = f"{n} landmark{'s' * (n != 1)}" if n else "no landmark"
        return f"frame {frame} has {has}, too few where the telemetry does not say {lacking}"
    return ""


def _with_unusable(fix: Fix, marks: LandmarkObservations, usable: np.ndarray, changes: tuple[str, ...]) -> Fix:
    """The fix with the landmarks added that are in the picture but could not be used."""
    seen = np.flatnonzero(usable | np.isfinite(marks.image_px).all(axis=1))
    states = dict(zip(np.flatnonzero(usable).tolist(), fix.state, strict=True))
    state = tuple(states.get(row, "excluded") for row in seen.tolist())
    return replace(fix, landmark=marks.landmark[seen], state=state, changes=changes + fix.changes)
