"""Run a scenario: world, agents and cameras, with steering. Use it alone or as a source of frames."""

import math
from collections import deque
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.elevation import read_elevation, read_ortho
from torchvision_dddas.lab.simulation.aerial_camera import AerialCamera
from torchvision_dddas.lab.simulation.agents import Agents, Moment
from torchvision_dddas.lab.simulation.body_shapes import UGV_HEIGHT_M
from torchvision_dddas.lab.simulation.ground_camera import GroundCamera
from torchvision_dddas.lab.simulation.ground_vehicles import marker_plates
from torchvision_dddas.lab.simulation.movement import heading_vector
from torchvision_dddas.lab.simulation.scenario import AircraftParameters, Scenario, check_scenario, load_scenario
from torchvision_dddas.lab.simulation.world import World, build_world
from torchvision_dddas.types import (
    Camera,
    Colours,
    Command,
    Elevation,
    Frame,
    GroundPicture,
    Landmarks,
    Ortho,
    Problem,
    Telemetry,
    Truth,
    is_sampled,
)

KEPT = 100  # most pictures and truths that wait to be fetched, about 1 MB each
_CLEAR_M = 4.0  # least distance of standing objects from the start of moving objects
# A UAV reports the first fields of Flight, from the altitude to the heading of the nose.
_SAID = 9
_FLIGHT_CLEAR_M = 1.0  # least height of the UAV over standing objects; gusts move it by less
_STEP_M = 1.0
_PARTS = 64


@dataclass(frozen=True)
class Shot:
    """The data of a frame of a run. frame: None if the camera dropped it.

    moments: the moments of all frames of the world since the last shot. The last moment belongs to this shot.
    """

    frame: Frame | None
    truth: Truth
    moments: tuple[Moment, ...]


class Simulator:
    """A run of a scenario from its first frame. The scenario, its seed and the commands determine it completely.

    camera: the aerial camera. colours: colours of the landmarks. names: names of the ground vehicles. frames: number of
    frames.
    """

    def __init__(self, scenario: Scenario, elevation: Elevation | None = None, photo: Ortho | None = None) -> None:
        """elevation, photo: replace the synthetic ground, in metres about the scenario's world.origin_deg.

        Raises InputError for an impossible scenario.
        """
        check_scenario(scenario)
        self.scenario = scenario
        clear = _start_places_m(scenario), _CLEAR_M
        # Thermal pictures have no shadows, so put the sun straight above.
        light = {"sun_height_deg": 90.0} if scenario.camera.thermal else {}
        ground = scenario.world.model_copy(update=light)
        self.world: World = build_world(ground, scenario.seed, elevation, photo, clear)
        _check_flight(scenario.uav, self.world)
        self._aerial = AerialCamera(self.world, scenario)
        self._ground = GroundCamera(self.world, scenario)
        self.camera: Camera = self._aerial.camera
        self.names, _, self.colours = marker_plates(scenario.team.ugvs)
        self.frames = round(scenario.clip.seconds * scenario.clip.rate_hz)
        self.restart()

    def restart(self) -> None:
        """Start the run again, with the same world and the same events."""
        self._agents = Agents(self.scenario, self.world)
        self._every, self._number, self._skipped = 1, 0, 0
        self._before: np.ndarray | None = None
        self._now: Moment | None = None

    def steer(self, command: Command) -> None:
        """Carry out a command from the next frame on. Raises InputError if it names an unknown vehicle."""
        for order in command.orders:
            if order.vehicle not in self.names:
                raise InputError(f"no ground vehicle is named {order.vehicle!r}; there are {', '.join(self.names)}")
        self._every = max(1, int(command.every))
        self._agents.steer(command)

    def next(self) -> Shot | None:
        """Return the next frame at the commanded interval, or None after the last."""
        ahead = self._every if self._number else 1
        if self._number + ahead > self.frames:
            return None
        moments = []
        for _ in range(ahead):
            if self._number:
                self._agents.step()
            self._number += 1
            moments.append(self._agents.moment())
        moment = self._now = moments[-1]
        self._skipped += ahead - 1
        image, mask, people = self._aerial.take(moment)
        if moment.picture == "frozen" and self._before is not None:
            image = self._before
        events = tuple(event for one in moments for event in one.events)
        truth = Truth(moment.number, moment.time_s, mask, people, moment.bodies, moment.pose, events)
        if moment.picture == "dropped":
            return Shot(None, truth, tuple(moments))
        self._before = image
        frame = Frame(moment.number, moment.time_s, image, self._skipped)
        self._skipped = 0
        return Shot(frame, truth, tuple(moments))

    def picture(self, vehicle: str) -> GroundPicture | None:
        """Return a ground vehicle's picture at the last frame, or None while it is silent."""
        return None if self._now is None else self._ground.take(self._now, self.names.index(vehicle))


