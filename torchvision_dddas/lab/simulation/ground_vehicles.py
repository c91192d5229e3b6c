"""Ground vehicles: the team of UGVs with coloured markers, and cars, which are not landmarks."""

from collections.abc import Collection
from copy import copy

import cv2
import numpy as np

from torchvision_dddas.lab.simulation.body_shapes import UGV_LENGTH_M, UGV_WIDTH_M
from torchvision_dddas.lab.simulation.movement import (
    Obstacles,
    Waypoints,
    heading_vector,
    steer_round_discs,
    wrap_angle,
)
from torchvision_dddas.lab.simulation.scenario import AircraftParameters, CarPlan, TeamParameters
from torchvision_dddas.types import Colours

ACCELERATION_M_S2, TURN_RAD_S, PAN_RAD_S = 1.5, float(np.radians(90)), float(np.radians(90))
UGV_HALF_M, CAR_HALF_M = (UGV_LENGTH_M / 2, UGV_WIDTH_M / 2), (2.2, 0.9)  # half the length and half the width
_APART_M, _ROOM_M = 2.1, 3.0  # least and intended distance between the middles of two vehicles
_KEPT_OFF_M = 6.0  # distance at which unsteered vehicles pass people
_LOOK_S = 0.25  # time step of the plans
_HEADING_SIGMA_RAD = float(np.radians(2.0))
_STOP_M = UGV_HALF_M[0] + 1.0  # vehicles stop at this distance from others, middle to middle
# Patrol "gather": speed factor beyond _NEAR_M from the middle, and radius of the final ring.
_FAST, _NEAR_M, _GATHERED_M = 3.0, 6.0, 4.0
# Hues in OpenCV's units. The hues that differ most from sand and scrub come first.
_HUES = (120, 150, 90, 0, 60, 30, 105, 165, 75, 135, 45, 15)

RADIUS_M = 6.0  # least turning radius of a car
_BRAKE_M_S2 = 4.0
_ASIDE_M_S2 = 2.5  # greatest lateral acceleration: cars slow down in turns
# Cars see others within _SEEN_M, pass at a distance of _WIDE_M, and brake for others less than _NARROW_M aside.
_SEEN_M, _WIDE_M, _NARROW_M, _LONG_M, _CREEP_M_S = 25.0, 2.6, 1.5, 2.8, 0.6
# Paints and shirts are duller than the markers, because a team chooses colours that its surroundings lack.
_PAINTS = np.array([[230, 230, 228], [40, 38, 36], [150, 150, 148], [95, 90, 88], [105, 88, 76], [78, 76, 108]], float)


def marker_plates(count: int) -> tuple[tuple[str, ...], np.ndarray, Colours]:
    """Return the names of up to 12 UGVs, their markers' colours (K, 3) BGR, and colour ranges for their detection.

    The ranges do not overlap: hues (in OpenCV's steps of two degrees) are 15 apart, and ranges reach 7 to each side.
    """
    hue = np.array(_HUES[:count], int)
    hsv = np.stack([hue, np.full(count, 235), np.full(count, 225)], axis=1).astype(np.uint8)
    bgr = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2BGR)[0].astype(float) if count else np.zeros((0, 3))
    low = np.stack([(hue - 7) % 180, np.full(count, 90), np.full(count, 50)], axis=1)
    high = np.stack([hue + 7, np.full(count, 255), np.full(count, 255)], axis=1)
    names = tuple(f"ugv{k + 1}" for k in range(count))
    return names, bgr, Colours(names, low.astype(np.int64), high.astype(np.int64))


