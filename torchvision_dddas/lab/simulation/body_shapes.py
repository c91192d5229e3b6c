"""Shapes of people and vehicles: jointed limbs with gait and varied clothes; faces of cars and UGVs."""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from torchvision_dddas.types import Bodies

_TROUSERS = ((92, 66, 48), (40, 38, 36), (70, 70, 72), (84, 112, 132), (56, 74, 96), (120, 124, 128), (62, 48, 40))
_SKIN = ((142, 172, 214), (104, 140, 188), (78, 108, 156), (52, 74, 112))
_HAIR = ((22, 24, 28), (34, 48, 66), (60, 82, 110), (110, 112, 116))
_SHOES = np.array([34.0, 36, 42])
_UP = np.array([0.0, 0.0, 1.0])

# A rover of the size of a small buggy. Its plate covers about 20 pixels at 200 m in a picture 640 pixels wide.
UGV_LENGTH_M, UGV_WIDTH_M, UGV_HEIGHT_M = 2.4, 1.7, 0.95
PLATE_M = (1.9, 1.5)  # the coloured marker on top: along, across
_COVERED_BGR = np.array([118.0, 122.0, 124.0])  # colour of a covered marker
_WHEEL_M = (0.7, 0.3, 0.33)  # wheel: distance from the vehicle's middle, width, radius
_SPOKES = 12
_GLASS, _DARK = (58.0, 50, 44), (38.0, 38, 38)
# Lower and upper section (back, front, half width, height), colours of sides and top; () stands for the paint.
_PRISMS: tuple = (
    ((-2.0, 2.0, 0.8, 0.12), (-2.0, 2.0, 0.8, 0.4), _DARK, _DARK),
    ((-2.2, 2.2, 0.86, 0.3), (-2.15, 2.1, 0.82, 0.85), (), ()),
    ((-1.7, 1.0, 0.76, 0.85), (-1.25, 0.35, 0.64, 1.42), _GLASS, ()),
)
# Panels on a car's flanks: start, end along the car; start, end in height; brightness of the paint or a lamp's BGR.
_FLANK = (
    (-2.12, 2.05, 0.47, 0.53, 0.45),
    (-1.02, -0.98, 0.36, 0.84, 0.4),
    (0.02, 0.06, 0.36, 0.84, 0.4),
    (1.0, 1.04, 0.36, 0.84, 0.4),
    (-0.82, -0.6, 0.7, 0.74, 0.4),
    (0.2, 0.42, 0.7, 0.74, 0.4),
    (-1.0, -0.9, 0.86, 1.38, 0.75),
    (-0.32, -0.22, 0.86, 1.4, 0.75),
    (1.92, 2.1, 0.58, 0.74, (205.0, 225, 230)),
    (-2.16, -1.98, 0.58, 0.76, (36.0, 30, 150)),
)
# Panels on a car's roof: start, end along the car, half width, height, brightness of the paint.
_ROOF = (
    (-0.75, -0.1, 0.4, 1.42, 0.3),
    (1.06, 1.1, 0.74, 0.85, 0.5),
    (1.85, 1.89, 0.7, 0.85, 0.6),
    (-1.8, -1.75, 0.72, 0.85, 0.5),
)


class Dress(NamedTuple):
    """Clothes, build and gait of a person. wide: relative width of the body. pace: relative swing of the legs.

    colours: (4, 3) BGR of shirt, trousers, skin and hair. loose: width of the clothes relative to the body.
    elbows_rad: (2,) bend of the arms. lean_rad: forward lean. The other fields are True if the person wears the item.
    The values of several people are stacked, (N, ...).
    """

    colours: np.ndarray
    wide: np.ndarray
    pace: np.ndarray
    loose: np.ndarray
    elbows_rad: np.ndarray
    lean_rad: np.ndarray
    sleeves: np.ndarray
    skirt: np.ndarray
    coat: np.ndarray
    hat: np.ndarray
    brim: np.ndarray
    pack: np.ndarray
    bag: np.ndarray


class Figures(NamedTuple):
    """Limbs of N people, L each. ends_m: (N, L, 2, 3). radius_m: (N, L, 2), NaN if not worn. colour: (N, L, 3)."""

    ends_m: np.ndarray
    radius_m: np.ndarray
    colour: np.ndarray


