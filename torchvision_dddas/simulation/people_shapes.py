"""People as a camera near the ground sees them: limbs with joints, a gait, and clothes that differ."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.simulation.drawing import SUBPIXEL_BITS, Canvas, View
from torchvision_dddas.types import Bodies

_TROUSERS = ((92, 66, 48), (40, 38, 36), (70, 70, 72), (84, 112, 132), (56, 74, 96), (120, 124, 128), (62, 48, 40))
_SKIN = ((142, 172, 214), (104, 140, 188), (78, 108, 156), (52, 74, 112))
_HAIR = ((22, 24, 28), (34, 48, 66), (60, 82, 110), (110, 112, 116))
_SHOES = np.array([34.0, 36, 42])
_UP = np.array([0.0, 0.0, 1.0])
_LEAST_WRINKLED_PX = 30


@dataclass(frozen=True)
class Dress:
    """What a person wears and how they are built and walk. wide, pace: beside the usual width and swing of the legs.

    colours: (4, 3) BGR of shirt, trousers, skin and hair. loose: how much wider their clothes are than they.
    elbows_rad: (2,) how far the arms are bent, as of someone who holds something. lean_rad: forward.
    """

    colours: np.ndarray
    wide: float
    pace: float
    loose: float
    elbows_rad: np.ndarray
    lean_rad: float
    sleeves: bool
    skirt: bool
    coat: bool
    hat: bool
    brim: bool
    pack: bool
    bag: bool


class Figures(NamedTuple):
    """Limbs of N people, L each. ends_m: (N, L, 2, 3). radius_m: (N, L, 2), NaN: not worn; colour: (N, L, 3)."""

    ends_m: np.ndarray
    radius_m: np.ndarray
    colour: np.ndarray


def choose_dress(colour: np.ndarray, seed: int, number: int) -> Dress:
    """What the person of a number wears, in a shirt of that colour; the same at each call."""
    rng = np.random.default_rng([seed, 61, number])
    chance = rng.uniform(size=7)
    skin, hair, trousers = (rng.integers(len(choice)) for choice in (_SKIN, _HAIR, _TROUSERS))
    legs = np.array(_TROUSERS[trousers]) * rng.uniform(0.75, 1.2)
    return Dress(
        np.stack([np.asarray(colour, float), legs, np.array(_SKIN[skin]), np.array(_HAIR[hair])]),
        float(np.clip(rng.normal(1.0, 0.1), 0.8, 1.35)),
        float(rng.uniform(0.75, 1.2)),
        float(rng.uniform(1.0, 1.35)),
        np.where(rng.uniform(size=2) < 0.35, rng.uniform(0.7, 2.0, 2), 0.15),
        float(np.abs(rng.normal(0, 0.07))),
        *(bool(chance[k] < share) for k, share in enumerate((0.6, 0.1, 0.12, 0.4, 0.4, 0.35, 0.25))),
    )


class Wardrobe:
    """What the people of a world wear, chosen when somebody is first seen."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._dress: dict[int, Dress] = {}

    def figures_of(self, bodies: Bodies, rows: np.ndarray) -> Figures:
        """The limbs of the people in rows of bodies."""
        for row in rows:
            number = int(bodies.number[row])
            if number not in self._dress:
                self._dress[number] = choose_dress(bodies.colour[row], self._seed, number)
        return pose_figures(
            bodies.place_m[rows], bodies.facing_rad[rows], bodies.height_m[rows],
            np.linalg.norm(bodies.velocity_m_s[rows], axis=1), bodies.phase[rows],
            [self._dress[int(number)] for number in bodies.number[rows]],
        )  # fmt: skip


