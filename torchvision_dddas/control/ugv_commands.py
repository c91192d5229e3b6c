"""The orders of the ground vehicles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.config import Settings
from torchvision_dddas.control.footprint import CameraMount
from torchvision_dddas.control.prediction import Prediction
from torchvision_dddas.control.rules import AdjustmentLog, count_of
from torchvision_dddas.types import LandmarkObservations, Order

# No vehicle comes nearer to the border of a crowd than this: from above they would be one blob.
KEEP_OFF_M = 5.0
# A station is this far within the aerial picture, as a share of its half.
_WITHIN = 0.2
# Turns of the ring that are tried; the assignment changes where the total way shrinks below this share, ...
_TURNS, _BETTER = 12, 0.75
# ... and are longer than this share of the ring's radius.
_NEAR = 0.5


@dataclass(frozen=True)
class Ring:
    """Places about a middle. turn_rad: of the first, clockwise from north."""

    middle_m: np.ndarray
    radius_m: float
    turn_rad: float = 0.0

    def places(self, count: int) -> np.ndarray:
        """(count, 2), evenly about the middle: any three of them make a triangle."""
        bearing = self.turn_rad + 2 * np.pi * np.arange(count) / count
        return self.middle_m + self.radius_m * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)


def assigned(team_m: np.ndarray, ring: Ring, now: np.ndarray | None) -> tuple[Ring, np.ndarray]:
    """The ring, turned, and which of its places (V,) each of the vehicles at (V, 2) takes, by the shortest ways.

    now: the places in force; they stay as they are unless others save a quarter of ways that are long.
    """
    count, held = len(team_m), np.inf
    if now is not None and len(now) == count:
        held = float(_ways(team_m, ring)[np.arange(count), now].sum())
        if held < _NEAR * count * ring.radius_m:
            return ring, now
    best: tuple[float, Ring, np.ndarray] = (np.inf, ring, np.arange(count))
    for turn in np.arange(_TURNS) * 2 * np.pi / count / _TURNS:
        turned = Ring(ring.middle_m, ring.radius_m, ring.turn_rad + turn)
        ways = _ways(team_m, turned)
        rows, places = linear_sum_assignment(ways)
        if (total := float(ways[rows, places].sum())) < best[0] - 1e-9:
            best = total, turned, places
    return (ring, now) if now is not None and best[0] > _BETTER * held else best[1:]


def _ways(team_m: np.ndarray, ring: Ring) -> np.ndarray:
    return np.linalg.norm(team_m[:, None] - ring.places(len(team_m))[None], axis=2)


def drawn_in(places_m: np.ndarray, middle_m: np.ndarray, mount: CameraMount | None) -> np.ndarray:
    """The places (V, 2), those outside an aerial picture of the middle drawn towards it until they are well within."""
    if mount is None:
        return places_m
    drawn = places_m.copy()
    for share in np.linspace(1.0, 0.3, 8):
        outside = mount.inside(drawn, middle_m, mount.altitude_m) < _WITHIN
        if not outside.any():
            break
        drawn[outside] = middle_m + share * (places_m[outside] - middle_m)
    return drawn


def kept_off(places_m: np.ndarray, prediction: Prediction, from_m: np.ndarray) -> np.ndarray:
    """The places (V, 2), those too near a target moved away from it, towards where the vehicle is (V, 2)."""
    moved = places_m.copy()
    for _ in range(3):  # away from one may be nearer to another
        for place, radius in zip(prediction.east_north_m, prediction.radius_m + KEEP_OFF_M, strict=True):
            apart = moved - place
            distance = np.linalg.norm(apart, axis=1)
            near = distance < radius
            if near.any():
                apart[distance < 0.5] = (from_m - place)[distance < 0.5]
                length = np.maximum(np.linalg.norm(apart, axis=1), 1e-6)
                moved[near] = place + (apart / length[:, None] * radius)[near]
    return moved


def around(places_m: np.ndarray, from_m: np.ndarray, prediction: Prediction) -> np.ndarray:
    """The next goals (V, 2) on the ways from (V, 2) to places: past a crowd that is in the way, not through it."""
    goals = places_m.copy()
    for k, (start, goal) in enumerate(zip(from_m, places_m, strict=True)):
        way = goal - start
        length = float(np.linalg.norm(way))
        if length < 1e-6:
            continue
        along = way / length
        aside = np.array([along[1], -along[0]])
        nearest = np.inf
        for place, radius in zip(prediction.east_north_m, prediction.radius_m + KEEP_OFF_M, strict=True):
            ahead, off = float((place - start) @ along), float((place - start) @ aside)
            if 0 < ahead < min(length, nearest) and abs(off) < radius:
                nearest = ahead
                # On the side on which the crowd is not, at its height.
                goals[k] = place - aside * (np.sign(off) or 1.0) * (radius + 1.0)
    return goals


def need(prediction: Prediction) -> np.ndarray:
    """(N,) how much a closer look would tell: 1 where nobody has looked, else up to 1/2, and 0 where sure."""
    doubt = 0.5 - np.abs(prediction.probability - 0.5)
    return np.where(prediction.unseen, 1.0, doubt)


def most_needed(prediction: Prediction, place_m: np.ndarray, far_m: float, now: int) -> int:
    """The row of the target that a vehicle at a place (2,) should look at; -1: there is none. now: the one it looks at.

    Those in reach before others; of these the one most in need, and of equals the nearest.
    """
    if not len(prediction):
        return -1
    distance = np.linalg.norm(prediction.east_north_m - place_m, axis=1) - prediction.radius_m
    held = prediction.target == now
    doubt = np.round(need(prediction) * 4) / 4  # what differs by less is alike
    # A vehicle that changed its mind at each step would see nothing.
    score = 2.0 * (distance <= far_m * np.where(held, 1.1, 1.0)) + doubt + 0.2 * held - 1e-3 * np.maximum(distance, 0)
    return int(np.argmax(score))


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
NEEDED = 4


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

    def __init__(self, settings: Settings, vehicles: Sequence[str]) -> None:
        self.parameters, self.names = settings.steering, tuple(vehicles)
        self._known: dict[int, _Vehicle] = {}
        self._ring: Ring | None = None
        self._on_ring: tuple[int, ...] = ()
        self._place_of: np.ndarray | None = None
        self._let_be: dict[int, float] = {}

    def hear(self, marks: LandmarkObservations, now_s: float, log: AdjustmentLog) -> np.ndarray:
        """Take over the places that the team reports; returns those (V, 2) of the present vehicles."""
        for row, place in zip(marks.landmark.tolist(), marks.east_north_m, strict=True):
            if 0 <= row < len(self.names) and np.isfinite(place).all():
                if row not in self._known:
                    self._known[row] = _Vehicle(np.asarray(place, float), now_s)
                self._known[row].place_m, self._known[row].heard_s = np.asarray(place, float), now_s
        before = len(self._known)
        for row in [row for row, vehicle in self._known.items() if now_s - vehicle.heard_s > _SILENT_S]:
            del self._known[row]
            log.set("team.vehicles", len(self._known), f"{self.names[row]} silent for {_SILENT_S:.0f} s", old=before)
        if before == len(self._known):
            log.set("team.vehicles", before, "all that report", old=before)
        return np.array([self._known[row].place_m for row in self.present]).reshape(-1, 2)

    @property
    def present(self) -> list[int]:
        """The vehicles that count as present."""
        return sorted(self._known)

    def orders(
        self, prediction: Prediction, rows: np.ndarray, mount: CameraMount | None, now_s: float, log: AdjustmentLog
    ) -> tuple[Order, ...]:
        """Orders for each vehicle; none without targets. rows: the targets that are followed."""
        present = self.present
        if not len(rows) or not present:
            self._ring = None
            return ()
        middle = self._middle(prediction, rows, mount)
        self._send(prediction, now_s, log)
        team_m = np.array([self._known[v].place_m for v in present])
        goals = self._stations(prediction, middle, rows, team_m, mount, log)
        goals = kept_off(goals, prediction, team_m)
        passing = around(goals, team_m, prediction)
        drift = prediction.velocity_m_s[rows].mean(axis=0)
        return tuple(
            self._order(v, goals[k], passing[k], prediction, float(np.linalg.norm(drift)), now_s, log)
            for k, v in enumerate(present)
        )

    def _middle(self, prediction: Prediction, rows: np.ndarray, mount: CameraMount | None) -> np.ndarray:
        """Centre of the ring: the wanted targets, a little later."""
        later = prediction.east_north_m[rows] + _LEAD_S * prediction.velocity_m_s[rows]
        return later.mean(axis=0) if mount is None else mount.centre(later, mount.altitude_m)[0]

    def _stations(
        self,
        prediction: Prediction,
        middle: np.ndarray,
        rows: np.ndarray,
        team_m: np.ndarray,
        mount: CameraMount | None,
        log: AdjustmentLog,
    ) -> np.ndarray:
        """(V, 2) the goals of those on the ring and of those sent to look."""
        present, parameters = self.present, self.parameters
        reach = np.linalg.norm(prediction.east_north_m[rows] - middle, axis=1) + prediction.radius_m[rows]
        radius = float(np.clip(reach.max() + KEEP_OFF_M, parameters.station_m, _WIDEST * parameters.station_m))
        on = [k for k, v in enumerate(present) if self._known[v].sent_to < 0]
        names = tuple(present[k] for k in on)
        goals = team_m.copy()
        if on:
            held = self._place_of if names == self._on_ring else None
            turn = self._ring.turn_rad if self._ring is not None else 0.0
            self._ring, self._place_of = assigned(team_m[on], Ring(middle, radius, turn), held)
            self._on_ring = names
            goals[on] = self._ring.places(len(on))[self._place_of]
            about = f"{count_of(len(rows), 'target')} at ({middle[0]:.0f}, {middle[1]:.0f}) m"
            why = f"{count_of(len(on), 'vehicle')} about {about}"
            log.set("team.ring_m", round(radius, 1), why, least=2.0)
        for k, v in enumerate(present):
            if self._known[v].sent_to >= 0:
                row = int(np.flatnonzero(prediction.target == self._known[v].sent_to)[0])
                goals[k] = self._close_to(prediction, row, team_m[k])
        tied = on if len(present) > NEEDED else list(range(len(present)))
        goals[tied] = drawn_in(goals[tied], middle, mount)
        return goals

    def _close_to(self, prediction: Prediction, row: int, from_m: np.ndarray) -> np.ndarray:
        """A place from which a vehicle sees a target well, on its own side of it."""
        place = prediction.east_north_m[row] + _LEAD_S * prediction.velocity_m_s[row]
        apart = from_m - place
        away = prediction.radius_m[row] + max(KEEP_OFF_M, 0.6 * self.parameters.look_m)
        return place + apart / max(float(np.linalg.norm(apart)), 1e-6) * away

    def _send(self, prediction: Prediction, now_s: float, log: AdjustmentLog) -> None:
        """Send vehicles to targets that nobody can see from the ring, and call back those that have seen enough."""
        parameters, wanted = self.parameters, dict(zip(prediction.target.tolist(), range(len(prediction)), strict=True))
        needs = need(prediction)
        for v, vehicle in self._known.items():
            if vehicle.sent_to < 0:
                continue
            row, why = wanted.get(vehicle.sent_to), ""
            if row is None:
                why = f"target {vehicle.sent_to} is lost"
            elif not prediction.unseen[row] and needs[row] < 1 - _UNSURE:
                why = f"target {vehicle.sent_to}: {_known(prediction, row)}"
            elif now_s - vehicle.sent_s > _TRIED_S:
                why = f"target {vehicle.sent_to} told nothing for {_TRIED_S:.0f} s"
                self._let_be[vehicle.sent_to] = now_s
            if why:
                vehicle.sent_to = -1
                log.set(f"{self.names[v]}.sent_to", 0, why)
        free = max(len(self._known) - NEEDED, 1) - sum(vehicle.sent_to >= 0 for vehicle in self._known.values())
        gone_to = {vehicle.sent_to for vehicle in self._known.values()}
        if self._ring is None:
            return
        ring_m = self._ring.places(max(len(self._on_ring), 1))
        afar = np.linalg.norm(prediction.east_north_m[:, None] - ring_m, axis=2).min(axis=1) - prediction.radius_m
        for row in np.argsort(-needs, kind="stable"):
            target = int(prediction.target[row])
            let_be = now_s - self._let_be.get(target, -np.inf) < _LET_BE_S
            if free <= 0 or needs[row] < 1 - _UNSURE:
                break
            seen_from_ring = afar[row] < parameters.look_m
            too_fast = prediction.speed_m_s[row] > parameters.fast_m_s or not prediction.steady[row]
            if target in gone_to or let_be or too_fast or seen_from_ring or prediction.lost_s[row] > 1:
                continue
            idle = [v for v, vehicle in self._known.items() if vehicle.sent_to < 0]
            away = [float(np.linalg.norm(self._known[v].place_m - prediction.east_north_m[row])) for v in idle]
            if min(away) - prediction.radius_m[row] < 0.8 * parameters.look_m:
                continue  # somebody sees it already
            v = idle[int(np.argmin(away))]
            self._known[v].sent_to, self._known[v].sent_s = target, now_s
            why = f"{afar[row]:.0f} m from the nearest station: {_known(prediction, row)}"
            log.set(f"{self.names[v]}.sent_to", target, why)
            free -= 1

    def _order(
        self,
        v: int,
        station: np.ndarray,
        goal: np.ndarray,
        prediction: Prediction,
        drift_m_s: float,
        now_s: float,
        log: AdjustmentLog,
    ) -> Order:
        vehicle, parameters, name = self._known[v], self.parameters, self.names[v]
        away = float(np.linalg.norm(station - vehicle.place_m))
        vehicle.near = away < parameters.near_m * (_FAR if vehicle.near else 1.0)
        # It must not fall behind a crowd that walks faster than it should go near it.
        slow = round(min(max(parameters.slow_m_s, 1.1 * drift_m_s), max(parameters.fast_m_s, parameters.slow_m_s)), 1)
        log.set(
            f"{name}.speed_m_s",
            slow if vehicle.near else parameters.fast_m_s,
            f"{away:.0f} m from its station, the crowd goes at {drift_m_s:.1f} m/s",
            least=1.0,
        )
        row = self._watched(v, prediction, now_s, log)
        speed = slow if vehicle.near else parameters.fast_m_s
        picture = self._pictured(v, prediction, row, now_s, log)
        return Order(name, goal, speed, prediction.east_north_m[row], picture)

    def _watched(self, v: int, prediction: Prediction, now_s: float, log: AdjustmentLog) -> int:
        """The row of the target that a vehicle looks at."""
        vehicle, parameters, name = self._known[v], self.parameters, self.names[v]
        row = most_needed(prediction, vehicle.place_m, parameters.look_m, vehicle.watches)
        here = np.flatnonzero(prediction.target == vehicle.watches)
        if len(here) and now_s - vehicle.watched_s < _LOOK_S:
            row = int(here[0])
        if vehicle.sent_to >= 0:
            row = int(np.flatnonzero(prediction.target == vehicle.sent_to)[0])
        target = int(prediction.target[row])
        if target != vehicle.watches:
            vehicle.watches, vehicle.watched_s, vehicle.sure = target, now_s, self._sure(prediction, row, False)
            apart = float(np.linalg.norm(prediction.east_north_m[row] - vehicle.place_m))
            often = f"a picture every {self._period_s(vehicle):g} s"
            log.set(
                f"{name}.looks_at", target, f"target {target}, {apart:.0f} m off: {_known(prediction, row)}; {often}"
            )
            log.know(f"{name}.picture_s", self._period_s(vehicle))
        return row

    def _sure(self, prediction: Prediction, row: int, now: bool) -> bool:
        """Whether a target counts as surely human or surely not; now: whether it did."""
        surely = abs(float(prediction.probability[row]) - 0.5) + 0.5
        return not bool(prediction.unseen[row]) and surely > (_UNSURE if now else _SURE)

    def _period_s(self, vehicle: _Vehicle) -> float:
        return self.parameters.picture_s * (_SELDOM if vehicle.sure else 1)

    def _pictured(self, v: int, prediction: Prediction, row: int, now_s: float, log: AdjustmentLog) -> bool:
        """Whether it is time for a picture: seldom of what is sure, never of what is out of reach."""
        vehicle, name = self._known[v], self.names[v]
        vehicle.sure = self._sure(prediction, row, vehicle.sure)
        period = self._period_s(vehicle)
        why = f"target {prediction.target[row]}: {_known(prediction, row)}"
        log.set(f"{name}.picture_s", period, why, old=self.parameters.picture_s)
        apart = float(np.linalg.norm(prediction.east_north_m[row] - vehicle.place_m)) - float(prediction.radius_m[row])
        # One vehicle after the other, each in its part of the period.
        shift_s = 1e-6 - v * period / len(self.names)
        turn, last = (int((when_s + shift_s) // period) for when_s in (now_s, vehicle.pictured_s))
        if apart > self.parameters.look_m or turn == last:
            return False
        vehicle.pictured_s = now_s
        return True


def _known(prediction: Prediction, row: int) -> str:
    return "nobody has seen it" if prediction.unseen[row] else f"human with {prediction.probability[row]:.2f}"
