"""Targets of a scene that make one crowd on the ground, as one target."""

from dataclasses import replace

import numpy as np

from torchvision_dddas.config import LandmarkParameters
from torchvision_dddas.geo.aerial_locator import Locator
from torchvision_dddas.geo.crowds import joined, together
from torchvision_dddas.geo.landmark_watch import Watched, without
from torchvision_dddas.geometry import middles_of
from torchvision_dddas.types import Detections, Fix, LandmarkObservations


def gathered(watched: Watched, locator: Locator, rate_hz: float) -> Watched:
    """The scene with its crowds as targets; as it is where crowds are not asked for, or the picture lies nowhere.

    rate_hz: pictures a second, of which velocities in pixels a frame are.
    """
    parameters, scene = locator.settings.crowds, watched.scene
    if not parameters.join_m or not len(scene.detections):
        return watched
    found = replace(scene.detections, middle_px=middles_of(scene.detections.box_px, scene.mask, scene.core))
    place, velocity = _moving(found, watched.look.fix, locator, rate_hz)
    radius = locator.radii(watched.look.fix, found.box_px)
    beside = _beside(place, radius, locator.marks(scene.frame.number), locator.settings.landmarks)
    scene = without(replace(scene, detections=found), beside)
    crowd = together(place[~beside], radius[~beside], velocity[~beside], parameters.join_m, parameters.speed_m_s)
    detections, mask = joined(scene.detections, scene.mask, crowd)
    return replace(watched, scene=replace(scene, detections=detections, mask=mask))


def _beside(
    place_m: np.ndarray, radius_m: np.ndarray, marks: LandmarkObservations, parameters: LandmarkParameters
) -> np.ndarray:
    """(N,) bool, what is no larger than a vehicle and lies where one stands: of it something, or its shadow.

    Its colour need not be seen for that: where it is, it says itself.
    """
    away = np.linalg.norm(place_m[:, None] - marks.east_north_m[None], axis=-1)
    beside: np.ndarray = (away <= parameters.length_m + 2 * marks.sigma_m).any(axis=1) & (
        radius_m <= parameters.length_m / 2
    )
    return beside


def _moving(found: Detections, fix: Fix, locator: Locator, rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) places and (N, 2) velocities; NaN where the picture does not lie on the ground."""
    ahead = np.stack([np.cos(found.heading_rad), np.sin(found.heading_rad)], axis=1) * found.speed_px[:, None]
    middle, onward = (locator.places(fix, pixels) for pixels in (found.middle_px, found.middle_px + ahead))
    return middle, (onward - middle) * rate_hz
