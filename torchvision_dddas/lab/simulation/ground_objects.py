"""Draw plants (as upright pictures), buildings, vehicles and people for a camera near the ground."""

from itertools import pairwise

import cv2
import numpy as np

from torchvision_dddas.lab.simulation.body_shapes import limb_capsules, vehicle_faces
from torchvision_dddas.lab.simulation.cameras import PinholeView
from torchvision_dddas.lab.simulation.cover import StandingObjects
from torchvision_dddas.lab.simulation.ground_backdrop import HAZE
from torchvision_dddas.types import Bodies

BITS = 4  # fractional bits of corners: OpenCV draws in sixteenths of a pixel
NEAR_M = 0.4  # least depth that a camera on the ground draws
_SHAPES = 6  # different bushes, and different trees
_SIZE_PX = (160, 160)  # width, height of a drawn plant
_DARK = np.array([52.0, 48, 44])  # BGR of windows and doors
_CLEAR = np.array([[-1.0, 0, 1]] * 3)  # computes 1 - cover for three channels
_LEAST_WRINKLED_PX = 30

Plant = list[np.ndarray]
"""A drawn plant in ever smaller sizes: (h, w, 2) float32, cover from 0 to 1 and brightness times cover."""


class Canvas:
    """A picture (H, W, 3) and a mask (H, W) that are drawn together, so that the mask matches the picture."""

    def __init__(self, picture: np.ndarray) -> None:
        self.picture = picture
        self.mask = np.zeros(picture.shape[:2], np.uint16)

    def fill(self, corners: np.ndarray, colour: np.ndarray, value: int) -> None:
        """Fill a convex outline (N, 2) in fixed point, antialiased in the picture and as `value` in the mask."""
        cv2.fillConvexPoly(self.picture, corners, colour.tolist(), cv2.LINE_AA, BITS)
        cv2.fillConvexPoly(self.mask, corners, value, cv2.LINE_8, BITS)

    def fill_in_view(self, points_m: np.ndarray, colour: np.ndarray, value: int, view: PinholeView) -> None:
        """Fill a convex outline (N, 3), without the part behind the camera."""
        seen = view.homogeneous(points_m)
        kept = []
        for here, following in pairwise([*seen, seen[0]]):
            a, b = here[2], following[2]
            if a >= NEAR_M:
                kept.append(here)
            if (a >= NEAR_M) != (b >= NEAR_M):
                kept.append(here + (NEAR_M - a) / (b - a) * (following - here))
        if len(kept) < 3:
            return
        seen = np.array(kept)
        px = seen[:, :2] / seen[:, 2:]
        if (px.max(axis=0) > 0).all() and (px.min(axis=0) < self.mask.shape[::-1]).all():
            self.fill(fixed_point(px), colour, value)


def fixed_point(points_px: np.ndarray) -> np.ndarray:
    """Return points in sixteenths of a pixel, int32, clipped to OpenCV's range of 16 bits for whole pixels."""
    return np.round(np.clip(points_px, -3e4, 3e4) * 2**BITS).astype(np.int32)


def draw_plants(seed: int) -> dict[str, list[Plant]]:
    """Return drawn bushes and trees, lit from the upper right."""
    rng = np.random.default_rng([seed, 62])
    return {"bush": [_bush(rng) for _ in range(_SHAPES)], "tree": [_tree(rng) for _ in range(_SHAPES)]}


