"""Fuse the measurements of all platforms over time into one state in metres for each target."""

import bisect
import math
from copy import deepcopy
from dataclasses import replace

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, check_settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.ground_locator import gate_distance
from torchvision_dddas.geo.measurements import Measurement, aerial_sightings
from torchvision_dddas.geo.shared_targets import SharedTargets
from torchvision_dddas.types import AerialLocations, FusedTargets, GroundLocations, Sightings


class TargetFusion:
    """Fuse the measurements of several platforms, each at its own times, into one state for each target.

    >>> camera = td.Camera("ugv1", (640, 480), (500.0, 500.0), (319.5, 239.5), height_m=1.2)
    >>> people = td.People(np.array([[309.5, 240, 20, 60]]), np.ones(1), np.ones(1), np.array([False]))
    >>> fusion = td.TargetFusion()
    >>> final = fusion.update(td.GroundLocator(camera).locate(people), "ugv1", time_s=0.0)
    >>> len(final), fusion.now().by, len(fusion.flush())
    (0, 'ugv1', 1)
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        delay_s: float | None = None,
        origin_deg: tuple[float, float] | None = None,
    ) -> None:
        """delay_s: overrides `fusion.delay_s`; 0 if measurements arrive in order.

        origin_deg: longitude and latitude of the local metres of results; None: taken from the first measurement.
        Raise InputError for a delay below 0.
        """
        self.settings = check_settings(settings)
        self.delay_s = self.settings.fusion.delay_s if delay_s is None else delay_s
        if not self.delay_s >= 0:
            raise InputError(f"delay_s must be 0 or more, got {delay_s}")
        self.origin_deg, self._begun = origin_deg, origin_deg is not None
        self.late = 0
        self._targets = SharedTargets(self.settings.fusion, gate_distance(self.settings.ground.gate_sigmas))
        self._waiting: list[Measurement] = []

    def update(
        self,
        located: AerialLocations | GroundLocations,
        platform: str,
        *,
        time_s: float | None = None,
        lasting: bool = True,
    ) -> list[FusedTargets]:
        """Add the targets that a platform located, and return a result for each measurement that is now final.

        time_s: time of GroundLocations, by the aerial platforms' clock. lasting: whether the numbers of targets are
        identities. Targets without a place are left out. Raise InputError for another type, a missing time, several
        cameras in one record, or a mix of local metres without an origin and longitude and latitude.
        """
        found = self._measurement(located, platform, time_s, lasting)
        if found.time_s < self._targets.filter.time_s:
            self.late += 1
            return []
        bisect.insort(self._waiting, found, key=lambda one: one.time_s)
        return self._settle(self._waiting[-1].time_s - self.delay_s)

    def flush(self) -> list[FusedTargets]:
        """Return the results of all measurements that still wait."""
        return self._settle(math.inf)

    def now(self) -> FusedTargets | None:
        """Return the targets by all measurements so far; None before the first."""
        if not self._waiting:
            return self._targets.result
        targets = deepcopy(self._targets)
        return [targets.step(one, self.origin_deg) for one in self._waiting][-1]

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each platform's position: 1 by its own stated error, less if it disagrees with the others."""
        known = self._targets.filter
        return dict(zip(known.platforms, known.read()[2].tolist(), strict=True))

    @property
    def offsets_m(self) -> dict[str, tuple[float, float]]:
        """Estimated east and north error of each platform's position, from all platforms together."""
        known = self._targets.filter
        off = known.read()[0][known.positions].reshape(-1, 2)
        offsets = ((known.sigma_m[name] @ row).tolist() for name, row in zip(known.platforms, off, strict=True))
        return {name: (east, north) for name, (east, north) in zip(known.platforms, offsets, strict=True)}

    def _settle(self, until_s: float) -> list[FusedTargets]:
        count = bisect.bisect_right(self._waiting, until_s, key=lambda one: one.time_s)
        ready, self._waiting = self._waiting[:count], self._waiting[count:]
        return [self._targets.step(one, self.origin_deg) for one in ready]

    def _measurement(
        self, located: AerialLocations | GroundLocations, platform: str, time_s: float | None, lasting: bool
    ) -> Measurement:
        pose = root = None
        if isinstance(located, AerialLocations):
            when = located.time_s if time_s is None else time_s
            seen, pose, root = aerial_sightings(located)
            number, score, label = located.positions.target, located.positions.score, located.positions.label
        elif isinstance(located, GroundLocations):
            if len(set(located.vehicle.tolist())) > 1:
                raise InputError("one record holds several cameras; give a record for each camera")
            seen, number, score = located.sightings, located.target, located.score
            label, when = np.full(len(seen), "person", object), math.nan if time_s is None else time_s
        else:
            raise InputError(f"TargetFusion expects AerialLocations or GroundLocations, got {type(located).__name__}")
        if not math.isfinite(when):
            raise InputError(f"the measurement of {platform} has no time; give time_s")
        placed = np.isfinite(seen.east_north_m).all(axis=1)
        seen, number, score, label = seen[placed], number[placed], score[placed], label[placed]
        there, seen = seen, self._in_common_metres(seen, located.positions.origin_deg, platform)
        if pose is not None and len(seen):
            shift = (seen.east_north_m - there.east_north_m).mean(axis=0)
            pose = replace(pose, place_m=pose.place_m + np.r_[shift, 0.0])
        unknown = ~np.isfinite(seen.own_m2).all(axis=(1, 2))
        own = np.where(unknown[:, None, None], self.settings.confirm.unknown_sigma_m**2 * np.eye(2), seen.own_m2)
        seen = replace(seen, own_m2=own, body_m=np.nan_to_num(seen.body_m), camera_m=np.nan_to_num(seen.camera_m))
        number = np.where(lasting, number, -1)
        return Measurement(when, located.frame, platform, seen, number, score, label, pose, root)

    def _in_common_metres(self, seen: Sightings, origin_deg: tuple[float, float] | None, platform: str) -> Sightings:
        if not self._begun:
            self._begun, self.origin_deg = True, origin_deg
        if (origin_deg is None) != (self.origin_deg is None):
            raise InputError(
                f"{platform} has places {'in local metres' if origin_deg is None else 'in longitude and latitude'}, "
                "but the earlier platform has not; give all in the same kind"
            )
        if origin_deg is None or self.origin_deg is None or origin_deg == self.origin_deg:
            return seen
        degrees = geometry.lonlat(seen.east_north_m, origin_deg)
        return replace(seen, east_north_m=geometry.east_north(degrees, self.origin_deg))
