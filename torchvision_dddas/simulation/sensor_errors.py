"""Errors of satellite receivers, lasting and new in each report; and the faults of a scenario."""

from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.simulation.scenario import Fault

SIGMAS_95 = 2.4477  # radius that holds 95 % of a circular normal distribution, in standard deviations along each axis


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
        """Advance to the next report, `seconds` later."""
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


# What goes wrong, when, and its events in words.


_WORDS = {
    "ugv_lost": ("{who} is lost", "{who} is back"),
    "gps_dropout": ("{who} has no GPS", "{who} has GPS again"),
    "gps_jump": ("the GPS of {who} is off by {size:g} m", "the GPS of {who} is as before"),
    "frozen": ("the UAV's camera repeats a picture", "the UAV's camera sees again"),
    "dropped": ("pictures of the UAV are missing", "the UAV's pictures come again"),
    "gust": ("a gust pushes the UAV with {size:g} m/s", "the gust is over"),
    "landmark_hidden": ("the marker of {who} is covered", "the marker of {who} is seen again"),
    "telemetry_silent": ("the UAV says nothing of itself", "the UAV reports again"),
}


@dataclass(frozen=True)
class ActiveFaults:
    """What is wrong at a moment; vehicles by their rows, from 0. jumped: metres, by vehicle."""

    lost: frozenset[int] = frozenset()
    silent: frozenset[int] = frozenset()
    covered: frozenset[int] = frozenset()
    jumped: dict[int, float] = field(default_factory=dict)
    picture: str = ""
    mute: bool = False


class Faults:
    """The faults of a scenario; a fault lasts from its time until, but not at, its end."""

    def __init__(self, faults: tuple[Fault, ...]) -> None:
        self._faults = faults

    def at(self, time_s: float) -> ActiveFaults:
        """What is wrong at a time."""
        now = [fault for fault in self._faults if _on(fault, time_s)]

        def vehicles(what: str) -> frozenset[int]:
            return frozenset(fault.vehicle - 1 for fault in now if fault.what == what)

        kinds = {fault.what for fault in now}
        return ActiveFaults(
            vehicles("ugv_lost"),
            vehicles("gps_dropout"),
            vehicles("landmark_hidden"),
            {fault.vehicle - 1: fault.size for fault in now if fault.what == "gps_jump"},
            "dropped" if "dropped" in kinds else "frozen" if "frozen" in kinds else "",
            "telemetry_silent" in kinds,
        )

    def gusts(self, time_s: float) -> list[tuple[int, float, float]]:
        """(row of the fault, seconds since it began, size) of the gusts that blow."""
        return [
            (row, time_s - fault.time_s, fault.size)
            for row, fault in enumerate(self._faults)
            if fault.what == "gust" and _on(fault, time_s)
        ]

    def events(self, before_s: float, now_s: float) -> list[str]:
        """What began or ended after the one time, and until the other, in words."""
        events = []
        for fault in self._faults:
            who = f"ugv{fault.vehicle}"
            for words, time_s in zip(_WORDS[fault.what], (fault.time_s, fault.time_s + fault.seconds), strict=True):
                if before_s < time_s - _EARLY_S <= now_s:
                    events.append((time_s, words.format(who=who, size=fault.size)))
        return [words for _, words in sorted(events)]


_EARLY_S = 1e-9  # times of frames are rounded; a fault begins at the frame of its time, not one later


def _on(fault: Fault, time_s: float) -> bool:
    return fault.time_s - _EARLY_S <= time_s < fault.time_s + fault.seconds - _EARLY_S
