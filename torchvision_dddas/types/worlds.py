"""Commands to the vehicles, and what is true in a simulated world."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.types.ground import Camera, CameraPose


@dataclass(frozen=True)
class Order:
    """An order to a ground vehicle: drive to a goal and look at a point.

    goal, look_at: (2,) in the vehicles' own coordinates, longitude and latitude or local metres; look_at None: ahead.
    picture: whether a picture is requested.
    """

    vehicle: str
    goal: np.ndarray
    speed_m_s: float
    look_at: np.ndarray | None = None
    picture: bool = False


@dataclass(frozen=True)
class Command:
    """A command to the vehicles; a simulator executes it, a recording ignores it. None: no change.

    every: process every so many frames. fly_to: (2,) position of the UAV. look_at: (2,) ground point in the picture's
    centre. Coordinates as in Order.
    """

    every: int = 1
    fly_to: np.ndarray | None = None
    look_at: np.ndarray | None = None
    altitude_m: float | None = None
    orders: tuple[Order, ...] = ()


@dataclass(frozen=True)
class GroundPicture:
    """A ground vehicle's picture at a frame of the aerial camera; camera has the reported pose at that moment."""

    vehicle: str
    frame: int
    image: np.ndarray
    camera: Camera


@dataclass(frozen=True)
class Bodies:
    """Everything that moves in a simulated world at one moment, one row per body.

    number: (N,) int64 from 1, constant. kind: (N,) person, car or ugv. target: (N,) int64 from 1, shared by the people
    of a crowd. place_m: (N, 3) of the feet, local east, north, up. velocity_m_s: (N, 2). facing_rad: (N,) clockwise
    from north. height_m: (N,) of a person. phase: (N,) of the gait, in strides. colour: (N, 3) BGR, 0 to 255.
    plate: (N, 3) BGR of a landmark's marker, or NaN. hidden: (N,) bool, the marker is covered.
    """

    number: np.ndarray
    kind: np.ndarray
    target: np.ndarray
    place_m: np.ndarray
    velocity_m_s: np.ndarray
    facing_rad: np.ndarray
    height_m: np.ndarray
    phase: np.ndarray
    colour: np.ndarray
    plate: np.ndarray
    hidden: np.ndarray

    def __len__(self) -> int:
        return len(self.number)


@dataclass(frozen=True)
class Truth:
    """Ground truth of a simulated frame.

    mask: (H, W) uint16, target number of each pixel, or 0. people: (H, W), body number. bodies: all in the world.
    pose: of the camera at mid-exposure. events: faults, crowds that join or split, in words.
    """

    frame: int
    time_s: float
    mask: np.ndarray
    people: np.ndarray
    bodies: Bodies
    pose: CameraPose
    events: tuple[str, ...] = ()
