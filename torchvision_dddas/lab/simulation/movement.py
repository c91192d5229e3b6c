"""Steer moving bodies around obstacles and each other, and along waypoints. Directions are clockwise from north."""

import numpy as np

from torchvision_dddas.lab.simulation.cover import StandingObjects

_CELL_M = 4.0
_REACH_M = 8.0
_NEAREST = 6  # objects that each cell stores, nearest edges first
_TOUCHING = 3  # nearest objects of these that are tested for contact


def heading_vector(heading_rad: np.ndarray | float) -> np.ndarray:
    """Return (..., 2) unit vectors, east and north."""
    return np.stack([np.sin(heading_rad), np.cos(heading_rad)], axis=-1)


def wrap_angle(angle_rad: np.ndarray) -> np.ndarray:
    """Return the angles wrapped to [-pi, pi)."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


class Obstacles:
    """Discs on the ground, stored by grid cell. Trees and buildings block. Bushes are avoided where there is room."""

    def __init__(self, things: StandingObjects, side_m: float) -> None:
        place, radius = np.asarray(things.east_north_m, float).reshape(-1, 2), np.asarray(things.radius_m, float)
        self._half, self._across = side_m / 2, max(1, int(np.ceil(side_m / _CELL_M)))
        self._table = self._near_cells(place, radius)
        # Entry -1 of the table means no object. It refers to the last row here, which is very far away.
        self._place = np.concatenate([place, [[1e9, 1e9]]])
        self._radius = np.append(radius, 0.0)
        self._blocks = np.array([*(str(kind) != "bush" for kind in things.kind), False])

    def _near_cells(self, place: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Return (cells, _NEAREST) int64 objects near each cell, -1 for no object."""
        table = np.full((self._across**2, _NEAREST), -1, np.int64)
        if not len(place):
            return table
        cells, things, away = [], [], []
        reach = (radius + _REACH_M)[:, None]
        low = np.floor((place - reach + self._half) / _CELL_M).astype(int).clip(0)
        high = np.floor((place + reach + self._half) / _CELL_M).astype(int).clip(max=self._across - 1)
        for k, (first, last) in enumerate(zip(low, high, strict=True)):
            column, row = np.meshgrid(np.arange(first[0], last[0] + 1), np.arange(first[1], last[1] + 1))
            middle = (np.stack([column, row], -1) + 0.5) * _CELL_M - self._half
            away.append((np.linalg.norm(middle - place[k], axis=-1) - radius[k]).ravel())
            cells.append((row * self._across + column).ravel())
            things.append(np.full(column.size, k))
        cell, thing = np.concatenate(cells), np.concatenate(things)
        order = np.lexsort((np.concatenate(away), cell))
        cell, thing = cell[order], thing[order]
        rank = np.arange(len(cell)) - np.searchsorted(cell, cell)
        kept = rank < _NEAREST
        table[cell[kept], rank[kept]] = thing[kept]
        return table

    def _near(self, place: np.ndarray) -> np.ndarray:
        """Return (N, _NEAREST) objects near places, -1 for no object."""
        index = np.floor((place + self._half) / _CELL_M).astype(int).clip(0, self._across - 1)
        return self._table[index[:, 1] * self._across + index[:, 0]]

    def steer(self, place: np.ndarray, velocity: np.ndarray, clear_m: float) -> np.ndarray:
        """Turn velocities (N, 2) at constant speed so that they pass objects ahead at clear_m from their edge."""
        near = self._near(place)
        if not (near >= 0).any():
            return velocity
        return steer_round_discs(place, velocity, self._place[near], self._radius[near] + clear_m)

    def outside(self, place: np.ndarray, clear_m: float = 0.3) -> np.ndarray:
        """Return the places (N, 2), moved out of trees and buildings."""
        near = self._near(place)[:, :_TOUCHING]
        away = place[:, None] - self._place[near]
        reach = self._radius[near] + clear_m
        hit = self._blocks[near] & ((away**2).sum(axis=2) < reach**2)
        if not hit.any():
            return place
        row, which = np.nonzero(hit)
        away, reach = away[row, which], reach[row, which]
        distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-6)
        moved = place.copy()
        # If two objects touch a place, the object listed last decides.
        moved[row] = place[row] + ((reach - distance) / distance)[:, None] * away
        return moved


