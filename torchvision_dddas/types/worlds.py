"""Commands to the vehicles, and the truth of a simulated world."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.types.ground import Camera, CameraPose
from torchvision_dddas.types.record import Record
from torchvision_dddas.types.table import Table


@dataclass(frozen=True)
class Order(Record):
    """An order to a ground vehicle: drive to a goal and look at a point.

    goal, look_at: (2,) in the vehicles' own coordinates, longitude and latitude or local metres. look_at: None is
    ahead. picture: whether a picture is requested.

    >>> types.Order("ugv1", goal=np.array([10.0, 20.0]), speed_m_s=2.0, picture=True)
    Order(vehicle='ugv1', goal: 2 10 to 20, speed_m_s=2, picture=True)
    """

    vehicle: str
    goal: np.ndarray
    speed_m_s: float
    look_at: np.ndarray | None = None
    picture: bool = False


@dataclass(frozen=True)
class Command(Record):
    """A command to the vehicles. A simulator executes it, a recording ignores it. None: no change.

    every: interval of the frames to process. fly_to: (2,) position of the UAV. look_at: (2,) ground point in the
    picture's centre. Coordinates as in Order.

    >>> types.Command(every=2, fly_to=np.array([10.0, 20.0]))
    Command(every=2, fly_to: 2 10 to 20)
    """

    every: int = 1
    fly_to: np.ndarray | None = None
    look_at: np.ndarray | None = None
    altitude_m: float | None = None
    orders: tuple[Order, ...] = ()


@dataclass(frozen=True)
class GroundPicture(Record):
    """A picture of a ground vehicle at a frame of the aerial camera. camera: its reported pose at that moment.

    >>> camera = td.Camera("ugv1", (640, 480), (500.0, 500.0), (319.5, 239.5))
    >>> types.GroundPicture("ugv1", 12, np.zeros((480, 640, 3), np.uint8), camera)
    GroundPicture(vehicle='ugv1', frame=12, image: 480x640x3 0, camera=Camera(...))
    """

    vehicle: str
    frame: int
    image: np.ndarray
    camera: Camera


@dataclass(frozen=True)
class Bodies(Table):
    """Everything that moves in a simulated world at one moment, one row per body.

    number: (N,) int64 from 1, constant. kind: (N,) person, car or ugv. target: (N,) int64 from 1, shared by the people
    of a crowd. place_m: (N, 3) of the feet, local east, north, up. velocity_m_s: (N, 2). facing_rad: (N,) clockwise
    from north. height_m: (N,) of a person. phase: (N,) of the gait, in strides. colour: (N, 3) BGR, 0 to 255.
    plate: (N, 3) BGR of a landmark's marker, or NaN. hidden: (N,) bool, the marker is covered.

    >>> one, pair, triple = np.ones(2), np.zeros((2, 2)), np.zeros((2, 3))
    >>> number, kind = np.array([1, 2]), np.array(["person", "car"])
    >>> bodies = types.Bodies(number, kind, number, triple, pair, one, 1.7 * one, one, triple, triple, one < 0)
    >>> bodies[bodies.kind == "person"].height_m
    array([1.7])
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


@dataclass(frozen=True)
class Truth(Record):
    """Ground truth of a simulated frame.

    mask: (H, W) uint16, target number of each pixel, or 0. people: (H, W), body number. bodies: all in the world.
    pose: pose of the camera at mid-exposure. events: faults, joins and splits of crowds, in words.

    >>> none, pair, triple = np.zeros(0), np.zeros((0, 2)), np.zeros((0, 3))
    >>> nobody = types.Bodies(none, none, none, triple, pair, none, none, none, triple, triple, none)
    >>> mask, pose = np.zeros((48, 64), np.uint16), td.CameraPose(np.zeros(3), np.eye(3))
    >>> types.Truth(1, 0.0, mask, mask, nobody, pose)
    Truth(frame=1, time_s=0, mask: 48x64 0, people: 48x64 0, bodies=Bodies(0 rows), pose=CameraPose(...))
    """

    frame: int
    time_s: float
    mask: np.ndarray
    people: np.ndarray
    bodies: Bodies
    pose: CameraPose
    events: tuple[str, ...] = ()
