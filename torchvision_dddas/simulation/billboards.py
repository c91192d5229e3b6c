"""Bushes and trees as pictures that stand upright, and boxes, as a camera near the ground sees them."""

from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.simulation.bodies import Canvas
from torchvision_dddas.simulation.camera import View

_SHAPES = 6  # different bushes, and different trees
_SIZE_PX = (160, 160)  # width, height of a drawn plant
NEAR_M = 0.4  # what is nearer to the camera, in depth, is not drawn


@dataclass(frozen=True)
class Plant:
    """A drawn plant, smaller and smaller: cover (h, w) in [0, 1] and light (h, w), 1 where it has its own colour."""

    cover: tuple[np.ndarray, ...]
    light: tuple[np.ndarray, ...]


def plants(seed: int) -> dict[str, list[Plant]]:
    """Drawn bushes and trees, lit from the upper right."""
    rng = np.random.default_rng([seed, 62])
    return {"bush": [_bush(rng) for _ in range(_SHAPES)], "tree": [_tree(rng) for _ in range(_SHAPES)]}


def draw_plant(plant: Plant, canvas: Canvas, box: tuple[float, float, float, float], colour: np.ndarray) -> None:
    """Draw a plant into a box (left, top, right, bottom), px, of the picture; what is outside of it is left out."""
    left, top, right, bottom = box
    height, width = canvas.picture.shape[:2]
    x0, y0 = max(int(np.floor(left)), 0), max(int(np.floor(top)), 0)
    x1, y1 = min(int(np.ceil(right)) + 1, width), min(int(np.ceil(bottom)) + 1, height)
    if x0 >= x1 or y0 >= y1 or right - left < 0.5 or bottom - top < 0.5:
        return
    tall = bottom - top
    k = int(np.clip(np.floor(np.log2(_SIZE_PX[1] / tall)), 0, len(plant.cover) - 1))
    source = plant.cover[k].shape
    scale = (right - left) / source[1], tall / source[0]
    place = np.array([[scale[0], 0, left - x0 + 0.5 * scale[0]], [0, scale[1], top - y0 + 0.5 * scale[1]]])
    cover, light = (
        cv2.warpAffine(one, place, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        for one in (plant.cover[k], plant.light[k])
    )
    part = canvas.picture[y0:y1, x0:x1]
    # Where its edge covers half, so much of its light came along.
    part[:] = np.clip(part * (1 - cover[..., None]) + light[..., None] * colour.astype(np.float32), 0, 255)
    canvas.mask[y0:y1, x0:x1][cover > 0.5] = 0


def draw_box(
    corners_m: np.ndarray,
    low_m: float,
    high_m: float,
    colour: np.ndarray,
    view: View,
    canvas: Canvas,
    to_sun: np.ndarray,
) -> None:
    """Draw an upright box on an outline (4, 2), counter-clockwise seen from above, from one height to another."""
    pairs = [(k, (k + 1) % 4) for k in range(4)]
    faces = []
    for a, b in pairs:
        along = corners_m[b] - corners_m[a]
        normal = np.array([along[1], -along[0], 0.0]) / max(float(np.linalg.norm(along)), 1e-9)
        wall = np.array(
            [[*corners_m[a], low_m], [*corners_m[b], low_m], [*corners_m[b], high_m], [*corners_m[a], high_m]]
        )
        faces.append((wall, normal))
    faces.append((np.c_[corners_m, np.full(4, high_m)], np.array([0, 0, 1.0])))
    for face, normal in faces:
        if normal @ (view.position_m - face[0]) > 0:
            light = 0.55 + 0.5 * max(float(normal @ to_sun), 0.0)
            fill(face, np.clip(light * colour, 0, 255), 0, view, canvas)


def fill(points_m: np.ndarray, colour: np.ndarray, value: int, view: View, canvas: Canvas) -> None:
    """Fill a convex outline (N, 3) of which what is behind the camera is cut off."""
    depth = points_m @ view.image_from_world[2, :3] + view.image_from_world[2, 3]
    if (depth < NEAR_M).any():
        kept = []
        for k in range(len(points_m)):
            a, b = depth[k], depth[(k + 1) % len(points_m)]
            if a >= NEAR_M:
                kept.append(points_m[k])
            if (a >= NEAR_M) != (b >= NEAR_M):
                share = (NEAR_M - a) / (b - a)
                kept.append(points_m[k] + share * (points_m[(k + 1) % len(points_m)] - points_m[k]))
        if len(kept) < 3:
            return
        points_m = np.array(kept)
    height, width = canvas.picture.shape[:2]
    px = view.project(points_m)
    if px[:, 0].max() < 0 or px[:, 0].min() >= width or px[:, 1].max() < 0 or px[:, 1].min() >= height:
        return
    # OpenCV counts pixels in 16 bits where it counts them in sixteenths.
    canvas.fill(np.clip(px, -3e4, 3e4), colour, value)


def _bush(rng: np.random.Generator) -> Plant:
    """A dome of small leaves with gaps, its foot in the shade, and bare twigs that stick out."""
    width, height = _SIZE_PX
    cover, light = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    lobes = [
        (rng.uniform(0.2, 0.8), rng.uniform(0.0, 0.25), rng.uniform(0.14, 0.3), rng.uniform(0.4, 0.9))
        for _ in range(rng.integers(4, 8))
    ]
    for _ in range(14):
        _twig(rng, cover, light, (rng.uniform(0.35, 0.65) * width, height - 1), rng.uniform(-0.9, 0.9), 0.95 * height)
    for _ in range(rng.integers(700, 1300)):
        x, foot, across, tall = lobes[rng.integers(len(lobes))]
        angle, r = rng.uniform(0, np.pi), np.sqrt(rng.uniform(0.05, 1))
        a, b = r * np.cos(angle), r * np.sin(angle)
        _leaf(rng, cover, light, (x + across * a) * width, (1 - foot - tall * b) * height, 0.25 * a + 0.55 * b)
    return _smaller(cover, light)


def _tree(rng: np.random.Generator) -> Plant:
    """Several stems that part, and a wide crown in lumps."""
    width, height = _SIZE_PX
    cover, light = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for _ in range(rng.integers(2, 5)):
        start = (rng.uniform(0.46, 0.54) * width, height - 1)
        _twig(rng, cover, light, start, rng.uniform(-0.55, 0.55), 0.7 * height, int(rng.integers(3, 7)))
    lumps = [
        (rng.uniform(0.18, 0.82), rng.uniform(0.42, 0.85), rng.uniform(0.09, 0.18)) for _ in range(rng.integers(9, 15))
    ]
    for _ in range(rng.integers(1000, 1500)):
        x, up, size = lumps[rng.integers(len(lumps))]
        angle, r = rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform(0, 1))
        a, b = r * np.cos(angle), r * np.sin(angle)
        rise = 0.2 * a + 0.45 * b + 0.7 * (up - 0.6)
        _leaf(rng, cover, light, (x + size * a) * width, (1 - up - 0.8 * size * b) * height, rise)
    return _smaller(cover, light)


