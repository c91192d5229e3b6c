"""Ways through places, there and back again."""

import numpy as np


class Way:
    """A point that goes through places (P, 2) one after the other at a constant speed, and back, without end."""

    def __init__(self, places_m: np.ndarray, speed_m_s: float) -> None:
        self._places = np.asarray(places_m, float).reshape(-1, 2)
        self._speed = speed_m_s
        steps = np.linalg.norm(np.diff(self._places, axis=0), axis=1)
        self._at = np.concatenate([[0.0], np.cumsum(steps)])

    def at(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Place (2,) and velocity (2,)."""
        length = self._at[-1]
        if length <= 0 or self._speed <= 0:
            return self._places[0].copy(), np.zeros(2)
        gone = (self._speed * max(time_s, 0.0)) % (2 * length)
        back = gone >= length
        gone = 2 * length - gone if back else gone
        leg = int(np.clip(np.searchsorted(self._at, gone, side="right") - 1, 0, len(self._at) - 2))
        # Places twice in a row make legs of no length.
        while self._at[leg + 1] <= self._at[leg]:
            leg += 1 if leg + 2 < len(self._at) else -1
        ahead = (self._places[leg + 1] - self._places[leg]) / (self._at[leg + 1] - self._at[leg])
        return self._places[leg] + (gone - self._at[leg]) * ahead, ahead * self._speed * (-1 if back else 1)
