"""Where ground vehicles stand and look: on a ring about the crowd, never on one line, near targets in doubt."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.control.footprint import CameraMount
from torchvision_dddas.control.prediction import Prediction

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
