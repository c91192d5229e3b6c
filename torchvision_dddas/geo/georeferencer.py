"""Map the pictures of a clip to the ground frame by frame, and estimate slow errors over all frames so far.

The errors of the telemetry and of the landmarks' receivers change slowly, so many frames estimate them. Each error is
an Ornstein-Uhlenbeck process plus noise. Process and noise together have the stated standard deviation of the error;
the process decays with a time constant. The first frame is therefore solved like a single picture. Later frames gain
from independent errors only: errors of pixels and motion. No result becomes more certain than the slow errors allow.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.geo.landmark_faults import LandmarkCheck, check_landmarks, passes, reorder_pixels, try_repairs
from torchvision_dddas.geo.landmark_misfit import (
    IN_A_FRAME,
    OVER_FRAMES,
    Misfit,
    measure_misfit,
    student_factor,
    widen_errors,
)
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
    PoseSolution,
    Prior,
    find_pose,
    focal_prior,
    independent_expectation,
    pose_prior,
)
from torchvision_dddas.geometry import undistort_pixels
from torchvision_dddas.types import Camera, Fix, Flight, LandmarkObservations

# A landmark that was not seen for this many time constants is forgotten.
_FORGOTTEN = 4.0
# A standard deviation that changes by more than this factor marks a receiver in another mode, with a new error.
_ANOTHER = 1.5
# Share of the log likelihood of a hypothesis that is kept from frame to frame.
_KEPT_LIKELIHOOD = 0.95
# Largest evidence of a single frame against a hypothesis: a report may jump.
_MOST_EVIDENCE = 15.0
# Solve a frame again, _AGAIN times at most, while its landmark errors are more than _MORE times the assumed errors.
_MORE, _AGAIN = 1.1, 4
_POSE_PARTS = np.array(["heading", "heading", "heading", "place", "place", "altitude", "focal length"])
# Key of each part of the pose in a camera's file.
_KEYS = {"heading": "heading_deg", "altitude": "height_m or takeoff_above_sea_m", "pitch": "pitch_deg"}
# Columns of each part of the pose in a table of telemetry.
_COLUMNS = {"heading": "heading_deg", "pitch": "pitch_deg", "altitude": "altitude_m", "focal length": "hfov_deg"}
_COLUMNS |= {"place": "longitude_deg,latitude_deg"}

Degrees = tuple[np.ndarray, tuple[float, float]]
"""Longitudes and latitudes of landmarks (n, 2), and of the origin of the local metres."""


@dataclass(frozen=True)
class ErrorPersistence:
    """The share of the errors that persists from frame to frame; the rest is new in every frame.

    telemetry: share of the variance of its angles and place; the rest comes from a shaking gimbal and from samples that
    are older than the picture. landmarks: share of the variance of their reports. pace: the persistent part decays this
    many times faster than aerial.correlation_s; infinite if nothing persists.
    """

    telemetry: float = 0.9
    landmarks: float = 1.0
    pace: float = 1.0


# It is unknown which errors of a vehicle and its landmarks persist. Use the hypothesis that predicts the pictures best.
_HYPOTHESES = (
    ErrorPersistence(),
    ErrorPersistence(pace=5.0),
    ErrorPersistence(pace=25.0),
    ErrorPersistence(telemetry=0.5),
    ErrorPersistence(telemetry=0.0),
    ErrorPersistence(landmarks=0.0),
    ErrorPersistence(telemetry=0.0, landmarks=0.0, pace=np.inf),
)


@lru_cache(maxsize=256)
def _persistent_share(persistence: ErrorPersistence, size: int) -> np.ndarray:
    """Return the share of each standard deviation that persists; 1 for the focal length. Cached and read-only."""
    share = np.full(size, np.sqrt(persistence.landmarks))
    share[:6], share[6] = np.sqrt(persistence.telemetry), 1.0
    share.flags.writeable = False
    return share


@dataclass(frozen=True)
class BiasFilter:
    """Estimate of the errors at a time: truth minus report, seven for the pose, then two for each landmark.

    mean, covariance: (7 + 2m,) with the landmarks `ids` (m,), last seen at `seen_s`. sigma: (7 + 2m,) of each error
    before any frame; NaN for quantities that the telemetry has never given.
    """

    time_s: float = float("nan")
    ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    seen_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    mean: np.ndarray = field(default_factory=lambda: np.zeros(7))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((7, 7)))
    sigma: np.ndarray = field(default_factory=lambda: np.full(7, np.nan))
    persistence: ErrorPersistence = ErrorPersistence()

    def at(self, time_s: float, prior: Prior, marks: LandmarkObservations, correlation_s: float) -> "BiasFilter":
        """Predict to time_s: decay the errors, add process noise and new landmarks, and drop landmarks long unseen."""
        correlation_s /= self.persistence.pace
        gap_s = time_s - self.time_s
        keeps = float(np.exp(-gap_s / correlation_s)) if correlation_s > 0 and gap_s >= 0 else 0.0
        before = self
        staying = np.isin(self.ids, marks.landmark) | (time_s - self.seen_s <= _FORGOTTEN * correlation_s)
        new = marks.landmark[~np.isin(marks.landmark, self.ids)]
        if len(new) or not staying.all():
            rows = np.r_[np.arange(7), (7 + 2 * np.flatnonzero(staying)[:, None] + [0, 1]).ravel()]
            more = (0, 2 * len(new))
            before = replace(
                self,
                ids=np.r_[self.ids[staying], new].astype(np.int64),
                seen_s=np.r_[self.seen_s[staying], np.full(len(new), time_s)],
                mean=np.pad(self.mean[rows], more),
                covariance=np.pad(self.covariance[np.ix_(rows, rows)], more),
                sigma=np.pad(self.sigma[rows], more, constant_values=np.nan),
            )
        was, share = before.sigma, before._share
        sigma = was.copy()
        sigma[:7][prior.known] = 1 / np.sqrt(np.diag(prior.information)[prior.known])
        sigma[before.rows_of(marks.landmark)] = np.repeat(np.maximum(marks.sigma_m, EXACT_M), 2)
        with np.errstate(invalid="ignore"):
            grown = sigma / was
        # The altitude's sigma may be a share of the altitude, and then changes with it; so only landmarks are tested.
        grown[7:] = np.where((grown[7:] < _ANOTHER) & (grown[7:] > 1 / _ANOTHER), grown[7:], 0.0)
        factor = np.where(np.isfinite(grown), grown, 0.0) * keeps
        now, was = (np.where(np.isfinite(each * share), each * share, 0.0) for each in (sigma, was))
        covariance = before.covariance * np.outer(factor, factor)
        # Process noise: the variance of each error in excess of its decayed part.
        covariance[np.diag_indices(len(was))] += now**2 - (factor * was) ** 2
        return replace(before, time_s=time_s, mean=before.mean * factor, covariance=covariance, sigma=sigma)

    def expected(self, prior: Prior, marks: LandmarkObservations) -> Expected:
        """Return the expected pose and landmarks of a frame; call `at` with that frame's time before."""
        ours, theirs = self._matching_rows(prior.known, marks)
        size = 7 + 2 * len(marks)
        mean, information = np.zeros(size), np.zeros((size, size))
        mean[theirs] = self.mean[ours]
        inverse = np.linalg.inv(self._in_one_frame(ours))
        information[np.ix_(theirs, theirs)] = (inverse + inverse.T) / 2
        return Expected(prior.pose, mean, information, prior.known)

    def predict(
        self, marks: LandmarkObservations, used: np.ndarray, shown_px: np.ndarray, slopes: np.ndarray
    ) -> tuple[float, "BiasFilter"]:
        """Return the log density of a picture under the prediction, and the filter updated by the picture.

        shown_px: (2m,) pixels of the used landmarks, linear in the errors with slopes (2m, 7 + 2n). The telemetry
        must give all seven parameters of the pose.
        """
        ours, _ = self._matching_rows(np.ones(7, bool), marks)
        variance = np.repeat(marks.pixel_sigma[used], 2) ** 2
        crossed = self.covariance[:, ours] @ slopes.T
        root = np.linalg.cholesky(slopes @ self._in_one_frame(ours) @ slopes.T + np.diag(variance))
        innovation = shown_px - slopes @ self.mean[ours]
        white = np.linalg.solve(root, np.column_stack([innovation, crossed.T]))
        density = -0.5 * float(white[:, 0] @ white[:, 0]) - float(np.log(np.diag(root)).sum())
        covariance = self.covariance - white[:, 1:].T @ white[:, 1:]
        return density, self._with(self.mean + white[:, 1:].T @ white[:, 0], covariance, marks.landmark[used])

    def after(
        self, prior: Prior, marks: LandmarkObservations, used: np.ndarray, solution: PoseSolution
    ) -> "BiasFilter":
        """Return the filter updated by a frame's solution, including errors correlated with observed errors."""
        ours, theirs = self._matching_rows(prior.known, marks)
        before = self._in_one_frame(ours)
        gain = np.linalg.solve(before, self.covariance[ours]).T
        now = solution.correction_covariance[np.ix_(theirs, theirs)]
        mean = self.mean + gain @ (solution.correction[theirs] - self.mean[ours])
        return self._with(mean, self.covariance + gain @ (now - before) @ gain.T, marks.landmark[used])

    def forget(self, rows: np.ndarray) -> "BiasFilter":
        """Return the filter with some of its errors reset to their state before any frame."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[rows] = 0
        covariance[rows] = 0
        covariance[:, rows] = 0
        persistent = (self.sigma * self._share)[rows]
        covariance[rows, rows] = np.where(np.isfinite(persistent), persistent, 0.0) ** 2
        return replace(self, mean=mean, covariance=covariance)

    def rows_of(self, wanted: np.ndarray) -> np.ndarray:
        """Return the (2 K,) rows of mean and covariance with the two position errors of each of K landmarks."""
        row = {identity: 7 + 2 * k for k, identity in enumerate(self.ids.tolist())}
        return np.array([row[identity] + k for identity in wanted.tolist() for k in (0, 1)], int)

    def _matching_rows(self, known: np.ndarray, marks: LandmarkObservations) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows here and in a Solution of the known parts of the pose and of landmarks."""
        pose = np.flatnonzero(known)
        return np.r_[pose, self.rows_of(marks.landmark)], np.r_[pose, 7 : 7 + 2 * len(marks)]

    def _with(self, mean: np.ndarray, covariance: np.ndarray, seen: np.ndarray) -> "BiasFilter":
        seen_s = np.where(np.isin(self.ids, seen), self.time_s, self.seen_s)
        return replace(self, mean=mean, covariance=(covariance + covariance.T) / 2, seen_s=seen_s)

    def _in_one_frame(self, rows: np.ndarray) -> np.ndarray:
        """Return the covariance of errors in a single frame: the persistent part plus the part new in every frame."""
        return self.covariance[np.ix_(rows, rows)] + np.diag(self.sigma[rows] ** 2 * (1 - self._share[rows] ** 2))

    @property
    def _share(self) -> np.ndarray:
        return _persistent_share(self.persistence, len(self.mean))


