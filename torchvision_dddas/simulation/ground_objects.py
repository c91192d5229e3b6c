"""Bushes and trees as pictures that stand upright, buildings and vehicles, as a camera near the ground sees them."""

from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.simulation.cover import StandingObjects
from torchvision_dddas.simulation.drawing import NEAR_M, SUBPIXEL_BITS, Canvas, View, fill_outline
from torchvision_dddas.simulation.ground_backdrop import HAZE
from torchvision_dddas.simulation.vehicle_shapes import COVERED_BGR, Faces, place_faces
from torchvision_dddas.types import Bodies

_SHAPES = 6  # different bushes, and different trees
_SIZE_PX = (160, 160)  # width, height of a drawn plant
_DARK = np.array([52.0, 48, 44])  # BGR of windows and doors
_CLEAR = np.array([[-1.0, 0, 1]] * 3)  # of what is covered: what is not, three times


@dataclass(frozen=True)
class Plant:
    """A drawn plant, smaller and smaller: (h, w, 2) float32, what it covers, 0 to 1, and its light times that."""

    layers: tuple[np.ndarray, ...]


def draw_plants(seed: int) -> dict[str, list[Plant]]:
    """Drawn bushes and trees, lit from the upper right."""
    rng = np.random.default_rng([seed, 62])
    return {"bush": [_bush(rng) for _ in range(_SHAPES)], "tree": [_tree(rng) for _ in range(_SHAPES)]}