class Team:
    """All UGVs as arrays: place (K, 2), course, heading (of the camera) and speed (K,)."""

    def __init__(
        self, parameters: TeamParameters, flight: AircraftParameters, side_m: float, obstacles: Obstacles, seed: int
    ) -> None:
        count = parameters.ugvs
        self._parameters, self._half, self._obstacles, self._seed = parameters, side_m / 2, obstacles, seed
        rng = np.random.default_rng([seed, 30])
        self._spoke = heading_vector(rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(count) / max(count, 1))
        self._middle = np.array(parameters.middle_m, float)
        self._way = Waypoints(np.array([flight.start_m, *flight.way_m], float), flight.speed_m_s)
        self.place = self._inside(obstacles.outside(self._middle + parameters.ring_m * self._spoke, 1.5))
        self._start = self.place.copy()
        self.course = rng.uniform(0, 2 * np.pi, count)
        self.speed = np.zeros(count)
        self.heading = self.course.copy()
        self.heading_error = _HEADING_SIGMA_RAD * rng.standard_normal(count)
        self._passed = np.zeros(count, int)
        self._drawn: dict[tuple[int, int], np.ndarray] = {}
        self._ordered = np.full((count, 2), np.nan)
        self._ordered_speed = np.zeros(count)
        self._look_at = np.full((count, 2), np.nan)

    def __len__(self) -> int:
        return len(self.place)

    @property
    def velocity(self) -> np.ndarray:
        """(K, 2) east and north, m/s."""
        return self.speed[:, None] * heading_vector(self.course)

    def order(self, row: int, goal_m: np.ndarray | None, speed_m_s: float, look_at_m: np.ndarray | None) -> None:
        """Send a vehicle to goal_m in local metres (None or NaN: keep the goal), and turn its camera to look_at_m."""
        if goal_m is not None and np.isfinite(goal_m).all():
            self._ordered[row] = self._inside(goal_m)
            self._ordered_speed[row] = max(speed_m_s, 0.0)
        self._look_at[row] = np.nan if look_at_m is None else look_at_m

    def step(self, time_s: float, seconds: float, lost: Collection[int], people: np.ndarray) -> None:
        """Advance by `seconds` to time_s. Lost vehicles stand still. Vehicles stop for people (M, 2)."""
        if not len(self):
            return
        goal, most = self._goals(time_s)
        to = goal - self.place
        distance = np.hypot(*to.T)
        arrived = self._is_there(goal, 0.3)
        # The largest speed at which the vehicle can still brake.
        wanted = np.minimum(most, np.sqrt(ACCELERATION_M_S2 * np.maximum(distance - 0.2, 0)))
        direction = to / np.maximum(distance, 1e-9)[:, None] * np.maximum(wanted, 0.3)[:, None]
        direction = self._avoid(self._obstacles.steer(self.place, direction, 1.7), people)
        error = wrap_angle(np.arctan2(direction[:, 0], direction[:, 1]) - self.course)
        stopped = np.isin(np.arange(len(self)), list(lost))
        turn = np.where(arrived | stopped, 0.0, np.clip(2.5 * error, -TURN_RAD_S, TURN_RAD_S))
        wanted = np.where(arrived, 0.0, wanted * np.clip(np.cos(error), 0, 1))
        wanted = np.minimum(wanted, self._free_speed(people))
        hardest = ACCELERATION_M_S2 * seconds
        speed = np.maximum(self.speed + np.clip(wanted - self.speed, -2 * hardest, hardest), 0.0)
        # A lost vehicle stops at once, so that its place is the last that the team knew.
        self.speed = np.where(stopped, 0.0, speed)
        place = self.place + (seconds * self.speed)[:, None] * heading_vector(self.course + turn * seconds / 2)
        # Move each of two vehicles that are too near by half the missing distance.
        away = place[:, None] - place
        distance = np.hypot(away[..., 0], away[..., 1]) + 1e9 * np.eye(len(place))
        short = 0.5 * np.maximum(_APART_M - distance, 0) / np.maximum(distance, 1e-6)
        place = self._obstacles.outside(place + (short[..., None] * away).sum(axis=1), 1.0)
        self.place = np.where(stopped[:, None], self.place, self._inside(place))
        self.course = (self.course + turn * seconds) % (2 * np.pi)
        to = self._look_at - self.place
        bearing = np.where(np.isfinite(to[:, 0]), np.arctan2(to[:, 0], to[:, 1]), self.course)
        panned = np.clip(wrap_angle(bearing - self.heading), -PAN_RAD_S * seconds, PAN_RAD_S * seconds)
        self.heading = (self.heading + np.where(stopped, 0.0, panned)) % (2 * np.pi)

    def waypoints(self, time_s: float, seconds: int, lost: Collection[int]) -> np.ndarray:
        """Return (1 + seconds, K, 2) planned places now and in each coming second, if no person stops the vehicles."""
        ahead, places = copy(self), [self.place]
        for step in range(1, round(seconds / _LOOK_S) + 1):
            ahead.step(time_s + step * _LOOK_S, _LOOK_S, lost, np.zeros((0, 2)))
            if step % round(1 / _LOOK_S) == 0:
                places.append(ahead.place)
        return np.array(places)

    def _goals(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return (K, 2) goals and (K,) speeds."""
        parameters, patrol, goal = self._parameters, self._parameters.patrol, self._start
        speed = np.full(len(self), parameters.patrol_m_s)
        if patrol == "random":
            goal = np.array([self._random_place(k, int(n)) for k, n in enumerate(self._passed)])
            self._passed = self._passed + self._is_there(goal, 1.0)
        elif patrol == "gather":
            reach = max(_GATHERED_M, len(self) * _ROOM_M / 6)
            goal = self._middle + min(reach, parameters.ring_m) * self._spoke
            speed = np.where(np.hypot(*(goal - self.place).T) > _NEAR_M, _FAST * speed, speed)
        elif patrol == "along":
            middle, going = self._way.at(time_s)
            # Braking keeps a vehicle behind a moving goal, so set the goal ahead by that distance.
            goal = middle + self._start - self._way.at(0.0)[0] + going * np.linalg.norm(going) / ACCELERATION_M_S2
            speed = np.full(len(self), 1.5 * float(np.linalg.norm(going)) + 0.2)
        sent = np.isfinite(self._ordered[:, 0])
        goal = np.where(sent[:, None], self._ordered, goal)
        return self._inside(goal), np.where(sent, self._ordered_speed, speed)

    def _is_there(self, goal: np.ndarray, within_m: float) -> np.ndarray:
        """Return (K,) bool, whether each vehicle is at its goal, or close behind another vehicle that stands there."""
        distance = np.hypot(*(goal - self.place).T)
        taken = np.linalg.norm(goal[:, None] - self.place, axis=2) < _ROOM_M
        np.fill_diagonal(taken, False)
        return (distance < within_m) | (taken.any(axis=1) & (distance < 1.5 * _ROOM_M))

    def _random_place(self, k: int, n: int) -> np.ndarray:
        """Return the n-th random place (2,) of vehicle k within the ring."""
        if (k, n) not in self._drawn:
            rng = np.random.default_rng([self._seed, 31, k, n])
            reach, turn = self._parameters.ring_m * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
            self._drawn[k, n] = self._middle + reach * heading_vector(turn)
        return self._drawn[k, n]

    def _avoid(self, direction: np.ndarray, people: np.ndarray) -> np.ndarray:
        """Return directions (K, 2) around people and other vehicles."""
        # Vehicles without orders keep away from people: nearby, a vehicle is no landmark and hides people.
        free = np.flatnonzero(np.isnan(self._ordered[:, 0]))
        if len(free) and len(people):
            centre = np.broadcast_to(people, (len(free), *people.shape))
            radius = np.full(centre.shape[:2], _KEPT_OFF_M)
            direction = direction.copy()
            direction[free] = steer_round_discs(self.place[free], direction[free], centre, radius)
        radius = np.full((len(self), len(self)), _ROOM_M)
        np.fill_diagonal(radius, -1.0)  # a vehicle does not avoid itself
        return steer_round_discs(self.place, direction, np.broadcast_to(self.place, (*radius.shape, 2)), radius)

    def _free_speed(self, people: np.ndarray) -> np.ndarray:
        """Return (K,) greatest speeds that people ahead, and vehicles ahead with a lower row, allow."""
        others, ahead = np.concatenate([people, self.place]), heading_vector(self.course)
        to = others[None] - self.place[:, None]
        along = to[..., 0] * ahead[:, None, 0] + to[..., 1] * ahead[:, None, 1]
        aside = np.abs(ahead[:, None, 1] * to[..., 0] - ahead[:, None, 0] * to[..., 1])
        blocks = (along > 0) & (aside < UGV_HALF_M[1] + 0.3)
        blocks[:, len(people) :] &= np.tri(len(self), k=-1, dtype=bool)
        room = np.where(blocks, along, np.inf).min(axis=1)
        return np.sqrt(2 * ACCELERATION_M_S2 * np.maximum(room - _STOP_M, 0))

    def _inside(self, place: np.ndarray) -> np.ndarray:
        edge = self._half - min(3.0, self._half / 4)
        return place.clip(-edge, edge)


class Cars:
    """All cars as arrays: place (N, 2), course (N,) clockwise from north, speed (N,), colour (N, 3).

    Cars follow their way with a least turning radius and brake for people and vehicles ahead.
    """

    def __init__(self, plans: tuple[CarPlan, ...], side_m: float, obstacles: Obstacles, seed: int) -> None:
        rng = np.random.default_rng([seed, 20])
        self._half, self._margin, self._obstacles = side_m / 2, min(15.0, side_m / 8), obstacles
        limit = self._half - self._margin
        self._ways = [np.clip(np.array(plan.way_m, float).reshape(-1, 2), -limit, limit) for plan in plans]
        self._from_s = np.array([plan.from_s for plan in plans], float)
        self._fastest = np.array([plan.speed_m_s for plan in plans], float)
        self.place = obstacles.outside(np.array([plan.start_m for plan in plans], float).reshape(-1, 2), 1.5)
        self.course = np.radians(np.array([plan.heading_deg for plan in plans], float))
        for row, (way, plan) in enumerate(zip(self._ways, plans, strict=True)):
            away = way - np.array(plan.start_m)
            far = np.flatnonzero(np.linalg.norm(away, axis=1) > 1.0)
            if len(far):
                self.course[row] = np.arctan2(*away[far[0]])
        self.speed = np.where(self._from_s <= 0, self._fastest, 0.0)
        self._straight = self.course.copy()
        self._at, self._step = np.zeros(len(plans), int), np.ones(len(plans), int)
        self.colour = _PAINTS[rng.integers(0, len(_PAINTS), len(plans))]

    def __len__(self) -> int:
        return len(self.place)

    @property
    def velocity(self) -> np.ndarray:
        """(N, 2) east and north, m/s."""
        return self.speed[:, None] * heading_vector(self.course)

    def step(self, time_s: float, seconds: float, others: np.ndarray) -> None:
        """Advance by `seconds` to time_s. others: (M, 2) people and vehicles that cars avoid."""
        for row in range(len(self)):
            wanted = self._wanted(row)
            self._drive(row, time_s, seconds, wanted, np.concatenate([others, np.delete(self.place, row, axis=0)]))

    def _wanted(self, row: int) -> np.ndarray:
        """Return the direction (2,) in which a car wants to go."""
        place, way = self.place[row], self._ways[row]
        if not len(way):
            ahead = heading_vector(self._straight[row])
            # Turn back at the world's edge.
            out = (np.abs(place) > self._half - self._margin - RADIUS_M) & (np.sign(ahead) == np.sign(place))
            if out.any():
                ahead = np.where(out, -ahead, ahead)
                self._straight[row] = np.arctan2(*ahead)
            return ahead
        if np.linalg.norm(way[self._at[row]] - place) < RADIUS_M and len(way) > 1:
            if not 0 <= self._at[row] + self._step[row] < len(way):
                self._step[row] *= -1
            self._at[row] += self._step[row]
        return way[self._at[row]] - place

    def _drive(self, row: int, time_s: float, seconds: float, wanted: np.ndarray, others: np.ndarray) -> None:
        place, course, speed = self.place[row : row + 1], self.course[row], float(self.speed[row])
        distance = float(np.linalg.norm(wanted))
        direction = wanted / max(distance, 1e-9) * max(speed, 1.0)
        direction = self._obstacles.steer(place, direction[None], 1.5)
        to = others - place
        near = np.hypot(*to.T) < _SEEN_M
        discs = np.full((1, int(near.sum())), _WIDE_M)
        direction = steer_round_discs(place, direction, others[None, near], discs)[0]
        error = wrap_angle(np.arctan2(*direction) - course)
        curve = float(np.clip(1.2 * error / max(speed, 1.0), -1 / RADIUS_M, 1 / RADIUS_M))
        most = float(self._fastest[row]) if time_s >= self._from_s[row] else 0.0
        most = min(most, np.sqrt(_ASIDE_M_S2 / max(abs(curve), 1e-6)))
        if len(self._ways[row]) == 1:
            most = min(most, np.sqrt(2 * ACCELERATION_M_S2 * max(distance - 1.0, 0.0)))
        ahead = heading_vector(course)
        along, aside = to @ ahead, to @ np.array([ahead[1], -ahead[0]])
        if (blocked := along[(along > 0) & (np.abs(aside) < _NARROW_M)]).size:
            room = float(blocked.min()) - _LONG_M
            braked = np.sqrt(2 * 0.6 * _BRAKE_M_S2 * max(room - 1.0, 0.0))
            # Creep past a standing obstacle if there is room to turn.
            most = min(most, max(float(braked), _CREEP_M_S if room > 0 else 0.0))
        self.speed[row] += np.clip(most - speed, -_BRAKE_M_S2 * seconds, ACCELERATION_M_S2 * seconds)
        gone = self.speed[row] * seconds
        moved = place[0] + gone * heading_vector(course + gone * curve / 2)
        self.place[row] = np.clip(moved, -self._half + 2, self._half - 2)
        self.course[row] = (course + gone * curve) % (2 * np.pi)
