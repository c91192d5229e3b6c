"""A scenario that runs: world, agents and cameras in one, frame by frame, steered on the way."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.simulation.aerial import AerialCamera
from torchvision_dddas.simulation.agents import Agents
from torchvision_dddas.simulation.clearance import check_way
from torchvision_dddas.simulation.groundview import GroundCamera
from torchvision_dddas.simulation.moment import Moment
from torchvision_dddas.simulation.scenario import Scenario, check
from torchvision_dddas.simulation.team import plates
from torchvision_dddas.simulation.world import World, build
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
        check(scenario)
        self.scenario = scenario
        self.world: World = build(scenario.world, scenario.seed, elevation, photo, (starts_m(scenario), CLEAR_M))
        check_way(scenario.uav, self.world)
        self._aerial = AerialCamera(self.world, scenario)
        self._ground = GroundCamera(self.world, scenario)
        self.camera: Camera = self._aerial.camera
        self.names, _, self.colours = plates(scenario.team.ugvs)
        self.frames = round(scenario.clip.seconds * scenario.clip.rate_hz)
        self.restart()

    def restart(self) -> None:
        """Begin anew: the same world, and the same happenings in it."""
        self._agents = Agents(self.scenario, self.world)
        self._every = 1
        self._number = 0
        self._skipped = 0
        self._before: np.ndarray | None = None
        self._now: Moment | None = None

    def steer(self, command: Command) -> None:
        """Do as told from the next frame on. Raises InputError where the command names a vehicle that is not there."""
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
        if moment is None or not np.isfinite(moment.said_lonlat_deg[row]).all():
            return None
        return self._ground.take(moment, row)


CLEAR_M = 4.0
"""Nothing stands nearer to where something that moves begins."""


def starts_m(scenario: Scenario) -> np.ndarray:
    """(N, 2) places about which what moves begins: crowds and what is about their middles, cars, the ring of UGVs."""
    about = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)]).reshape(-1, 2)
    places = [np.array([car.start_m]) for car in scenario.car]
    places += [np.array(crowd.start_m) + about * min(crowd.radius_m, 2 * CLEAR_M) for crowd in scenario.crowd]
    team = scenario.team
    turn = 2 * np.pi * np.arange(64) / 64
    if team.ugvs:
        places.append(np.array(team.middle_m) + team.ring_m * np.stack([np.sin(turn), np.cos(turn)], axis=1))
    return np.concatenate(places) if places else np.zeros((0, 2))
