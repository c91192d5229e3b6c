"""Cars and ground vehicles as flat faces about their middle, to be placed and drawn."""

from functools import cache
from typing import NamedTuple

import numpy as np

# A rover of the size of a small buggy: its plate still has some 20 pixels at 200 m in a picture 640 wide.
UGV_LENGTH_M, UGV_WIDTH_M, UGV_HEIGHT_M = 2.4, 1.7, 0.95
PLATE_M = (1.9, 1.5)  # the coloured marker on top: along, across
COVERED_BGR = np.array([118.0, 122.0, 124.0])  # a marker that is covered
_WHEEL_M = (0.7, 0.3, 0.33)  # from the middle to a wheel's, its width, its radius
_SPOKES = 12
# Panels on a car's flanks: from, to along the car, from, to in height, brightness of the paint, or a lamp's BGR.
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
# Panels seen from above: from, to along the car, half width, height, brightness of the paint.
_ROOF = (
    (-0.75, -0.1, 0.4, 1.42, 0.3),
    (1.06, 1.1, 0.74, 0.85, 0.5),
    (1.85, 1.89, 0.7, 0.85, 0.6),
    (-1.8, -1.75, 0.72, 0.85, 0.5),
)


class Faces(NamedTuple):
    """Faces of a vehicle, each a flat convex outline of corners about its middle: ahead, left, up in metres.

    corners_m: (F, C, 3), the last corner repeated where there are fewer than C. normal: (F, 3) outwards. colour:
    (F, 3) BGR where the paint is black; paint, plate: (F,) how much of those colours is added. lit: (F,) bool,
    whether the sun shades it.
    """

    corners_m: np.ndarray
    normal: np.ndarray
    colour: np.ndarray
    paint: np.ndarray
    plate: np.ndarray
    lit: np.ndarray


@cache
def car_faces() -> Faces:
    """A car 4.4 m long, in the order to draw it: the body, then doors, lamps, wheels and roof window."""
    rows: list[tuple[np.ndarray, np.ndarray, tuple[float, ...], float, bool]] = []
    glass, dark, middle, up = (58.0, 50, 44), (38.0, 38, 38), np.array([0, 0, 0.7]), np.array([0, 0, 1.0])

    def prism(low: tuple[float, ...], high: tuple[float, ...], side: tuple[float, ...], top: tuple[float, ...]) -> None:
        """A prism's sides and top, between two sections (back, front, half width, height); no colour: the paint."""
        ring = []
        for back, front, half, height in (low, high):
            ring.append(
                np.array([[front, half, height], [front, -half, height], [back, -half, height], [back, half, height]])
            )
        faces = [
            np.stack([ring[0][i], ring[0][j], ring[1][j], ring[1][i]]) for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))
        ]
        for corners, colour in [*((face, side) for face in faces), (ring[1], top)]:
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            normal = normal / np.linalg.norm(normal)
            outward = normal if normal @ (corners.mean(0) - middle) > 0 else -normal
            rows.append((corners, outward, colour or (0.0, 0, 0), 0.0 if colour else 1.0, True))

    prism((-2.0, 2.0, 0.8, 0.12), (-2.0, 2.0, 0.8, 0.4), dark, dark)
    prism((-2.2, 2.2, 0.86, 0.3), (-2.15, 2.1, 0.82, 0.85), (), ())
    prism((-1.7, 1.0, 0.76, 0.85), (-1.25, 0.35, 0.64, 1.42), glass, ())
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rim = np.stack([np.cos(turn), np.zeros(12), np.sin(turn)], axis=1)
    for hand in (1, -1):
        aside = np.array([0.0, hand, 0.0])
        for back, front, low, high, tone in _FLANK:
            # The flank leans inwards, more above the sill of the windows.
            foot, head = hand * np.interp((low, high), (0.3, 0.85, 0.851, 1.42), (0.865, 0.825, 0.765, 0.645))
            corners = np.array([[back, foot, low], [front, foot, low], [front, head, high], [back, head, high]])
            paint, colour = (0.8 * tone, (0.0, 0, 0)) if isinstance(tone, float) else (0.0, tone)
            rows.append((corners, aside, colour, paint, False))
        for along in (-1.35, 1.35):
            hub = np.array([along, 0.875 * hand, 0.31])
            rows += [(hub + 0.31 * rim, aside, (26.0, 26, 26), 0.0, False)]
            rows += [(hub + 0.15 * rim, aside, (120.0, 120, 122), 0.0, False)]
    for back, front, half, height, tone in _ROOF:
        corners = np.array([[back, -half, height], [front, -half, height], [front, half, height], [back, half, height]])
        rows.append((corners, up, (0.0, 0, 0), tone, False))
    corners, normal, colour, paint, lit = zip(*rows, strict=True)
    return Faces(
        np.stack([_repeat_last(outline, 12) for outline in corners]), np.array(normal), np.array(colour, float),
        np.array(paint), np.zeros(len(rows)), np.array(lit),
    )  # fmt: skip