def draw_plant(
    plant: Plant, canvas: Canvas, box: tuple[float, float, float, float], colour: np.ndarray, turned: bool = False
) -> None:
    """Draw a plant into a box (left, top, right, bottom), px; turned: its left side to the right."""
    left, top, right, bottom = box
    height, width = canvas.picture.shape[:2]
    x0, y0 = max(int(np.floor(left)), 0), max(int(np.floor(top)), 0)
    x1, y1 = min(int(np.ceil(right)) + 1, width), min(int(np.ceil(bottom)) + 1, height)
    if x0 >= x1 or y0 >= y1 or right - left < 0.5 or bottom - top < 0.5:
        return
    wide, tall = right - left, bottom - top
    k = int(np.clip(np.floor(np.log2(_SIZE_PX[1] / tall)), 0, len(plant.layers) - 1))
    layer = plant.layers[k]
    along, down = wide / layer.shape[1], tall / layer.shape[0]
    start = left - x0 + 0.5 * along - 0.5
    if turned:
        along, start = -along, right - x0 - 0.5 * along - 0.5
    place = np.array([[along, 0, start], [0, down, top - y0 + 0.5 * down - 0.5]])
    seen = cv2.warpAffine(layer, place, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    clear = cv2.transform(seen, _CLEAR)
    lit = cv2.transform(seen, np.array([[0.0, tone] for tone in colour.tolist()]))
    part = canvas.picture[y0:y1, x0:x1]
    part[:] = cv2.add(cv2.multiply(part, clear, dtype=cv2.CV_32F), lit, dtype=cv2.CV_8U)
    np.copyto(canvas.mask[y0:y1, x0:x1], 0, where=seen[..., 0] > 0.5)


def draw_building(
    things: StandingObjects, k: int, foot_m: float, colour: np.ndarray, view: View, canvas: Canvas, to_sun: np.ndarray
) -> None:
    """Draw a building's walls and roof, with a door and windows, that stands at a height."""
    along = np.array([np.sin(things.heading_rad[k]), np.cos(things.heading_rad[k])])
    across = np.array([-along[1], along[0]])
    half, top = things.half_m[k], foot_m + float(things.height_m[k])
    outline = things.east_north_m[k] + (np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half) @ [along, across]
    for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
        start, way = outline[a], outline[b] - outline[a]
        normal = np.array([way[1], -way[0], 0.0]) / float(np.linalg.norm(way))
        if normal @ (view.position_m - [*start, foot_m]) <= 0:
            continue
        light = 0.5 + 0.5 * max(float(normal @ to_sun), 0.0)

        def panel(first: float, last: float, low: float, high: float, tone: np.ndarray) -> None:
            ends = start + first * way, start + last * way  # noqa: B023 (used at once)
            corners = np.array([[*ends[0], low], [*ends[1], low], [*ends[1], high], [*ends[0], high]])
            fill_outline(corners, np.clip(tone, 0, 255), 0, view, canvas)

        panel(0, 1, foot_m - 0.5, top, light * colour)
        panel(0, 1, top - 0.25, top, 0.8 * light * colour)
        length = float(np.linalg.norm(way))
        openings = int(length // 3)
        for n in range(openings):
            middle, door = (n + 0.5) / openings, a == 0 and n == openings // 2
            low, high, side = (0.0, 2.1, 0.45) if door else (1.0, 2.0, 0.5)
            panel(middle - side / length, middle + side / length, foot_m + low, foot_m + high, light * _DARK)
    if view.position_m[2] > top:
        fill_outline(
            np.c_[outline, np.full(4, top)], np.clip(colour * (0.5 + 0.5 * to_sun[2]), 0, 255), 0, view, canvas
        )


def draw_vehicle(
    faces: Faces, bodies: Bodies, k: int, haze: float, view: View, canvas: Canvas, to_sun: np.ndarray
) -> None:
    """Draw the faces of a car or a ground vehicle that look at the camera."""
    corners, normal = place_faces(faces, bodies.place_m[k], float(bodies.facing_rad[k]))
    plate = COVERED_BGR if bodies.hidden[k] or not np.isfinite(bodies.plate[k]).all() else bodies.plate[k]
    colour = faces.colour + faces.paint[:, None] * bodies.colour[k] + faces.plate[:, None] * plate
    light = np.where(faces.lit, 0.55 + 0.45 * np.maximum(normal @ to_sun, 0), 1)[:, None]
    colour = np.clip(colour * light, 0, 255)
    colour = colour + haze * (HAZE - colour)
    middle = corners.mean(axis=1)
    towards = ((view.position_m - middle) * normal).sum(axis=1) > 0
    order = np.flatnonzero(towards)
    if bodies.kind[k] == "ugv":  # a car's faces come in an order of their own: its doors lie on its flanks
        order = order[np.argsort(-np.linalg.norm(middle[order] - view.position_m, axis=1))]
    value, matrix = int(bodies.number[k]), view.image_from_world
    seen = corners @ matrix[:, :3].T + matrix[:, 3]
    if seen[..., 2].min() < NEAR_M:
        for n in order:
            fill_outline(corners[n], colour[n], value, view, canvas)
        return
    px = np.round(np.clip(seen[..., :2] / seen[..., 2:], -3e4, 3e4) * 2**SUBPIXEL_BITS).astype(np.int32)
    for n in order:
        cv2.fillConvexPoly(canvas.picture, px[n], colour[n].tolist(), cv2.LINE_AA, SUBPIXEL_BITS)
        cv2.fillConvexPoly(canvas.mask, px[n], value, cv2.LINE_8, SUBPIXEL_BITS)


def _bush(rng: np.random.Generator) -> Plant:
    """A dome of small leaves with gaps, its foot in the shade, and bare twigs that stick out."""
    width, height = _SIZE_PX
    plant = np.zeros((height, width, 2), np.float32)
    lobes = [
        (rng.uniform(0.2, 0.8), rng.uniform(0.0, 0.25), rng.uniform(0.14, 0.3), rng.uniform(0.4, 0.9))
        for _ in range(rng.integers(4, 8))
    ]
    for _ in range(14):
        _twig(rng, plant, (rng.uniform(0.35, 0.65) * width, height - 1), rng.uniform(-0.9, 0.9), 0.75 * height)
    for _ in range(rng.integers(700, 1300)):
        x, foot, across, tall = lobes[rng.integers(len(lobes))]
        angle, r = rng.uniform(0, np.pi), np.sqrt(rng.uniform(0.05, 1))
        a, b = r * np.cos(angle), r * np.sin(angle)
        _leaf(rng, plant, (x + across * a) * width, (1 - foot - tall * b) * height, 0.25 * a + 0.55 * b)
    return _smaller(plant)


def _tree(rng: np.random.Generator) -> Plant:
    """Several stems that part, and a wide crown in lumps."""
    width, height = _SIZE_PX
    plant = np.zeros((height, width, 2), np.float32)
    for _ in range(rng.integers(2, 5)):
        start = (rng.uniform(0.46, 0.54) * width, height - 1)
        _twig(rng, plant, start, rng.uniform(-0.6, 0.6), 0.65 * height, int(rng.integers(3, 6)))
    lumps = [
        (rng.uniform(0.14, 0.86), rng.uniform(0.24, 0.87), rng.uniform(0.09, 0.2)) for _ in range(rng.integers(11, 17))
    ]
    for _ in range(rng.integers(1000, 1500)):
        x, up, size = lumps[rng.integers(len(lumps))]
        angle, r = rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform(0, 1))
        a, b = r * np.cos(angle), r * np.sin(angle)
        rise = 0.2 * a + 0.45 * b + 0.5 * (up - 0.6)
        _leaf(rng, plant, (x + size * a) * width, (1 - up - 0.8 * size * b) * height, rise)
    return _smaller(plant)


def _leaf(rng: np.random.Generator, plant: np.ndarray, x: float, y: float, rise: float) -> None:
    bright = min(max(0.62 + 0.5 * rise + rng.normal(0, 0.16), 0.2), 1.6)
    place = (round(x * 16), round(y * 16))
    axes = (round(rng.uniform(1.2, 4.2) * 16), round(rng.uniform(0.8, 2.2) * 16))
    turn = float(rng.uniform(0, 180))
    cv2.ellipse(plant, place, axes, turn, 0, 360, (1.0, bright), -1, cv2.LINE_8, 4)


def _twig(
    rng: np.random.Generator,
    plant: np.ndarray,
    start: tuple[float, float],
    lean: float,
    length: float,
    thick: int = 1,
) -> None:
    x, y = start
    bright = float(rng.uniform(0.25, 0.6))
    for k in range(6):
        x1, y1 = x + lean * length / 6, y - length / 6 * np.sqrt(max(1 - lean**2, 0.05))
        cv2.line(plant, (round(x), round(y)), (round(x1), round(y1)), (1.0, bright), max(1, thick - k // 2))
        x, y, lean = x1, y1, float(np.clip(lean + rng.normal(0, 0.22), -0.98, 0.98))


def _smaller(plant: np.ndarray) -> Plant:
    layers = [plant]
    while min(layers[-1].shape[:2]) > 5:
        size = layers[-1].shape[1] // 2, layers[-1].shape[0] // 2
        layers.append(cv2.resize(layers[-1], size, interpolation=cv2.INTER_AREA))
    return Plant(tuple(layers))
