"""Errors of telemetry and of the landmarks' receivers from frame to frame: they change slowly, so a clip tells them.

Each is an Ornstein-Uhlenbeck process: it has the standard deviation that it is said to have, and forgets itself by a
time constant. The first frame thus is like any single one; later ones gain by what is independent, pixels and motion,
and no confidence grows beyond what slow errors allow.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from torchvision_dddas.targets.pose import EXACT_M, Expected, Prior, Solution
from torchvision_dddas.types import Marks

FORGOTTEN = 4.0
"""A landmark not seen for so many time constants is forgotten."""

JITTER = 0.1
"""Share of the variance of the telemetry's angles and place that is new in every frame: a gimbal shakes, and samples
are older than the picture. Without it a clip would take such shaking for news of its landmarks."""

ANOTHER = 1.5
"""A receiver whose standard deviation changes by more than this factor works another way: its error is another."""


@dataclass(frozen=True)
class Memory:
    """What is known of the errors at a time: truth less report, telemetry's seven first, then two a landmark.

    covariance: with the mean, (7 + 2m,) of landmarks `ids` (m,), last seen at `seen_s`. sigma: (7 + 2m,) that they
    have when nothing is known; NaN for what the telemetry has never told.
    """

    time_s: float = float("nan")
    ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    seen_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    mean: np.ndarray = field(default_factory=lambda: np.zeros(7))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((7, 7)))
    sigma: np.ndarray = field(default_factory=lambda: np.full(7, np.nan))

    @property
    def told(self) -> bool:
        """Whether any frame has told anything."""
        return bool(self.mean.any())

    def at(self, time_s: float, prior: Prior, marks: Marks, correlation_s: float) -> "Memory":
        """The same at a later time, with the landmarks that are new."""
        gap_s = time_s - self.time_s
        keeps = float(np.exp(-gap_s / correlation_s)) if correlation_s > 0 and gap_s >= 0 else 0.0
        known = np.flatnonzero(prior.known)
        old_ids = self.ids.tolist()
        staying = [
            row
            for row, identity in enumerate(old_ids)
            if identity in marks.landmark or time_s - self.seen_s[row] <= FORGOTTEN * correlation_s
        ]
        new = [row for row, identity in enumerate(marks.landmark.tolist()) if identity not in old_ids]
        ids = np.concatenate([self.ids[staying], marks.landmark[new]]).astype(np.int64)
        seen_s = np.concatenate([self.seen_s[staying], np.full(len(new), time_s)])
        from_old = np.concatenate([np.arange(7), *(7 + 2 * row + np.arange(2) for row in staying)]).astype(int)
        size, kept = 7 + 2 * len(ids), len(from_old)
        mean, covariance = np.zeros(size), np.zeros((size, size))
        was, sigma = np.full(size, np.nan), np.full(size, np.nan)
        mean[:kept], was[:kept] = self.mean[from_old], self.sigma[from_old]
        covariance[:kept, :kept] = self.covariance[np.ix_(from_old, from_old)]
        sigma[:] = was
        sigma[known] = 1 / np.sqrt(np.diag(prior.information)[known])
        own = places_of(ids, marks.landmark)
        sigma[own] = np.repeat(np.maximum(marks.sigma_m, EXACT_M), 2)
        with np.errstate(invalid="ignore"):
            grown = sigma / was
        # The telemetry's may be a share of the altitude, and grow with it.
        grown[7:] = np.where((grown[7:] < ANOTHER) & (grown[7:] > 1 / ANOTHER), grown[7:], 0.0)
        factor = np.where(np.isfinite(grown), grown, 0.0) * keeps
        filled = np.where(np.isfinite(sigma), sigma, 0.0) * _slow(size)
        was = was * _slow(size)
        mean, covariance = mean * factor, covariance * np.outer(factor, factor)
        # What is new of each: all that it has beyond what it keeps of its standard deviation.
        covariance[np.diag_indices(size)] += filled**2 - (factor * np.where(np.isfinite(was), was, 0.0)) ** 2
        return Memory(time_s, ids, seen_s, mean, covariance, sigma)

    def expected(self, prior: Prior, marks: Marks) -> Expected:
        """What it lets expect of a frame's pose and landmarks; it must be of that frame's time."""
        known, n = np.flatnonzero(prior.known), len(marks)
        ours = np.concatenate([known, places_of(self.ids, marks.landmark)])
        theirs = np.concatenate([known, np.arange(7, 7 + 2 * n)])
        mean, information = np.zeros(7 + 2 * n), np.zeros((7 + 2 * n, 7 + 2 * n))
        mean[theirs] = self.mean[ours]
        inverse = np.linalg.inv(self._seen(ours))
        information[np.ix_(theirs, theirs)] = (inverse + inverse.T) / 2
        return Expected(prior.pose, mean, information, prior.known)

    def after(self, prior: Prior, marks: Marks, used: np.ndarray, solution: Solution) -> "Memory":
        """With what a frame told: of errors that were not looked at too, as far as they go with those that were."""
        known, n = np.flatnonzero(prior.known), len(marks)
        ours = np.concatenate([known, places_of(self.ids, marks.landmark)])
        theirs = np.concatenate([known, np.arange(7, 7 + 2 * n)])
        before = self._seen(ours)
        gain = np.linalg.solve(before, self.covariance[ours]).T
        now = solution.correction_covariance[np.ix_(theirs, theirs)]
        mean = self.mean + gain @ (solution.correction[theirs] - self.mean[ours])
        covariance = self.covariance + gain @ (now - before) @ gain.T
        seen_s = self.seen_s.copy()
        seen_s[np.isin(self.ids, marks.landmark[used])] = self.time_s
        return replace(self, mean=mean, covariance=(covariance + covariance.T) / 2, seen_s=seen_s)

    def anew(self, rows: np.ndarray) -> "Memory":
        """With some of its errors as if nothing were known of them."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[rows] = 0
        covariance[rows] = 0
        covariance[:, rows] = 0
        slow = (self.sigma * _slow(len(mean)))[rows]
        covariance[rows, rows] = np.where(np.isfinite(slow), slow, 0.0) ** 2
        return replace(self, mean=mean, covariance=covariance)

    def _seen(self, rows: np.ndarray) -> np.ndarray:
        """The covariance of errors as a single frame has them: what lasts, and what is new in every frame."""
        sigma = self.sigma[rows]
        return self.covariance[np.ix_(rows, rows)] + np.diag(sigma**2 * (1 - _slow(len(self.mean))[rows] ** 2))


def _slow(size: int) -> np.ndarray:
    """Share of each standard deviation that lasts."""
    share = np.ones(size)
    share[:6] = np.sqrt(1 - JITTER)
    return share


def places_of(ids: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Where the two errors of each wanted landmark stand."""
    row = {identity: 7 + 2 * k for k, identity in enumerate(ids.tolist())}
    return np.array([row[identity] + k for identity in wanted.tolist() for k in (0, 1)], int)
