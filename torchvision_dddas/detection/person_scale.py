"""The size of people and vehicles in the picture according to telemetry, and the settings for tiny people."""

import math
from typing import Any

import numpy as np

from torchvision_dddas.types import Flight, ground_distance

BODY_M = 1.7, 0.5
"""Height and width of a person."""

# The box of a person is this many times as large as the body that `person_px` computes, because limbs and motion widen
# it. The side of a vehicle is the root of its box's area, in metres, from a motorcycle to a truck.
_PERSON_SIDES, _VEHICLE_SIDES_M = (1.0, 1.5), (2.0, 4.5)
# Spread of the logarithm of a side around these ranges. A size that fits neither costs at most _MISFIT of _FIT.
_SIDE_SPREAD, _MISFIT = 0.3, 2.0
# Log odds of a person's size. A vehicle's size counts 0, because large boxes also show groups of people, trees and
# buildings. Thermal clips alone would give 1.5 to 2, simulated flights 0.8 to 1.
_FIT = 1.0

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
    # The people of a crowd do not move as one body, so an outline refined by motion would lose most of it.
    "refine.on": False,
}
"""Detection parameters for pictures in which people are smaller than `gates.tiny_px`."""


def pixels_per_metre(distance_m: Any, focal_px: float) -> Any:
    """Return the scale, px a metre, at distances. Distances below 1 m count as 1 m, so that the scale stays finite."""
    return focal_px / np.maximum(distance_m, 1.0)


def person_px(flight: Flight, focal_px: float) -> float:
    """Return the side, px, of a square with the same picture area as a person in the picture's centre.

    A camera that looks straight down sees only the shoulders. An unknown pitch counts as straight down.
    """
    pitch = flight.pitch_rad if math.isfinite(flight.pitch_rad) else math.pi / 2
    return float(np.sqrt(_seen_length(pitch) * BODY_M[1]) * pixels_per_metre(flight.distance_m, focal_px))


def score_size(box_px: np.ndarray, flight: Flight, focal_px: float, height_px: int) -> np.ndarray:
    """Return (N,) log odds from the sizes of boxes (N, 4): above 0 for people, 0 for vehicles, below 0 for neither.

    The distance is that of level ground at the foot of each box. height_px: height of the picture.
    """
    pitch = flight.pitch_rad if math.isfinite(flight.pitch_rad) else math.pi / 2
    below_axis = np.arctan((box_px[:, 1] + box_px[:, 3] - height_px / 2) / focal_px)
    below_horizon = pitch + below_axis
    metre = pixels_per_metre(ground_distance(flight.altitude_m, below_horizon) * np.cos(below_axis), focal_px)
    body = metre * np.sqrt(_seen_length(below_horizon) * BODY_M[1])
    side = np.sqrt(box_px[:, 2] * box_px[:, 3])

    def fit(unit: np.ndarray, least: float, most: float) -> np.ndarray:
        away = np.maximum(np.log(least * unit / side), np.log(side / (most * unit))).clip(min=0)
        return -np.minimum((away / _SIDE_SPREAD) ** 2 / 2, _MISFIT)

    return _FIT * np.maximum(1 + fit(body, *_PERSON_SIDES), fit(metre, *_VEHICLE_SIDES_M))


def _seen_length(below_horizon: Any) -> Any:
    """Return the length, m, of a standing person across a line of sight at an angle (N,) below the horizon."""
    return BODY_M[0] * np.abs(np.cos(below_horizon)) + BODY_M[1] * np.abs(np.sin(below_horizon))
