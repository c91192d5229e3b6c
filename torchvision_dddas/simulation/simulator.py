"""A scenario that runs: world, agents and cameras in one, frame by frame, steered on the way."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.simulation.aerial_camera import AerialCamera
from torchvision_dddas.simulation.agents import Agents, Moment
from torchvision_dddas.simulation.ground_camera import GroundCamera
from torchvision_dddas.simulation.ground_vehicles import marker_plates
from torchvision_dddas.simulation.scenario import AircraftParameters, Scenario
from torchvision_dddas.simulation.scenario_file import check_scenario
from torchvision_dddas.simulation.world import World, build_world
from torchvision_dddas.types import Camera, Command, Elevation, Frame, GroundPicture, Ortho, Truth


@dataclass(frozen=True)
class Shot:
    """What one frame of a run gives. frame: None where the camera dropped it.

    moment: what the vehicles said since the shot before it is in `said`, one moment a frame of the world, the last of
    them this shot's own.
    """

    frame: Frame | None
    truth: Truth
    said: tuple[Moment, ...]

    @property
    def moment(self) -> Moment:
        """The world at this frame."""
        return self.said[-1]


class Simulator:
    """A run of a scenario from its first frame on. Everything in it follows from the scenario, its seed and commands.

    camera: the aerial one. colours: of the landmarks. names: of the ground vehicles. frames: of the whole run.
    """

    def __init__(self, scenario: Scenario, elevation: Elevation | None = None, photo: Ortho | None = None) -> None:
        """elevation, photo: in place of the synthetic ground, about the scenario's world.origin_deg.

        Raises InputError where the scenario cannot be.
        """
        check_scenario(scenario)
        self.scenario = scenario
        self.world: World = build_world(
            scenario.world, scenario.seed, elevation, photo, (start_places_m(scenario), CLEAR_M)
        )
        check_way(scenario.uav, self.world)
        self._aerial = AerialCamera(self.world, scenario)
        self._ground = GroundCamera(self.world, scenario)
        self.camera: Camera = self._aerial.camera
        self.names, _, self.colours = marker_plates(scenario.team.ugvs)
        self.frames = round(scenario.clip.seconds * scenario.clip.rate_hz)
        self.restart()

    def restart(self) -> None:
        """Begin again: the same world, and the same events in it."""
        self._agents = Agents(self.scenario, self.world)
        self._every = 1
        self._number = 0
        self._skipped = 0
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
        """The next frame that is wanted; None after the last."""
        ahead = 1 if self._number == 0 else self._every
        if self._number + ahead > self.frames:
            return None
        said = []
        for _ in range(ahead):
            if self._number:
                self._agents.step()
            self._number += 1
            said.append(self._agents.moment())
        moment = self._now = said[-1]
        self._skipped += ahead - 1
        image, mask, people = self._aerial.take(moment)
        if moment.picture == "frozen" and self._before is not None:
            image = self._before
        events = tuple(event for one in said for event in one.events)
        truth = Truth(moment.number, moment.time_s, mask, people, moment.bodies, moment.pose, events)
        if moment.picture == "dropped":
            return Shot(None, truth, tuple(said))
        self._before = image
        frame = Frame(moment.number, moment.time_s, image, self._skipped)
        self._skipped = 0
        return Shot(frame, truth, tuple(said))

    def picture(self, vehicle: str) -> GroundPicture | None:
        """What a ground vehicle sees at the frame taken last; None while nothing is heard of it."""
        moment, row = self._now, self.names.index(vehicle)
        if moment is None or not np.isfinite(moment.reported_lonlat_deg[row]).all():
            return None
        return self._ground.take(moment, row)


CLEAR_M = 4.0  # nothing stands nearer to where something that moves begins


def start_places_m(scenario: Scenario) -> np.ndarray:
    """(N, 2) places about which what moves begins: crowds and what is about their middles, cars, the ring of UGVs."""
    about = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)]).reshape(-1, 2)
    places = [np.array([car.start_m]) for car in scenario.car]
    places += [np.array(crowd.start_m) + about * min(crowd.radius_m, 2 * CLEAR_M) for crowd in scenario.crowd]
    team = scenario.team
    turn = 2 * np.pi * np.arange(64) / 64
    if team.ugvs:
        places.append(np.array(team.middle_m) + team.ring_m * np.stack([np.sin(turn), np.cos(turn)], axis=1))
    return np.concatenate(places) if places else np.zeros((0, 2))


# Whether a UAV can fly its way through a world, and see what it means to see.


FLIGHT_CLEAR_M = 1.0  # nothing that stands below it comes nearer: gusts push it about by less

_STEP_M = 1.0
_PARTS = 64


def check_way(parameters: AircraftParameters, world: World) -> None:
    """Raises InputError where what stands there reaches up to its way, or the ground hides what it looks at."""
    aimed = _places(parameters)
    aimed_up = world.up_m(aimed)
    heading, pitch = np.radians(parameters.heading_deg), np.radians(parameters.pitch_deg)
    back = parameters.altitude_m / np.tan(pitch) if parameters.pitch_deg < 90 else 0.0
    flown = aimed - back * np.array([np.sin(heading), np.cos(heading)])
    tall = object_heights_m(world, flown)
    if (low := tall + FLIGHT_CLEAR_M > parameters.altitude_m).any():
        k = int(np.where(low, tall, -1).argmax())
        raise InputError(
            f"uav.altitude_m = {parameters.altitude_m:g} is too low: {tall[k]:.1f} m stand at {_place_text(flown[k])}; "
            f"fly {np.ceil(tall[k] + FLIGHT_CLEAR_M):g} m high or more"
        )
    flown_up = parameters.altitude_m + world.up_m(flown)
    share = np.linspace(0, 1, _PARTS, endpoint=False)[:, None]
    rays = flown + share[..., None] * (aimed - flown)
    ground = world.up_m(rays.reshape(-1, 2)).reshape(rays.shape[:2])
    over = flown_up + share * (aimed_up - flown_up) - ground
    if (over < 0).any():
        part, aim = divmod(int(over.argmin()), over.shape[1])
        raise InputError(
            f"uav.altitude_m = {parameters.altitude_m:g} is below the terrain that it looks over: at "
            f"{_place_text(rays[part, aim])} the ground is {-over[part, aim]:.1f} m above its line of sight; fly "
            f"higher, or look down more steeply than uav.pitch_deg = {parameters.pitch_deg:g}"
        )


def object_heights_m(world: World, east_north_m: np.ndarray) -> np.ndarray:
    """(N,) of what stands at places (N, 2), above the ground; beyond its edges the world is mirrored."""
    side = world.surface.shape[0]
    column = (east_north_m[:, 0] + world.side_m / 2) / world.surface_texel_m
    row = (world.side_m / 2 - east_north_m[:, 1]) / world.surface_texel_m
    places = np.floor(np.stack([row, column])).astype(int) % (2 * side)
    places = np.where(places < side, places, 2 * side - 1 - places)
    return world.surface[places[0], places[1]].astype(float)


def _places(parameters: AircraftParameters) -> np.ndarray:
    """(N, 2) the ground that it looks at, a metre from one to the next."""
    corners = np.array([parameters.start_m, *parameters.way_m], float)
    legs = [corners[:1]]
    for begin, end in pairwise(corners):
        count = max(1, int(np.ceil(np.linalg.norm(end - begin) / _STEP_M)))
        legs.append(begin + np.arange(1, count + 1)[:, None] / count * (end - begin))
    return np.concatenate(legs)


def _place_text(place: np.ndarray) -> str:
    return f"[{place[0]:.0f}, {place[1]:.0f}]"