def choose_dress(colour: np.ndarray, seed: int, number: int) -> Dress:
    """Choose the clothes of the person with a number, whose shirt has a colour. Each call gives the same result."""
    rng = np.random.default_rng([seed, 61, number])
    chance = rng.uniform(size=7)
    skin, hair, trousers = (rng.integers(len(choice)) for choice in (_SKIN, _HAIR, _TROUSERS))
    legs = np.array(_TROUSERS[trousers]) * rng.uniform(0.75, 1.2)
    build = np.clip(rng.normal(1.0, 0.1), 0.8, 1.35), rng.uniform(0.75, 1.2), rng.uniform(1.0, 1.35)
    elbows = np.where(rng.uniform(size=2) < 0.35, rng.uniform(0.7, 2.0, 2), 0.15)
    has = chance < (0.6, 0.1, 0.12, 0.4, 0.4, 0.35, 0.25)
    values = np.stack([colour, legs, _SKIN[skin], _HAIR[hair]]), *build, elbows, np.abs(rng.normal(0, 0.07)), *has
    return Dress(*(np.asarray(value) for value in values))


class Wardrobe:
    """The clothes of the people of a world, chosen when a person is first seen."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._dress: dict[int, Dress] = {}

    def figures(self, bodies: Bodies, rows: np.ndarray) -> Figures:
        """Return the limbs of the people in rows of bodies."""
        numbers = bodies.number[rows].tolist()
        for row, number in zip(rows, numbers, strict=True):
            if number not in self._dress:
                self._dress[number] = choose_dress(bodies.colour[row], self._seed, number)
        if not numbers:
            return Figures(np.zeros((0, 1, 2, 3)), np.zeros((0, 1, 2)), np.zeros((0, 1, 3)))
        dress = Dress(*(np.array(column) for column in zip(*(self._dress[n] for n in numbers), strict=True)))
        speed = np.linalg.norm(bodies.velocity_m_s[rows], axis=1)
        return _pose(
            bodies.place_m[rows], bodies.facing_rad[rows], bodies.height_m[rows], speed, bodies.phase[rows], dress
        )


def _pose(
    feet_m: np.ndarray,
    facing_rad: np.ndarray,
    height_m: np.ndarray,
    speed_m_s: np.ndarray,
    phase: np.ndarray,
    dress: Dress,
) -> Figures:
    """Return the limbs of people at feet_m (N, 3), at a phase of their gait in strides. dress: columns (N, ...)."""
    count = len(feet_m)
    h = height_m[:, None]
    w = h * dress.wide[:, None]
    cloth = w * dress.loose[:, None]
    shirt, trousers, skin, hair = dress.colours.transpose(1, 0, 2)
    ahead = np.stack([np.sin(facing_rad), np.cos(facing_rad), np.zeros(count)], axis=1)
    right = np.stack([ahead[:, 1], -ahead[:, 0], np.zeros(count)], axis=1)
    speed = np.clip(speed_m_s, 0, 3)
    swing = 0.36 * dress.pace * (np.minimum(speed, 2.5) / 1.4) ** 0.7 * (speed > 0.05)
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def along(angle: np.ndarray) -> np.ndarray:
        """Return the downward direction, turned forward by an angle."""
        return np.sin(angle)[:, None] * ahead - np.cos(angle)[:, None] * _UP

    def limb(start: np.ndarray, end: np.ndarray, first: np.ndarray, last: np.ndarray, colour: np.ndarray) -> None:
        rows.append((start, end, first, last, np.broadcast_to(colour, (count, 3))))

    def worn(has: np.ndarray) -> np.ndarray:
        return np.where(has, 0.0, np.nan)[:, None]

    turns = [2 * np.pi * (phase + half) for half in (0.0, 0.5)]
    thighs = [swing * np.sin(turn) + 0.02 for turn in turns]
    # A knee bends while its leg swings forward.
    shins = [
        thigh - 0.08 - 1.6 * swing * np.maximum(np.cos(turn), 0) ** 2 for thigh, turn in zip(thighs, turns, strict=True)
    ]
    reach = np.max([np.cos(thigh) + np.cos(shin) for thigh, shin in zip(thighs, shins, strict=True)], axis=0)
    hips = feet_m + h * (0.245 * reach + 0.037)[:, None] * _UP
    lean = dress.lean_rad + 0.043 * speed
    chest = hips + 0.285 * h * (np.cos(lean)[:, None] * _UP + np.sin(lean)[:, None] * ahead)
    head = chest + h * (0.113 * _UP + 0.012 * ahead)
    for side, thigh, shin in zip((1, -1), thighs, shins, strict=True):
        hip = hips + side * 0.048 * h * right
        knee = hip + 0.245 * h * along(thigh)
        ankle = knee + 0.245 * h * along(shin)
        limb(hip, knee, 0.052 * w, 0.036 * cloth, trousers)
        limb(knee, ankle, 0.036 * cloth, 0.025 * cloth, 0.96 * trousers)
        limb(ankle - 0.018 * h * _UP, ankle + 0.085 * h * (0.955 * ahead - 0.25 * _UP), 0.023 * h, 0.018 * h, _SHOES)
    limb(hips, hips - 0.25 * h * _UP, 0.085 * w + worn(dress.skirt), 0.115 * cloth, trousers)
    limb(hips + 0.02 * h * _UP, chest - 0.1 * h * _UP, 0.078 * w, 0.078 * cloth, shirt)
    limb(chest - 0.1 * h * _UP, hips - 0.2 * h * _UP, 0.085 * w + worn(dress.coat), 0.1 * cloth, 0.9 * shirt)
    sleeves = dress.sleeves[:, None]
    for side, turn, bend in zip((1, -1), turns, dress.elbows_rad.T, strict=True):
        limb(hips + 0.1 * h * _UP, chest + side * 0.062 * w * right, 0.07 * cloth, 0.052 * w, shirt)
        back = -0.9 * swing * np.sin(turn)
        shoulder, out = chest + side * 0.108 * w * right, 0.05 * side * right
        elbow = shoulder + 0.172 * h * (along(back) + out)
        # A bent arm is held in front of the body.
        inward = -np.sin(bend)[:, None] * 0.5 * side * right
        hand = elbow + 0.15 * h * (along(back + 0.1 + bend + 0.5 * swing) + out + inward)
        limb(shoulder, elbow, 0.036 * w, 0.028 * cloth, 0.95 * shirt)
        limb(elbow, hand, 0.026 * cloth, 0.02 * h, np.where(sleeves, 0.92 * shirt, skin))
        limb(hand, hand + 0.03 * h * along(back), 0.021 * h, 0.019 * h, skin)
    limb(chest + 0.05 * h * _UP, head, 0.03 * h, 0.03 * h, 0.9 * skin)
    limb(head + h * (0.012 * ahead - 0.018 * _UP), head + 0.03 * h * _UP, 0.04 * h, 0.044 * h, skin)
    limb(head + h * (0.02 * _UP - 0.016 * ahead), head + 0.04 * h * _UP, 0.043 * h, 0.04 * h, hair)
    peak, rim = 0.03 * h + worn(dress.hat), 0.018 * h + worn(dress.brim)
    limb(head + h * (0.05 * _UP - 0.04 * ahead), head + h * (0.05 * _UP + 0.07 * ahead), peak, 0.02 * h, 1.3 * hair)
    left_end, right_end = (head + h * (0.045 * _UP + side * 0.08 * right) for side in (-1, 1))
    limb(left_end, right_end, rim, 0.018 * h, 0.6 * trousers + 40)
    pack, bag = 0.07 * h + worn(dress.pack), 0.04 * h + worn(dress.bag)
    limb(chest - 0.09 * h * ahead, hips + h * (0.08 * _UP - 0.09 * ahead), pack, 0.075 * h, 0.6 * shirt)
    limb(hand - 0.05 * h * _UP, hand - 0.17 * h * _UP, bag, 0.055 * h, 0.5 * hair + 60)
    start, end, first, last, colour = (np.stack(column, axis=1) for column in zip(*rows, strict=True))
    return Figures(np.stack([start, end], axis=2), np.concatenate([first, last], axis=2), np.clip(colour, 0, 255))


def limb_capsules(px: np.ndarray, size: np.ndarray, points: int = 8) -> np.ndarray:
    """Return outlines (L, 2 * points, 2) of limbs, with half circles of radii (L, 2) about the ends (L, 2, 2), px."""
    way = px[:, 1] - px[:, 0]
    length = np.hypot(way[:, 0], way[:, 1])[:, None]
    ahead = np.where(length > 1e-9, way / np.maximum(length, 1e-9), (1.0, 0.0))
    aside = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    turn = np.linspace(0, np.pi, points)[:, None]
    half = np.cos(turn) * aside[:, None] - np.sin(turn) * ahead[:, None]
    circles = px[:, :, None] + size[:, :, None, None] * np.stack([half, -half], axis=1)
    return circles.reshape(len(px), 2 * points, 2)


class Faces(NamedTuple):
    """Faces of a vehicle: flat convex outlines. Coordinates are metres ahead, left, up of the vehicle's middle.

    corners_m: (F, C, 3); a face with fewer than C corners repeats its last corner. normal: (F, 3) outwards. colour:
    (F, 3) BGR without paint; paint, plate: (F,) share of the paint's and the plate's colour that is added. lit: (F,)
    bool, whether the brightness depends on the sun.
    """

    corners_m: np.ndarray
    normal: np.ndarray
    colour: np.ndarray
    paint: np.ndarray
    plate: np.ndarray
    lit: np.ndarray

    def placed(self, bodies: Bodies, row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return corners (F, C, 3), normals (F, 3) and colours (F, 3) of the vehicle in a row of bodies."""
        sine, cosine = np.sin(bodies.facing_rad[row]), np.cos(bodies.facing_rad[row])
        local_from_body = np.array([[sine, -cosine, 0.0], [cosine, sine, 0.0], [0.0, 0.0, 1.0]])
        is_bare = not bodies.hidden[row] and np.isfinite(bodies.plate[row]).all()
        plate = bodies.plate[row] if is_bare else _COVERED_BGR
        colour = self.colour + self.paint[:, None] * bodies.colour[row] + self.plate[:, None] * plate
        return self.corners_m @ local_from_body.T + bodies.place_m[row], self.normal @ local_from_body.T, colour


