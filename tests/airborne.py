"""Simulated looks of a camera in the air at landmarks and targets, with telemetry, for the tests of poses."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from torchvision_dddas.config import AerialParameters, Settings
from torchvision_dddas.geometry import turned
from torchvision_dddas.geometry.projection import axes_of, project
from torchvision_dddas.types import Camera, CameraPose, Flight, LandmarkObservations

FOCAL_PX = 960 / np.tan(np.radians(35))
CAMERA = Camera("aerial", (1920, 1080), (FOCAL_PX, FOCAL_PX), (959.5, 539.5))
GPS_M = 3.5 / np.sqrt(-2 * np.log(0.05))
"""Standard deviation along each axis of a GPS that is 3.5 m off in 95 %."""


@dataclass(frozen=True)
class Look:
    """What is true, and what is measured of it."""

    pose: CameraPose
    flight: Flight
    marks: LandmarkObservations
    targets: np.ndarray
    targets_px: np.ndarray


def ring(n: int, radius_m: float = 25.0) -> np.ndarray:
    """(n, 2) landmarks about the middle."""
    turn = 0.3 + 2 * np.pi * np.arange(n) / n
    return radius_m * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def look(
    seed: int,
    n: int = 4,
    sigma_m: float = GPS_M,
    altitude_m: float = 50.0,
    tilt_deg: float = 0.0,
    pixel_sigma: float = 1.0,
    errors: float = 1.0,
    places: np.ndarray | None = None,
    camera: Camera = CAMERA,
) -> Look:
    """One look from the air; errors: of the telemetry, as a share of what the parameters have; 0: all is exact."""
    rng = np.random.default_rng(seed)
    axes = axes_of(rng.uniform(0, 2 * np.pi), np.pi / 2 - np.radians(tilt_deg), 0.0)
    place = axes[:, 2] * altitude_m / axes[2, 2] + [2.0, -3.0, 0.0]
    place[2] = altitude_m
    parameters = AerialParameters()
    off = errors * rng.normal(0, 1, 7)
    turn = off[:3] * np.radians([parameters.tilt_sigma_deg, parameters.tilt_sigma_deg, parameters.heading_sigma_deg])
    heading, pitch, roll = CameraPose(np.zeros(3), turned(-turn) @ axes).angles_rad
    told = place - off[3:6] * [
        parameters.position_sigma_m,
        parameters.position_sigma_m,
        parameters.altitude_sigma * altitude_m,
    ]
    flight = Flight(told[2], place=(told[0], told[1]), heading_rad=heading, pitch_rad=pitch, roll_rad=roll)
    pose = CameraPose(place, axes, float(np.exp(parameters.focal_sigma * off[6])))
    true = ring(n) if places is None else np.asarray(places, float)
    n = len(true)
    noise = errors * pixel_sigma
    pixels = project(np.c_[true, np.zeros(n)], pose, camera) + noise * rng.normal(0, 1, (n, 2))
    told_places = true + errors * sigma_m * rng.normal(0, 1, (n, 2))
    marks = LandmarkObservations(
        np.arange(n), pixels, told_places, np.full(n, sigma_m), np.full(n, pixel_sigma), np.zeros(n)
    )
    targets = rng.uniform(-12, 12, (4, 2))
    targets_px = project(np.c_[targets, np.zeros(4)], pose, camera) + noise * rng.normal(0, 1, (4, 2))
    return Look(pose, flight, marks, targets, targets_px)


def with_aerial(**parameters: Any) -> Settings:
    """The defaults but for some parameters of the group `aerial`."""
    return Settings(aerial=AerialParameters(**parameters))


def within_95(off_m: np.ndarray, covariance_m2: np.ndarray) -> np.ndarray:
    """Which errors (N, 2) lie in their ellipses of 95 %."""
    return np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(covariance_m2), off_m) < -2 * np.log(0.05)
