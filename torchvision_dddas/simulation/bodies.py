"""Cars and people as simple solids: how they look in a view, which pixels are theirs, what shade they cast."""

from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.simulation.camera import View

SUN_SHADE = np.array([0.55, 0.3])  # metres that a shadow reaches on the ground (x, y) per metre of height
_TO_SUN = np.array([-0.55, -0.3, 1.0]) / np.linalg.norm([0.55, 0.3, 1.0])
_Section = tuple[float, float, float, float]  # back, front, half width, height in metres
_FRACTION = 4  # bits of sub-pixel accuracy that OpenCV draws with


@dataclass(frozen=True)
class Body:
    """A car or a person. start_m (x, y) at time 0, velocity_m_s (x, y), colour BGR; stride_hz moves a walker's legs."""

    kind: str
    start_m: np.ndarray
    velocity_m_s: np.ndarray
    colour: tuple[float, float, float]
    facing: float = 0.0  # radians from x, for a body that stands
    stride_hz: float = 0.0

    def place(self, time_s: float) -> np.ndarray:
        """Where it is, (x, y) metres."""
        return self.start_m + time_s * self.velocity_m_s


class Canvas:
    """A picture (H, W, 3) and a mask (H, W) that are drawn on together, so that the truth is what the eye sees."""

    def __init__(self, picture: np.ndarray) -> None:
        self.picture = picture
        self.mask = np.zeros(picture.shape[:2], np.uint16)

    def fill(self, points_px: np.ndarray, colour: np.ndarray, value: int) -> None:
        """Fill a convex outline (N, 2): smooth in the picture, whole pixels of `value` in the mask."""
        points = np.round(points_px * 2**_FRACTION).astype(np.int32)
        cv2.fillConvexPoly(self.picture, points, colour.tolist(), cv2.LINE_AA, _FRACTION)
        cv2.fillConvexPoly(self.mask, points, value, cv2.LINE_8, _FRACTION)


def draw(body: Body, time_s: float, view: View, canvas: Canvas, value: int) -> None:
    """Draw a body and give its pixels `value` in the mask (0 for what stands still)."""
    if body.kind == "car":
        for corners, normal, colour in _car_faces(body, time_s):
            if normal @ (view.position_m - corners.mean(0)) > 0:
                light = 0.55 + 0.45 * max(float(normal @ _TO_SUN), 0.0)
                canvas.fill(view.project(corners), light * colour, value)
        for corners, normal, colour in _car_trim(body, time_s):
            if normal @ (view.position_m - corners.mean(0)) > 0:
                canvas.fill(view.project(corners), colour, value)
    else:
        for start, end, width_m, colour in _limbs(body, time_s):
            width = width_m * view.pixels_per_metre(start)
            ends = view.project(np.stack([start, end]))
            canvas.fill(_capsule(ends, width), colour, value)


def shade(body: Body, time_s: float, view: View, layer: np.ndarray) -> None:
    """Draw the body's cast shadow into layer, (H, W) uint8, 255 where the sun is hidden."""
    if body.kind == "car":
        points = np.concatenate([corners for corners, _, _ in _car_faces(body, time_s)])
        groups = [points]
    else:
        groups = []
        for start, end, width_m, _ in _limbs(body, time_s):
            around = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]) * width_m / 2
            groups.append(np.concatenate([start + around, end + around]))
    for points in groups:
        flat = np.c_[points[:, :2] + points[:, 2:] * SUN_SHADE, np.zeros(len(points))]
        hull = cv2.convexHull(view.project(flat).astype(np.float32))
        cv2.fillConvexPoly(layer, np.round(hull * 2**_FRACTION).astype(np.int32), 255, cv2.LINE_AA, _FRACTION)


def car_faces(body: Body, time_s: float) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, bool]]:
    """(corners (N, 3), outward normal, colour, whether the sun shades it) of a car, in the order to draw them."""
    solid = [(*face, True) for face in _car_faces(body, time_s)]
    return [*solid, *((*face, False) for face in _car_trim(body, time_s))]


