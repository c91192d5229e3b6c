"""One moment of a simulated world: where everything is, and what the vehicles say of it."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.types import Bodies, CameraPose, Flight


@dataclass(frozen=True)
class Report:
    """What a ground vehicle says by radio. vehicle: its row in the team, from 0. frame: may be broken.

    lonlat_deg: (2,). planned: a waypoint that it means to pass at that frame, not a place where it was; plans are told
    anew each second, and of two waypoints for one frame the one that was told last counts. sigma_m: along each axis, of
    what the receivers do not share.
    """

    vehicle: int
    frame: float
    lonlat_deg: np.ndarray
    sigma_m: float
    planned: bool = False


@dataclass(frozen=True)
class Moment:
    """The world at a frame of the aerial camera.

    pose: of the camera in the middle of the exposure of the picture's middle row, true; velocity_m_s, turn_rad_s: (3,)
    its rates about east, north, up. flight: what the UAV reports of itself, longitude and latitude; None while silent.
    reports: of the ground vehicles since the frame before. The ground vehicles' own cameras: heading_rad (K,) whither
    they truly look; said_lonlat_deg (K, 2), NaN where silent, and said_heading_rad (K,) what they say of it. Their
    places are those of the bodies of kind ugv, in the same order. picture: "", frozen or dropped. events: in words.
    """

    number: int
    time_s: float
    bodies: Bodies
    pose: CameraPose
    velocity_m_s: np.ndarray
    turn_rad_s: np.ndarray
    flight: Flight | None
    reports: tuple[Report, ...]
    heading_rad: np.ndarray
    said_lonlat_deg: np.ndarray
    said_heading_rad: np.ndarray
    picture: str = ""
    events: tuple[str, ...] = ()