def _start_places_m(scenario: Scenario) -> np.ndarray:
    """Return (N, 2) places near which moving objects start: crowds with their surroundings, cars, the ring of UGVs."""
    about = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    places = [np.zeros((0, 2)), *(np.array([car.start_m]) for car in scenario.car)]
    places += [np.array(crowd.start_m) + about * min(crowd.radius_m, 2 * _CLEAR_M) for crowd in scenario.crowd]
    team = scenario.team
    if team.ugvs:
        places.append(np.array(team.middle_m) + team.ring_m * heading_vector(2 * np.pi * np.arange(64) / 64))
    return np.concatenate(places)


def _check_flight(parameters: AircraftParameters, world: World) -> None:
    """Raise InputError if objects reach up to the UAV's way, or if the ground hides the place that it looks at."""
    corners = np.array([parameters.start_m, *parameters.way_m], float)
    legs = [corners[:1]]
    for begin, end in pairwise(corners):
        count = max(1, int(np.ceil(np.linalg.norm(end - begin) / _STEP_M)))
        legs.append(begin + np.arange(1, count + 1)[:, None] / count * (end - begin))
    aimed = np.concatenate(legs)
    altitude, pitch = parameters.altitude_m, np.radians(parameters.pitch_deg)
    back = altitude / np.tan(pitch) if parameters.pitch_deg < 90 else 0.0
    flown = aimed - back * heading_vector(np.radians(parameters.heading_deg))
    # Heights of objects below the way. The world is mirrored beyond its edges.
    side, half = world.surface.shape[0], world.side_m / 2
    at = np.stack([half - flown[:, 1], flown[:, 0] + half]) / world.surface_texel_m
    at = np.floor(at).astype(int) % (2 * side)
    row, column = np.where(at < side, at, 2 * side - 1 - at)
    tall = world.surface[row, column].astype(float)
    if (low := tall + _FLIGHT_CLEAR_M > altitude).any():
        k = int(np.where(low, tall, -1).argmax())
        raise InputError(
            f"uav.altitude_m = {altitude:g} is too low: the object at [{flown[k, 0]:.0f}, {flown[k, 1]:.0f}] is "
            f"{tall[k]:.1f} m high; fly {np.ceil(tall[k] + _FLIGHT_CLEAR_M):g} m high or more"
        )
    aimed_up, flown_up = world.up_m(aimed), altitude + world.up_m(flown)
    share = np.linspace(0, 1, _PARTS, endpoint=False)[:, None]
    rays = flown + share[..., None] * (aimed - flown)
    ground = world.up_m(rays.reshape(-1, 2)).reshape(rays.shape[:2])
    over = flown_up + share * (aimed_up - flown_up) - ground
    if (over < 0).any():
        worst = np.unravel_index(over.argmin(), over.shape)
        east, north = rays[worst]
        raise InputError(
            f"uav.altitude_m = {altitude:g} is too low for the terrain in view: at [{east:.0f}, {north:.0f}] the "
            f"ground is {-over[worst]:.1f} m above the line of sight; fly higher, or look down more steeply than "
            f"uav.pitch_deg = {parameters.pitch_deg:g}"
        )


