"""Control the detection interval by telemetry or by the background flow."""

from collections import deque

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.detection.frame_buffer import FrameBuffer, Slot
from torchvision_dddas.detection.interval import (
    adjust_interval,
    describe_distance,
    follow_distance,
    interval_from_flow,
    interval_from_telemetry,
    look_cost,
    settings_at,
)
from torchvision_dddas.types import Flight, Telemetry


class IntervalController:
    """Chooses each frame's detection interval, and the settings for its distance to the ground.

    telemetry: may be replaced between two frames. interval, distance: the current interval and distance settings.
    """

    def __init__(self, settings: Settings, rate_hz: float, telemetry: Telemetry | None) -> None:
        self.settings, self.rate_hz, self.telemetry = settings, rate_hz, telemetry
        self.interval, self.distance = settings.interval.frames, settings_at(None, rate_hz, settings)
        self._flows: deque[float] = deque(maxlen=settings.interval.memory_frames)
        self._costs: deque[float] = deque(maxlen=settings.interval.memory_frames)  # computing time of looks, s

    def change_settings(self, settings: Settings) -> None:
        """Use other settings from now on."""
        self.settings, self.distance = settings, settings_at(self.distance.flight, self.rate_hz, settings)

    def add_cost(self, slot: Slot) -> None:
        """Record the computing time of a look."""
        self._costs.append(sum(slot.seconds.values()))

    def steer(self, buffer: FrameBuffer, index: int) -> None:
        """Set the interval and the settings of a frame, and record the changes in its slot."""
        slot = buffer[index]
        flight = None if self.telemetry is None else self.telemetry.at(slot.frame.time_s)
        # A log may have only the altitude or only the speed, or a gap in time. An altitude of 0 or less, as on the
        # ground or below the take-off place, does not give the distance to the ground in view.
        high = flight if flight is not None and flight.altitude_m > 0 else None
        number = slot.frame.number
        self.distance, moved = follow_distance(number, self.distance, high, self.rate_hz, self.settings)
        slot.adjustments += moved
        slot.distance = self.distance
        if slot.step is not None and slot.step.reliable:
            self._flows.append(slot.step.flow_px / (buffer[index + 1].passed + 1))
        wanted, cause = self._wanted_interval(slot, high)
        if wanted is not None:
            wanted /= slot.passed + 1
            if left := slot.passed:
                cause += f", {left} frame{'s' * (left > 1)} before it dropped or skipped"
                cause += " or repeated" * (left > slot.frame.skipped)
            _, measured = look_cost(self._costs, self.settings.interval)
            used = self.distance.settings
            self.interval, moved = adjust_interval(number, self.interval, wanted, cause + measured, used)
            slot.adjustments += moved
        slot.interval = self.interval

    def _wanted_interval(self, slot: Slot, high: Flight | None) -> tuple[float | None, str]:
        """Return the interval by the rule (appendix B, eq. 2) and its cause; None if the rule is off or lacks input."""
        parameters = self.settings.interval
        cost, _ = look_cost(self._costs, parameters)
        if not parameters.rule:
            return None, ""
        if high is not None and np.isfinite(high.speed_m_s):
            wanted = interval_from_telemetry(high.distance_m, high.speed_m_s, self.rate_hz, cost, parameters)
            return wanted, f"{describe_distance(high)}, speed {high.speed_m_s:.1f} m/s"
        if self._flows and parameters.reference_flow:
            wanted = interval_from_flow(self._flows, slot.view.size[0], cost, parameters)
            return wanted, f"background flow {np.median(self._flows):.2f} px a frame"
        return None, ""