class _FaceList:
    """Faces of a vehicle that is being built."""

    def __init__(self) -> None:
        self._rows: list[tuple] = []

    def add(
        self,
        corners: np.ndarray | Sequence,
        normal: np.ndarray,
        colour: float | tuple[float, ...] = 0.0,
        paint: float = 0.0,
        plate: float = 0.0,
        is_lit: bool = True,
    ) -> None:
        """Add a face. colour: BGR or a grey level."""
        bgr = np.broadcast_to(np.array(colour, float), 3)
        self._rows.append((np.array(corners), normal / np.linalg.norm(normal), bgr, paint, plate, is_lit))

    def add_box(self, middle: Sequence[float], size: Sequence[float], tone: float, paint: float = 0.0) -> None:
        """Add the sides and the top of a box."""
        for axis, sign in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0), (2, 1.0)):
            a, b = (k for k in range(3) if k != axis)
            corners = np.zeros((4, 3))
            corners[:, axis], corners[:, a], corners[:, b] = sign, (1, 1, -1, -1), (1, -1, -1, 1)
            self.add(np.array(middle) + corners * np.array(size) / 2, sign * np.eye(3)[axis], tone, paint)

    def add_hull(self) -> None:
        """Add the hull of a UGV."""
        self.add_box((0.0, 0.0, 0.5), (UGV_LENGTH_M, 1.08, 0.5), 12.0, 0.9)

    def add_marker(self) -> None:
        """Add the coloured plate on top of a UGV."""
        top = np.array([(1, 1, 0), (1, -1, 0), (-1, -1, 0), (-1, 1, 0)]) * [PLATE_M[0] / 2, PLATE_M[1] / 2, 0]
        self.add(top + UGV_HEIGHT_M * _UP, _UP, plate=1.0)

    def faces(self) -> Faces:
        """Return all faces, padded to the same number of corners."""
        corners, *columns = zip(*self._rows, strict=True)
        most = max(len(outline) for outline in corners)
        padded = [np.pad(outline, ((0, most - len(outline)), (0, 0)), mode="edge") for outline in corners]
        return Faces(np.stack(padded), *(np.array(column) for column in columns))