def _axes(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors ahead and to the left of a body, on the ground."""
    speed = float(np.linalg.norm(body.velocity_m_s))
    angle = float(np.arctan2(body.velocity_m_s[1], body.velocity_m_s[0])) if speed > 0 else body.facing
    return np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])


def _car_faces(body: Body, time_s: float) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(corners (4, 3), outward normal, colour) of each face, in the order to draw them for a camera above."""
    ahead, left = _axes(body)
    origin = np.append(body.place(time_s), 0.0)
    paint, glass, dark = np.array(body.colour), np.array([58.0, 50, 44]), np.array([38.0, 38, 38])

    def solid(low: _Section, high: _Section, side: np.ndarray, top: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """(corners, colour) of a prism's faces, from one section at its foot to another at its top."""
        ring = []
        for back, front, half_width, height in (low, high):
            corners = ((front, 1), (front, -1), (back, -1), (back, 1))
            foot = origin + np.array([0, 0, height])
            ring.append(np.array([foot + along * ahead + hand * half_width * left for along, hand in corners]))
        pairs = ((0, 1), (1, 2), (2, 3), (3, 0))
        sides = [np.stack([ring[0][i], ring[0][j], ring[1][j], ring[1][i]]) for i, j in pairs]
        return [*((corners, side) for corners in sides), (ring[1], top)]

    parts = solid((-2.0, 2.0, 0.8, 0.12), (-2.0, 2.0, 0.8, 0.4), dark, dark)
    parts += solid((-2.2, 2.2, 0.86, 0.3), (-2.15, 2.1, 0.82, 0.85), paint, paint)
    parts += solid((-1.7, 1.0, 0.76, 0.85), (-1.25, 0.35, 0.64, 1.42), glass, paint)
    middle = origin + np.array([0, 0, 0.7])
    faces = []
    for corners, colour in parts:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal = normal / np.linalg.norm(normal)
        faces.append((corners, normal if normal @ (corners.mean(0) - middle) > 0 else -normal, colour))
    return faces


# Panels on a car's flanks: from, to along the car, from, to in height, brightness of the paint; below 0, a lamp.
_FLANK = (
    (-2.12, 2.05, 0.47, 0.53, 0.45),
    (-1.02, -0.98, 0.36, 0.84, 0.4),
    (0.02, 0.06, 0.36, 0.84, 0.4),
    (1.0, 1.04, 0.36, 0.84, 0.4),
    (-0.82, -0.6, 0.7, 0.74, 0.4),
    (0.2, 0.42, 0.7, 0.74, 0.4),
    (-1.0, -0.9, 0.86, 1.38, 0.75),
    (-0.32, -0.22, 0.86, 1.4, 0.75),
    (1.92, 2.1, 0.58, 0.74, -1),
    (-2.16, -1.98, 0.58, 0.76, -2),
)
_LAMPS = {-1: np.array([205.0, 225, 230]), -2: np.array([36.0, 30, 150])}
# Panels seen from above: from, to along the car, half width, height, brightness of the paint.
_ABOVE = (
    (-0.75, -0.1, 0.4, 1.42, 0.3),
    (1.06, 1.1, 0.74, 0.85, 0.5),
    (1.85, 1.89, 0.7, 0.85, 0.6),
    (-1.8, -1.75, 0.72, 0.85, 0.5),
)


def _car_trim(body: Body, time_s: float) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(corners (N, 3), outward normal, colour) of doors, pillars, lamps, roof window and wheels, to draw last."""
    ahead, left = _axes(body)
    origin, up = np.append(body.place(time_s), 0.0), np.array([0, 0, 1.0])
    paint = np.array(body.colour)

    def at(along: float, aside: float, height: float) -> np.ndarray:
        return origin + along * ahead + aside * left + height * up

    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)[:, None]
    rim = np.cos(turn) * ahead + np.sin(turn) * up
    trim = []
    for hand in (1, -1):
        for back, front, low, high, tone in _FLANK:
            # The flank leans inwards, more above the sill of the windows.
            foot, head = hand * np.interp((low, high), (0.3, 0.85, 0.851, 1.42), (0.865, 0.825, 0.765, 0.645))
            corners = [at(back, foot, low), at(front, foot, low), at(front, head, high), at(back, head, high)]
            trim.append((np.stack(corners), hand * left, tone * 0.8 * paint if tone > 0 else _LAMPS[int(tone)]))
        for along in (-1.35, 1.35):
            hub = at(along, 0.875 * hand, 0.31)
            trim.append((hub + 0.31 * rim, hand * left, np.array([26.0, 26, 26])))
            trim.append((hub + 0.15 * rim, hand * left, np.array([120.0, 120, 122])))
    for back, front, half_width, height, tone in _ABOVE:
        places = ((back, -1), (front, -1), (front, 1), (back, 1))
        trim.append((np.stack([at(a, h * half_width, height) for a, h in places]), up, tone * paint))
    return trim


def _limbs(body: Body, time_s: float) -> list[tuple[np.ndarray, np.ndarray, float, np.ndarray]]:
    """(from, to, width in metres, colour) of legs, body, arms and head of a walking person."""
    ahead, left = _axes(body)
    origin = np.append(body.place(time_s), 0.0)
    shirt = np.array(body.colour)
    trousers, skin, hair = np.array([70.0, 56, 50]), np.array([120.0, 150, 190]), np.array([30.0, 34, 40])
    swing = 0.32 * np.sin(2 * np.pi * body.stride_hz * time_s)

    def at(forward: float, aside: float, height: float) -> np.ndarray:
        return origin + forward * ahead + aside * left + np.array([0, 0, height])

    legs = [(at(0, 0.09 * s, 0.88), at(s * swing, 0.1 * s, 0.06), 0.17, trousers) for s in (1, -1)]
    arms = [(at(0, 0.22 * s, 1.38), at(-0.8 * s * swing, 0.26 * s, 0.85), 0.11, 0.85 * shirt) for s in (1, -1)]
    return [
        *legs,
        (at(0, 0, 0.95), at(0.03, 0, 1.38), 0.36, shirt),
        *arms,
        (at(0.03, 0, 1.5), at(0.04, 0, 1.6), 0.2, skin),
        (at(0.02, 0, 1.63), at(0.02, 0, 1.66), 0.19, hair),
    ]


def _capsule(ends_px: np.ndarray, width_px: float) -> np.ndarray:
    """Outline of a thick line with round ends, as a convex polygon."""
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    circle = np.c_[np.cos(turn), np.sin(turn)] * width_px / 2
    return cv2.convexHull(np.concatenate([ends_px[0] + circle, ends_px[1] + circle]).astype(np.float32))[:, 0]
