"""Size and speed gates: bounds in metres on the ground, in pixels at an altitude (appendix A, baseline of appendix B).

A camera that looks straight down sees a metre as focal / altitude pixels; obliquely the far side of the picture is
smaller, so the bounds are meant wide.
"""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.config import GateParameters


@dataclass(frozen=True)
class Gates:
    """What a target may measure: longer side of its box in pixels, speed in pixels a frame over the background."""

    min_size_px: float
    max_size_px: float
    max_speed_px: float

    def admit(self, width_px: float, height_px: float, velocity_px: np.ndarray) -> bool:
        """Whether a target of this box and velocity passes. An unknown (NaN) velocity passes."""
        size, speed = max(width_px, height_px), float(np.hypot(*velocity_px))
        return self.min_size_px <= size <= self.max_size_px and not speed > self.max_speed_px


def pixels_per_metre(altitude_m: float, focal_px: float) -> float:
    """Scale of the ground straight below. An altitude below 1 m counts as 1 m: the bounds stay finite on landing."""
    return focal_px / max(altitude_m, 1.0)


def gates_at(altitude_m: float, rate_hz: float, parameters: GateParameters) -> Gates:
    """The gates at an altitude above ground; rate_hz: frames a second."""
    scale = pixels_per_metre(altitude_m, parameters.focal_px)
    return Gates(
        parameters.min_size_m * scale, parameters.max_size_m * scale, parameters.max_speed_m_s * scale / rate_hz
    )
