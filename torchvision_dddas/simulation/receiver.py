"""What satellite receivers say of their places: errors that last, errors that are new each time."""

import numpy as np

SIGMAS_95 = 2.4477
"""Radius that holds 95 % of a circular normal distribution, in standard deviations along each axis."""


class Receivers:
    """The errors of K receivers, from one report to the next.

    Of the variance, white_share is new in each report. The rest is a Gauss-Markov process: it lasts for about
    correlation_s and starts as it goes on. On top of that all share one more, of standard deviation common_m.
    """

    def __init__(
        self,
        count: int,
        error95_m: float,
        white_share: float,
        correlation_s: float,
        common_m: float,
        rng: np.random.Generator,
    ) -> None:
        self.sigma_m = error95_m / SIGMAS_95
        self._white = self.sigma_m * np.sqrt(white_share)
        self._slow = self.sigma_m * np.sqrt(1 - white_share)
        self._correlation_s, self._common, self._rng = correlation_s, common_m, rng
        # The last row is what all share.
        self._state = rng.standard_normal((count + 1, 2))
        self._new = rng.standard_normal((count, 2))

    def advance(self, seconds: float) -> None:
        """On to the next report, so much later."""
        kept = np.exp(-seconds / self._correlation_s)
        self._state = kept * self._state + np.sqrt(1 - kept**2) * self._rng.standard_normal(self._state.shape)
        self._new = self._rng.standard_normal(self._new.shape)

    @property
    def lasting_m(self) -> np.ndarray:
        """(K, 2) east, north: the part of the errors that the next report still has, what all share included."""
        return self._slow * self._state[:-1] + self._common * self._state[-1]

    @property
    def error_m(self) -> np.ndarray:
        """(K, 2) east, north: the errors of this report."""
        return self.lasting_m + self._white * self._new