@cache
def vehicle_faces(kind: str, is_near: bool = False) -> Faces:
    """Return the faces of a "car" or "ugv". is_near: add the details that a camera on the ground sees."""
    if kind == "car":
        return _car()
    return _rover() if is_near else _ugv()


def _car() -> Faces:
    """Build a car 4.4 m long in drawing order: the body, then doors, lamps, wheels and roof window."""
    faces, middle = _FaceList(), np.array([0, 0, 0.7])
    for low, high, side, top in _PRISMS:
        foot, head = (
            np.array([[front, half, up], [front, -half, up], [back, -half, up], [back, half, up]])
            for back, front, half, up in (low, high)
        )
        sides = [np.stack([foot[i], foot[j], head[j], head[i]]) for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))]
        for corners, colour in [*((face, side) for face in sides), (head, top)]:
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            outward = normal if normal @ (corners.mean(0) - middle) > 0 else -normal
            faces.add(corners, outward, colour or 0.0, 0.0 if colour else 1.0)
    rim = _ring()
    for hand in (1, -1):
        aside = np.array([0.0, hand, 0.0])
        for back, front, low, high, tone in _FLANK:
            # The flank leans inwards, and leans more above the window sill.
            sill, eave = hand * np.interp((low, high), (0.3, 0.85, 0.851, 1.42), (0.865, 0.825, 0.765, 0.645))
            panel = [[back, sill, low], [front, sill, low], [front, eave, high], [back, eave, high]]
            paint, colour = (0.8 * tone, 0.0) if isinstance(tone, float) else (0.0, tone)
            faces.add(panel, aside, colour, paint, is_lit=False)
        for along in (-1.35, 1.35):
            hub = np.array([along, 0.875 * hand, 0.31])
            faces.add(hub + 0.31 * rim, aside, 26.0, is_lit=False)
            faces.add(hub + 0.15 * rim, aside, (120.0, 120, 122), is_lit=False)
    for back, front, half, height, tone in _ROOF:
        panel = [[back, -half, height], [front, -half, height], [front, half, height], [back, half, height]]
        faces.add(panel, _UP, paint=tone, is_lit=False)
    return faces.faces()