def steer_round_discs(place: np.ndarray, velocity: np.ndarray, centre: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Turn velocities (N, 2) along the tangent of the first of M discs that lies ahead.

    place, velocity: (N, 2). centre: (N, M, 2); radius: (N, M), clearance included.
    """
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    ahead = velocity / np.maximum(speed, 1e-9)[:, None]
    to = centre - place[:, None]
    along = to[..., 0] * ahead[:, None, 0] + to[..., 1] * ahead[:, None, 1]
    # Positive if the disc's middle is to the left.
    left = ahead[:, None, 0] * to[..., 1] - ahead[:, None, 1] * to[..., 0]
    reach = np.maximum(3.0, 2.0 * speed)[:, None] + radius
    hit = (along > 0) & (along < reach) & (np.abs(left) < radius) & (speed[:, None] > 1e-6)
    if not hit.any():
        return velocity
    row = np.flatnonzero(hit.any(axis=1))
    first = np.where(hit[row], along[row], np.inf).argmin(axis=1)
    to, left, radius = to[row, first], left[row, first], radius[row, first]
    distance = np.maximum(np.hypot(to[:, 0], to[:, 1]), 1e-6)
    # Inside the clearance, go along the edge and a little outward.
    turn = np.where(distance > radius, np.arcsin(np.minimum(radius / distance, 1.0)), np.pi / 2 + 0.3)
    turn = np.where(left > 0, -turn, turn)
    cos, sin = np.cos(turn), np.sin(turn)
    way = np.stack([cos * to[:, 0] - sin * to[:, 1], sin * to[:, 0] + cos * to[:, 1]], axis=1) / distance[:, None]
    turned = velocity.copy()
    turned[row] = speed[row, None] * way
    return turned


def near_pairs(place: np.ndarray, reach_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of rows (P,), (P,) of places (N, 2) that are nearer to each other than reach_m, each pair once.

    The search uses a grid of cells, so that its time grows with the number of bodies, not with its square.
    """
    if len(place) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    cell = np.floor((place - place.min(axis=0)) / reach_m).astype(np.int64) + 1
    across = int(cell[:, 0].max()) + 2
    key = cell[:, 1] * across + cell[:, 0]
    order = np.argsort(key, kind="stable")
    ranked = key[order]
    # Neighbours later in the same row of cells, and in the three consecutive cells of the row above.
    rank = np.arange(len(place))
    firsts, seconds = [], []
    for begin, end in (
        (rank + 1, np.searchsorted(ranked, ranked + 1, side="right")),
        (np.searchsorted(ranked, ranked + across - 1), np.searchsorted(ranked, ranked + across + 1, side="right")),
    ):
        many = np.maximum(end - begin, 0)
        firsts.append(np.repeat(rank, many))
        seconds.append(np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many) + np.repeat(begin, many))
    first, second = order[np.concatenate(firsts)], order[np.concatenate(seconds)]
    near = ((place[first] - place[second]) ** 2).sum(axis=1) < reach_m**2
    return first[near], second[near]


class Waypoints:
    """A point that moves through places (P, 2) at a constant speed, forwards and backwards, without end."""

    def __init__(self, places_m: np.ndarray, speed_m_s: float) -> None:
        self._places, self._speed = np.asarray(places_m, float).reshape(-1, 2), speed_m_s
        self._at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self._places, axis=0), axis=1))])

    def at(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the place (2,) and velocity (2,) at a time."""
        length = self._at[-1]
        if length <= 0 or self._speed <= 0:
            return self._places[0].copy(), np.zeros(2)
        gone = (self._speed * max(time_s, 0.0)) % (2 * length)
        back = gone >= length
        gone = 2 * length - gone if back else gone
        leg = int(np.clip(np.searchsorted(self._at, gone, side="right") - 1, 0, len(self._at) - 2))
        # Repeated places make legs of length 0.
        while self._at[leg + 1] <= self._at[leg]:
            leg += 1 if leg + 2 < len(self._at) else -1
        ahead = (self._places[leg + 1] - self._places[leg]) / (self._at[leg + 1] - self._at[leg])
        return self._places[leg] + (gone - self._at[leg]) * ahead, ahead * self._speed * (-1 if back else 1)
