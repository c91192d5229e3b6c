"""Move the people and vehicles of a simulated world step by step, and collect the vehicles' reports."""

import math
from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.lab.simulation.crowds import Crowds
from torchvision_dddas.lab.simulation.ground_vehicles import CAR_HALF_M, UGV_HALF_M, Cars, Team, marker_plates
from torchvision_dddas.lab.simulation.movement import Obstacles, heading_vector
from torchvision_dddas.lab.simulation.scenario import Scenario
from torchvision_dddas.lab.simulation.sensors import ActiveFaults, Receivers, active_faults, fault_events
from torchvision_dddas.lab.simulation.uav import Aircraft, ReportedPose, rotation_matrix
from torchvision_dddas.lab.simulation.world import World
from torchvision_dddas.types import Bodies, CameraPose, Command, Flight

_TICK_S = 0.1
_PLANNED_S = 5
_STRAYS_M = 0.1  # deviation of a vehicle from its plan, per second ahead: standard deviation along each axis
_UGV_BGR = (70.0, 74.0, 72.0)
_GUST_S = 1.5


@dataclass(frozen=True)
class Report:
    """A radio report of a ground vehicle. vehicle: its row in the team, from 0. frame: may be fractional.

    lonlat_deg: (2,). planned: True for a waypoint that the vehicle plans to pass at that frame. Plans are sent each
    second, and the newest plan for a frame replaces older plans. sigma_m: standard deviation along each axis of the
    error, without the part that all receivers share.
    """

    vehicle: int
    frame: float
    lonlat_deg: np.ndarray
    sigma_m: float
    planned: bool = False


