"""People as a camera near the ground sees them: limbs with joints, a gait, and clothes that differ."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchvision_dddas.simulation.bodies import Canvas
from torchvision_dddas.simulation.camera import View

_TROUSERS = ((92, 66, 48), (40, 38, 36), (70, 70, 72), (84, 112, 132), (56, 74, 96), (120, 124, 128), (62, 48, 40))
_SKIN = ((142, 172, 214), (104, 140, 188), (78, 108, 156), (52, 74, 112))
_HAIR = ((22, 24, 28), (34, 48, 66), (60, 82, 110), (110, 112, 116))
_ROUND = np.linspace(0, np.pi, 9)


@dataclass(frozen=True)
class Dress:
    """What a person wears and how they are built; colours BGR. wide: width of the body beside the usual one."""

    shirt: np.ndarray
    trousers: np.ndarray
    skin: np.ndarray
    hair: np.ndarray
    wide: float
    sleeves: bool
    skirt: bool
    hat: bool
    pack: bool
    pace: float


class Parts(NamedTuple):
    """Tapered limbs, one row each: from, to (N, 3) local metres, radius there (N,), colour (N, 3) BGR."""

    start_m: np.ndarray
    end_m: np.ndarray
    start_radius_m: np.ndarray
    end_radius_m: np.ndarray
    colour: np.ndarray


def dress(colour: np.ndarray, seed: int, number: int) -> Dress:
    """What the person of a number wears, in a shirt of that colour; the same at each call."""
    rng = np.random.default_rng([seed, 61, number])
    chance = rng.uniform(size=6)
    skin, hair, trousers = (rng.integers(len(choice)) for choice in (_SKIN, _HAIR, _TROUSERS))
    tone = rng.uniform(0.75, 1.2)
    return Dress(
        np.asarray(colour, float),
        np.clip(np.array(_TROUSERS[trousers]) * tone, 0, 255),
        np.array(_SKIN[skin], float),
        np.array(_HAIR[hair], float),
        float(np.clip(rng.normal(1.0, 0.09), 0.8, 1.3)),
        bool(chance[0] < 0.6),
        bool(chance[1] < 0.12),
        bool(chance[2] < 0.35),
        bool(chance[3] < 0.3),
        float(rng.uniform(0.8, 1.2)),
    )


def person(
    feet_m: np.ndarray, facing_rad: float, height_m: float, speed_m_s: float, phase: float, wears: Dress
) -> Parts:
    """The limbs of someone who stands at a place (3,) or walks; phase in strides, facing clockwise from north."""
    h = height_m
    swing = 0.36 * wears.pace * min(speed_m_s / 1.4, 1.8) ** 0.7 if speed_m_s > 0.05 else 0.0
    turn = 2 * np.pi * phase
    ahead = np.array([np.sin(facing_rad), np.cos(facing_rad), 0.0])
    right = np.array([np.cos(facing_rad), -np.sin(facing_rad), 0.0])
    up = np.array([0.0, 0.0, 1.0])

    def along(angle: float) -> np.ndarray:
        """Down, turned forward."""
        return np.sin(angle) * ahead - np.cos(angle) * up

    legs = []
    for side in (1, -1):
        thigh = swing * np.sin(turn + (side < 0) * np.pi) + 0.02
        # The knee bends while its leg comes forward.
        bend = 0.08 + 1.6 * swing * max(0.0, np.cos(turn + (side < 0) * np.pi)) ** 2 * (swing > 0)
        legs.append((side, along(thigh), along(thigh - bend)))
    reach = max(0.245 * -thigh[2] + 0.245 * -shin[2] for _, thigh, shin in legs)
    hips = np.asarray(feet_m, float) + (reach * h + 0.04 * h) * up
    chest = hips + 0.30 * h * (up + 0.06 * min(speed_m_s, 3) * ahead / 1.4)
    neck, head = chest + 0.05 * h * up, chest + 0.125 * h * up + 0.012 * h * ahead
    w = wears.wide * h
    rows: list[tuple[np.ndarray, np.ndarray, float, float, np.ndarray]] = []
    for side, thigh, shin in legs:
        hip = hips + side * 0.048 * h * right
        knee = hip + 0.245 * h * thigh
        ankle = knee + 0.245 * h * shin
        rows.append((hip, knee, 0.052 * w, 0.036 * w, wears.trousers))
        rows.append((knee, ankle, 0.037 * w, 0.026 * h, wears.trousers * 0.96))
        toe = ankle + 0.085 * h * (ahead * np.cos(0.3) - 0.25 * up)
        rows.append((ankle - 0.018 * h * up, toe, 0.023 * h, 0.018 * h, np.array([34.0, 36, 42])))
    if wears.skirt:
        rows.append((hips, hips - 0.25 * h * up, 0.085 * w, 0.115 * w, wears.trousers))
    rows.append((hips + 0.02 * h * up, chest - 0.1 * h * up, 0.078 * w, 0.082 * w, wears.shirt))
    flank = hips + 0.1 * h * up
    rows += [(flank, chest + side * 0.062 * w * right, 0.07 * w, 0.052 * w, wears.shirt) for side in (1, -1)]
    for side in (1, -1):
        back = -0.9 * swing * np.sin(turn + (side < 0) * np.pi)
        shoulder = chest + side * 0.108 * w * right
        out = 0.05 * side * right
        elbow = shoulder + 0.172 * h * (along(back) + out)
        hand = elbow + 0.15 * h * (along(back + 0.25 + 0.5 * swing) + out)
        rows.append((shoulder, elbow, 0.036 * w, 0.028 * w, wears.shirt * 0.95))
        rows.append((elbow, hand, 0.027 * w, 0.02 * h, wears.shirt * 0.92 if wears.sleeves else wears.skin))
        rows.append((hand, hand + 0.03 * h * along(back), 0.021 * h, 0.019 * h, wears.skin))
    rows.append((neck, head, 0.03 * h, 0.03 * h, wears.skin * 0.9))
    rows.append((head - 0.018 * h * up + 0.012 * h * ahead, head + 0.03 * h * up, 0.04 * h, 0.044 * h, wears.skin))
    rows.append((head + 0.02 * h * up - 0.016 * h * ahead, head + 0.045 * h * up, 0.044 * h, 0.042 * h, wears.hair))
    if wears.hat:
        brim = head + 0.05 * h * up
        rows.append((brim - 0.04 * h * ahead, brim + 0.07 * h * ahead, 0.03 * h, 0.02 * h, wears.hair * 1.3))
    if wears.pack:
        rows.append(
            (chest - 0.09 * h * ahead, hips + 0.08 * h * up - 0.09 * h * ahead, 0.07 * h, 0.075 * h, wears.shirt * 0.6)
        )
    start, end, first, last, colour = (np.array(column, float) for column in zip(*rows, strict=True))
    return Parts(start, end, first, last, np.clip(colour, 0, 255))


def outlines(parts: Parts, view: View, widen: float = 1.0, aside: np.ndarray | None = None) -> np.ndarray:
    """(N, 18, 2) pixels of the limbs' outlines, so much wider, moved aside (2,) by shares of their radius."""
    ends = np.stack([parts.start_m, parts.end_m], axis=1)
    radius = np.stack([parts.start_radius_m, parts.end_radius_m], axis=1)
    homogeneous = ends @ view.image_from_world[:, :3].T + view.image_from_world[:, 3]
    depth = homogeneous[..., 2]
    px = homogeneous[..., :2] / depth[..., None]
    size = radius * np.linalg.norm(view.image_from_world[0, :3]) / depth
    if aside is not None:
        px = px + size[..., None] * aside
    size = size * widen
    way = px[:, 1] - px[:, 0]
    angle = np.arctan2(way[:, 1], way[:, 0])
    # Half a circle about each end, turned away from the other.
    turns = np.stack([angle[:, None] + np.pi / 2 + _ROUND, angle[:, None] - np.pi / 2 + _ROUND], axis=1)
    circles = px[:, :, None] + size[:, :, None, None] * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    return circles.reshape(len(px), -1, 2)


def draw_parts(parts: Parts, view: View, canvas: Canvas, value: int, to_sun: np.ndarray) -> None:
    """Draw limbs, far ones first, lit from the sun's side."""
    middle = (parts.start_m + parts.end_m) / 2
    away = np.linalg.norm(middle - view.position_m, axis=1)
    towards = view.position_m - middle.mean(axis=0)
    towards = towards / np.linalg.norm(towards)
    right = view.image_from_world[0, :3] / np.linalg.norm(view.image_from_world[0, :3])
    facing = float(towards @ to_sun)
    # Seen from the sun's side all of it is lit, from the other only its edge.
    lit = np.array([np.sign(right @ to_sun) * 0.32 * (1 - abs(facing)), -0.12])
    shaded, bright = 0.62 + 0.12 * max(facing, 0), 0.82 + 0.25 * max(facing, 0)
    whole, part = outlines(parts, view), outlines(parts, view, 0.66 + 0.2 * max(facing, 0), lit)
    for k in np.argsort(-away):
        canvas.fill(whole[k], np.clip(parts.colour[k] * shaded, 0, 255), value)
        canvas.fill(part[k], np.clip(parts.colour[k] * bright, 0, 255), value)
