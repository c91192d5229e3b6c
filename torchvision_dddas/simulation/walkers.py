"""Many people at once as tapered limbs: what a camera in the air sees of them, and what shade they cast."""

from typing import NamedTuple

import numpy as np

_STRIDE = 0.36  # radians that a leg swings either way at an easy walk
_EASY_M_S = 1.4


class Limbs(NamedTuple):
    """Limbs of N people, L each: ends_m (N, L, 2, 3), radius_m (N, L, 2), colour (N, L, 3) BGR."""

    ends_m: np.ndarray
    radius_m: np.ndarray
    colour: np.ndarray


def limbs(
    feet_m: np.ndarray,
    facing_rad: np.ndarray,
    height_m: np.ndarray,
    speed_m_s: np.ndarray,
    phase: np.ndarray,
    colours: np.ndarray,
) -> Limbs:
    """People who stand at (N, 3), walking with so many strides behind them; facing is clockwise from north.

    colours: (N, 4, 3) BGR of shirt, trousers, skin and hair.
    """
    count = len(feet_m)
    h = height_m[:, None]
    ahead = np.stack([np.sin(facing_rad), np.cos(facing_rad), np.zeros(count)], axis=1)
    right = np.stack([ahead[:, 1], -ahead[:, 0], np.zeros(count)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    swing = _STRIDE * np.clip(speed_m_s / _EASY_M_S, 0, 1.8) ** 0.7 * (speed_m_s > 0.05)

    def along(angle: np.ndarray) -> np.ndarray:
        """Down, turned forward."""
        return np.sin(angle)[:, None] * ahead - np.cos(angle)[:, None] * up

    shirt, trousers, skin, hair = (colours[:, k] for k in range(4))
    hips = feet_m + 0.52 * h * up
    chest = hips + 0.30 * h * (up + (0.04 * np.clip(speed_m_s, 0, 3))[:, None] * ahead)
    rows: list[tuple[np.ndarray, np.ndarray, float, float, np.ndarray]] = []
    for side in (1, -1):
        turn = 2 * np.pi * (phase + (side < 0) * 0.5)
        hip = hips + side * 0.055 * h * right
        knee = hip + 0.245 * h * along(swing * np.sin(turn))
        ankle = knee + 0.24 * h * along(swing * (np.sin(turn) - 1.4 * np.maximum(np.cos(turn), 0) ** 2))
        rows.append((hip, knee, 0.055, 0.04, trousers))
        rows.append((knee, ankle, 0.04, 0.03, trousers))
        rows.append((ankle, ankle + 0.08 * h * ahead, 0.026, 0.024, 0.5 * trousers))
    rows.append((hips, chest, 0.085, 0.09, shirt))
    for side in (1, -1):
        back = -0.9 * swing * np.sin(2 * np.pi * (phase + (side < 0) * 0.5))
        shoulder = chest + side * 0.115 * h * right
        elbow = shoulder + 0.17 * h * along(back) + 0.02 * side * h * right
        hand = elbow + 0.16 * h * along(back + 0.3 + 0.5 * swing)
        rows.append((shoulder, elbow, 0.038, 0.03, shirt))
        rows.append((elbow, hand, 0.03, 0.024, skin))
    rows.append((chest - 0.1 * h * right, chest + 0.1 * h * right, 0.055, 0.055, shirt))
    face = chest + 0.115 * h * up + 0.015 * h * ahead
    rows.append((face, face + 0.03 * h * up, 0.05, 0.05, skin))
    rows.append((face + 0.03 * h * up - 0.02 * h * ahead, face + 0.045 * h * up - 0.01 * h * ahead, 0.053, 0.05, hair))
    ends = np.stack([np.stack([row[0], row[1]], axis=1) for row in rows], axis=1)
    radius = np.array([row[2:4] for row in rows]) * h[:, :, None]
    return Limbs(ends, radius, np.stack([row[4] for row in rows], axis=1))
