"""Centroids and velocities of crowds from the people that ground vehicles see (appendix A, III-B).

The source averages the positions of the people that a vehicle sees, to predict where the crowd will be. Here the looks
of several vehicles at several times are combined. A vehicle sees the people on its side of a crowd, and its receiver
has an error; both shift the means of all its looks by the same amount. Therefore each vehicle has its own mean, and all
share one velocity, which is fitted by least squares. The centroid is the mean of the vehicles' means, extrapolated to
the current time.
"""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.types import Float, GroundCrowds, Int

# Looks up to this age are used. Vehicles take pictures of targets that are sure every 5 s.
_MEMORY_S = 6.0
# A velocity is fitted if the squared times of the looks, relative to each vehicle's mean time, sum to at least this.
_LEAST_S2 = 2.0


@dataclass(frozen=True)
class _CrowdLook:
    """The people of one crowd in one picture. place_m: (2,) their mean position. people: their number."""

    time_s: float
    vehicle: str
    place_m: np.ndarray
    people: int


class CrowdLooks:
    """The looks of the last seconds, by target. Add pictures in order of their frames."""

    def __init__(self) -> None:
        self._looks: dict[int, list[_CrowdLook]] = {}

    def add(self, time_s: float, vehicle: str, target: Int[np.ndarray, "M"], place_m: Float[np.ndarray, "M 2"]) -> None:
        """Add a picture. target: (M,) the target of each person, below 1 for none. place_m: (M, 2) their positions."""
        for name in np.unique(target[target > 0]).tolist():
            mine = place_m[target == name]
            self._looks.setdefault(name, []).append(_CrowdLook(time_s, vehicle, mine.mean(axis=0), len(mine)))

    def crowds(self, time_s: float) -> GroundCrowds:
        """Return the crowds that were seen in a picture added at this time."""
        self._looks = {
            name: looks
            for name, all_looks in self._looks.items()
            if (looks := [look for look in all_looks if time_s - look.time_s <= _MEMORY_S])
        }
        seen = {name: looks for name, looks in self._looks.items() if looks[-1].time_s == time_s}
        states = [_centroid_and_velocity(looks, time_s) for looks in seen.values()]
        now = [[look for look in looks if look.time_s == time_s] for looks in seen.values()]
        return GroundCrowds(
            np.array(list(seen), np.int64),
            np.array([place for place, _ in states]).reshape(-1, 2),
            np.array([velocity for _, velocity in states]).reshape(-1, 2),
            np.array([max(look.people for look in looks) for looks in now], np.int64),
            np.array([";".join(look.vehicle for look in looks) for looks in now], object),
        )


def _centroid_and_velocity(looks: list[_CrowdLook], time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a crowd's centroid (2,) and velocity (2,). If the velocity is unknown (NaN), use the last second only."""
    names = sorted({look.vehicle for look in looks})
    by_vehicle = [[look for look in looks if look.vehicle == name] for name in names]
    since = [np.array([look.time_s - time_s for look in own]) for own in by_vehicle]
    place = [np.array([look.place_m for look in own]) for own in by_vehicle]
    apart = [times - times.mean() for times in since]
    spread = sum(float(times @ times) for times in apart)
    if spread < _LEAST_S2:
        recent = [own[times >= -1.0].mean(axis=0) for own, times in zip(place, since, strict=True) if times[-1] >= -1.0]
        return np.mean(recent, axis=0), np.full(2, np.nan)
    velocity = np.sum([times @ own for times, own in zip(apart, place, strict=True)], axis=0) / spread
    means = [own.mean(axis=0) - times.mean() * velocity for own, times in zip(place, since, strict=True)]
    return np.mean(means, axis=0), velocity