def _ugv() -> Faces:
    """Build a UGV for views from above: six wheels, a hull, a mast, and the marker in the middle of the top."""
    faces = _FaceList()
    for along in (-0.82, 0.0, 0.82):
        for aside in (-0.7, 0.7):
            faces.add_box((along, aside, 0.33), (0.66, 0.3, 0.66), 34.0)
    faces.add_hull()
    faces.add_box((1.0, 0.0, 0.95), (0.16, 0.3, 0.5), 40.0)
    faces.add_marker()
    return faces.faces()


def _rover() -> Faces:
    """Build a UGV for near views: round wheels behind skirts, and a slender mast."""
    faces, ring = _FaceList(), _ring()
    faces.add_hull()
    faces.add_marker()
    for along in (-0.82, 0.0, 0.82):
        for hand in (-1.0, 1.0):
            aside = hand * np.array([0.0, 1.0, 0.0])
            middle = np.array([along, 0.0, _WHEEL_M[2]]) + _WHEEL_M[0] * aside
            half, rim = _WHEEL_M[1] / 2 * aside, middle + _WHEEL_M[2] * ring
            for k in range(_SPOKES):
                a, b = rim[k], rim[(k + 1) % _SPOKES]
                tread = [a + half, b + half, b - half, a - half]
                faces.add(tread, ring[k] + ring[(k + 1) % _SPOKES], 30.0 + 8 * (k % 2))
            faces.add(rim + half, aside, 36.0)
            faces.add(middle + 0.55 * (rim - middle) + 1.02 * half, aside, 50.0)
    for hand in (-1.0, 1.0):
        y = hand * (_WHEEL_M[0] + 0.54 * _WHEEL_M[1])
        skirt = [[-1.2, y, 0.42], [1.2, y, 0.42], [1.15, y, 0.78], [-1.15, y, 0.78]]
        faces.add(skirt, np.array([0.0, hand, 0.0]), 14.0, 0.85)
    for low, high, half_long, half_wide in ((0.75, 1.2, 0.015, 0.015), (1.2, 1.27, 0.05, 0.06)):
        block = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (half_long, half_wide) + (1.05, 0.0)
        for k in range(4):
            (x0, y0), (x1, y1) = block[k], block[(k + 1) % 4]
            side = [[x0, y0, low], [x1, y1, low], [x1, y1, high], [x0, y0, high]]
            faces.add(side, np.array([y1 - y0, x0 - x1, 0.0]), 44.0)
    return faces.faces()


def _ring() -> np.ndarray:
    """Return (_SPOKES, 3) points on a circle of radius 1 in the plane of a wheel."""
    turn = np.linspace(0, 2 * np.pi, _SPOKES, endpoint=False)
    return np.stack([np.cos(turn), np.zeros(_SPOKES), np.sin(turn)], axis=1)
