"""Crowds: targets that are close together on the ground and move alike count as one target.

Source: appendix A takes each crowd for one target of the aerial camera. How far its people may be apart is in metres
here, not in pixels of a closing kernel, so that it is the same at every altitude.
"""

from dataclasses import replace

import numpy as np

from torchvision_dddas.geo.aerial_locator import AerialLocator
from torchvision_dddas.geo.landmark_watch import WatchedScene, without_detections
from torchvision_dddas.geometry import middles_of
from torchvision_dddas.types import Detections, Float, Int


def group_crowds(watched: WatchedScene, locator: AerialLocator, rate_hz: float) -> WatchedScene:
    """The scene with each crowd as one target; unchanged where crowds are switched off or the fix is unknown.

    rate_hz: frames a second; speed_px of the detections is in pixels a frame.
    """
    parameters, scene = locator.settings.crowds, watched.scene
    if not parameters.join_m or not len(scene.detections):
        return watched
    found = replace(scene.detections, middle_px=middles_of(scene.detections.box_px, scene.mask, scene.core))
    fix = watched.fixed.fix
    ahead = np.stack([np.cos(found.heading_rad), np.sin(found.heading_rad)], axis=1) * found.speed_px[:, None]
    place, onward = (locator.ground_places(fix, pixels) for pixels in (found.middle_px, found.middle_px + ahead))
    velocity, radius = (onward - place) * rate_hz, locator.ground_radii(fix, found.box_px)
    marks, length_m = locator.landmarks_at(scene.frame.number), locator.settings.landmarks.length_m
    # What is no larger than a vehicle and lies where one reports to be is part of it or its shadow, whether or not its
    # colour is seen.
    away = np.linalg.norm(place[:, None] - marks.east_north_m[None], axis=-1)
    beside = (away <= length_m + 2 * marks.sigma_m).any(axis=1) & (radius <= length_m / 2)
    scene = without_detections(replace(scene, detections=found), beside)
    crowd = group_targets(place[~beside], radius[~beside], velocity[~beside], parameters.join_m, parameters.speed_m_s)
    detections, mask = merge_detections(scene.detections, scene.mask, crowd)
    return replace(watched, scene=replace(scene, detections=detections, mask=mask))


def group_targets(
    place_m: Float[np.ndarray, "N 2"],
    radius_m: Float[np.ndarray, " N"],
    velocity_m_s: Float[np.ndarray, "N 2"],
    join_m: float,
    speed_m_s: float,
) -> Int[np.ndarray, " N"]:
    """The crowd of each target, numbered from 0 in the order of the first targets.

    Two targets are in one crowd if the gap between their rims is at most join_m and their velocities differ by at most
    speed_m_s; the relation is transitive. A target of unknown place is alone. An unknown velocity differs from none.
    """
    count = len(place_m)
    apart = np.linalg.norm(place_m[:, None] - place_m[None], axis=-1) - radius_m[:, None] - radius_m[None]
    away = np.linalg.norm(velocity_m_s[:, None] - velocity_m_s[None], axis=-1)
    # NaN compares as false: an unknown place is near none, an unknown velocity differs from none.
    near = (apart <= join_m) & ~(away > speed_m_s) | np.eye(count, dtype=bool)
    leader = np.arange(count)
    while True:
        lower = np.array([leader[row].min() for row in near], np.int64)
        if (lower == leader).all():
            return np.unique(leader, return_inverse=True)[1].astype(np.int64)
        leader = lower


def merge_detections(
    found: Detections, mask: np.ndarray, crowd: Int[np.ndarray, " N"]
) -> tuple[Detections, np.ndarray]:
    """The crowds as detections, and the (H, W) mask with their numbers. crowd: as by `group_targets`.

    The velocity of a crowd is the mean of its parts', weighed by area; its middle is the mean of their foreground.
    """
    size = int(crowd.max(initial=-1)) + 1
    area = np.maximum(found.area_px, 1e-9)

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(crowd, values, size)

    low, high = np.full((size, 2), np.inf), np.full((size, 2), -np.inf)
    np.minimum.at(low, crowd, found.box_px[:, :2])
    np.maximum.at(high, crowd, found.box_px[:, :2] + found.box_px[:, 2:])
    score = np.zeros(size)
    np.maximum.at(score, crowd, found.score)
    known = np.isfinite(found.speed_px) & np.isfinite(found.heading_rad)
    weight = np.where(known, area, 0.0)
    speed, heading = np.where(known, found.speed_px, 0.0), np.where(known, found.heading_rad, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        across = total(weight * speed * np.cos(heading)) / total(weight)
        down = total(weight * speed * np.sin(heading)) / total(weight)
        middle = np.stack([total(area * found.middle_px[:, k]) / total(area) for k in range(2)], axis=1)
    number = np.zeros(len(crowd) + 1, mask.dtype)
    number[1:] = crowd + 1
    crowds = Detections(
        np.c_[low, high - low].reshape(-1, 4),
        score,
        total(found.area_px),
        np.where(np.hypot(across, down) > 0, np.arctan2(down, across), np.nan),
        np.hypot(across, down),
        found.kind,
        middle,
    )
    return crowds, number[mask]
