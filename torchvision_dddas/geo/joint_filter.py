"""Estimate places, velocities and body heights of all targets and each platform's slow errors in one Kalman filter.

The errors of a platform are its position, heading, tilt, height and focal length. A receiver's error is thus learned
from the targets that its platform shares with others, and is not counted again with each measurement. Measurements are
linear in this state, as `ranging` and `Fix` give them. Targets move straight on with random accelerations.

Within the filter the position of a platform is nearly free: shared targets show how far platforms are apart, but not
which of them is right. For each result this is decided anew from the errors that each platform states, under a Student
t distribution: a platform far from the agreement of the others gets less weight (expectation maximization). This
replaces the source's choice of the best platform by its history.

Source: appendix A, VI (future work), names the idea. Persistent errors are Gauss-Markov processes of the first order.
"""

import math
from itertools import pairwise

import numpy as np

from torchvision_dddas.config import FusionParameters
from torchvision_dddas.types import Sightings

# The state of a target: east, north, their velocities, and the body height in standard deviations.
SIZE, PLACE, _HEIGHT = 5, np.arange(2), 4
# Standard deviation of a platform's position within the filter, as a multiple of the stated deviation.
_FREE = 30.0
_FASTEST_M_S = 10.0  # standard deviation of a new target's velocity
_ROUNDS = 15  # iterations of the platforms' weights
_ESTIMATED = 3  # number of estimated errors of a platform: position and heading