class Georeferencer:
    """Find how each frame of a clip maps to the ground. Call `update` with the frames in order.

    solver: solver of the plane homography. focal_known: whether the camera's focal length is given, not guessed. names:
    names of the landmarks, for messages.
    """

    def __init__(
        self,
        camera: Camera,
        settings: Settings,
        solver: PlaneSolver,
        focal_known: bool = True,
        names: tuple[str, ...] = (),
    ) -> None:
        self.camera, self.parameters, self.solver = camera, settings.aerial, solver
        self.focal_known, self.names = focal_known, names
        hypotheses = _HYPOTHESES if settings.aerial.correlation_s > 0 else _HYPOTHESES[-1:]
        self._filters = [BiasFilter(persistence=hypothesis) for hypothesis in hypotheses]
        self._likelihood = np.zeros(len(hypotheses))
        self._misfit, self._misfit_s = Misfit(), float("-inf")
        # The repair of the last frame: which pixels the landmarks had, and which landmarks were left out.
        self._repair: tuple[dict[int, int], list[int]] = {}, []

    def update(
        self,
        frame: int,
        time_s: float,
        flight: Flight | None,
        marks: LandmarkObservations,
        degrees: Degrees | None = None,
    ) -> Fix:
        """Return how one frame maps to the ground; by = "" and a cause if that is unknown.

        flight: the telemetry at the frame, its place in local metres; None without telemetry. marks: the landmarks with
        places in local metres; rows without pixel or place are ignored. degrees: only for aerial.mode = paper.
        """
        usable, changes = self._usable(marks)
        if degrees is not None:
            degrees = (np.asarray(degrees[0], float)[usable], degrees[1])
        prior = pose_prior(flight, self.camera, self.parameters, self.focal_known)
        if self.parameters.mode == "pose":
            fix = self._by_pose(frame, time_s, flight, prior, marks[usable])
        else:
            fix = self._by_homography(frame, prior, marks[usable], degrees)
        # Mark landmarks that are in the picture but could not be used as excluded.
        shown = usable | np.isfinite(marks.image_px).all(axis=1)
        states = iter(fix.state)
        state = tuple(next(states) if can else "excluded" for can in usable[shown].tolist())
        return replace(fix, landmark=marks.landmark[shown], state=state, changes=changes + fix.changes)

    def _usable(self, marks: LandmarkObservations) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return the rows with pixel and place, each landmark once, and why the other rows are left out."""
        in_picture = np.isfinite(marks.image_px).all(axis=1)
        placed = np.isfinite(marks.east_north_m).all(axis=1) & np.isfinite(marks.sigma_m)
        unplaced = marks.landmark[in_picture & ~placed].tolist()
        changes = [f"{self._name(identity)} left out: its place is not known" for identity in unplaced]
        usable = in_picture & placed
        rows, first = np.flatnonzero(usable), np.unique(marks.landmark[usable], return_index=True)[1]
        for row in np.delete(rows, first).tolist():
            usable[row] = False
            changes.append(f"{self._name(int(marks.landmark[row]))} left out where it is seen a second time")
        return usable, tuple(changes)

    def _by_pose(
        self, frame: int, time_s: float, flight: Flight | None, prior: Prior | None, marks: LandmarkObservations
    ) -> Fix:
        """Solve the pose, with landmark errors as large as measured up to this frame."""
        factor, before = self._misfit.factor(OVER_FRAMES), self._state
        # Frames within a correlation time share their errors, so they count once.
        apart_s, correlation_s = time_s - self._misfit_s, self.parameters.correlation_s
        share = min(apart_s / (2 * correlation_s), 1.0) if correlation_s > 0 else 1.0
        for _ in range(_AGAIN):
            self._state = before
            fix, seen = self._solve_pose(frame, time_s, flight, prior, widen_errors(marks, factor))
            if seen is None:
                return fix
            own = Misfit(seen.squares * factor**2, seen.redundancy)
            misfit = self._misfit.and_more(own, max(share, 0.0))
            if misfit.factor(OVER_FRAMES) <= _MORE * factor:
                break
            factor = misfit.factor(OVER_FRAMES)
        self._misfit, self._misfit_s = misfit, time_s
        redundancy = misfit.redundancy
        if own.factor(IN_A_FRAME) > _MORE * factor:
            # Only the landmarks of this frame are worse: widen the ellipses of this frame only.
            after, self._state, factor, redundancy = self._state, before, own.factor(IN_A_FRAME), own.redundancy
            fix, _ = self._solve_pose(frame, time_s, flight, prior, widen_errors(marks, factor))
            self._state = after
        if factor == 1 or fix.covariance is None:
            return fix
        words = f"errors of landmarks taken {factor:.1f} times as large as stated"
        wider = fix.covariance * student_factor(redundancy)
        return replace(fix, covariance=wider, cause=f"{fix.cause}; {words}" if fix.cause else words)

    @property
    def _state(self) -> tuple[list[BiasFilter], np.ndarray, tuple[dict[int, int], list[int]]]:
        """The variables that locating a frame changes, except for the misfit."""
        return list(self._filters), self._likelihood, self._repair

    @_state.setter
    def _state(self, state: tuple[list[BiasFilter], np.ndarray, tuple[dict[int, int], list[int]]]) -> None:
        filters, self._likelihood, self._repair = state
        self._filters = list(filters)

    def _solve_pose(
        self, frame: int, time_s: float, flight: Flight | None, prior: Prior | None, marks: LandmarkObservations
    ) -> tuple[Fix, Misfit | None]:
        """Solve the pose with the stated errors, and return the landmarks' misfit; None if unknown."""
        if len(marks) or self.names:
            cause = _describe_refusal(frame, prior, marks, self.parameters.least_spread)
        else:
            cause = describe_unknown_pose(flight, prior)
        bare = focal_prior(self.camera, self.parameters, self.focal_known)
        correlation_s = self.parameters.correlation_s
        self._filters = [bias.at(time_s, prior or bare, marks, correlation_s) for bias in self._filters]
        best = int(self._likelihood.argmax())
        before = self._filters[best]
        if cause:
            return no_fix(frame, marks, cause), None
        if prior is None:
            # Landmarks alone hardly distinguish a tilt from its mirror. A wrong one would persist: clear the filter.
            before = before.forget(np.arange(len(before.mean)))
        check, before = self._check(before, prior or bare, marks, None if prior is None else bare)
        solution, cause = check.solution, check.cause
        if solution is None:
            no_pose = f"no pose of the camera shows the landmarks of frame {frame} where the picture has them"
            return no_fix(frame, marks, cause or no_pose), None
        if prior is not None and check.passed and not check.alone:
            self._update_filters(prior, reorder_pixels(marks, check.order), check.used, solution)
            self._filters[best] = before.after(prior, marks, check.used, solution)
        count = int(check.used.sum())
        if not cause and count == 0:
            cause = f"frame {frame} has no landmark: by telemetry alone" if self.names else ""
        elif not cause and count < LEAST:
            cause = describe_too_few(frame, count)
        if count == 0 and flight is not None and flight.heading_from:
            sigma_deg = np.degrees(np.sqrt(solution.covariance[2, 2]))
            words = f"heading from {flight.heading_from}, sigma {sigma_deg:.0f} degrees"
            cause = f"{cause}; {words}" if cause else words
        fix = Fix(
            frame,
            "pose" if count else "telemetry",
            solution.pose,
            solution.covariance[:7, :7],
            landmark=marks.landmark,
            state=check.state,
            chi2=solution.cost if len(marks) else float("nan"),
            freedom=solution.freedom if len(marks) else 0,
            changes=check.changes,
            cause=cause,
        )
        return fix, self._landmark_misfit(check, marks) if count else None

    def _landmark_misfit(self, check: LandmarkCheck, marks: LandmarkObservations) -> Misfit | None:
        """Return how well the landmarks of a frame fit; None if the telemetry fits even less."""
        assert check.solution is not None
        seen = measure_misfit(check.solution, reorder_pixels(marks, check.order), check.used)
        rest, freedom = check.solution.cost - seen.squares, check.solution.freedom - seen.redundancy
        return None if not check.passed and rest * seen.redundancy > seen.squares * freedom else seen

    def _update_filters(
        self, prior: Prior, marks: LandmarkObservations, used: np.ndarray, solution: PoseSolution
    ) -> None:
        """Compare the prediction of each hypothesis with the picture, and update the filter of each hypothesis."""
        if len(self._filters) == 1 or not (prior.known.all() and used.any()):
            return
        slopes = solution.slopes.copy()
        slopes[:, :3] = slopes[:, :3] @ np.linalg.inv(solution.by_turn)
        shown_px = solution.missing + slopes @ solution.correction
        density, self._filters = map(
            list, zip(*(bias.predict(marks, used, shown_px, slopes) for bias in self._filters), strict=True)
        )
        evidence = np.maximum(np.array(density) - max(density), -_MOST_EVIDENCE)
        self._likelihood = _KEPT_LIKELIHOOD * self._likelihood + evidence

    def _check(
        self, before: BiasFilter, prior: Prior, marks: LandmarkObservations, bare: Prior | None
    ) -> tuple[LandmarkCheck, BiasFilter]:
        """Test the landmarks against the filter, and return the result and the filter to continue with."""
        gate, n, identities = self.parameters.gate_probability, len(marks), marks.landmark.tolist()
        everyone, itself = np.ones(n, bool), np.arange(n)
        expected = before.expected(prior, marks)
        first = find_pose(marks, self.camera, expected)
        if passes(first, gate):
            self._repair = {}, []
            return LandmarkCheck(first, itself, everyone), before
        names = tuple(self._name(identity) for identity in identities)
        # Try the repair of the last frame first, if it applies to this frame's landmarks.
        pixels_of, without = self._repair
        rows = {identity: k for k, identity in enumerate(identities)}
        order = np.array([rows.get(pixels_of.get(identity, identity), -1) for identity in identities], int)
        if (pixels_of or without) and sorted(order) == list(range(n)):
            known = [(order, ~np.isin(marks.landmark, without))]
            if repaired := try_repairs(known, first, marks, self.camera, expected, gate, names):
                return repaired, before
        for bias in self._forgetting(before, marks):
            solution = find_pose(marks, self.camera, bias.expected(prior, marks))
            if passes(solution, gate):
                return LandmarkCheck(solution, itself, everyone), bias
        alone = None if bare is None else independent_expectation(bare, marks.sigma_m)
        for bias in (before, before.forget(np.arange(len(before.mean)))):
            check = check_landmarks(marks, self.camera, bias.expected(prior, marks), gate, names, alone)
            if check.passed:
                break
        pairs = zip(identities, marks.landmark[check.order].tolist(), strict=True)
        self._repair = {a: b for a, b in pairs if a != b}, marks.landmark[~check.used].tolist()
        return check, bias

    def _forgetting(self, before: BiasFilter, marks: LandmarkObservations) -> Iterator[BiasFilter]:
        """Yield filters with part of the past forgotten, for a report that jumps within its errors."""
        if before.mean.any():
            yield before.forget(np.arange(7))
            for identity in marks.landmark:
                yield before.forget(before.rows_of(np.array([identity])))
            yield before.forget(np.arange(len(before.mean)))

    def _by_homography(
        self, frame: int, prior: Prior | None, marks: LandmarkObservations, degrees: Degrees | None
    ) -> Fix:
        """Fit the homography to landmarks alone; telemetry, if given, only tests their identities and places."""
        parameters, n = self.parameters, len(marks)
        paper = parameters.mode == "paper"
        # Pixels and ground are related by a homography only for a plane seen by a lens without distortion.
        flat = marks if paper else replace(marks, image_px=undistort_pixels(marks.image_px, self.camera))
        if paper or prior is None or not prior.known.all() or n == 0:
            return fix_by_homography(frame, flat, self.solver, parameters.least_spread, degrees, paper)
        names = tuple(self._name(identity) for identity in marks.landmark.tolist())
        expected = independent_expectation(prior, marks.sigma_m)
        check = check_landmarks(marks, self.camera, expected, parameters.gate_probability, names)
        # If no repair explains the disagreement, the telemetry may be wrong: use the landmarks as reported.
        kept = reorder_pixels(flat, check.order)[check.used] if check.passed else flat
        fix = fix_by_homography(frame, kept, self.solver, parameters.least_spread)
        state = check.state if check.passed else ("used",) * n
        solution = check.solution
        return replace(
            fix,
            landmark=marks.landmark,
            state=state if fix.by else ("excluded",) * n,
            chi2=float("nan") if solution is None else solution.cost,
            freedom=0 if solution is None else solution.freedom,
            changes=check.changes,
            cause=fix.cause or check.cause,
        )

    def _name(self, identity: int) -> str:
        return self.names[identity] if 0 <= identity < len(self.names) else f"landmark {identity}"