def pose_figures(
    feet_m: np.ndarray,
    facing_rad: np.ndarray,
    height_m: np.ndarray,
    speed_m_s: np.ndarray,
    phase: np.ndarray,
    wear: list[Dress],
) -> Figures:
    """People who stand at (N, 3) or walk, at a phase of their gait in strides; facing is clockwise from north."""
    count = len(feet_m)
    h = np.asarray(height_m, float)[:, None]
    w = h * np.array([one.wide for one in wear])[:, None]
    cloth = w * np.array([one.loose for one in wear])[:, None]
    shirt, trousers, skin, hair = (np.array([one.colours[k] for one in wear]).reshape(-1, 3) for k in range(4))
    ahead = np.stack([np.sin(facing_rad), np.cos(facing_rad), np.zeros(count)], axis=1)
    right = np.stack([ahead[:, 1], -ahead[:, 0], np.zeros(count)], axis=1)
    speed = np.clip(speed_m_s, 0, 3)
    swing = 0.36 * np.array([one.pace for one in wear]) * (np.minimum(speed, 2.5) / 1.4) ** 0.7 * (speed > 0.05)
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def along(angle: np.ndarray) -> np.ndarray:
        """Down, turned forward."""
        return np.sin(angle)[:, None] * ahead - np.cos(angle)[:, None] * _UP

    def limb(start: np.ndarray, end: np.ndarray, first: np.ndarray, last: np.ndarray, colour: np.ndarray) -> None:
        rows.append((start, end, first, last, np.broadcast_to(colour, (count, 3))))

    turns = [2 * np.pi * (phase + half) for half in (0.0, 0.5)]
    thighs = [swing * np.sin(turn) + 0.02 for turn in turns]
    # The knee bends while its leg comes forward.
    shins = [
        thigh - 0.08 - 1.6 * swing * np.maximum(np.cos(turn), 0) ** 2 for thigh, turn in zip(thighs, turns, strict=True)
    ]
    reach = np.max([np.cos(thigh) + np.cos(shin) for thigh, shin in zip(thighs, shins, strict=True)], axis=0)
    hips = feet_m + h * (0.245 * reach + 0.037)[:, None] * _UP
    lean = np.array([one.lean_rad for one in wear]) + 0.043 * speed
    chest = hips + 0.285 * h * (np.cos(lean)[:, None] * _UP + np.sin(lean)[:, None] * ahead)
    head = chest + h * (0.113 * _UP + 0.012 * ahead)
    for side, thigh, shin in zip((1, -1), thighs, shins, strict=True):
        hip = hips + side * 0.048 * h * right
        knee = hip + 0.245 * h * along(thigh)
        ankle = knee + 0.245 * h * along(shin)
        limb(hip, knee, 0.052 * w, 0.036 * cloth, trousers)
        limb(knee, ankle, 0.036 * cloth, 0.025 * cloth, 0.96 * trousers)
        limb(ankle - 0.018 * h * _UP, ankle + 0.085 * h * (0.955 * ahead - 0.25 * _UP), 0.023 * h, 0.018 * h, _SHOES)

    def worn(what: str) -> np.ndarray:
        return np.array([[0.0] if getattr(one, what) else [np.nan] for one in wear]).reshape(-1, 1)

    limb(hips, hips - 0.25 * h * _UP, 0.085 * w + worn("skirt"), 0.115 * cloth, trousers)
    limb(hips + 0.02 * h * _UP, chest - 0.1 * h * _UP, 0.078 * w, 0.078 * cloth, shirt)
    limb(chest - 0.1 * h * _UP, hips - 0.2 * h * _UP, 0.085 * w + worn("coat"), 0.1 * cloth, 0.9 * shirt)
    sleeves = np.array([[one.sleeves] for one in wear]).reshape(-1, 1)
    bends = np.array([one.elbows_rad for one in wear]).reshape(-1, 2)
    for side, turn, bend in zip((1, -1), turns, bends.T, strict=True):
        limb(hips + 0.1 * h * _UP, chest + side * 0.062 * w * right, 0.07 * cloth, 0.052 * w, shirt)
        back = -0.9 * swing * np.sin(turn)
        shoulder, out = chest + side * 0.108 * w * right, 0.05 * side * right
        elbow = shoulder + 0.172 * h * (along(back) + out)
        # A bent arm goes before the body.
        inward = -np.sin(bend)[:, None] * 0.5 * side * right
        hand = elbow + 0.15 * h * (along(back + 0.1 + bend + 0.5 * swing) + out + inward)
        limb(shoulder, elbow, 0.036 * w, 0.028 * cloth, 0.95 * shirt)
        limb(elbow, hand, 0.026 * cloth, 0.02 * h, np.where(sleeves, 0.92 * shirt, skin))
        limb(hand, hand + 0.03 * h * along(back), 0.021 * h, 0.019 * h, skin)
    limb(chest + 0.05 * h * _UP, head, 0.03 * h, 0.03 * h, 0.9 * skin)
    limb(head + h * (0.012 * ahead - 0.018 * _UP), head + 0.03 * h * _UP, 0.04 * h, 0.044 * h, skin)
    limb(head + h * (0.02 * _UP - 0.016 * ahead), head + 0.04 * h * _UP, 0.043 * h, 0.04 * h, hair)
    limb(head + h * (0.05 * _UP - 0.04 * ahead), head + h * (0.05 * _UP + 0.07 * ahead), 0.03 * h + worn("hat"),
         0.02 * h, 1.3 * hair)  # fmt: skip
    limb(head + h * (0.045 * _UP - 0.08 * right), head + h * (0.045 * _UP + 0.08 * right), 0.018 * h + worn("brim"),
         0.018 * h, 0.6 * trousers + 40)  # fmt: skip
    limb(chest - 0.09 * h * ahead, hips + h * (0.08 * _UP - 0.09 * ahead), 0.07 * h + worn("pack"), 0.075 * h,
         0.6 * shirt)  # fmt: skip
    limb(hand - 0.05 * h * _UP, hand - 0.17 * h * _UP, 0.04 * h + worn("bag"), 0.055 * h, 0.5 * hair + 60)
    ends = np.stack([np.stack([row[0], row[1]], axis=1) for row in rows], axis=1)
    radius = np.stack([np.concatenate([row[2], row[3]], axis=1) for row in rows], axis=1)
    return Figures(ends, radius, np.clip(np.stack([row[4] for row in rows], axis=1), 0, 255))


