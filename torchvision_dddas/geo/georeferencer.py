"""How the pictures of a clip map to the ground."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.geo.landmark_faults import LandmarkCheck, check_landmarks, passes, reorder_pixels
from torchvision_dddas.geo.plane_homography import (
    LEAST,
    PlaneSolver,
    describe_one_line,
    describe_too_few,
    fix_by_homography,
    no_fix,
)
from torchvision_dddas.geo.pose_estimation import (
    EXACT_M,
    Expected,
    Prior,
    Solution,
    find_pose,
    focal_prior,
    independent_expectation,
    pose_prior,
)
from torchvision_dddas.geo.projection import project_with_slopes, undistort_pixels
from torchvision_dddas.geometry import slope_of_turn
from torchvision_dddas.types import Camera, Fix, Flight, LandmarkObservations

# A landmark not seen for so many time constants is forgotten.
FORGOTTEN = 4.0
# A receiver whose standard deviation changes by more than this factor works another way: its error is another.
ANOTHER = 1.5


@dataclass(frozen=True)
class LinearizedImage:
    """The pixels of k of n landmarks as a linear function of the errors of telemetry and reports: truth less report.

    shown_px: (2k,) slopes times the errors, plus noise of variance_px2 (2k,). slopes: (2k, 7 + 2n). used: (n,) bool.
    """

    shown_px: np.ndarray
    slopes: np.ndarray
    variance_px2: np.ndarray
    used: np.ndarray


def linearize_image(
    marks: LandmarkObservations, camera: Camera, used: np.ndarray, solution: Solution
) -> LinearizedImage:
    """The picture of one frame, linear about its solution. The telemetry must give all seven of the pose."""
    points = np.column_stack([solution.places, marks.up_m])[used]
    seen, by_pose, by_point = project_with_slopes(points, solution.pose, camera)
    k = len(points)
    slopes = np.zeros((k, 2, 7 + 2 * len(used)))
    slopes[:, :, :7] = by_pose
    slopes[:, :, :3] = by_pose[:, :, :3] @ np.linalg.inv(slope_of_turn(solution.correction[:3]))
    for row, landmark in enumerate(np.flatnonzero(used).tolist()):
        slopes[row, :, 7 + 2 * landmark : 9 + 2 * landmark] = by_point[row, :, :2]
    flat = slopes.reshape(2 * k, -1)
    missing = (marks.image_px[used] - seen).ravel()
    return LinearizedImage(missing + flat @ solution.correction, flat, np.repeat(marks.pixel_sigma[used], 2) ** 2, used)


@dataclass(frozen=True)
class ErrorPersistence:
    """Which share of the errors persists from frame to frame; the rest is new in every frame.

    telemetry: share of the variance of its angles and place; a gimbal shakes, and samples are older than the picture.
    landmarks: share of the variance of their reports. pace: how many times faster than aerial.correlation_s the
    persistent part decays; infinite where nothing is kept.
    """

    telemetry: float = 0.9
    landmarks: float = 1.0
    pace: float = 1.0


@dataclass(frozen=True)
class BiasFilter:
    """Estimate of the errors at a time: truth less report, the seven of the pose first, then two a landmark.

    mean, covariance: (7 + 2m,) with the landmarks `ids` (m,), last seen at `seen_s`. sigma: (7 + 2m,) of each error
    before any frame; NaN for what the telemetry has never given.
    """

    time_s: float = float("nan")
    ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    seen_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    mean: np.ndarray = field(default_factory=lambda: np.zeros(7))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((7, 7)))
    sigma: np.ndarray = field(default_factory=lambda: np.full(7, np.nan))
    persistence: ErrorPersistence = ErrorPersistence()

    @property
    def is_updated(self) -> bool:
        """Whether any frame has contributed."""
        return bool(self.mean.any())

    def at(self, time_s: float, prior: Prior, marks: LandmarkObservations, correlation_s: float) -> "BiasFilter":
        """The filter at a later time, with new landmarks added."""
        correlation_s /= self.persistence.pace
        gap_s = time_s - self.time_s
        keeps = float(np.exp(-gap_s / correlation_s)) if correlation_s > 0 and gap_s >= 0 else 0.0
        known, before = np.flatnonzero(prior.known), self._of(time_s, marks, FORGOTTEN * correlation_s)
        was, size = before.sigma, len(before.mean)
        sigma = was.copy()
        sigma[known] = 1 / np.sqrt(np.diag(prior.information)[known])
        sigma[error_rows(before.ids, marks.landmark)] = np.repeat(np.maximum(marks.sigma_m, EXACT_M), 2)
        with np.errstate(invalid="ignore"):
            grown = sigma / was
        # The altitude's sigma may be a share of the altitude, and grows with it.
        grown[7:] = np.where((grown[7:] < ANOTHER) & (grown[7:] > 1 / ANOTHER), grown[7:], 0.0)
        factor = np.where(np.isfinite(grown), grown, 0.0) * keeps
        filled = np.where(np.isfinite(sigma), sigma, 0.0) * self._slow(size)
        was = was * self._slow(size)
        covariance = before.covariance * np.outer(factor, factor)
        # Process noise: what each error has beyond the kept part of its standard deviation.
        covariance[np.diag_indices(size)] += filled**2 - (factor * np.where(np.isfinite(was), was, 0.0)) ** 2
        return replace(before, time_s=time_s, mean=before.mean * factor, covariance=covariance, sigma=sigma)

    def _of(self, time_s: float, marks: LandmarkObservations, forgotten_s: float) -> "BiasFilter":
        """The filter with new landmarks added, and those removed that were not seen for too long."""
        seen, old = marks.landmark.tolist(), self.ids.tolist()
        staying = [
            row for row, identity in enumerate(old) if identity in seen or time_s - self.seen_s[row] <= forgotten_s
        ]
        new = [row for row, identity in enumerate(seen) if identity not in old]
        if len(staying) == len(old) and not new:
            return self
        from_old = np.concatenate([np.arange(7), *(7 + 2 * row + np.arange(2) for row in staying)]).astype(int)
        kept = len(from_old)
        size = kept + 2 * len(new)
        mean, covariance, sigma = np.zeros(size), np.zeros((size, size)), np.full(size, np.nan)
        mean[:kept], sigma[:kept] = self.mean[from_old], self.sigma[from_old]
        covariance[:kept, :kept] = self.covariance[np.ix_(from_old, from_old)]
        ids = np.concatenate([self.ids[staying], marks.landmark[new]]).astype(np.int64)
        seen_s = np.concatenate([self.seen_s[staying], np.full(len(new), time_s)])
        return replace(self, ids=ids, seen_s=seen_s, mean=mean, covariance=covariance, sigma=sigma)

    def expected(self, prior: Prior, marks: LandmarkObservations) -> Expected:
        """What to expect of a frame's pose and landmarks; call `at` with that frame's time before."""
        known, n = np.flatnonzero(prior.known), len(marks)
        ours = np.concatenate([known, error_rows(self.ids, marks.landmark)])
        theirs = np.concatenate([known, np.arange(7, 7 + 2 * n)])
        mean, information = np.zeros(7 + 2 * n), np.zeros((7 + 2 * n, 7 + 2 * n))
        mean[theirs] = self.mean[ours]
        inverse = np.linalg.inv(self._seen(ours))
        information[np.ix_(theirs, theirs)] = (inverse + inverse.T) / 2
        return Expected(prior.pose, mean, information, prior.known)

    def predict(self, marks: LandmarkObservations, linear: LinearizedImage) -> tuple[float, "BiasFilter"]:
        """Log density of a picture under the prediction, and the filter updated by it.

        The telemetry must give all seven of the pose.
        """
        ours = np.concatenate([np.arange(7), error_rows(self.ids, marks.landmark)])
        crossed = self.covariance[:, ours] @ linear.slopes.T
        expected = linear.slopes @ self._seen(ours) @ linear.slopes.T + np.diag(linear.variance_px2)
        surprise = linear.shown_px - linear.slopes @ self.mean[ours]
        root = np.linalg.cholesky(expected)
        white = np.linalg.solve(root, np.column_stack([surprise, crossed.T]))
        density = -0.5 * float(white[:, 0] @ white[:, 0]) - float(np.log(np.diag(root)).sum())
        covariance = self.covariance - white[:, 1:].T @ white[:, 1:]
        mean = self.mean + white[:, 1:].T @ white[:, 0]
        return density, self._with(mean, covariance, marks.landmark[linear.used])

    def after(self, prior: Prior, marks: LandmarkObservations, used: np.ndarray, solution: Solution) -> "BiasFilter":
        """The filter updated by a frame's solution, including errors that are correlated with those observed."""
        known, n = np.flatnonzero(prior.known), len(marks)
        ours = np.concatenate([known, error_rows(self.ids, marks.landmark)])
        theirs = np.concatenate([known, np.arange(7, 7 + 2 * n)])
        before = self._seen(ours)
        gain = np.linalg.solve(before, self.covariance[ours]).T
        now = solution.correction_covariance[np.ix_(theirs, theirs)]
        mean = self.mean + gain @ (solution.correction[theirs] - self.mean[ours])
        covariance = self.covariance + gain @ (now - before) @ gain.T
        return self._with(mean, covariance, marks.landmark[used])

    def _with(self, mean: np.ndarray, covariance: np.ndarray, seen: np.ndarray) -> "BiasFilter":
        ids = set(seen.tolist())
        seen_s = np.array([self.time_s if i in ids else t for i, t in zip(self.ids.tolist(), self.seen_s, strict=True)])
        return replace(self, mean=mean, covariance=(covariance + covariance.T) / 2, seen_s=seen_s)

    def forget(self, rows: np.ndarray) -> "BiasFilter":
        """The filter with some of its errors as before any frame."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[rows] = 0
        covariance[rows] = 0
        covariance[:, rows] = 0
        slow = (self.sigma * self._slow(len(mean)))[rows]
        covariance[rows, rows] = np.where(np.isfinite(slow), slow, 0.0) ** 2
        return replace(self, mean=mean, covariance=covariance)

    def _seen(self, rows: np.ndarray) -> np.ndarray:
        """The covariance of errors in a single frame: the persistent part plus what is new in every frame."""
        sigma = self.sigma[rows]
        return self.covariance[np.ix_(rows, rows)] + np.diag(sigma**2 * (1 - self._slow(len(self.mean))[rows] ** 2))

    def _slow(self, size: int) -> np.ndarray:
        return _slow(self.persistence, size)


@lru_cache(maxsize=256)
def _slow(persistence: ErrorPersistence, size: int) -> np.ndarray:
    """Share of each standard deviation that persists; a focal length does. Cached and read-only."""
    share = np.full(size, np.sqrt(persistence.landmarks))
    share[:6], share[6] = np.sqrt(persistence.telemetry), 1.0
    share.flags.writeable = False
    return share


def error_rows(ids: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The rows of the two errors of each wanted landmark."""
    row = {identity: 7 + 2 * k for k, identity in enumerate(ids.tolist())}
    return np.array([row[identity] + k for identity in wanted.tolist() for k in (0, 1)], int)


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
