"""The feedback rules: how what was found steers the knobs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.settings import IntervalKnobs, Settings, with_knobs
from torchvision_dddas.targets.gates import Gates, gates_at, pixels_per_metre
from torchvision_dddas.types import Adjustment

# A change of altitude by this share moves the gates: less is not worth a line in the record.
_ALTITUDE_STEP = 0.2


def interval_from_telemetry(altitude_m: float, speed_m_s: float, rate_hz: float, knobs: IntervalKnobs) -> float:
    """The detection interval in frames before rounding and bounds: (A / 20) (5 / S) (R / 10) O.

    Source: appendix B, eq. 2, calibrated to one frame at 20 m, 5 m/s and 10 Hz; the floor of the speed, which keeps
    hovering finite, is ours.
    """
    speed = max(speed_m_s, knobs.lowest_speed_m_s)
    by_height = altitude_m / knobs.reference_altitude_m * knobs.reference_speed_m_s / speed
    return by_height * rate_hz / knobs.reference_rate_hz * knobs.cost


def interval_from_flow(flows_px: Sequence[float], width: int, knobs: IntervalKnobs) -> float:
    """The same without telemetry: the background's flow is proportional to S / (A R), so its inverse takes their place.

    flows_px: median background flow of the latest steps, pixels a frame. width: of the picture, pixels.
    """
    flow = float(np.median(flows_px)) / width
    return knobs.reference_flow / max(flow, 1e-4) * knobs.cost


def bounded(interval: float, knobs: IntervalKnobs) -> int:
    """Rounded and within the interval's bounds."""
    return int(np.clip(round(min(interval, 1e6)), knobs.minimum_frames, knobs.maximum_frames))


def adjusted(frame: int, now: int, wanted: float, why: str, knobs: IntervalKnobs) -> tuple[int, tuple[Adjustment, ...]]:
    """The interval from here on, and the record of its change, if any.

    A change by one frame waits until the rule is past the middle by a quarter, so that noise does not make it flutter.
    """
    new = bounded(wanted, knobs)
    if new == now or (abs(new - now) == 1 and abs(wanted - now) < 0.75 and knobs.minimum_frames <= now):
        return now, ()
    return new, (Adjustment(frame, "interval.frames", now, new, why),)


@dataclass(frozen=True)
class Regime:
    """What the expected size of a target decides. altitude_m, gates: None where no telemetry tells.

    settings: those given, with the smallest area and the path for small targets chosen for the altitude.
    """

    settings: Settings
    altitude_m: float | None = None
    gates: Gates | None = None

    def values(self) -> dict[str, float]:
        """The numbers in force, by name."""
        gates = self.gates or Gates(0.0, np.inf, np.inf)
        return {
            "gates.min_area_px": self.settings.gates.min_area_px,
            "small.on": float(self.settings.small.on),
            "gates.min_size_px": gates.min_size_px,
            "gates.max_size_px": gates.max_size_px,
            "gates.max_speed_px": gates.max_speed_px,
        }


def regime_at(altitude_m: float, rate_hz: float, base: Settings) -> Regime:
    """The regime for an altitude above ground: e = expected_size_m x focal / altitude pixels is what a target measures.

    The smallest area is expected_share x e^2, between the small path's and the one in the settings. The small path is
    on while e^2 is within its largest box: larger targets show without it.
    """
    gates, small = base.gates, base.small
    square = (gates.expected_size_m * pixels_per_metre(altitude_m, gates.focal_px)) ** 2
    area = int(min(gates.min_area_px, max(small.min_area_px, round(gates.expected_share * square))))
    on = small.on and square <= small.max_box_px
    settings = with_knobs(base, {"gates.min_area_px": area, "small.on": on})
    return Regime(settings, altitude_m, gates_at(altitude_m, rate_hz, gates))


def steered(
    frame: int, now: Regime, altitude_m: float | None, rate_hz: float, base: Settings
) -> tuple[Regime, tuple[Adjustment, ...]]:
    """The regime from here on, and the record of what changed.

    The altitude must have changed by a fifth since the last time, or have become known or unknown.
    """
    if altitude_m is None:
        new, why = Regime(base), "no telemetry for this frame"
        if now.altitude_m is None:
            return now, ()
    else:
        was = now.altitude_m
        if was is not None and abs(altitude_m - was) <= _ALTITUDE_STEP * max(was, 1.0):
            return now, ()
        new, why = regime_at(altitude_m, rate_hz, base), f"altitude {altitude_m:.1f} m"
        why += "" if was is None else f", was {was:.1f} m"
    old = now.values()
    changed = {name: value for name, value in new.values().items() if value != old[name]}
    return new, tuple(Adjustment(frame, name, old[name], value, why) for name, value in changed.items())