def limb_outlines(
    ends_m: np.ndarray, radius_m: np.ndarray, view: View, widen: float = 1.0, aside: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """(L, 16, 2) pixels of limbs (L, 2, 3), (L, 2), widened by a factor, moved aside by shares of their radius."""
    seen = ends_m.reshape(-1, 3) @ view.image_from_world[:, :3].T + view.image_from_world[:, 3]
    seen = seen.reshape(ends_m.shape)
    depth = seen[..., 2]
    size = radius_m * np.linalg.norm(view.image_from_world[0, :3]) / depth
    px = seen[..., :2] / depth[..., None] + size[..., None] * aside
    return limb_capsules(px, widen * size)


def limb_capsules(px: np.ndarray, size: np.ndarray, points: int = 8) -> np.ndarray:
    """Outlines (L, 2 * points, 2) of limbs with ends (L, 2, 2) and radii (L, 2), px: half a circle about each end."""
    way = px[:, 1] - px[:, 0]
    length = np.hypot(way[:, 0], way[:, 1])[:, None]
    ahead = np.where(length > 1e-9, way / np.maximum(length, 1e-9), (1.0, 0.0))
    aside = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    turn = np.linspace(0, np.pi, points)[:, None]
    half = np.cos(turn) * aside[:, None] - np.sin(turn) * ahead[:, None]
    circles = px[:, :, None] + size[:, :, None, None] * np.stack([half, -half], axis=1)
    return circles.reshape(len(px), 2 * points, 2)


def draw_figure(
    ends_m: np.ndarray,
    radius_m: np.ndarray,
    colour: np.ndarray,
    view: View,
    canvas: Canvas,
    value: int,
    to_sun: np.ndarray,
) -> np.ndarray:
    """Draw someone's limbs, far ones first, lit from the sun's side. Returns their outlines (L, 16, 2), px."""
    worn = np.isfinite(radius_m).all(axis=1)
    ends_m, radius_m, colour = ends_m[worn], radius_m[worn], colour[worn]
    away = np.linalg.norm(ends_m.mean(axis=1) - view.position_m, axis=1)
    towards = view.position_m - ends_m.mean(axis=(0, 1))
    facing = float(towards @ to_sun / np.linalg.norm(towards))
    # The third row looks ahead; across it, upright, is the right.
    side = float(np.sign(view.image_from_world[2, 1] * to_sun[0] - view.image_from_world[2, 0] * to_sun[1]))
    # Seen from the sun's side all of it is lit, from the other only its edge.
    front = max(facing, 0.0)
    whole = limb_outlines(ends_m, radius_m, view)
    part = limb_outlines(ends_m, radius_m, view, 0.66 + 0.2 * front, (side * 0.32 * (1 - abs(facing)), -0.12))
    dark, bright = (np.clip(colour * tone, 0, 255).tolist() for tone in (0.62 + 0.12 * front, 0.82 + 0.25 * front))
    fixed_whole, fixed_part = (
        list(np.round(np.clip(one, -3e4, 3e4) * 2**SUBPIXEL_BITS).astype(np.int32)) for one in (whole, part)
    )
    for k in np.argsort(-away).tolist():
        cv2.fillConvexPoly(canvas.picture, fixed_whole[k], dark[k], cv2.LINE_AA, SUBPIXEL_BITS)
        cv2.fillConvexPoly(canvas.mask, fixed_whole[k], value, cv2.LINE_8, SUBPIXEL_BITS)
        cv2.fillConvexPoly(canvas.picture, fixed_part[k], bright[k], cv2.LINE_AA, SUBPIXEL_BITS)
    _wrinkle(whole, canvas, value)
    return whole


def _wrinkle(outlines_px: np.ndarray, canvas: Canvas, value: int) -> None:
    """Give drawn clothes folds and soft borders of light and shade, as cloth has and flat colours have not."""
    low, high = outlines_px.min(axis=(0, 1)), outlines_px.max(axis=(0, 1))
    tall = float(high[1] - low[1])
    height, width = canvas.picture.shape[:2]
    x0, x1 = (int(np.clip(x, 0, width)) for x in (np.floor(low[0]), np.ceil(high[0]) + 1))
    y0, y1 = (int(np.clip(y, 0, height)) for y in (np.floor(low[1]), np.ceil(high[1]) + 1))
    if tall < _LEAST_WRINKLED_PX or x1 - x0 < 2 or y1 - y0 < 2:
        return
    picture, inside = canvas.picture[y0:y1, x0:x1], (canvas.mask[y0:y1, x0:x1] == value).astype(np.uint8)
    # Its outline stays sharp.
    within = cv2.erode(inside, np.ones((3, 3), np.uint8), iterations=max(1, round(0.01 * tall)), borderValue=1)
    soft = cv2.GaussianBlur(picture, (0, 0), max(0.5, 0.01 * tall))
    cv2.copyTo(soft, within, picture)
    scale = tall / _FOLDS.shape[0]
    place = np.array([[scale, 0, low[0] - x0 - scale * (37 * value % 90)], [0, scale, low[1] - y0]])
    folds = cv2.warpAffine(_FOLDS, place, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    folds[inside == 0] = 128
    picture[:] = cv2.multiply(picture, cv2.merge([folds] * 3), scale=1 / 128)


def _folds() -> np.ndarray:
    """(180, 180) uint8 about 128: a pattern of folds, on a body 180 pixels tall."""
    rng = np.random.default_rng(64)
    pattern = np.zeros((180, 180), np.float32)
    for turn in (60.0, 95.0, 130.0):
        noise = cv2.GaussianBlur(rng.standard_normal((300, 300), np.float32), (0, 0), sigmaX=9, sigmaY=2.2)
        turned = cv2.warpAffine(noise, cv2.getRotationMatrix2D((150, 150), turn, 1), (300, 300))[60:240, 60:240]
        pattern += turned / turned.std()
    return np.clip(128 * (1 + 0.09 * pattern), 0, 255).astype(np.uint8)


def limb_shadows(ends_m: np.ndarray, radius_m: np.ndarray, up_m: float, to_sun: np.ndarray) -> np.ndarray:
    """(L, 16, 3) outlines of limbs' shadows on level ground of a height, local metres."""
    worn = np.isfinite(radius_m).all(axis=1)
    reach = -to_sun[:2] / max(float(to_sun[2]), 0.15)
    flat = ends_m[worn][..., :2] + (ends_m[worn][..., 2:] - up_m) * reach
    outline = limb_capsules(flat, radius_m[worn])
    return np.concatenate([outline, np.full((*outline.shape[:2], 1), up_m)], axis=2)


_FOLDS = _folds()
