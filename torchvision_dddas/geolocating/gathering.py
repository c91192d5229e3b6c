"""Targets of a scene that make one crowd on the ground, as one target."""

from dataclasses import replace

import numpy as np

from torchvision_dddas.geolocating.locator import Locator
from torchvision_dddas.geolocating.watch import Watched, without
from torchvision_dddas.settings import LandmarkKnobs
from torchvision_dddas.targets.crowding import joined, together, with_middles
from torchvision_dddas.types import Detections, Fix, Marks, Scene


def gathered(watched: Watched, locator: Locator, rate_hz: float) -> Watched:
    """The scene with its crowds as targets; as it is where crowds are not asked for, or the picture lies nowhere.

    rate_hz: pictures a second, of which velocities in pixels a frame are.
    """
    knobs, scene = locator.settings.crowds, watched.scene
    if not knobs.join_m or not len(scene.detections):
        return watched
    place, radius, _ = _on_ground(_with_middles(scene), watched.look.fix, locator, rate_hz)
    scene = without(scene, _beside(place, radius, locator.marks(scene.frame.number), locator.settings.landmarks))
    found = _with_middles(scene)
    place, radius, velocity = _on_ground(found, watched.look.fix, locator, rate_hz)
    crowd = together(place, radius, velocity, knobs.join_m, knobs.speed_m_s)
    detections, mask = joined(found, scene.mask, crowd)
    return replace(watched, scene=replace(scene, detections=detections, mask=mask))


def _with_middles(scene: Scene) -> Detections:
    return replace(scene.detections, middle_px=with_middles(scene.detections, scene.mask, scene.core))


def _beside(place_m: np.ndarray, radius_m: np.ndarray, marks: Marks, knobs: LandmarkKnobs) -> np.ndarray:
    """(N,) bool, what is no larger than a vehicle and lies where one stands: of it something, or its shadow.

    Its colour need not be seen for that: where it is, it says itself.
    """
    away = np.linalg.norm(place_m[:, None] - marks.east_north_m[None], axis=-1)
    beside: np.ndarray = (away <= knobs.length_m + 2 * marks.sigma_m).any(axis=1) & (radius_m <= knobs.length_m / 2)
    return beside


def _on_ground(
    found: Detections, fix: Fix, locator: Locator, rate_hz: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, 2) places, (N,) radii and (N, 2) velocities; NaN where the picture does not lie on the ground."""
    count = len(found)
    unknown = np.full((count, 2), np.nan)
    if not fix.by:
        return unknown, unknown[:, 0], unknown
    box = found.box_px
    low, high = box[:, :2] - 0.5, box[:, :2] + box[:, 2:] - 0.5
    ahead = np.stack([np.cos(found.heading_rad), np.sin(found.heading_rad)], axis=1) * found.speed_px[:, None]
    corners = low, high, np.c_[low[:, 0], high[:, 1]], np.c_[high[:, 0], low[:, 1]]
    pixels = np.concatenate([found.middle_px, np.nan_to_num(found.middle_px + ahead, nan=-1e6), *corners])
    middle, onward, *ends = np.split(locator.places(fix, pixels), 6)
    # The ellipse within the box, as a circle.
    across, along = (np.linalg.norm(a - b, axis=1) for a, b in ((ends[0], ends[3]), (ends[0], ends[2])))
    velocity = np.where(np.isfinite(ahead), (onward - middle) * rate_hz, np.nan)
    return middle, np.sqrt(across * along) / 2, velocity