@cache
def ugv_faces() -> Faces:
    """A ground vehicle: six wheels, a hull, and the marker on top in its middle."""
    rows: list[tuple[np.ndarray, np.ndarray, float, float]] = []

    def box(middle: tuple[float, float, float], size: tuple[float, float, float], tone: float, paint: float) -> None:
        for axis in range(3):
            for sign in (-1.0, 1.0):
                if axis == 2 and sign < 0:
                    continue
                a, b = (k for k in range(3) if k != axis)
                corners = np.zeros((4, 3))
                corners[:, axis] = sign
                corners[:, a], corners[:, b] = (1, 1, -1, -1), (1, -1, -1, 1)
                normal = np.zeros(3)
                normal[axis] = sign
                rows.append((np.array(middle) + corners * np.array(size) / 2, normal, tone, paint))

    for along in (-0.82, 0.0, 0.82):
        for aside in (-0.7, 0.7):
            box((along, aside, 0.33), (0.66, 0.3, 0.66), 34.0, 0.0)
    box((0.0, 0.0, 0.5), (UGV_LENGTH_M, 1.08, 0.5), 12.0, 0.9)
    box((1.0, 0.0, 0.95), (0.16, 0.3, 0.5), 40.0, 0.0)
    top = np.array([(1, 1, 0), (1, -1, 0), (-1, -1, 0), (-1, 1, 0)]) * [PLATE_M[0] / 2, PLATE_M[1] / 2, 0]
    rows.append((top + np.array([0, 0, UGV_HEIGHT_M]), np.array([0.0, 0.0, 1.0]), 0.0, 0.0))
    plate = np.zeros(len(rows))
    plate[-1] = 1
    return Faces(
        np.stack([row[0] for row in rows]),
        np.stack([row[1] for row in rows]),
        np.array([[row[2]] * 3 for row in rows]),
        np.array([row[3] for row in rows]),
        plate,
        np.ones(len(rows), bool),
    )


@cache
def rover_faces() -> Faces:
    """A ground vehicle as `vehicles.ugv` has it, seen from near: round wheels behind skirts, and a slender mast."""
    plain = ugv_faces()
    # The wheels come first, and nothing else has their grey; the mast alone has none of the paint, but for the marker.
    kept = (plain.colour != plain.colour[0]).any(axis=1) & (plain.paint + plain.plate > 0)
    turn = np.linspace(0, 2 * np.pi, _SPOKES, endpoint=False)
    ring = np.stack([np.cos(turn), np.zeros(_SPOKES), np.sin(turn)], axis=1)
    corners, normals, tones = [], [], []
    for along in (-0.82, 0.0, 0.82):
        for hand in (-1.0, 1.0):
            aside = hand * np.array([0.0, 1.0, 0.0])
            middle = np.array([along, 0.0, _WHEEL_M[2]]) + _WHEEL_M[0] * aside
            half, rim = _WHEEL_M[1] / 2 * aside, middle + _WHEEL_M[2] * ring
            for k in range(_SPOKES):
                a, b = rim[k], rim[(k + 1) % _SPOKES]
                tread = np.array([a + half, b + half, b - half, a - half])
                corners.append(_repeat_last(tread, _SPOKES))
                normals.append(ring[k] + ring[(k + 1) % _SPOKES])
                tones.append(30.0 + 8 * (k % 2))
            corners += [rim + half, middle + 0.55 * (rim - middle) + 1.02 * half]
            normals += [aside, aside]
            tones += [36.0, 50.0]
    for hand in (-1.0, 1.0):
        y = hand * (_WHEEL_M[0] + 0.54 * _WHEEL_M[1])
        skirt = np.array([[-1.2, y, 0.42], [1.2, y, 0.42], [1.15, y, 0.78], [-1.15, y, 0.78]])
        corners.append(_repeat_last(skirt, _SPOKES))
        normals.append(np.array([0.0, hand, 0.0]))
        tones.append(14.0)
    for low, high, half_long, half_wide in ((0.75, 1.2, 0.015, 0.015), (1.2, 1.27, 0.05, 0.06)):
        block = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (half_long, half_wide) + (1.05, 0.0)
        for k in range(4):
            (x0, y0), (x1, y1) = block[k], block[(k + 1) % 4]
            side = np.array([[x0, y0, low], [x1, y1, low], [x1, y1, high], [x0, y0, high]])
            corners.append(_repeat_last(side, _SPOKES))
            normals.append(np.array([y1 - y0, x0 - x1, 0.0]))
            tones.append(44.0)
    paint = np.array([0.85 if tone == 14 else 0.0 for tone in tones])
    hull = np.pad(plain.corners_m[kept], ((0, 0), (0, _SPOKES - plain.corners_m.shape[1]), (0, 0)), mode="edge")
    normal = np.array(normals) / np.linalg.norm(normals, axis=1, keepdims=True)
    added = len(tones)
    return Faces(
        np.concatenate([hull, np.array(corners)]),
        np.concatenate([plain.normal[kept], normal]),
        np.concatenate([plain.colour[kept], np.repeat(np.array(tones)[:, None], 3, axis=1)]),
        np.concatenate([plain.paint[kept], paint]),
        np.concatenate([plain.plate[kept], np.zeros(added)]),
        np.ones(kept.sum() + added, bool),
    )


def place_faces(faces: Faces, place_m: np.ndarray, facing_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners (F, C, 3) and normals (F, 3) of a vehicle that stands at a place (3,) and faces so, from north."""
    sine, cosine = np.sin(facing_rad), np.cos(facing_rad)
    local_from_body = np.array([[sine, -cosine, 0.0], [cosine, sine, 0.0], [0.0, 0.0, 1.0]])
    return faces.corners_m @ local_from_body.T + place_m, faces.normal @ local_from_body.T


def _repeat_last(outline: np.ndarray, corners: int) -> np.ndarray:
    """(corners, 3) an outline whose last corner is repeated."""
    return np.pad(outline, ((0, corners - len(outline)), (0, 0)), mode="edge")
