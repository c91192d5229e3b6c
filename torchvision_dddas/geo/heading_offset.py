"""Estimate the heading error of a log from the motion of the ground in the pictures while the vehicle flies.

The same ground must have the same place in two pictures. A wrong heading turns the direction of the ground's motion
against the vehicle's; wrong pitch, roll and height shift and stretch the motion in other ways, so they are estimated
too, each with the stated standard deviation of the telemetry. A hovering vehicle shows none of these errors.
"""

from collections.abc import Sequence

import numpy as np

from torchvision_dddas.config import AerialParameters
from torchvision_dddas.geo.aerial_locator import AerialLocator
from torchvision_dddas.geometry import axes_of, ground_with_slopes, surface_of, transfer, turned
from torchvision_dddas.types import CameraPose, Flight

# The ground is compared over stretches of this length, at the middle and at corners at this share of the half picture.
_STRETCH_S, _SHARE = 3.0, 0.5
# Fewest stretches; Gauss-Newton steps; robust standard deviations beyond which a residual gets little weight.
_LEAST, _STEPS, _OUTLIER = 8, 6, 3.0
# A broad prior of the offset, and the largest standard deviation at which the offset counts as known.
_EXPECTED_RAD, _KNOWN_RAD = np.radians(30.0), np.radians(1.0)
# Step of the numerical slopes of heading, pitch and sideways tilt (radians) and of the log of the height.
_NUDGE = 1e-4
# Number of consecutive stretches with correlated errors, for the standard deviation.
_ALIKE = 2
_Pair = tuple[Flight, Flight, np.ndarray]


def describe_heading_offset(locator: AerialLocator, seen: Sequence[tuple[float, np.ndarray]]) -> str:
    """Return a message on the heading error of the log and the setting that corrects it; empty if there is none.

    seen: time of each frame, s, and (3, 3) pixel homography from the frame before, NaN if unknown.
    """
    telemetry, parameters = locator.site.telemetry, locator.settings.aerial
    if telemetry is None or telemetry.heading_from or parameters.mode != "pose":
        return ""
    found = find_heading_offset(locator, seen)
    if found is None or found[1] > _KNOWN_RAD or abs(found[0]) <= 3 * found[1]:
        return ""
    offset_deg, sigma_deg = np.degrees(found)
    whole_deg = parameters.heading_offset_deg + offset_deg
    return (
        f"the pictures show that the camera looks {abs(offset_deg):.1f} degrees farther "
        f"{'right' if offset_deg > 0 else 'left'} than the log's heading (sigma {sigma_deg:.1f}); unless a known "
        f"declination or mounting gives another value, set aerial.heading_offset_deg={whole_deg:.1f}"
    )


def find_heading_offset(locator: AerialLocator, seen: Sequence[tuple[float, np.ndarray]]) -> tuple[float, float] | None:
    """Return the angle to add to the log's headings, clockwise, and its sigma, rad; None if the data do not show it.

    seen: as in `describe_heading_offset`.
    """
    pairs = _stretches(locator, seen)
    if len(pairs) < _LEAST:
        return None
    state, expected = np.zeros(4), _expected_sigma(locator.settings.aerial)
    for _ in range(_STEPS):
        missed = _missed(locator, pairs, state)
        slopes = np.stack([(_missed(locator, pairs, state + d) - missed) / _NUDGE for d in _NUDGE * np.eye(4)], axis=2)
        known = np.isfinite(missed).all(axis=1) & np.isfinite(slopes).all(axis=(1, 2))
        if known.sum() < _LEAST:
            return None
        missed, slopes = missed[known], slopes[known]
        size = np.sqrt((missed**2).mean(axis=1))
        spread = max(float(np.median(size)), 1e-3)
        weight = 1 / np.maximum(spread, size / _OUTLIER) ** 2
        information = np.einsum("n,nki,nkj->ij", weight, slopes, slopes) + np.diag(1 / expected**2)
        score = np.einsum("n,nki,nk->ni", weight, slopes, missed)
        state = state - np.linalg.solve(information, score.sum(axis=0) + state / expected**2)
    blocks = np.array([part.sum(axis=0) for part in np.array_split(score, max(len(score) // _ALIKE, 5))])
    # The errors of a stretch are common to its points: the scatter between stretches shows how much they vary.
    inverse = np.linalg.inv(information)
    spread_out = blocks.T @ blocks * len(blocks) / max(len(blocks) - 4, 1) + np.diag(1 / expected**2)
    return float(state[0]), float(np.sqrt((inverse @ spread_out @ inverse)[0, 0]))


def _expected_sigma(parameters: AerialParameters) -> np.ndarray:
    tilt = np.radians(parameters.tilt_sigma_deg)
    return np.maximum([_EXPECTED_RAD, tilt, tilt, np.hypot(parameters.altitude_sigma, parameters.focal_sigma)], 1e-4)


def _stretches(locator: AerialLocator, seen: Sequence[tuple[float, np.ndarray]]) -> list[_Pair]:
    """Return the telemetry at both ends of consecutive stretches, and the homography from the first to the second."""
    pairs: list[_Pair] = []
    first, motion = None, np.eye(3)
    for time_s, step in seen:
        motion = step @ motion
        if first is None or not np.isfinite(motion).all():
            first, motion = time_s, np.eye(3)
        elif time_s - first >= _STRETCH_S - 1e-6:
            before, now = locator.telemetry_at(first), locator.telemetry_at(time_s)
            if before is not None and now is not None:
                pairs.append((before, now, motion))
            first, motion = time_s, np.eye(3)
    return pairs


def _missed(locator: AerialLocator, pairs: Sequence[_Pair], state: np.ndarray) -> np.ndarray:
    """Return (N, 10) metres, by how much the ground of a stretch seems to move between its beginning and its end."""
    camera, surface = locator.camera, surface_of(locator.site.elevation)
    corners = np.array([[0, 0], [-1, -1], [1, -1], [-1, 1], [1, 1]]) * _SHARE
    before_px = camera.centre_px + corners * np.array(camera.size_px) / 2
    places = [
        [
            ground_with_slopes(_pose(flight, state), camera, pixels, 0.0, surface)[0]
            for flight, pixels in ((before, before_px), (now, transfer(motion, before_px)))
        ]
        for before, now, motion in pairs
    ]
    missed: np.ndarray = np.diff(np.array(places), axis=1).reshape(len(pairs), -1)
    return missed


def _pose(flight: Flight, state: np.ndarray) -> CameraPose:
    heading, pitch, aside, taller = state
    looks = flight.heading_rad + heading
    # Turn about the level line of sight: a roll, but well defined if the camera looks straight down.
    turn = turned(aside * np.array([np.sin(looks), np.cos(looks), 0.0]))
    axes = turn @ axes_of(looks, flight.pitch_rad + pitch, np.nan_to_num(flight.roll_rad))
    return CameraPose(np.array([*flight.place, flight.altitude_m * np.exp(taller)]), axes)
