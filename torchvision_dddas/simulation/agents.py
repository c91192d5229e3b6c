"""One moment of a simulated world: where everything is, and what the vehicles say of it."""

import math
from dataclasses import dataclass

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.simulation.crowds import Crowds
from torchvision_dddas.simulation.ground_vehicles import CAR_HALF_M, UGV_HALF_M, Cars, Team, marker_plates
from torchvision_dddas.simulation.movement import Obstacles
from torchvision_dddas.simulation.scenario import Scenario
from torchvision_dddas.simulation.sensor_errors import ActiveFaults, Faults, Receivers
from torchvision_dddas.simulation.uav import Aircraft, ReportedPose, rotation_matrix
from torchvision_dddas.simulation.world import World
from torchvision_dddas.types import Bodies, CameraPose, Command, Flight


@dataclass(frozen=True)
class Report:
    """What a ground vehicle says by radio. vehicle: its row in the team, from 0. frame: may be broken.

    lonlat_deg: (2,). planned: a waypoint that it means to pass at that frame, not a place where it was; plans are
    sent each second, and of two waypoints for one frame the later one counts. sigma_m: along each axis, of
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

    pose: of the camera in the middle of the exposure of the picture's middle row, true. velocity_m_s, turn_rad_s: (3,)
    its rates about east, north, up. flight: what the UAV reports of itself, in longitude and latitude; None while it is
    silent. reports: of the ground vehicles since the frame before. heading_rad (K,): where their own cameras truly
    point. reported_lonlat_deg (K, 2), NaN where silent, and reported_heading_rad (K,): what they report. Their places
    are those of the bodies of kind ugv, in the same order. picture: "", frozen or dropped. events: in words.
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
    reported_lonlat_deg: np.ndarray
    reported_heading_rad: np.ndarray
    picture: str = ""
    events: tuple[str, ...] = ()


# All that moves in a simulated world, step by step, and what the vehicles say of it.


_TICK_S = 0.1
_PLANNED_S = 5
_STRAYS_M = 0.1  # how well a vehicle keeps to what it plans, a second ahead; standard deviation along each axis
_UGV_BGR = (70.0, 74.0, 72.0)
_GUST_S = 1.5


class Agents:
    """People, cars, ground vehicles and the UAV of a scenario.

    Each step of a frame is made of equal steps of at most 0.1 s, whether or not anyone looks at the frame: what happens
    does not depend on that.
    """

    def __init__(self, scenario: Scenario, world: World) -> None:
        self._scenario, self._world, seed = scenario, world, scenario.seed
        obstacles = Obstacles(world.things, world.side_m)
        many, cars, ugvs = len(scenario.crowd), len(scenario.car), scenario.team.ugvs
        self._car_target = many + 1 + np.arange(cars)
        self._ugv_target = many + cars + 1 + np.arange(ugvs)
        self._crowds = Crowds(scenario.crowd, scenario.happening, world.side_m, obstacles, seed, many + cars + ugvs + 1)
        self._cars = Cars(scenario.car, world.side_m, obstacles, seed)
        self._team = Team(scenario.team, scenario.uav, world.side_m, obstacles, seed)
        self._plates = marker_plates(ugvs)[1]
        self._aircraft = Aircraft(scenario.uav, world.side_m / 2, world.up_m, seed)
        self._telemetry = ReportedPose(scenario.uav, seed)
        self._telemetry_errors = self._telemetry.errors(0.0)
        gps = scenario.gps
        rng = np.random.default_rng([seed, 40])
        self._gps = Receivers(ugvs, gps.error95_m, gps.white_share, gps.correlation_s, gps.common_m, rng)
        self._jump = rng.uniform(0, 2 * np.pi, ugvs)
        self._faults = Faults(scenario.fault)
        self._gust = np.random.default_rng([seed, 53]).uniform(0, 2 * np.pi, len(scenario.fault))
        self._rate = scenario.clip.rate_hz
        self._ticks = max(1, int(np.ceil(1 / self._rate / _TICK_S - 1e-9)))
        self._number, self._reported = 1, 0
        self._reports: list[Report] = []
        self._events: list[str] = self._faults.events(-np.inf, 0.0)
        self._report(self._team.place, self._team.place, 0.0, 0.0)
        self._plan(0.0)
        self._last: Moment | None = None

    @property
    def time_s(self) -> float:
        """Time of the current frame."""
        return (self._number - 1) / self._rate

    def moment(self) -> Moment:
        """The world at the current frame, with all reports since the moment before."""
        if self._last is None:
            self._last = self._moment()
        return self._last

    def step(self, every: int = 1) -> None:
        """Advance by `every` frames."""
        if every < 1:
            raise ValueError(f"a step of {every} frames; wanted 1 or more")
        if self._last is not None:
            self._reports, self._events, self._last = [], [], None
        for _ in range(every):
            self._frame()

    def steer(self, command: Command) -> None:
        """Set what the instruments do from now on; what a command does not name goes on as before."""
        self._aircraft.steer(self._local(command.fly_to), self._local(command.look_at), command.altitude_m)
        for order in command.orders:
            if order.vehicle in self._team.names:
                goal = self._local(order.goal)
                assert goal is not None
                self._team.order(
                    self._team.names.index(order.vehicle), goal, order.speed_m_s, self._local(order.look_at)
                )

    def _local(self, place_deg: np.ndarray | None) -> np.ndarray | None:
        """(2,) local metres of longitude and latitude."""
        if place_deg is None:
            return None
        return geometry.east_north(np.asarray(place_deg, float)[None], self._scenario.world.origin_deg)[0]

    def _lonlat(self, place_m: np.ndarray) -> np.ndarray:
        return geometry.lonlat(place_m, self._scenario.world.origin_deg)

    def _frame(self) -> None:
        start, seconds = self.time_s, 1 / self._rate / self._ticks
        for tick in range(self._ticks):
            begin = start + tick * seconds
            self._tick(begin, seconds)
        self._number += 1
        self._telemetry_errors = self._telemetry.errors(1 / self._rate)
        self._events += self._faults.events(start, self.time_s)

    def _tick(self, begin: float, seconds: float) -> None:
        end, wrong = begin + seconds, self._faults.at(begin)
        team, before = self._team, self._team.place
        self._events += self._crowds.step(end, seconds, self._shapes())
        people = self._crowds.place
        self._cars.step(end, seconds, np.concatenate([people, before]))
        team.step(end, seconds, sorted(wrong.lost), people)
        self._aircraft.step(end, seconds, *self._blow(begin))
        self._report(before, team.place, begin, end)
        if np.floor(end + 1e-6) > np.floor(begin + 1e-6):
            self._plan(end)

    def _shapes(self) -> np.ndarray:
        """(V, 5) vehicles as Crowds.step wants them."""
        cars, team = self._cars, self._team
        return np.concatenate(
            [
                np.c_[cars.place, cars.course, np.tile(CAR_HALF_M, (len(cars), 1))],
                np.c_[team.place, team.course, np.tile(UGV_HALF_M, (len(team), 1))],
            ]
        )

    def _blow(self, time_s: float) -> tuple[np.ndarray | None, float]:
        """The push (3,) of the gusts, m/s2, and how much rougher the air is."""
        gusts = self._faults.gusts(time_s)
        push = np.zeros(3)
        for row, since, size in gusts:
            if since < _GUST_S:
                # A spring at rest is by then as fast as the gust.
                push[:2] += math.e * size / _GUST_S * np.array([np.sin(self._gust[row]), np.cos(self._gust[row])])
        return (push, 1 + max(size for *_, size in gusts) / 5) if gusts else (None, 1.0)

    def _report(self, before: np.ndarray, after: np.ndarray, begin: float, end: float) -> None:
        """What the receivers say between two times, at which the vehicles are at places (K, 2)."""
        rate = self._scenario.gps.rate_hz
        while self._reported / rate <= end + 1e-9:
            time = self._reported / rate
            if self._reported:
                self._gps.advance(1 / rate)
            share = np.clip((time - begin) / (end - begin), 0, 1) if end > begin else 1.0
            place = before + share * (after - before) + self._gps.error_m
            wrong = self._faults.at(time)
            reported = self._lonlat(place + self._jumped(wrong))
            for k in range(len(self._team)):
                if k not in wrong.lost and k not in wrong.silent:
                    self._reports.append(Report(k, round(time * self._rate + 1, 6), reported[k], self._gps.sigma_m))
            self._reported += 1

    def _jumped(self, wrong: ActiveFaults) -> np.ndarray:
        """(K, 2) by how much the receivers are off."""
        off = np.zeros((len(self._team), 2))
        for k, size in wrong.jumped.items():
            if k < len(off):
                off[k] = size * np.array([np.sin(self._jump[k]), np.cos(self._jump[k])])
        return off

    def _plan(self, time_s: float) -> None:
        """Report the waypoints of the coming seconds, this one included; called each second."""
        if not self._scenario.team.planned or not len(self._team):
            return
        wrong = self._faults.at(time_s)
        places = self._team.waypoints(time_s, _PLANNED_S, sorted(wrong.lost))
        # A vehicle knows where it is no better than its receiver does, and plans from there.
        reported = self._lonlat((places + self._gps.lasting_m + self._jumped(wrong)).reshape(-1, 2)).reshape(
            places.shape
        )
        for ahead, points in enumerate(reported):
            frame = round((time_s + ahead) * self._rate + 1, 6)
            sigma = float(np.hypot(self._gps.sigma_m, _STRAYS_M * ahead))
            self._reports += [
                Report(k, frame, point, sigma, planned=True) for k, point in enumerate(points) if k not in wrong.lost
            ]

    def _moment(self) -> Moment:
        time, team = self.time_s, self._team
        wrong = self._faults.at(time)
        pose, velocity, turn = self._aircraft.pose()
        # The UAV's place is the last.
        places = np.concatenate([team.place, pose.place_m[None, :2]])
        errors = np.concatenate([self._gps.error_m + self._jumped(wrong), self._telemetry_errors[None, 4:]])
        reported = self._lonlat(places + errors)
        reported, own = reported[:-1], reported[-1]
        silent = [k for k in range(len(team)) if k in wrong.lost or k in wrong.silent]
        reported[silent] = np.nan
        return Moment(
            self._number,
            time,
            self._bodies(wrong),
            pose,
            velocity,
            turn,
            None if wrong.mute else self._flight(pose, velocity, own),
            tuple(self._reports),
            team.heading.copy(),
            reported,
            (team.heading + team.heading_error) % (2 * np.pi),
            wrong.picture,
            tuple(self._events),
        )

    def _flight(self, pose: CameraPose, velocity: np.ndarray, lonlat_deg: np.ndarray) -> Flight:
        """What the UAV says of itself. lonlat_deg: (2,) where it says that it is."""
        wrong, place = self._telemetry_errors, pose.place_m
        ground = float(self._world.up_m(place[None, :2])[0])
        high = (place[2] - ground) * (1 + wrong[3])
        reported = CameraPose(place, rotation_matrix(wrong[:3]) @ pose.axes)
        heading, pitch, roll = reported.angles_rad
        longitude, latitude = lonlat_deg.tolist()
        hfov = float(np.radians(self._scenario.camera.hfov_deg))
        return Flight(
            float(high),
            float(np.hypot(velocity[0], velocity[1])),
            (longitude, latitude),
            float(self._scenario.world.above_sea_m + ground + high),
            heading,
            pitch,
            roll,
            hfov,
        )

    def _bodies(self, wrong: ActiveFaults) -> Bodies:
        crowds, cars, team = self._crowds, self._cars, self._team
        people, machines, ugvs = len(crowds), len(cars), len(team)
        total = people + machines + ugvs
        place = np.concatenate([crowds.place, cars.place, team.place])
        plate = np.full((total, 3), np.nan)
        plate[people + machines :] = self._plates
        hidden = np.zeros(total, bool)
        hidden[[people + machines + k for k in wrong.covered if k < ugvs]] = True
        none = np.zeros(machines + ugvs)
        return Bodies(
            np.arange(1, total + 1),
            np.repeat(np.array(["person", "car", "ugv"]), [people, machines, ugvs]),
            np.concatenate([crowds.target, self._car_target, self._ugv_target]).astype(np.int64),
            np.c_[place, self._world.up_m(place)],
            np.concatenate([crowds.velocity, cars.velocity, team.velocity]),
            np.concatenate([crowds.facing, cars.course, team.course]),
            np.concatenate([crowds.height, none]),
            np.concatenate([crowds.phase, none]),
            np.concatenate([crowds.colour, cars.colour, np.tile(_UGV_BGR, (ugvs, 1))]),
            plate,
            hidden,
        )