def describe_unknown_pose(flight: Flight | None, prior: Prior | None) -> str:
    """Return why telemetry alone does not give the pose; empty if it does. A guessed pitch does not count."""
    if flight is None or prior is None:
        return "the telemetry has no data for this time; give the whole log, or set aerial.clock_offset_s"
    lacking = list(dict.fromkeys(_POSE_PARTS[~prior.known].tolist()))
    if not np.isfinite(flight.pitch_rad):
        lacking.append("pitch")
    if not lacking:
        return ""
    keys = ", ".join(_KEYS[part] for part in lacking if part in _KEYS)
    columns = ", ".join(_COLUMNS[part] for part in lacking)
    helped = f"; add the column{'s' * (',' in columns)} {columns} to a CSV of it"
    helped += f", or give {keys} in the camera's file (--camera)" if keys else ""
    return f"the telemetry does not say the camera's {', '.join(lacking)}{helped}"


def _describe_refusal(frame: int, prior: Prior | None, marks: LandmarkObservations, least_spread: float) -> str:
    """Return why the pose cannot be determined; empty if it can be."""
    n = len(marks)
    if prior is None:
        if n < LEAST:
            return describe_too_few(frame, n, " and no telemetry")
        return describe_one_line(frame, marks, least_spread)
    if 2 * n < int((~prior.known).sum()) or (n < 2 and not prior.known[2]):
        lacking = " and ".join(dict.fromkeys(_POSE_PARTS[~prior.known].tolist()))
        has = f"{n} landmark{'s' * (n != 1)}" if n else "no landmark"
        return f"frame {frame} has {has}, too few where the telemetry does not say {lacking}"
    return ""
