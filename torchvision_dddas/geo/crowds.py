"""Crowds: targets that are close together on the ground and go the same way are one.

Source: appendix A takes each crowd for one target of the aerial camera. How far its people may be apart is in metres
here, not in pixels of a closing kernel, so that it is the same at every altitude.
"""

import numpy as np

from torchvision_dddas.types import Detections, Float, Int


def together(
    place_m: Float[np.ndarray, "N 2"],
    radius_m: Float[np.ndarray, " N"],
    velocity_m_s: Float[np.ndarray, "N 2"],
    join_m: float,
    speed_m_s: float,
) -> Int[np.ndarray, " N"]:
    """Which crowd each target is part of, numbered from 0 in the order of its first one.

    Two are together if no more than join_m is between their rims and their velocities differ by speed_m_s at most, and
    so are all that are together with one of them. A target of unknown place is alone; an unknown velocity differs from
    none.
    """
    count = len(place_m)
    apart = np.linalg.norm(place_m[:, None] - place_m[None], axis=-1) - radius_m[:, None] - radius_m[None]
    away = np.linalg.norm(velocity_m_s[:, None] - velocity_m_s[None], axis=-1)
    # NaN compares as false: of no known place is near none, of no known velocity goes with all.
    near = (apart <= join_m) & ~(away > speed_m_s) | np.eye(count, dtype=bool)
    leader = np.arange(count)
    while True:
        lower = np.array([leader[row].min() for row in near], np.int64)
        if (lower == leader).all():
            return np.unique(leader, return_inverse=True)[1].astype(np.int64)
        leader = lower


def joined(found: Detections, mask: np.ndarray, crowd: Int[np.ndarray, " N"]) -> tuple[Detections, np.ndarray]:
    """The crowds as detections, and the (H, W) mask with their numbers. crowd: as `together` gives it.

    A crowd moves as its parts do on average, by their area, and its middle is the mean of their foreground.
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
