"""The size of people in the picture according to telemetry, and the settings for pictures of tiny people."""

import math

from torchvision_dddas.types import Flight

BODY_M = 1.7, 0.5
"""Height and width of a person."""

TINY: dict[str, object] = {
    # People are as small as the texture of the ground, so no kernel may be wider than a person.
    "difference.noise_levels": 3.0,
    "difference.threshold": 2.0,
    "difference.peak": 3.0,
    "difference.blur_px": 3,
    "difference.gradient_share": 0.2,
    "morphology.erode_px": 1,
    # People who walk together become one target.
    "morphology.close_m": 1.5,
    # A crowd does not move as one body, so an outline refined by motion would lose most of it.
    "refine.on": False,
}
"""Detection parameters for pictures in which people are smaller than `gates.tiny_px`."""


def pixels_per_metre(distance_m: float, focal_px: float) -> float:
    """Return the scale, px a metre, at a distance. Distances below 1 m count as 1 m, so that the scale stays finite."""
    return focal_px / max(distance_m, 1.0)


def person_px(flight: Flight, focal_px: float) -> float:
    """Return the side, px, of a square with the same picture area as a person in the picture's centre.

    A camera that looks straight down sees only the shoulders. An unknown pitch counts as straight down.
    """
    pitch = flight.pitch_rad if math.isfinite(flight.pitch_rad) else math.pi / 2
    height_m, width_m = BODY_M
    length_m = height_m * abs(math.cos(pitch)) + width_m * abs(math.sin(pitch))
    return math.sqrt(length_m * width_m) * pixels_per_metre(flight.distance_m, focal_px)