def _leaf(rng: np.random.Generator, cover: np.ndarray, light: np.ndarray, x: float, y: float, rise: float) -> None:
    bright = float(np.clip(0.62 + 0.5 * rise + rng.normal(0, 0.16), 0.2, 1.6))
    place = (round(x * 16), round(y * 16))
    axes = (round(rng.uniform(1.2, 4.2) * 16), round(rng.uniform(0.8, 2.2) * 16))
    turn = float(rng.uniform(0, 180))
    for layer, value in ((cover, 1.0), (light, bright)):
        cv2.ellipse(layer, place, axes, turn, 0, 360, value, -1, cv2.LINE_8, 4)


def _twig(
    rng: np.random.Generator,
    cover: np.ndarray,
    light: np.ndarray,
    start: tuple[float, float],
    lean: float,
    length: float,
    thick: int = 1,
) -> None:
    x, y = start
    bright = float(rng.uniform(0.35, 0.8))
    for k in range(6):
        x1, y1 = x + lean * length / 6, y - length / 6 * np.sqrt(max(1 - lean**2, 0.05))
        for layer, value in ((cover, 1.0), (light, bright)):
            cv2.line(layer, (round(x), round(y)), (round(x1), round(y1)), value, max(1, thick - k // 2))
        x, y, lean = x1, y1, float(np.clip(lean + rng.normal(0, 0.22), -0.98, 0.98))


def _smaller(cover: np.ndarray, light: np.ndarray) -> Plant:
    covers, lights = [cover], [light]
    while min(covers[-1].shape) > 5:
        size = covers[-1].shape[1] // 2, covers[-1].shape[0] // 2
        covers.append(cv2.resize(covers[-1], size, interpolation=cv2.INTER_AREA))
        lights.append(cv2.resize(lights[-1], size, interpolation=cv2.INTER_AREA))
    return Plant(tuple(covers), tuple(lights))
