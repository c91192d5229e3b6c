"""The orders of the ground vehicles: stations that move with the crowd, closer looks, and when a picture is wanted.

Stations are on a ring about the crowd, never on one line; vehicles look at targets in doubt.
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

# Vehicles on the ring that locating needs.
_NEEDED = 4
# No vehicle comes nearer to the border of a crowd than this: from above they would be one blob.
_KEEP_OFF_M = 5.0
# A station is this far within the aerial picture, as a share of its half.
_WITHIN = 0.2
# Turns of the ring that are tried; the assignment changes where the total way shrinks below this share, and ways are
# longer than this share of the ring's radius.
_TURNS, _BETTER, _NEAR = 12, 0.75, 0.5
# A vehicle that reports no place still counts for this time: planned waypoints bridge dropouts.
_SILENT_S = 10.0
# A vehicle that was near becomes far beyond this many times near_m.
_FAR = 1.5
# A target is sure above the first probability until it falls below the second; then only every n-th picture is taken.
_SURE, _UNSURE, _SELDOM = 0.95, 0.9, 5
# A vehicle sent to a target stays for the first time at most; the target is left alone for the second.
_TRIED_S, _LET_BE_S = 15.0, 30.0
# A vehicle looks at a target for this time at least.
_LOOK_S = 2.0
# The ring is at most this many times station_m wide: vehicles are sent to targets further away.
_WIDEST = 1.5
# Stations are around the crowd as predicted this much later.
_LEAD_S = 1.0


@dataclass(frozen=True)
class _Ring:
    """Places about a middle. turn_rad: of the first, clockwise from north."""

    middle_m: np.ndarray
    radius_m: float
    turn_rad: float = 0.0

    def places(self, count: int) -> np.ndarray:
        """(count, 2), evenly about the middle: any three of them make a triangle."""
        bearing = self.turn_rad + 2 * np.pi * np.arange(count) / count
        return self.middle_m + self.radius_m * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)

    def ways(self, team_m: np.ndarray) -> np.ndarray:
        """(V, V) metres from each vehicle to each place."""
        return np.linalg.norm(team_m[:, None] - self.places(len(team_m))[None], axis=2)


@dataclass
class _Vehicle:
    """State of one vehicle, and its orders."""

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
    """The ground vehicles, by name."""

    def __init__(self, settings: Settings, vehicles: Sequence[str], log: AdjustmentLog) -> None:
        self.parameters, self.names, self._log = settings.steering, tuple(vehicles), log
        self._known: dict[int, _Vehicle] = {}
        self._ring: _Ring | None = None
        self._on_ring: list[int] = []
        self._place_of: np.ndarray | None = None
        self._let_be: dict[int, float] = {}
        self._now_s = 0.0

    def hear(self, marks: LandmarkObservations, now_s: float) -> np.ndarray:
        """Take over the places that the team reports; returns those (V, 2) of the present vehicles."""
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
            self._log.set("team.vehicles", before, "all that report", old=before)
        self._known = dict(sorted(self._known.items()))
        return np.array([vehicle.place_m for vehicle in self._known.values()]).reshape(-1, 2)

    def orders(self, prediction: Prediction, rows: np.ndarray, mount: CameraMount | None) -> tuple[Order, ...]:
        """Orders for each vehicle that was heard; none without targets. rows: the targets that are followed."""
        if not len(rows) or not self._known:
            self._ring = None
            return ()
        # Around the followed targets, a little later.
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
        """(V, 2) the goals of those on the ring and of those sent to look."""
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
            self._log.set("team.ring_m", round(radius, 1), f"{count_of(len(on), 'vehicle')} about {about}", least=2.0)
        for k, vehicle in enumerate(vehicles):
            if vehicle.sent_to >= 0:
                # A place from which it sees the target well, on its own side of it.
                row = int(np.flatnonzero(prediction.target == vehicle.sent_to)[0])
                place = prediction.east_north_m[row] + _LEAD_S * prediction.velocity_m_s[row]
                apart = team_m[k] - place
                away = prediction.radius_m[row] + max(_KEEP_OFF_M, 0.6 * parameters.look_m)
                goals[k] = place + apart / max(float(np.linalg.norm(apart)), 1e-6) * away
        tied = on if len(vehicles) > _NEEDED else list(range(len(vehicles)))
        if mount is None:
            return goals
        # Those outside the aerial picture of the middle are drawn towards it until they are well within.
        drawn = goals[tied]
        for share in np.linspace(1.0, 0.3, 8):
            outside = mount.inside(drawn, middle, mount.altitude_m) < _WITHIN
            if not outside.any():
                break
            drawn[outside] = middle + share * (goals[tied][outside] - middle)
        goals[tied] = drawn
        return goals

    def _send(self, prediction: Prediction) -> None:
        """Send vehicles to targets that cannot be seen from the ring, and call back those that have seen enough."""
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
                why = f"target {vehicle.sent_to} told nothing for {_TRIED_S:.0f} s"
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
                continue  # somebody sees it already
            idle[v].sent_to, idle[v].sent_s = target, now_s
            why = f"{far_m[row]:.0f} m from the nearest station: {_describe(prediction, row)}"
            self._log.set(f"{self.names[v]}.sent_to", target, why)
            free -= 1

    def _order(self, v: int, station: np.ndarray, goal: np.ndarray, prediction: Prediction, drift_m_s: float) -> Order:
        vehicle, parameters, name = self._known[v], self.parameters, self.names[v]
        away = float(np.linalg.norm(station - vehicle.place_m))
        vehicle.near = away < parameters.near_m * (_FAR if vehicle.near else 1.0)
        # It must not fall behind a crowd that walks faster than it should go near it.
        slow = round(min(max(parameters.slow_m_s, 1.1 * drift_m_s), max(parameters.fast_m_s, parameters.slow_m_s)), 1)
        speed = slow if vehicle.near else parameters.fast_m_s
        why = f"{away:.0f} m from its station, the crowd goes at {drift_m_s:.1f} m/s"
        self._log.set(f"{name}.speed_m_s", speed, why, least=1.0)
        row = self._watch(v, prediction)
        return Order(name, goal, speed, prediction.east_north_m[row], self._is_pictured(v, prediction, row))

    def _watch(self, v: int, prediction: Prediction) -> int:
        """The row of the target that a vehicle looks at.

        Those in reach before others; of these the one most in need, and of equals the nearest.
        """
        vehicle, name = self._known[v], self.names[v]
        distance = np.linalg.norm(prediction.east_north_m - vehicle.place_m, axis=1)
        beyond, held = distance - prediction.radius_m, prediction.target == vehicle.watches
        doubt = np.round(_need(prediction) * 4) / 4  # what differs by less is alike
        # A vehicle that changed its mind at each step would see nothing.
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
        """Whether it is time for a picture: seldom of what is sure, never of what is out of reach."""
        vehicle = self._known[v]
        vehicle.sure = _is_sure(prediction, row, vehicle.sure)
        period = self._period_s(vehicle)
        why = f"target {prediction.target[row]}: {_describe(prediction, row)}"
        self._log.set(f"{self.names[v]}.picture_s", period, why, old=self.parameters.picture_s)
        beyond = float(np.linalg.norm(prediction.east_north_m[row] - vehicle.place_m)) - float(prediction.radius_m[row])
        # One vehicle after the other, each in its part of the period.
        shift_s = 1e-6 - v * period / len(self.names)
        turn, last = (int((when_s + shift_s) // period) for when_s in (self._now_s, vehicle.pictured_s))
        if beyond > self.parameters.look_m or turn == last:
            return False
        vehicle.pictured_s = self._now_s
        return True


def _assign(team_m: np.ndarray, ring: _Ring, now: np.ndarray | None) -> tuple[_Ring, np.ndarray]:
    """The ring, turned, and which of its places (V,) each of the vehicles at (V, 2) takes, by the shortest ways.

    now: the places in force; they stay as they are unless others save a quarter of ways that are long.
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
    """The places (V, 2), those too near a target moved away from it, towards where the vehicle is (V, 2)."""
    moved = places_m.copy()
    for _ in range(3):  # away from one may be nearer to another
        for place, radius in zip(prediction.east_north_m, prediction.radius_m + _KEEP_OFF_M, strict=True):
            apart = moved - place
            distance = np.linalg.norm(apart, axis=1)
            apart[distance < 0.5] = (from_m - place)[distance < 0.5]
            length = np.maximum(np.linalg.norm(apart, axis=1), 1e-6)
            near = distance < radius
            moved[near] = place + (apart / length[:, None] * radius)[near]
    return moved


