"""The feedback rules: how what was found steers the knobs."""

from collections.abc import Sequence

import numpy as np

from torchvision_dddas.settings import IntervalKnobs
from torchvision_dddas.types import Adjustment


def interval_from_telemetry(altitude_m: float, speed_m_s: float, rate_hz: float, knobs: IntervalKnobs) -> float:
    """The detection interval in frames before rounding and bounds: (A / 20) (5 / S) (R / 10) O.

    Source: appendix B, eq. 2, calibrated as METHOD.md section 1 says; the speed has a floor so that hovering is finite.
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