class SimulatorSource:
    """A scenario as a Source that renders its frames on demand.

    Beyond the members of every source: scenario; camera, the aerial camera; colours, the landmarks' colours; elevation
    of the ground about origin_deg; steer; and the data of the run until now: landmarks, telemetry, pictures, truths.
    Every iteration starts the run again. Frames that a command skips are not drawn. The numbers of dropped frames are
    missing.
    """

    exact = True

    def __init__(self, scenario: Scenario, name: str = "simulation") -> None:
        """Raises InputError for an impossible scenario, or if one of its rasters cannot be read."""
        self.scenario, self.name = scenario, name
        self._simulator = simulator = open_simulator(scenario)
        self.camera: Camera = simulator.camera
        self.colours: Colours = simulator.colours
        self.elevation: Elevation = simulator.world.relief
        self.plate_m = UGV_HEIGHT_M
        world = scenario.world
        self.origin_deg = world.origin_deg
        angles = math.radians(world.sun_azimuth_deg), math.radians(world.sun_height_deg)
        self.sun_rad: tuple[float, float] | None = angles
        self.names: tuple[str, ...] = simulator.names
        self.count: int | None = simulator.frames
        self.rate_hz, self.size = scenario.clip.rate_hz, simulator.camera.size_px
        self.problems: list[Problem] = []
        self._restart()

    def _restart(self) -> None:
        self._simulator.restart()
        self.problems.clear()
        self.last = 0
        self._reports, self._flown = _Rows(6), _Rows(11)
        self._pictures: deque[GroundPicture] = deque(maxlen=KEPT)
        self._truths: deque[Truth] = deque(maxlen=KEPT)
        self._wanted: list[str] = []

    def __iter__(self) -> Iterator[Frame]:
        self._restart()
        while (shot := self._simulator.next()) is not None:
            self.last = shot.truth.frame
            for moment in shot.moments:
                for r in moment.reports:
                    row = (r.frame, r.vehicle, *r.lonlat_deg.tolist(), r.sigma_m, r.planned)
                    self._reports.add(row, (r.vehicle, round(r.frame, 6), r.planned))
                if moment.flight is not None:
                    # The fields after the first _SAID are uncertainties, which the UAV does not report.
                    said = astuple(moment.flight)[:_SAID]
                    self._flown.add(np.hstack([moment.time_s, *said]).tolist())
            self._truths.append(shot.truth)
            # Ground pictures are taken with the aerial picture, dropped or not. An order asks for one picture.
            pictures = [self.picture(name) for name in self._wanted]
            self._pictures.extend(picture for picture in pictures if picture is not None)
            self._wanted.clear()
            if shot.frame is None:
                self.problems.append(Problem(self.last, f"frame {self.last} was dropped by the camera"))
                continue
            yield shot.frame

    def every(self, interval: int) -> Iterator[Frame]:
        """Yield frames 1, 1 + interval, ... The others are drawn too, so that the pictures stay the same."""
        return (frame for frame in self if is_sampled(frame.number, interval))

    def steer(self, command: Command) -> None:
        """Carry out a command, with places in longitude and latitude, from the next frame. See `Simulator.steer`."""
        self._simulator.steer(command)
        # A later command before the next frame does not cancel requests for pictures.
        asked = [order.vehicle for order in command.orders if order.picture]
        self._wanted += [name for name in asked if name not in self._wanted]

    def landmarks(self) -> Landmarks:
        """Return the ground vehicles' reports until now, in longitude and latitude, with the newest plan per frame."""
        rows = self._reports.rows
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        count = len(rows)
        return Landmarks(
            self.names,
            rows[:, 0],
            rows[:, 1].astype(np.int64),
            np.full((count, 2), np.nan),
            rows[:, 2:4],
            rows[:, 4],
            rows[:, 5] == 1,
            np.arange(2, count + 2),
            True,
            self.name,
        )

    def telemetry(self) -> Telemetry:
        """Return the UAV's telemetry until now, in longitude and latitude."""
        rows = self._flown.rows
        time_s, altitude, speed = rows[:, :3].T
        above_sea, heading, pitch, roll, hfov, nose = rows[:, 5:].T
        angles = heading, pitch, roll, hfov, nose
        return Telemetry(time_s, altitude, speed, rows[:, 3:5], True, above_sea, *angles, origin=self.name)

    def pictures(self) -> list[GroundPicture]:
        """Return the ground vehicles' pictures since the last call, at most the last KEPT."""
        return _take_all(self._pictures)

    def truths(self) -> list[Truth]:
        """Return the truth of frames since the last call, including dropped frames, at most the last KEPT."""
        return _take_all(self._truths)

    def picture(self, vehicle: str) -> GroundPicture | None:
        """Return a ground vehicle's picture at the last frame, or None while it is silent."""
        return self._simulator.picture(vehicle)


def _take_all(kept: deque[Any]) -> list[Any]:
    taken = list(kept)
    kept.clear()
    return taken


class _Rows:
    """A growing table (N, columns) float64, in the order of arrival."""

    def __init__(self, columns: int) -> None:
        self._table, self._count = np.zeros((256, columns)), 0
        self._place: dict[Hashable, int] = {}

    def add(self, row: Sequence[float], key: Hashable = None) -> None:
        """Add a row, or replace the row with the same key."""
        place = self._count if key is None else self._place.setdefault(key, self._count)
        if place == self._count:
            if self._count == len(self._table):
                self._table = np.concatenate([self._table, np.zeros_like(self._table)])
            self._count += 1
        self._table[place] = row

    @property
    def rows(self) -> np.ndarray:
        """All rows, as a view that must not be changed."""
        return self._table[: self._count]


def open_simulator(scenario: Scenario) -> Simulator:
    """Open a run of a scenario and read its ground rasters. Raises InputError."""
    world = scenario.world
    ends = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)]) * world.side_m / 2
    try:
        elevation = read_elevation(world.elevation, ends, world.origin_deg, margin_m=10.0) if world.elevation else None
        photo = read_ortho(world.photo, ends, world.origin_deg, margin_m=0.0) if world.photo else None
    except InputError as error:
        # The reader's message is about landmarks, so replace its subject.
        raise InputError(str(error).replace("the landmarks lie", "the world lies")) from None
    return Simulator(scenario, elevation, photo)


def open_scenario(spec: str, overrides: Sequence[str] = (), seed: int | None = None) -> SimulatorSource:
    """Open a scenario by its name or file, as in `load_scenario`. Raises InputError with one line."""
    scenario = load_scenario(spec, overrides, seed)
    with name_scenario_in_errors(spec):
        return SimulatorSource(scenario, Path(spec).stem)


@contextmanager
def name_scenario_in_errors(spec: str) -> Iterator[None]:
    """Prefix the message of an InputError with the name of a scenario."""
    try:
        yield
    except InputError as error:
        raise InputError(f"scenario {spec}: {error}") from None