def _pass_by(places_m: np.ndarray, from_m: np.ndarray, prediction: Prediction) -> np.ndarray:
    """The next goals (V, 2) on the ways from (V, 2) to places: past a crowd that is in the way, not through it."""
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
                # On the side on which the crowd is not, at its height.
                goals[k] = place - aside * (np.sign(off) or 1.0) * (radius + 1.0)
    return goals


def _need(prediction: Prediction) -> np.ndarray:
    """(N,) what a closer look is worth: 1 for a target not yet seen, else up to 1/2, and 0 where sure."""
    return np.where(prediction.unseen, 1.0, 0.5 - np.abs(prediction.probability - 0.5))


def _is_sure(prediction: Prediction, row: int, now: bool) -> bool:
    """Whether a target counts as surely human or surely not, and the air sees it; now: whether it did."""
    surely = abs(float(prediction.probability[row]) - 0.5) + 0.5
    known = not prediction.unseen[row] and prediction.lost_s[row] <= LOST_S
    return bool(known) and surely > (_UNSURE if now else _SURE)


def _describe(prediction: Prediction, row: int) -> str:
    if prediction.unseen[row]:
        return "nobody has seen it"
    missed = ", missed from the air" if prediction.lost_s[row] > LOST_S else ""
    return f"human with {prediction.probability[row]:.2f}{missed}"