class JointFilter:
    """The joint state at a time: the values of the targets, then the values of the platforms' errors."""

    def __init__(self, parameters: FusionParameters) -> None:
        self.time_s, self.targets = -math.inf, 0
        self.state, self.spread = np.zeros(0), np.zeros((0, 0))
        self.platforms: dict[str, int] = {}  # number of errors of each platform
        self.sigma_m: dict[str, np.ndarray] = {}  # (2, 2), effect of one sigma of the platform's position
        self._parameters = parameters

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return state and covariance with positions as the platforms state them, and each platform's weight."""
        rows, nu = self.positions, self._parameters.freedom
        own, weight = self.spread[np.ix_(rows, rows)], np.ones(len(rows) // 2)
        information = np.linalg.inv(own)
        for _ in range(_ROUNDS if len(weight) > 1 else 0):
            covariance = np.linalg.inv(information + np.diag(np.repeat(weight, 2)))
            squares = (covariance @ information @ self.state[rows]) ** 2 + covariance.diagonal()
            weight = (nu + 2) / (nu + squares.reshape(-1, 2).sum(axis=1))
        gain = self.spread[:, rows] @ np.linalg.inv(own + np.diag(np.repeat(1 / weight, 2)))
        return self.state - gain @ self.state[rows], self.spread - gain @ self.spread[rows], weight

    def place_rows(self, targets: np.ndarray) -> np.ndarray:
        """Return the (K, 2) rows of the targets' places in the state; their velocities are two rows further."""
        rows: np.ndarray = SIZE * np.asarray(targets, np.int64)[:, None] + PLACE
        return rows

    @property
    def positions(self) -> np.ndarray:
        """(2 P,) rows of the platforms' positions in the state."""
        return (self._starts()[:-1, None] + PLACE).ravel()

    def errors_of(self, platform: str) -> np.ndarray:
        """Return the rows of a platform's errors in the state, then the rows of errors new in the current record."""
        starts = self._starts()
        own = starts[list(self.platforms).index(platform)] + np.arange(self.platforms[platform])
        return np.r_[own, starts[-1] : len(self.state)]

    def _starts(self) -> np.ndarray:
        """Return the (P + 1,) first rows of each platform's errors, and the row after the last."""
        return np.cumsum([SIZE * self.targets, *self.platforms.values()])

    def predict(self, time_s: float) -> None:
        """Predict the state to a time."""
        lapse, parameters = time_s - self.time_s, self._parameters
        self.time_s = time_s
        if not 0 < lapse < math.inf:
            return
        end, place = SIZE * self.targets, self.place_rows(np.arange(self.targets)).ravel()
        speed, state, spread = place + 2, self.state, self.spread
        state[place] += lapse * state[speed]
        spread[place] += lapse * spread[speed]
        spread[:, place] += lapse * spread[:, speed]
        # People walk together: half of the variance of an acceleration is common to all targets.
        together = (np.eye(self.targets) + 1) / 2
        drive = np.kron(parameters.acceleration_m_s2**2 * together, np.eye(2))
        for rows, columns, share in (
            (place, place, lapse**3 / 3),
            (speed, speed, lapse),
            (place, speed, lapse**2 / 2),
            (speed, place, lapse**2 / 2),
        ):
            spread[np.ix_(rows, columns)] += share * drive
        keep = np.full(len(state) - end, math.exp(-lapse / parameters.angle_s))
        fresh = np.full(len(keep), 1 - math.exp(-2 * lapse / parameters.angle_s))
        keep[self.positions - end], fresh[self.positions - end] = 1.0, 2 * lapse / parameters.position_s
        state[end:] *= keep
        spread[end:] *= keep[:, None]
        spread[:, end:] *= keep
        spread[np.arange(end, len(state)), np.arange(end, len(state))] += fresh

    def begin_record(self, platform: str, seen: Sightings) -> None:
        """Make room for the errors of a new platform, and for the errors that are new in this record."""
        count = seen.camera_m.shape[2]
        if platform not in self.platforms:
            self._grow(len(self.state), np.zeros(count), np.diag([_FREE**2] * 2 + [1.0] * (count - 2)))
            self.platforms[platform], self.sigma_m[platform] = count, np.zeros((2, 2))
        if len(seen):
            self.sigma_m[platform] = seen.camera_m[:, :, :2].mean(axis=0)
        self._grow(len(self.state), np.zeros(count), self._parameters.white_share * np.eye(count))

    def end_record(self) -> None:
        """Remove the errors that were new in this record."""
        end = self._starts()[-1]
        self.state, self.spread = self.state[:end], self.spread[:end, :end]

    def correct(self, platform: str, targets: np.ndarray, seen: Sightings) -> None:
        """Correct the state by sightings of known targets."""
        count, by_errors, errors = len(seen), np.tile(seen.camera_m, 2), self.errors_of(platform)
        place, heights = self.place_rows(targets), SIZE * targets + _HEIGHT

        def design(numbers: np.ndarray) -> np.ndarray:
            """Return (2 K, ...) the measurements predicted from numbers of the state."""
            flat = numbers.reshape(len(numbers), -1)
            found = flat[place] + by_errors @ flat[errors] + seen.body_m[:, :, None] * flat[heights][:, None]
            return found.reshape(2 * count, *numbers.shape[1:])

        by_state = design(self.spread)
        joint = design(by_state.T)
        own = np.arange(2 * count).reshape(count, 2)
        joint[own[:, :, None], own[:, None]] += seen.own_m2
        self._condition(by_state, joint, seen.east_north_m.ravel() - design(self.state))

    def unite(self, first: int, second: int) -> None:
        """Constrain two targets to the same place and velocity."""
        one, other = SIZE * first + np.arange(4), SIZE * second + np.arange(4)
        by_state = self.spread[one] - self.spread[other]
        joint = by_state[:, one] - by_state[:, other] + 1e-6 * np.eye(4)
        self._condition(by_state, joint, self.state[other] - self.state[one])

    def _condition(self, by_state: np.ndarray, joint: np.ndarray, residual: np.ndarray, for_now: bool = False) -> None:
        """Condition the state on linear measurements. by_state: covariance with the state. joint: their covariance."""
        gain = np.linalg.solve(joint, by_state).T
        considered = self._considered()
        gain[considered] = 0.0
        self.state = self.state + gain @ residual
        spread = self.spread - gain @ by_state
        spread[considered] = spread[:, considered].T
        self.spread = (spread + spread.T) / 2

    def _considered(self) -> np.ndarray:
        """Return the rows of numbers that are not estimated but whose uncertainty counts.

        These are body heights, tilts, camera heights and scales. Their effect grows with the distance from the camera,
        as the measurement error does. A filter that estimated them would in the long run find false scales (Schmidt,
        1966).
        """
        starts = self._starts().tolist()
        errors = [np.arange(start + _ESTIMATED, end) for start, end in pairwise(starts)]
        return np.concatenate([SIZE * np.arange(self.targets) + _HEIGHT, *errors])

    def add(self, platform: str, seen: Sightings) -> None:
        """Add new targets for sightings; their covariance includes the platform's errors."""
        count, errors = len(seen), self.errors_of(platform)
        by_errors = np.tile(seen.camera_m, 2)
        new = SIZE * np.arange(count)
        state, own = np.zeros(SIZE * count), np.zeros((SIZE * count, SIZE * count))
        cross = np.zeros((SIZE * count, len(self.state)))
        place = (new[:, None] + PLACE).ravel()
        state[place] = (seen.east_north_m - by_errors @ self.state[errors]).ravel()
        cross[place] = -(by_errors @ self.spread[errors]).reshape(2 * count, len(self.state))
        own[np.ix_(place, place)] = -(by_errors @ cross[place].T[errors]).reshape(2 * count, 2 * count)
        for k, first in enumerate(new.tolist()):
            body, at = seen.body_m[k], slice(first, first + 2)
            own[at, at] += seen.own_m2[k] + np.outer(body, body)
            own[first + 2, first + 2] = own[first + 3, first + 3] = _FASTEST_M_S**2
            own[first + _HEIGHT, first + _HEIGHT] = 1.0
            own[first + _HEIGHT, at] = own[at, first + _HEIGHT] = -body
        self._grow(SIZE * self.targets, state, own, cross)
        self.targets += count

    def drop(self, targets: list[int]) -> None:
        """Remove targets."""
        rows = (SIZE * np.array(targets, np.int64)[:, None] + np.arange(SIZE)).ravel()
        kept = np.delete(np.arange(len(self.state)), rows)
        self.state, self.spread = self.state[kept], self.spread[np.ix_(kept, kept)]
        self.targets -= len(targets)

    def _grow(self, at: int, state: np.ndarray, own: np.ndarray, cross: np.ndarray | None = None) -> None:
        """Insert numbers into the state at row `at`. cross: (k, n) their covariance with the present numbers."""
        n, k = len(self.state), len(state)
        old, new = np.r_[:at, at + k : n + k], np.arange(at, at + k)
        spread = np.zeros((n + k, n + k))
        spread[np.ix_(old, old)], spread[np.ix_(new, new)] = self.spread, own
        if cross is not None:
            spread[np.ix_(new, old)], spread[np.ix_(old, new)] = cross, cross.T
        self.state, self.spread = np.insert(self.state, at, state), spread