@dataclass(frozen=True)
class Moment:
    """The world at a frame of the aerial camera.

    pose: the camera's true pose at mid-exposure of the picture's middle row. velocity_m_s, turn_rad_s: (3,) its rates
    along and about east, north, up. flight: the UAV's own report, in longitude and latitude; None while it is silent.
    reports: the ground vehicles' reports since the last frame. heading_rad: (K,) true headings of their cameras.
    reported_lonlat_deg: (K, 2), NaN while silent. reported_heading_rad: (K,). The vehicles' true places are in
    the bodies of kind ugv, in the same order. picture: "", "frozen" or "dropped". events: descriptions of events.
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


class Agents:
    """People, cars, ground vehicles and the UAV of a scenario.

    The step to the next frame consists of equal steps of at most 0.1 s. Events do not depend on which frames are
    rendered.
    """

    def __init__(self, scenario: Scenario, world: World) -> None:
        self._scenario, self._world, seed = scenario, world, scenario.seed
        obstacles = Obstacles(world.things, world.side_m)
        crowds, cars, ugvs = len(scenario.crowd), len(scenario.car), scenario.team.ugvs
        self._vehicle_targets = crowds + 1 + np.arange(cars + ugvs)
        next_number = crowds + cars + ugvs + 1
        self._crowds = Crowds(scenario.crowd, scenario.happening, world.side_m, obstacles, seed, next_number)
        self._cars = Cars(scenario.car, world.side_m, obstacles, seed)
        self._team = Team(scenario.team, scenario.uav, world.side_m, obstacles, seed)
        self._names, self._plates, _ = marker_plates(ugvs)
        self._aircraft = Aircraft(scenario.uav, world.side_m / 2, world.up_m, seed)
        self._telemetry = ReportedPose(scenario.uav, seed)
        self._telemetry_errors = self._telemetry.errors(0.0)
        gps = scenario.gps
        rng = np.random.default_rng([seed, 40])
        self._gps = Receivers(ugvs, gps.error95_m, gps.white_share, gps.correlation_s, gps.common_m, rng)
        self._jump = heading_vector(rng.uniform(0, 2 * np.pi, ugvs))
        self._gust = heading_vector(np.random.default_rng([seed, 53]).uniform(0, 2 * np.pi, len(scenario.fault)))
        self._rate = scenario.clip.rate_hz
        self._ticks = max(1, int(np.ceil(1 / self._rate / _TICK_S - 1e-9)))
        self._number, self._reported = 1, 0
        self._reports: list[Report] = []
        self._events = fault_events(scenario.fault, -np.inf, 0.0)
        self._report(self._team.place, 0.0, 0.0)
        self._plan(0.0)

    @property
    def time_s(self) -> float:
        """Time of the current frame, seconds."""
        return (self._number - 1) / self._rate

    def step(self) -> None:
        """Advance by one frame."""
        start, seconds = self.time_s, 1 / self._rate / self._ticks
        for tick in range(self._ticks):
            self._tick(start + tick * seconds, seconds)
        self._number += 1
        self._telemetry_errors = self._telemetry.errors(1 / self._rate)
        self._events += fault_events(self._scenario.fault, start, self.time_s)

    def steer(self, command: Command) -> None:
        """Carry out a command. Vehicles that the command does not name continue as before."""
        self._aircraft.steer(self._local(command.fly_to), self._local(command.look_at), command.altitude_m)
        for order in command.orders:
            row, goal, seen = self._names.index(order.vehicle), self._local(order.goal), self._local(order.look_at)
            self._team.order(row, goal, order.speed_m_s, seen)

    def moment(self) -> Moment:
        """Return the world at the current frame, with all reports and events since the last call."""
        time, team = self.time_s, self._team
        faults = active_faults(self._scenario.fault, time)
        pose, velocity, turn = self._aircraft.pose()
        pose = replace(pose, place_m=pose.place_m + np.array([faults.cut_m, 0.0, 0.0]))
        # The last row is the UAV's place.
        places = np.concatenate([team.place, pose.place_m[None, :2]])
        errors = np.concatenate([self._gps.error_m + self._jumped(faults), self._telemetry_errors[None, 4:]])
        lonlat = self._lonlat(places + errors)
        reported, own = lonlat[:-1], lonlat[-1]
        reported[[*faults.lost, *faults.silent]] = np.nan
        reports, events, self._reports, self._events = tuple(self._reports), tuple(self._events), [], []
        return Moment(
            self._number,
            time,
            self._bodies(faults),
            pose,
            velocity,
            turn,
            None if faults.is_mute else self._flight(pose, velocity, own),
            reports,
            team.heading.copy(),
            reported,
            (team.heading + team.heading_error) % (2 * np.pi),
            faults.picture,
            events,
        )

    def _local(self, place_deg: np.ndarray | None) -> np.ndarray | None:
        """Convert longitude and latitude (2,) to local metres (2,)."""
        if place_deg is None:
            return None
        return geometry.east_north(np.asarray(place_deg, float)[None], self._scenario.world.origin_deg)[0]

    def _lonlat(self, place_m: np.ndarray) -> np.ndarray:
        return geometry.lonlat(place_m, self._scenario.world.origin_deg)

    def _tick(self, begin: float, seconds: float) -> None:
        end, faults = begin + seconds, active_faults(self._scenario.fault, begin)
        crowds, cars, team, before = self._crowds, self._cars, self._team, self._team.place
        vehicles = [
            np.c_[cars.place, cars.course, np.tile(CAR_HALF_M, (len(cars), 1))],
            np.c_[team.place, team.course, np.tile(UGV_HALF_M, (len(team), 1))],
        ]
        self._events += crowds.step(end, seconds, np.concatenate(vehicles))
        cars.step(end, seconds, np.concatenate([crowds.place, before]))
        team.step(end, seconds, faults.lost, crowds.place)
        push = np.zeros(3)
        for row, since, size in faults.gusts:
            if since < _GUST_S:
                # This push accelerates a damped spring at rest to the gust's speed within _GUST_S.
                push[:2] += math.e * size / _GUST_S * self._gust[row]
        rougher = 1 + max((size for *_, size in faults.gusts), default=0.0) / 5
        self._aircraft.step(end, seconds, push, rougher)
        self._report(before, begin, end)
        if np.floor(end + 1e-6) > np.floor(begin + 1e-6):
            self._plan(end)

    def _report(self, before: np.ndarray, begin: float, end: float) -> None:
        """Collect the receivers' reports between two times. before: (K, 2) places at the first time."""
        rate, after = self._scenario.gps.rate_hz, self._team.place
        while self._reported / rate <= end + 1e-9:
            time = self._reported / rate
            if self._reported:
                self._gps.advance(1 / rate)
            share = np.clip((time - begin) / (end - begin), 0, 1) if end > begin else 1.0
            place = before + share * (after - before) + self._gps.error_m
            faults = active_faults(self._scenario.fault, time)
            reported = self._lonlat(place + self._jumped(faults))
            for k in range(len(self._team)):
                if k not in faults.lost and k not in faults.silent:
                    self._reports.append(Report(k, round(time * self._rate + 1, 6), reported[k], self._gps.sigma_m))
            self._reported += 1

    def _jumped(self, faults: ActiveFaults) -> np.ndarray:
        """Return (K, 2) offsets of the receivers by active faults, metres."""
        off = np.zeros((len(self._team), 2))
        for k, size in faults.jumped.items():
            off[k] = size * self._jump[k]
        return off

    def _plan(self, time_s: float) -> None:
        """Report the current place and the waypoints of the next seconds. Called once a second."""
        if not self._scenario.team.planned or not len(self._team):
            return
        faults = active_faults(self._scenario.fault, time_s)
        places = self._team.waypoints(time_s, _PLANNED_S, faults.lost)
        # A vehicle plans from its receiver's place, so the plan has the receiver's lasting error.
        reported = self._lonlat((places + self._gps.lasting_m + self._jumped(faults)).reshape(-1, 2))
        for ahead, points in enumerate(reported.reshape(places.shape)):
            frame = round((time_s + ahead) * self._rate + 1, 6)
            sigma = float(np.hypot(self._gps.sigma_m, _STRAYS_M * ahead))
            self._reports += [
                Report(k, frame, point, sigma, planned=True) for k, point in enumerate(points) if k not in faults.lost
            ]

    def _flight(self, pose: CameraPose, velocity: np.ndarray, lonlat_deg: np.ndarray) -> Flight:
        """Return the UAV's own report. lonlat_deg: (2,) the reported place."""
        errors, place = self._telemetry_errors, pose.place_m
        ground = float(self._world.up_m(place[None, :2])[0])
        high = (place[2] - ground) * (1 + errors[3])
        longitude, latitude = lonlat_deg.tolist()
        return Flight(
            float(high),
            float(np.hypot(velocity[0], velocity[1])),
            (longitude, latitude),
            float(self._scenario.world.above_sea_m + ground + high),
            *CameraPose(place, rotation_matrix(errors[:3]) @ pose.axes).angles_rad,
            float(np.radians(self._scenario.camera.hfov_deg)),
        )

    def _bodies(self, faults: ActiveFaults) -> Bodies:
        crowds, cars, team = self._crowds, self._cars, self._team
        counts = len(crowds), len(cars), len(team)
        total, first_ugv = sum(counts), sum(counts[:2])
        place = np.concatenate([crowds.place, cars.place, team.place])
        plate, hidden, none = np.full((total, 3), np.nan), np.zeros(total, bool), np.zeros(sum(counts[1:]))
        plate[first_ugv:] = self._plates
        hidden[[first_ugv + k for k in faults.covered]] = True
        return Bodies(
            np.arange(1, total + 1),
            np.repeat(np.array(["person", "car", "ugv"]), counts),
            np.concatenate([crowds.target, self._vehicle_targets]).astype(np.int64),
            np.c_[place, self._world.up_m(place)],
            np.concatenate([crowds.velocity, cars.velocity, team.velocity]),
            np.concatenate([crowds.facing, cars.course, team.course]),
            np.concatenate([crowds.height, none]),
            np.concatenate([crowds.phase, none]),
            np.concatenate([crowds.colour, cars.colour, np.tile(_UGV_BGR, (len(team), 1))]),
            plate,
            hidden,
        )
