"""A small world filmed from the air, with its truth: the demo's clip, and the tests' measure of right and wrong.

People walk and cars drive over textured ground under a camera that drifts, pans, rolls and zooms a little, in light
that changes, with sensor noise. One parked car stands still and belongs to the background.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.simulation.bodies import Body, Canvas, draw, shade
from torchvision_dddas.simulation.camera import flight
from torchvision_dddas.simulation.ground import Ground, road_centre

RATE_HZ = 10.0
SIZE = (640, 480)
FRAMES = 60
LEAST_PX = 12  # a mover of which fewer pixels are seen has no box


class Picture(NamedTuple):
    """One frame and its truth.

    image: (H, W, 3) uint8 BGR. mask: (H, W) uint16, 0 background, each mover its own value, the same in all frames.
    boxes_px: (N, 4) float64, x, y, width, height of the movers in view, by ascending value.
    """

    image: np.ndarray
    mask: np.ndarray
    boxes_px: np.ndarray


class Clip(NamedTuple):
    """A whole film: images, masks and boxes_px as in Picture, one entry a frame."""

    images: list[np.ndarray]
    masks: list[np.ndarray]
    boxes_px: list[np.ndarray]


def render(
    seed: int = 0, frames: int = FRAMES, size: tuple[int, int] = SIZE, gain: Sequence[float] | None = None
) -> Clip:
    """The film as lists. gain multiplies the light, one number a frame, beside the scene's own slow drift."""
    pictures = list(film(seed, frames, size, gain))
    return Clip([p.image for p in pictures], [p.mask for p in pictures], [p.boxes_px for p in pictures])


def film(
    seed: int = 0, frames: int = FRAMES, size: tuple[int, int] = SIZE, gain: Sequence[float] | None = None
) -> Iterator[Picture]:
    """The film, one picture at a time. size is (width, height); the same arguments always give the same film."""
    if gain is not None and len(gain) != frames:
        raise ValueError(f"gain has {len(gain)} numbers for {frames} frames; give one a frame")
    rng = np.random.default_rng([seed, 3])
    movers, parked = cast(seed)
    ground = Ground(seed)
    for k, view in enumerate(flight(seed, frames, size, RATE_HZ)):
        time_s = k / RATE_HZ
        picture = ground.seen(view.image_from_ground, size)
        layer = np.zeros(picture.shape[:2], np.uint8)
        for body in (*movers, *parked):
            shade(body, time_s, view, layer)
        picture *= 1 - (0.5 / 255) * cv2.GaussianBlur(layer, (0, 0), 0.8)[..., None].astype(np.float32)
        canvas = Canvas(np.clip(picture, 0, 255).astype(np.uint8))
        numbered = [*((i + 1, b) for i, b in enumerate(movers)), *((0, b) for b in parked)]
        # Far bodies first, so that near ones hide them.
        away = [float(np.hypot(*(body.place(time_s) - view.position_m[:2]))) for _, body in numbered]
        for i in np.argsort(away)[::-1]:
            value, body = numbered[i]
            draw(body, time_s, view, canvas, value)
        light = (1 + 0.03 * np.sin(0.9 * time_s)) * (1.0 if gain is None else gain[k])
        image = cv2.GaussianBlur(canvas.picture, (0, 0), 0.55).astype(np.float32) * np.float32(light)
        image += rng.normal(0, 1.6, image.shape).astype(np.float32)
        yield Picture(np.clip(np.round(image), 0, 255).astype(np.uint8), canvas.mask, boxes_of(canvas.mask))


def cast(seed: int) -> tuple[list[Body], list[Body]]:
    """Who moves and who stands: (movers, parked). A mover's place in the list, plus 1, is its value in the masks."""
    rng = np.random.default_rng([seed, 4])

    def driver(x: float, lane: float, speed: float, colour: tuple[float, float, float]) -> Body:
        run = 8 * np.sign(speed)
        ahead = np.array([1.0, (float(road_centre(x + run)) - float(road_centre(x))) / run])
        place = np.array([x, float(road_centre(x)) + lane])
        return Body("car", place, speed * ahead / np.linalg.norm(ahead), colour)

    def walker(x: float, y: float, direction: float, speed: float, colour: tuple[float, float, float]) -> Body:
        way = np.array([np.cos(direction), np.sin(direction)])
        place = np.array([x, y]) + rng.uniform(-0.4, 0.4, 2)
        return Body("person", place, speed * way, colour, stride_hz=0.62 * speed**0.5)

    wobble = rng.uniform(0.9, 1.1, 7)
    movers = [
        driver(-19.0, -1.75, 5.2 * wobble[0], (206, 210, 214)),
        driver(16.0, 1.75, -4.3 * wobble[1], (52, 44, 168)),
        walker(-7.0, 17.5, 0.1, 1.5 * wobble[2], (60, 70, 190)),
        walker(1.5, 15.2, 2.6, 1.3 * wobble[3], (205, 205, 200)),
        walker(7.5, 19.0, 1.75, 1.4 * wobble[4], (150, 96, 40)),
        walker(4.0, 35.5, -3.0, 1.6 * wobble[5], (40, 40, 44)),
        walker(-4.5, 21.3, -0.35, 2.6 * wobble[6], (40, 170, 210)),
    ]
    side = float(road_centre(-9.5)) + 5.1
    return movers, [Body("car", np.array([-9.5, side]), np.zeros(2), (120, 96, 70), facing=0.12)]


def boxes_of(mask: np.ndarray, least_px: int = LEAST_PX) -> np.ndarray:
    """(N, 4) boxes x, y, width, height of the labels of a mask that have at least `least_px` pixels."""
    boxes = []
    for value in np.unique(mask[mask > 0]):
        mine = mask == value
        if int(mine.sum()) >= least_px:
            boxes.append(cv2.boundingRect(mine.astype(np.uint8)))
    return np.array(boxes, float).reshape(-1, 4)