def draw_plant(
    plant: Plant, canvas: Canvas, box: tuple[float, float, float, float], colour: np.ndarray, is_turned: bool
) -> None:
    """Draw a plant into a box (left, top, right, bottom), px. is_turned: mirror the plant."""
    left, top, right, bottom = box
    height, width = canvas.picture.shape[:2]
    x0, y0 = max(int(np.floor(left)), 0), max(int(np.floor(top)), 0)
    x1, y1 = min(int(np.ceil(right)) + 1, width), min(int(np.ceil(bottom)) + 1, height)
    wide, tall = right - left, bottom - top
    if x0 >= x1 or y0 >= y1 or wide < 0.5 or tall < 0.5:
        return
    layer = plant[int(np.clip(np.floor(np.log2(_SIZE_PX[1] / tall)), 0, len(plant) - 1))]
    along, down = wide / layer.shape[1], tall / layer.shape[0]
    start = left - x0 + 0.5 * along - 0.5
    if is_turned:
        along, start = -along, right - x0 - 0.5 * along - 0.5
    place = np.array([[along, 0, start], [0, down, top - y0 + 0.5 * down - 0.5]])
    seen = cv2.warpAffine(layer, place, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    clear = cv2.transform(seen, _CLEAR)
    lit = cv2.transform(seen, np.array([[0.0, tone] for tone in colour.tolist()]))
    part = canvas.picture[y0:y1, x0:x1]
    part[:] = cv2.add(cv2.multiply(part, clear, dtype=cv2.CV_32F), lit, dtype=cv2.CV_8U)
    np.copyto(canvas.mask[y0:y1, x0:x1], 0, where=seen[..., 0] > 0.5)


def draw_building(
    things: StandingObjects,
    k: int,
    foot_m: float,
    colour: np.ndarray,
    view: PinholeView,
    canvas: Canvas,
    to_sun: np.ndarray,
) -> None:
    """Draw a building's walls and roof, with a door and windows. foot_m: height of its foot."""
    along = np.array([np.sin(things.heading_rad[k]), np.cos(things.heading_rad[k])])
    across = np.array([-along[1], along[0]])
    half, top = things.half_m[k], foot_m + float(things.height_m[k])
    outline = things.east_north_m[k] + (np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half) @ [along, across]
    for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
        start, way = outline[a], outline[b] - outline[a]
        length = float(np.linalg.norm(way))
        normal = np.array([way[1], -way[0], 0.0]) / length
        if normal @ (view.position_m - [*start, foot_m]) <= 0:
            continue
        light = 0.5 + 0.5 * max(float(normal @ to_sun), 0.0)
        # Panels (start, end along the wall, bottom, top, colour): the wall, its eaves, the door and windows.
        panels = [(0.0, 1.0, foot_m - 0.5, top, light * colour), (0.0, 1.0, top - 0.25, top, 0.8 * light * colour)]
        openings = int(length // 3)
        for n in range(openings):
            middle, is_door = (n + 0.5) / openings, a == 0 and n == openings // 2
            low, high, side = (0.0, 2.1, 0.45) if is_door else (1.0, 2.0, 0.5)
            ends = middle - side / length, middle + side / length
            panels.append((*ends, foot_m + low, foot_m + high, light * _DARK))
        for first, last, low, high, tone in panels:
            left, right = start + first * way, start + last * way
            corners = np.array([[*left, low], [*right, low], [*right, high], [*left, high]])
            canvas.fill_in_view(corners, np.clip(tone, 0, 255), 0, view)
    if view.position_m[2] > top:
        roof = np.clip(colour * (0.5 + 0.5 * to_sun[2]), 0, 255)
        canvas.fill_in_view(np.c_[outline, np.full(4, top)], roof, 0, view)


def draw_vehicle(bodies: Bodies, k: int, haze: float, view: PinholeView, canvas: Canvas, to_sun: np.ndarray) -> None:
    """Draw the faces of a car or a UGV that look at the camera."""
    faces = vehicle_faces(str(bodies.kind[k]), is_near=True)
    corners, normal, colour = faces.placed(bodies, k)
    light = np.where(faces.lit, 0.55 + 0.45 * np.maximum(normal @ to_sun, 0), 1)[:, None]
    colour = np.clip(colour * light, 0, 255)
    colour = colour + haze * (HAZE - colour)
    middle = corners.mean(axis=1)
    order = np.flatnonzero(((view.position_m - middle) * normal).sum(axis=1) > 0)
    if bodies.kind[k] == "ugv":  # a car's faces are already in drawing order
        order = order[np.argsort(-np.linalg.norm(middle[order] - view.position_m, axis=1))]
    value, is_cut = int(bodies.number[k]), view.homogeneous(corners)[..., 2].min() < NEAR_M
    px = None if is_cut else fixed_point(view.project(corners))
    for n in order:
        if px is None:
            canvas.fill_in_view(corners[n], colour[n], value, view)
        else:
            canvas.fill(px[n], colour[n], value)


def draw_figure(
    ends_m: np.ndarray,
    radius_m: np.ndarray,
    colour: np.ndarray,
    view: PinholeView,
    canvas: Canvas,
    value: int,
    to_sun: np.ndarray,
) -> np.ndarray:
    """Draw a person's limbs, far limbs first, lit from the sun's side. Return their outlines (L, 16, 2), px."""
    worn = np.isfinite(radius_m).all(axis=1)
    ends_m, radius_m, colour = ends_m[worn], radius_m[worn], colour[worn]
    away = np.linalg.norm(ends_m.mean(axis=1) - view.position_m, axis=1)
    towards = view.position_m - ends_m.mean(axis=(0, 1))
    facing = float(towards @ to_sun / np.linalg.norm(towards))
    # The third row points ahead, so the sign tells whether the sun is on the right or the left.
    side = float(np.sign(view.image_from_world[2, 1] * to_sun[0] - view.image_from_world[2, 0] * to_sun[1]))
    # From the sun's side the whole limb is lit. From the other side only its edge is lit.
    front = max(facing, 0.0)
    seen = view.homogeneous(ends_m)
    px, size = seen[..., :2] / seen[..., 2:], radius_m * view.scale_px / seen[..., 2]
    whole = limb_capsules(px, size)
    aside = size[..., None] * (side * 0.32 * (1 - abs(facing)), -0.12)
    fixed_whole, fixed_part = fixed_point(whole), fixed_point(limb_capsules(px + aside, (0.66 + 0.2 * front) * size))
    dark, bright = (np.clip(colour * tone, 0, 255) for tone in (0.62 + 0.12 * front, 0.82 + 0.25 * front))
    for k in np.argsort(-away).tolist():
        canvas.fill(fixed_whole[k], dark[k], value)
        cv2.fillConvexPoly(canvas.picture, fixed_part[k], bright[k].tolist(), cv2.LINE_AA, BITS)
    _wrinkle(whole, canvas, value)
    return whole


def _wrinkle(outlines_px: np.ndarray, canvas: Canvas, value: int) -> None:
    """Give the drawn clothes folds and soft borders between light and shade, so that they look like cloth."""
    low, high = outlines_px.min(axis=(0, 1)), outlines_px.max(axis=(0, 1))
    tall = float(high[1] - low[1])
    (x0, y0), (x1, y1) = np.clip([np.floor(low), np.ceil(high) + 1], 0, canvas.mask.shape[::-1]).astype(int).tolist()
    if tall < _LEAST_WRINKLED_PX or x1 - x0 < 2 or y1 - y0 < 2:
        return
    picture, inside = canvas.picture[y0:y1, x0:x1], (canvas.mask[y0:y1, x0:x1] == value).astype(np.uint8)
    # Keep the figure's outline sharp.
    within = cv2.erode(inside, np.ones((3, 3), np.uint8), iterations=max(1, round(0.01 * tall)), borderValue=1)
    cv2.copyTo(cv2.GaussianBlur(picture, (0, 0), max(0.5, 0.01 * tall)), within, picture)
    scale = tall / _FOLDS.shape[0]
    place = np.array([[scale, 0, low[0] - x0 - scale * (37 * value % 90)], [0, scale, low[1] - y0]])
    folds = cv2.warpAffine(_FOLDS, place, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    folds[inside == 0] = 128
    picture[:] = cv2.multiply(picture, cv2.merge([folds] * 3), scale=1 / 128)


def _draw_folds() -> np.ndarray:
    """Draw a pattern of folds for a body 180 pixels tall, (180, 180) uint8 about 128."""
    rng = np.random.default_rng(64)
    pattern = np.zeros((180, 180), np.float32)
    for turn in (60.0, 95.0, 130.0):
        noise = cv2.GaussianBlur(rng.standard_normal((300, 300), np.float32), (0, 0), sigmaX=9, sigmaY=2.2)
        turned = cv2.warpAffine(noise, cv2.getRotationMatrix2D((150, 150), turn, 1), (300, 300))[60:240, 60:240]
        pattern += turned / turned.std()
    return np.clip(128 * (1 + 0.09 * pattern), 0, 255).astype(np.uint8)


def _bush(rng: np.random.Generator) -> Plant:
    """Draw a bush: a dome of small leaves with gaps, a shaded foot, and bare twigs that stick out."""
    width, height = _SIZE_PX
    plant = np.zeros((height, width, 2), np.float32)
    lobes = [
        (rng.uniform(0.2, 0.8), rng.uniform(0.0, 0.25), rng.uniform(0.14, 0.3), rng.uniform(0.4, 0.9))
        for _ in range(rng.integers(4, 8))
    ]
    for _ in range(14):
        _twig(rng, plant, rng.uniform(0.35, 0.65) * width, rng.uniform(-0.9, 0.9), 0.75 * height, 1)
    for _ in range(rng.integers(700, 1300)):
        x, foot, across, tall = lobes[rng.integers(len(lobes))]
        angle, r = rng.uniform(0, np.pi), np.sqrt(rng.uniform(0.05, 1))
        a, b = r * np.cos(angle), r * np.sin(angle)
        _leaf(rng, plant, (x + across * a) * width, (1 - foot - tall * b) * height, 0.25 * a + 0.55 * b)
    return _halve(plant)


def _tree(rng: np.random.Generator) -> Plant:
    """Draw a tree: several stems that spread, and a wide crown of lumps."""
    width, height = _SIZE_PX
    plant = np.zeros((height, width, 2), np.float32)
    for _ in range(rng.integers(2, 5)):
        start, lean = rng.uniform(0.46, 0.54) * width, rng.uniform(-0.6, 0.6)
        _twig(rng, plant, start, lean, 0.65 * height, int(rng.integers(3, 6)))
    lumps = [
        (rng.uniform(0.14, 0.86), rng.uniform(0.24, 0.87), rng.uniform(0.09, 0.2)) for _ in range(rng.integers(11, 17))
    ]
    for _ in range(rng.integers(1000, 1500)):
        x, up, size = lumps[rng.integers(len(lumps))]
        angle, r = rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform(0, 1))
        a, b = r * np.cos(angle), r * np.sin(angle)
        rise = 0.2 * a + 0.45 * b + 0.5 * (up - 0.6)
        _leaf(rng, plant, (x + size * a) * width, (1 - up - 0.8 * size * b) * height, rise)
    return _halve(plant)


def _leaf(rng: np.random.Generator, plant: np.ndarray, x: float, y: float, rise: float) -> None:
    bright = min(max(0.62 + 0.5 * rise + rng.normal(0, 0.16), 0.2), 1.6)
    axes = (round(rng.uniform(1.2, 4.2) * 16), round(rng.uniform(0.8, 2.2) * 16))
    turn = float(rng.uniform(0, 180))
    cv2.ellipse(plant, (round(x * 16), round(y * 16)), axes, turn, 0, 360, (1.0, bright), -1, cv2.LINE_8, BITS)


def _twig(rng: np.random.Generator, plant: np.ndarray, x: float, lean: float, length: float, thick: int) -> None:
    y, bright = plant.shape[0] - 1.0, float(rng.uniform(0.25, 0.6))
    for k in range(6):
        x1, y1 = x + lean * length / 6, y - length / 6 * np.sqrt(max(1 - lean**2, 0.05))
        cv2.line(plant, (round(x), round(y)), (round(x1), round(y1)), (1.0, bright), max(1, thick - k // 2))
        x, y, lean = x1, y1, float(np.clip(lean + rng.normal(0, 0.22), -0.98, 0.98))


def _halve(plant: np.ndarray) -> Plant:
    layers = [plant]
    while min(layers[-1].shape[:2]) > 5:
        size = layers[-1].shape[1] // 2, layers[-1].shape[0] // 2
        layers.append(cv2.resize(layers[-1], size, interpolation=cv2.INTER_AREA))
    return layers


_FOLDS = _draw_folds()
