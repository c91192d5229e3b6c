"""Vehicles that are no landmarks: they drive their way, turn as wide as they must, and brake for who is ahead."""

import numpy as np

from torchvision_dddas.simulation.obstacles import Obstacles, round_discs
from torchvision_dddas.simulation.scenario import CarPlan

CAR_HALF_M = (2.2, 0.9)
"""Half the length and half the width."""
RADIUS_M = 6.0
"""The narrowest that they turn."""
_ACCELERATION_M_S2, _BRAKE_M_S2 = 1.5, 4.0
_ASIDE_M_S2 = 2.5
"""They slow down in turns so that no more pushes aside."""
_SEEN_M, _WIDE_M, _NARROW_M, _LONG_M, _CREEP_M_S = 25.0, 2.6, 1.5, 2.8, 0.6
"""They pass those whom they see at a distance of _WIDE_M, and brake for those less than _NARROW_M aside."""
# No paint and no shirt is as bright as a plate: a team chooses colours that nothing around it has.
_PAINTS = np.array([[230, 230, 228], [40, 38, 36], [150, 150, 148], [95, 90, 88], [105, 88, 76], [78, 76, 108]], float)


class Cars:
    """All cars as plain arrays: place (N, 2), course (N,) clockwise from north, speed (N,), colour (N, 3)."""

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
        """(N, 2)."""
        return self.speed[:, None] * np.stack([np.sin(self.course), np.cos(self.course)], axis=1)

    def step(self, time_s: float, seconds: float, others: np.ndarray) -> None:
        """On by so long, to time_s; others: (M, 2) people and vehicles that they must not run over."""
        for row in range(len(self)):
            wanted = self._wanted(row)
            around = np.delete(self.place, row, axis=0)
            self._drive(row, time_s, seconds, wanted, np.concatenate([others, around]))

    def _wanted(self, row: int) -> np.ndarray:
        """(2,) the direction in which it wants to go."""
        place, way = self.place[row], self._ways[row]
        if not len(way):
            ahead = np.array([np.sin(self._straight[row]), np.cos(self._straight[row])])
            # At the edge it turns back.
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
        ahead = np.array([np.sin(self.course[row]), np.cos(self.course[row])])
        distance = float(np.linalg.norm(wanted))
        direction = wanted / max(distance, 1e-9) * max(float(self.speed[row]), 1.0)
        direction = self._obstacles.steer(self.place[row : row + 1], direction[None], 1.5)
        to = others - self.place[row]
        near = np.hypot(*to.T) < _SEEN_M
        discs = np.full((1, int(near.sum())), _WIDE_M)
        direction = round_discs(self.place[row : row + 1], direction, others[None, near], discs)[0]
        error = (np.arctan2(*direction) - self.course[row] + np.pi) % (2 * np.pi) - np.pi
        curve = float(np.clip(1.2 * error / max(float(self.speed[row]), 1.0), -1 / RADIUS_M, 1 / RADIUS_M))
        most = float(self._fastest[row]) if time_s >= self._from_s[row] else 0.0
        most = min(most, np.sqrt(_ASIDE_M_S2 / max(abs(curve), 1e-6)))
        if len(self._ways[row]) == 1:
            most = min(most, np.sqrt(2 * _ACCELERATION_M_S2 * max(distance - 1.0, 0.0)))
        along, aside = to @ ahead, to @ np.array([ahead[1], -ahead[0]])
        if (blocked := along[(along > 0) & (np.abs(aside) < _NARROW_M)]).size:
            room = float(blocked.min()) - _LONG_M
            braked = np.sqrt(2 * 0.6 * _BRAKE_M_S2 * max(room - 1.0, 0.0))
            # Slowly past who stands, where there is room to turn.
            most = min(most, max(float(braked), _CREEP_M_S if room > 0 else 0.0))
        change = np.clip(most - self.speed[row], -_BRAKE_M_S2 * seconds, _ACCELERATION_M_S2 * seconds)
        self.speed[row] += change
        gone = self.speed[row] * seconds
        middle = self.course[row] + gone * curve / 2
        self.place[row] += gone * np.array([np.sin(middle), np.cos(middle)])
        self.course[row] = (self.course[row] + gone * curve) % (2 * np.pi)
        self.place[row] = np.clip(self.place[row], -self._half + 2, self._half - 2)
