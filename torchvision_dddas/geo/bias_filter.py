"""Errors of telemetry and of the landmarks' receivers over a clip: they change slowly, so many frames estimate them.

Each error is an Ornstein-Uhlenbeck process plus noise. Together they have the standard deviation that the error is said
to have; the process decays by a time constant. So the first frame is like a single picture, later ones gain in what is
independent, pixels and motion, and no confidence grows beyond what slow errors allow.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from torchvision_dddas.geo.pose_estimation import EXACT_M, Expected, Prior, Solution
from torchvision_dddas.geo.projection import project_with_slopes
from torchvision_dddas.geometry import slope_of_turn
from torchvision_dddas.types import Camera, LandmarkObservations

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
