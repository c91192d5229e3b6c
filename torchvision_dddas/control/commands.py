"""From what was found in a frame to what the instruments are asked to do next."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.control.adjustments import Record
from torchvision_dddas.control.footprint import Stand, inside, looked_at, stand_of
from torchvision_dddas.control.prediction import Memory, Outlook
from torchvision_dddas.control.rules import (
    every_least,
    every_wanted,
    sampled,
)
from torchvision_dddas.control.uav_commands import Follow
from torchvision_dddas.control.ugv_commands import Team
from torchvision_dddas.detection import interval_from_flow, interval_from_telemetry, pixels_per_metre
from torchvision_dddas.types import (
    Adjustment,
    AerialLocations,
    Camera,
    Command,
    Confirmation,
    Flight,
    LandmarkObservations,
    Registration,
)

# Vehicles are given new goals so often at most: what is found is a second old, and they do not turn faster.
_PERIOD_S = 0.2
# After something was lost every frame is looked at for so long.
_ALERT_S = 4.0
# Fewer frames are looked at only when the last change is so long ago.
_CALM_S = 3.0
# A target is lost once so many frames in a row do not show it.
_MISSED = 2
# A registration in which a smaller share of points agrees is weak.
_WEAK = 0.5


class Steering:
    """What was asked of the instruments so far. Feed it located frames in order."""

    def __init__(self, settings: Settings, camera: Camera, rate_hz: float, vehicles: Sequence[str]) -> None:
        """camera: of the aerial vehicle; vehicles: the names of the ground vehicles, as the landmarks have them."""
        self.settings, self.camera, self.rate_hz = settings, camera, rate_hz
        self._memory, self._record = Memory(camera), Record()
        self._follow, self._team = Follow(settings), Team(settings, vehicles)
        self._stand: Stand | None = None
        self._command, self._steered_s = Command(), -np.inf
        self._sampled_s = -np.inf
        self._every, self._before, self._alert_s, self._alert = 1, 0, -np.inf, ""

    def begin(self, flight: Flight | None) -> Command:
        """Before anything is found: as many frames as a walker needs to show at this altitude."""
        parameters = self.settings.steering
        if parameters.on and parameters.sampling and flight is not None and flight.altitude_m > 0:
            self._every = int(np.clip(round(self._least(flight)), 1, parameters.maximum_every))
        self._command = Command(self._every)
        return self._command

    def step(
        self,
        grounded: AerialLocations,
        confirmed: Confirmation | None,
        now_s: float,
        marks: LandmarkObservations,
        flight: Flight | None,
        step: Registration | None = None,
    ) -> tuple[Command, tuple[Adjustment, ...]]:
        """What the instruments are asked to do after a frame was located, and what of it is new, with its causes.

        confirmed: row = that of grounded.positions. now_s: of the newest frame read; the located one is older. marks,
        flight: what ground vehicles and the aerial vehicle report now, in local metres, altitude above up = 0; None
        while silent. step: how the background moved up to the located frame. Places in the command are local metres.
        """
        parameters = self.settings.steering
        if not parameters.on:
            return Command(), ()
        self._record.begin(grounded.frame)
        now_s = max(now_s, grounded.time_s)
        outlook = self._memory.step(grounded, confirmed, now_s)
        self._stand = stand_of(flight, grounded.fix, self._stand, self.camera)
        if parameters.sampling:
            self._sample(grounded, outlook, now_s, flight, step)
        if now_s - self._steered_s < _PERIOD_S - 1e-6:
            orders = tuple(replace(order, picture=False) for order in self._command.orders)
            self._command = replace(self._command, every=self._every, orders=orders)
            return self._command, self._record.made()
        self._steered_s = now_s
        team_m = self._team.hear(marks, now_s, self._record)
        if parameters.follow:
            at = looked_at(flight, grounded.fix, self._stand) if self._stand is not None else None
            self._follow.step(outlook, team_m, self._stand, at, now_s, self._record)
        orders = ()
        if parameters.look:
            orders = self._team.orders(outlook, self._follow.rows(outlook), self._aloft(), now_s, self._record)
        look_at = self._follow.look_at
        self._command = Command(self._every, self._fly_to(look_at), look_at, self._follow.altitude_m, orders)
        return self._command, self._record.made()

    def _least(self, flight: Flight) -> float:
        """Of how many frames one shows a walker at this altitude."""
        scale = pixels_per_metre(flight.altitude_m, self.camera.focal_px[0])
        return every_least(scale, self.rate_hz, self.settings.steering)

    def _aloft(self) -> Stand | None:
        """How the aerial camera is carried at the altitude at which it was asked to be."""
        if self._stand is None or self._follow.altitude_m is None:
            return self._stand
        return replace(self._stand, altitude_m=self._follow.altitude_m)

    def _fly_to(self, look_at: np.ndarray | None) -> np.ndarray | None:
        """The ground below the aerial vehicle when it looks there as it is carried."""
        stand = self._aloft()
        return None if look_at is None or stand is None else stand.pose(look_at, stand.altitude_m).place_m[:2]

    def _sample(
        self,
        grounded: AerialLocations,
        outlook: Outlook,
        now_s: float,
        flight: Flight | None,
        step: Registration | None,
    ) -> None:
        """Of how many frames one is wanted."""
        frame, parameters, interval = grounded.frame, self.settings.steering, self.settings.interval
        between, self._before = max(frame - self._before, 1), frame
        lost = np.flatnonzero(outlook.wanted & (outlook.missed == _MISSED))
        if grounded.fix.pose is not None and len(lost):  # what has left the picture is not lost
            lost = lost[inside(outlook.east_north_m[lost], grounded.fix.pose, self.camera) > 0]
        if len(lost):
            self._alert_s, self._alert = now_s + _ALERT_S, f"target {outlook.target[lost[0]]} was lost"
        elif step is not None and (not step.reliable or step.inliers < _WEAK * step.tracked):
            self._alert_s = now_s + _ALERT_S
            self._alert = f"weak registration: {step.inliers} of {step.tracked} points agree"
        wanted, why = 1.0, self._alert
        if now_s >= self._alert_s:
            if flight is not None and np.isfinite([flight.altitude_m, flight.speed_m_s]).all():
                wanted = interval_from_telemetry(flight.altitude_m, flight.speed_m_s, self.rate_hz, interval)
                why = f"altitude {flight.altitude_m:.1f} m, speed {flight.speed_m_s:.1f} m/s"
            elif step is not None and step.reliable:
                wanted = interval_from_flow([step.flow_px / between], self.camera.size_px[0], interval)
                why = f"background flow {step.flow_px / between:.2f} px a frame"
            else:
                return
            # One that is missed for a moment goes on.
            seen = outlook.missed <= _MISSED
            wanted, limit = every_wanted(
                wanted, self.rate_hz, outlook.speed_m_s[seen], 2 * outlook.radius_m[seen], parameters
            )
            why += limit
        if flight is not None and flight.altitude_m > 0:
            wanted = max(wanted, self._least(flight))
        every, made = sampled(frame, self._every, wanted, why, parameters)
        if every > self._every and now_s - self._sampled_s < _CALM_S:
            return
        if made:
            self._every, self._sampled_s = every, now_s
        self._record.add(made)
