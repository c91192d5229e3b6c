"""Compute the orders of the ground vehicles: stations that move with the crowd, closer looks, and picture requests.

Stations lie on a ring around the crowd, so that they are never on one line. Vehicles look at targets in doubt.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.control.footprint import CameraMount
from torchvision_dddas.control.prediction import LOST_S, Prediction
from torchvision_dddas.control.rules import AdjustmentLog, count_of
from torchvision_dddas.geometry import cheapest
from torchvision_dddas.types import LandmarkObservations, Order

# Number of vehicles on the ring that location from the air needs.
_NEEDED = 4
# Smallest distance of a vehicle from the edge of a crowd. Nearer vehicles would merge with the crowd's blob from above.
_KEEP_OFF_M = 5.0
# Smallest margin of a station inside the aerial picture, as a share of half the picture.
_WITHIN = 0.2
# Number of rotations of the ring that are tried. The assignment changes only if the total distance to drive falls below
# _BETTER of the current distance, and the mean distance is at least _NEAR of the ring's radius.
_TURNS, _BETTER, _NEAR = 12, 0.75, 0.5
# A vehicle that reports no position still counts for this time, because planned waypoints bridge dropouts.
_SILENT_S = 10.0
# A vehicle that was near its goal counts as far from it beyond this multiple of near_m.
_FAR = 1.5
# A target is sure above the probability _SURE, until it falls below _UNSURE. Of a sure target only every _SELDOM-th
# picture is taken.
_SURE, _UNSURE, _SELDOM = 0.95, 0.9, 5
# A vehicle sent to a target without a result returns after _TRIED_S, and no vehicle is sent there for _LET_BE_S.
_TRIED_S, _LET_BE_S = 15.0, 30.0
# Shortest time for which a vehicle looks at a target.
_LOOK_S = 2.0
# Largest radius of the ring in units of station_m. Vehicles are sent to targets further away.
_WIDEST = 1.5
# Stations lie around the crowd as predicted for this much later.
_LEAD_S = 1.0


@dataclass(frozen=True)
class _Ring:
    """Positions on a circle. turn_rad: bearing of the first position, clockwise from north."""

    middle_m: np.ndarray
    radius_m: float
    turn_rad: float = 0.0

    def places(self, count: int) -> np.ndarray:
        """Return (count, 2) evenly spaced positions on the circle, no three of which lie on a line."""
        bearing = self.turn_rad + 2 * np.pi * np.arange(count) / count
        return self.middle_m + self.radius_m * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)

    def ways(self, team_m: np.ndarray) -> np.ndarray:
        """Return the (V, V) distances in metres from each vehicle to each of V positions."""
        return np.linalg.norm(team_m[:, None] - self.places(len(team_m))[None], axis=2)


@dataclass
class _Vehicle:
    """The state of a ground vehicle, and its orders."""

    place_m: np.ndarray
    heard_s: float
    near: bool = False
    watches: int = -1
    watched_s: float = -np.inf
    sure: bool = False
    pictured_s: float = -1e6
    sent_to: int = -1
    sent_s: float = 0.0


class UgvTeam:
    """Computes the orders of the ground vehicles."""

    def __init__(self, settings: Settings, vehicles: Sequence[str], log: AdjustmentLog) -> None:
        self.parameters, self.names, self._log = settings.steering, tuple(vehicles), log
        self._known: dict[int, _Vehicle] = {}
        self._ring: _Ring | None = None
        self._on_ring: list[int] = []
        self._place_of: np.ndarray | None = None
        self._let_be: dict[int, float] = {}
        self._now_s = 0.0

    def hear(self, marks: LandmarkObservations, now_s: float) -> np.ndarray:
        """Take the reported positions of the team, and return the positions (V, 2) of vehicles that are not silent."""
        self._now_s = now_s
        for row, place in zip(marks.landmark.tolist(), marks.east_north_m, strict=True):
            if 0 <= row < len(self.names) and np.isfinite(place).all():
                vehicle = self._known.setdefault(row, _Vehicle(place, now_s))
                vehicle.place_m, vehicle.heard_s = place, now_s
        before = len(self._known)
        for row in [row for row, vehicle in self._known.items() if now_s - vehicle.heard_s > _SILENT_S]:
            del self._known[row]
            why = f"{self.names[row]} silent for {_SILENT_S:.0f} s"
            self._log.set("team.vehicles", len(self._known), why, old=before)
        if before == len(self._known):
            self._log.set("team.vehicles", before, "number of vehicles that report", old=before)
        self._known = dict(sorted(self._known.items()))
        return np.array([vehicle.place_m for vehicle in self._known.values()]).reshape(-1, 2)

    def orders(self, prediction: Prediction, rows: np.ndarray, mount: CameraMount | None) -> tuple[Order, ...]:
        """Return orders for all vehicles that are not silent; [] without targets. rows: the targets to follow."""
        if not len(rows) or not self._known:
            self._ring = None
            return ()
        # Stations lie around the positions of the followed targets a little later.
        later = prediction.east_north_m[rows] + _LEAD_S * prediction.velocity_m_s[rows]
        middle = later.mean(axis=0) if mount is None else mount.centre(later, mount.altitude_m)[0]
        self._send(prediction)
        team_m = np.array([vehicle.place_m for vehicle in self._known.values()])
        stations = _keep_off(self._stations(prediction, middle, rows, team_m, mount), prediction, team_m)
        goals = _pass_by(stations, team_m, prediction)
        drift_m_s = float(np.linalg.norm(prediction.velocity_m_s[rows].mean(axis=0)))
        return tuple(
            self._order(v, station, goal, prediction, drift_m_s)
            for v, station, goal in zip(self._known, stations, goals, strict=True)
        )

    def _stations(
        self,
        prediction: Prediction,
        middle: np.ndarray,
        rows: np.ndarray,
        team_m: np.ndarray,
        mount: CameraMount | None,
    ) -> np.ndarray:
        """Return the (V, 2) goals of the vehicles on the ring and of the vehicles sent to targets."""
        parameters, vehicles = self.parameters, list(self._known.values())
        reach = np.linalg.norm(prediction.east_north_m[rows] - middle, axis=1) + prediction.radius_m[rows]
        radius = float(np.clip(reach.max() + _KEEP_OFF_M, parameters.station_m, _WIDEST * parameters.station_m))
        on = [k for k, vehicle in enumerate(vehicles) if vehicle.sent_to < 0]
        goals = team_m.copy()
        if on:
            names = [v for v, vehicle in self._known.items() if vehicle.sent_to < 0]
            held = self._place_of if names == self._on_ring else None
            ring = _Ring(middle, radius, self._ring.turn_rad if self._ring is not None else 0.0)
            self._ring, self._place_of = _assign(team_m[on], ring, held)
            self._on_ring = names
            goals[on] = self._ring.places(len(on))[self._place_of]
            about = f"{count_of(len(rows), 'target')} at ({middle[0]:.0f}, {middle[1]:.0f}) m"
            self._log.set("team.ring_m", round(radius, 1), f"{count_of(len(on), 'vehicle')} around {about}", least=2.0)
        for k, vehicle in enumerate(vehicles):
            if vehicle.sent_to >= 0:
                # Choose a position from which the vehicle sees the target well, on the vehicle's side of the target.
                row = int(np.flatnonzero(prediction.target == vehicle.sent_to)[0])
                place = prediction.east_north_m[row] + _LEAD_S * prediction.velocity_m_s[row]
                apart = team_m[k] - place
                away = prediction.radius_m[row] + max(_KEEP_OFF_M, 0.6 * parameters.look_m)
                goals[k] = place + apart / max(float(np.linalg.norm(apart)), 1e-6) * away
        tied = on if len(vehicles) > _NEEDED else list(range(len(vehicles)))
        if mount is None:
            return goals
        # Move stations that lie outside the aerial picture towards its centre until they are well inside.
        drawn = goals[tied]
        for share in np.linspace(1.0, 0.3, 8):
            outside = mount.inside(drawn, middle, mount.altitude_m) < _WITHIN
            if not outside.any():
                break
            drawn[outside] = middle + share * (goals[tied][outside] - middle)
        goals[tied] = drawn
        return goals

    def _send(self, prediction: Prediction) -> None:
        """Send vehicles to targets that cannot be seen from the ring, and call back vehicles that have seen enough."""
        now_s, needs = self._now_s, _need(prediction)
        row_of = {target: row for row, target in enumerate(prediction.target.tolist())}
        for v, vehicle in self._known.items():
            if vehicle.sent_to < 0:
                continue
            row, why = row_of.get(vehicle.sent_to), ""
            if row is None:
                why = f"target {vehicle.sent_to} is lost"
            elif not prediction.unseen[row] and needs[row] < 1 - _UNSURE:
                why = f"target {vehicle.sent_to}: {_describe(prediction, row)}"
            elif now_s - vehicle.sent_s > _TRIED_S:
                why = f"target {vehicle.sent_to} was not recognized within {_TRIED_S:.0f} s"
                self._let_be[vehicle.sent_to] = now_s
            if why:
                vehicle.sent_to = -1
                self._log.set(f"{self.names[v]}.sent_to", 0, why)
        sent_to = {vehicle.sent_to for vehicle in self._known.values()}
        free = max(len(self._known) - _NEEDED, 1) - sum(vehicle.sent_to >= 0 for vehicle in self._known.values())
        if self._ring is None:
            return
        ring_m = self._ring.places(max(len(self._on_ring), 1))
        far_m = np.linalg.norm(prediction.east_north_m[:, None] - ring_m, axis=2).min(axis=1) - prediction.radius_m
        for row in np.argsort(-needs, kind="stable"):
            if free <= 0 or needs[row] < 1 - _UNSURE:
                break
            target = int(prediction.target[row])
            let_be = now_s - self._let_be.get(target, -np.inf) < _LET_BE_S
            seen_from_ring = far_m[row] < self.parameters.look_m
            too_fast = prediction.speed_m_s[row] > self.parameters.fast_m_s or not prediction.steady[row]
            if target in sent_to or let_be or too_fast or seen_from_ring or prediction.lost_s[row] > 1:
                continue
            place = prediction.east_north_m[row]
            idle = {v: vehicle for v, vehicle in self._known.items() if vehicle.sent_to < 0}
            away_m = {v: float(np.linalg.norm(vehicle.place_m - place)) for v, vehicle in idle.items()}
            v = min(away_m, key=lambda vehicle: away_m[vehicle])
            if away_m[v] - prediction.radius_m[row] < 0.8 * self.parameters.look_m:
                continue  # a vehicle is near enough to see the target already
            idle[v].sent_to, idle[v].sent_s = target, now_s
            why = f"{far_m[row]:.0f} m from the nearest station: {_describe(prediction, row)}"
            self._log.set(f"{self.names[v]}.sent_to", target, why)
            free -= 1

    def _order(self, v: int, station: np.ndarray, goal: np.ndarray, prediction: Prediction, drift_m_s: float) -> Order:
        vehicle, parameters, name = self._known[v], self.parameters, self.names[v]
        away = float(np.linalg.norm(station - vehicle.place_m))
        vehicle.near = away < parameters.near_m * (_FAR if vehicle.near else 1.0)
        # The vehicle must not fall behind a crowd that moves faster than slow_m_s.
        slow = round(min(max(parameters.slow_m_s, 1.1 * drift_m_s), max(parameters.fast_m_s, parameters.slow_m_s)), 1)
        speed = slow if vehicle.near else parameters.fast_m_s
        why = f"{away:.0f} m from its station, the crowd moves at {drift_m_s:.1f} m/s"
        self._log.set(f"{name}.speed_m_s", speed, why, least=1.0)
        row = self._watch(v, prediction)
        return Order(name, goal, speed, prediction.east_north_m[row], self._is_pictured(v, prediction, row))

    def _watch(self, v: int, prediction: Prediction) -> int:
        """Return the row of the target that a vehicle should look at.

        Targets in reach come first; among them the target most in need of a look, and among equals the nearest.
        """
        vehicle, name = self._known[v], self.names[v]
        distance = np.linalg.norm(prediction.east_north_m - vehicle.place_m, axis=1)
        beyond, held = distance - prediction.radius_m, prediction.target == vehicle.watches
        doubt = np.round(_need(prediction) * 4) / 4  # rounded, so that small differences do not count
        # Prefer the current target, because a vehicle that switches at every step would see nothing.
        in_reach = beyond <= self.parameters.look_m * np.where(held, 1.1, 1.0)
        row = int(np.argmax(2.0 * in_reach + doubt + 0.2 * held - 1e-3 * np.maximum(beyond, 0)))
        if held.any() and self._now_s - vehicle.watched_s < _LOOK_S:
            row = int(held.argmax())
        if vehicle.sent_to >= 0:
            row = int(np.flatnonzero(prediction.target == vehicle.sent_to)[0])
        target = int(prediction.target[row])
        if target != vehicle.watches:
            vehicle.watches, vehicle.watched_s, vehicle.sure = target, self._now_s, _is_sure(prediction, row, False)
            period = self._period_s(vehicle)
            what = f"target {target}, {distance[row]:.0f} m off: {_describe(prediction, row)}"
            self._log.set(f"{name}.looks_at", target, f"{what}; a picture every {period:g} s")
            self._log.know(f"{name}.picture_s", period)
        return row

    def _period_s(self, vehicle: _Vehicle) -> float:
        return self.parameters.picture_s * (_SELDOM if vehicle.sure else 1)

    def _is_pictured(self, v: int, prediction: Prediction, row: int) -> bool:
        """Return whether a picture is due: rarely of a sure target, and never of a target out of reach."""
        vehicle = self._known[v]
        vehicle.sure = _is_sure(prediction, row, vehicle.sure)
        period = self._period_s(vehicle)
        why = f"target {prediction.target[row]}: {_describe(prediction, row)}"
        self._log.set(f"{self.names[v]}.picture_s", period, why, old=self.parameters.picture_s)
        beyond = float(np.linalg.norm(prediction.east_north_m[row] - vehicle.place_m)) - float(prediction.radius_m[row])
        # Vehicles take pictures one after another, each in its own part of the period.
        shift_s = 1e-6 - v * period / len(self.names)
        turn, last = (int((when_s + shift_s) // period) for when_s in (self._now_s, vehicle.pictured_s))
        if beyond > self.parameters.look_m or turn == last:
            return False
        vehicle.pictured_s = self._now_s
        return True


def _assign(team_m: np.ndarray, ring: _Ring, now: np.ndarray | None) -> tuple[_Ring, np.ndarray]:
    """Return the rotated ring, and for each vehicle (V,) the index of its position, for the shortest total distance.

    team_m: (V, 2) positions of the vehicles. now: (V,) current indices. They are kept unless the distances are
    long and another assignment shortens them by a quarter.
    """
    count, held = len(team_m), np.inf
    if now is not None:
        held = float(ring.ways(team_m)[np.arange(count), now].sum())
        if held < _NEAR * count * ring.radius_m:
            return ring, now
    best: tuple[float, _Ring, np.ndarray] = (np.inf, ring, np.arange(count))
    for turn in np.arange(_TURNS) * 2 * np.pi / count / _TURNS:
        turned = replace(ring, turn_rad=ring.turn_rad + turn)
        ways = turned.ways(team_m)
        rows, places = cheapest(ways)
        if (total := float(ways[rows, places].sum())) < best[0] - 1e-9:
            best = total, turned, places
    return (ring, now) if now is not None and best[0] > _BETTER * held else best[1:]


def _keep_off(places_m: np.ndarray, prediction: Prediction, from_m: np.ndarray) -> np.ndarray:
    """Move positions (V, 2) that are too near a target away from it. from_m: (V, 2) positions of the vehicles."""
    moved = places_m.copy()
    for _ in range(3):  # repeat, because moving away from one target may bring a position near another
        for place, radius in zip(prediction.east_north_m, prediction.radius_m + _KEEP_OFF_M, strict=True):
            apart = moved - place
            distance = np.linalg.norm(apart, axis=1)
            apart[distance < 0.5] = (from_m - place)[distance < 0.5]
            length = np.maximum(np.linalg.norm(apart, axis=1), 1e-6)
            near = distance < radius
            moved[near] = place + (apart / length[:, None] * radius)[near]
    return moved


def _pass_by(places_m: np.ndarray, from_m: np.ndarray, prediction: Prediction) -> np.ndarray:
    """Return the next goals (V, 2) on paths from `from_m` to `places_m` that lead around crowds."""
    goals = places_m.copy()
    for k, (start, goal) in enumerate(zip(from_m, places_m, strict=True)):
        length = nearest = float(np.linalg.norm(goal - start))
        if length < 1e-6:
            continue
        along = (goal - start) / length
        aside = np.array([along[1], -along[0]])
        for place, radius in zip(prediction.east_north_m, prediction.radius_m + _KEEP_OFF_M, strict=True):
            ahead, off = float((place - start) @ along), float((place - start) @ aside)
            if 0 < ahead < nearest and abs(off) < radius:
                nearest = ahead
                # Pass the crowd on the side away from its centre.
                goals[k] = place - aside * (np.sign(off) or 1.0) * (radius + 1.0)
    return goals


def _need(prediction: Prediction) -> np.ndarray:
    """Return the (N,) need for a closer look: 1 for a target that was not observed, else 1/2 (in doubt) to 0 (sure)."""
    return np.where(prediction.unseen, 1.0, 0.5 - np.abs(prediction.probability - 0.5))


def _is_sure(prediction: Prediction, row: int, now: bool) -> bool:
    """Return whether a target is surely human or surely not, and seen from the air. now: the current answer."""
    surely = abs(float(prediction.probability[row]) - 0.5) + 0.5
    known = not prediction.unseen[row] and prediction.lost_s[row] <= LOST_S
    return bool(known) and surely > (_UNSURE if now else _SURE)


def _describe(prediction: Prediction, row: int) -> str:
    if prediction.unseen[row]:
        return "not yet seen by a ground vehicle"
    missed = ", missed from the air" if prediction.lost_s[row] > LOST_S else ""
    return f"human with {prediction.probability[row]:.2f}{missed}"
