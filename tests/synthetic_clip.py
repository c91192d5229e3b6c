"""A small synthetic clip with its truth: what the tests of detection, tracking and tuning look at.

A camera drifts, pans, rolls and zooms 15 m above textured level ground. Two cars and five people move;
one car is parked.
Ground frame: x to the right, y ahead, z up, metres. The same arguments always give the same clip.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

RATE_HZ = 10.0
SIZE = (640, 480)
FRAMES = 60
LEAST_PX = 12  # a mover that shows fewer pixels has no box
_TEXEL_M, _LEFT_M, _NEAR_M, _WIDTH_M, _DEPTH_M = 1 / 20, -44.0, 4.0, 88.0, 72.0
# x, y, x speed, y speed (m and m/s), half length, half width, height (m), BGR. The last is the parked car.
_BODIES = (
    (-19.0, 23.1, 5.2, 0.2, 2.2, 0.85, 1.4, (206, 210, 214)),
    (16.0, 30.8, -4.3, -0.3, 2.2, 0.85, 1.4, (52, 44, 168)),
    (-7.0, 17.5, 1.5, 0.15, 0.2, 0.25, 1.75, (60, 70, 190)),
    (1.5, 15.2, -1.1, 0.67, 0.2, 0.25, 1.75, (225, 225, 220)),
    (7.5, 19.0, -0.25, 1.38, 0.2, 0.25, 1.75, (150, 60, 30)),
    (4.0, 35.5, -1.58, -0.23, 0.2, 0.25, 1.75, (30, 30, 34)),
    (-4.5, 21.3, 2.44, -0.9, 0.2, 0.25, 1.75, (40, 170, 230)),
    (-9.5, 31.0, 0.0, 0.0, 2.2, 0.85, 1.4, (120, 96, 70)),
)


class View(NamedTuple):
    """image_from_world: (3, 4) projection. position_m: (3,) camera centre."""

    image_from_world: np.ndarray
    position_m: np.ndarray

    @property
    def image_from_ground(self) -> np.ndarray:
        """(3, 3) homography from ground points (x, y, 1) to pixels."""
        return self.image_from_world[:, [0, 1, 3]]


class Clip(NamedTuple):
    """One entry a frame: images (H, W, 3) uint8 BGR; masks (H, W) uint16, 0 background; boxes_px (N, 4) x, y, w, h."""

    images: list[np.ndarray]
    masks: list[np.ndarray]
    boxes_px: list[np.ndarray]


def render(
    seed: int = 0, frames: int = FRAMES, size: tuple[int, int] = SIZE, gain: Sequence[float] | None = None
) -> Clip:
    """The clip. size is (width, height); gain multiplies the light, one number a frame."""
    rng, ground = np.random.default_rng([seed, 3]), _pyramid(seed)
    clip = Clip([], [], [])
    for k, view in enumerate(flight(seed, frames, size)):
        image, mask = _ground_seen(ground, view, size), np.zeros((size[1], size[0]), np.uint16)
        by_distance = sorted(enumerate(_BODIES, 1), key=lambda body: -np.hypot(*(body[1][:2] - view.position_m[:2])))
        for number, body in by_distance:
            _draw(body, k / RATE_HZ, view, image, mask, number if any(body[2:4]) else 0)
        light = (1 + 0.03 * np.sin(0.09 * k)) * (1.0 if gain is None else gain[k])
        image = cv2.GaussianBlur(image, (0, 0), 0.55) * np.float32(light)
        image += rng.normal(0, 1.6, image.shape).astype(np.float32)
        clip.images.append(np.clip(np.round(image), 0, 255).astype(np.uint8))
        clip.masks.append(mask)
        clip.boxes_px.append(boxes_of(mask))
    return clip


def film_into(folder: Path, seed: int = 0, frames: int = FRAMES, size: tuple[int, int] = SIZE) -> Path:
    """Write frames/000001.jpg ... and masks/000001.png ... into a folder, which is returned."""
    clip = render(seed, frames, size)
    for name in ("frames", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for number, (image, mask) in enumerate(zip(clip.images, clip.masks, strict=True), 1):
        cv2.imwrite(str(folder / f"frames/{number:06d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        cv2.imwrite(str(folder / f"masks/{number:06d}.png"), mask.astype(np.uint8))
    return folder


def boxes_of(mask: np.ndarray, least_px: int = LEAST_PX) -> np.ndarray:
    """(N, 4) boxes of the labels of a mask that have at least `least_px` pixels, by ascending label."""
    seen = [mask == value for value in np.unique(mask[mask > 0])]
    boxes = [cv2.boundingRect(one.astype(np.uint8)) for one in seen if one.sum() >= least_px]
    return np.array(boxes, float).reshape(-1, 4)


def flight(seed: int, frames: int, size: tuple[int, int], rate_hz: float = RATE_HZ) -> list[View]:
    """The camera's true views; the field of view is the same for every size."""
    rng = np.random.default_rng([seed, 1])
    phase = rng.uniform(0, 2 * np.pi, 6)
    shake = rng.normal(0, 1, (frames, 3)) * np.radians([0.05, 0.05, 0.04])
    views = []
    for t, shaken in zip(np.arange(frames) / rate_hz, shake, strict=True):
        position = np.array([-3 + 0.9 * t, 0.25 * t, 15 + 0.25 * np.sin(0.9 * t + phase[0])])
        yaw = np.radians(-4 + 1.3 * t + 0.8 * np.sin(1.1 * t + phase[1])) + shaken[0]
        pitch = np.radians(35 + 0.8 * np.sin(0.8 * t + phase[2])) + shaken[1]
        roll = np.radians(1.5 * np.sin(0.7 * t + phase[3])) + shaken[2]
        ahead = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), -np.sin(pitch)])
        right = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
        down = np.cross(ahead, right)
        turned = right * np.cos(roll) + down * np.sin(roll), down * np.cos(roll) - right * np.sin(roll)
        rotation = np.stack([*turned, ahead])
        focal = 1.125 * max(size[0], size[1] * 4 / 3) * (1 + 0.015 * np.sin(0.9 * t + phase[4]))
        inner = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
        views.append(View(inner @ np.c_[rotation, -rotation @ position], position))
    return views


@lru_cache(maxsize=2)
def _pyramid(seed: int) -> list[np.ndarray]:
    """The ground's texture from above and its reductions, so that far ground does not shimmer."""
    rng = np.random.default_rng([seed, 2])
    height, width = int(_DEPTH_M / _TEXEL_M), int(_WIDTH_M / _TEXEL_M)
    grey = np.zeros((height, width), np.float32)
    for cell_m, spread in ((9, 12), (1.6, 11), (0.35, 11), (0.08, 12)):
        small = rng.normal(0, spread, (int(_DEPTH_M / cell_m), int(_WIDTH_M / cell_m))).astype(np.float32)
        grey += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    ground = np.clip(grey[..., None] + np.array([92, 124, 142], np.float32), 20, 220).astype(np.uint8)
    for x, y, radius, tone in rng.uniform((0, 0, 6, 40), (width, height, 24, 85), (260, 4)):  # bushes, flat
        middle = round(x), round(y)
        cv2.circle(ground, (middle[0] + 5, middle[1] + 3), round(radius), (60, 66, 70), -1, cv2.LINE_AA)
        cv2.circle(ground, middle, round(radius), (tone, tone + 40, tone + 30), -1, cv2.LINE_AA)
    levels: list[np.ndarray] = [ground]
    while len(levels) < 5:
        levels.append(cv2.pyrDown(levels[-1]))
    return levels


def _ground_seen(levels: list[np.ndarray], view: View, size: tuple[int, int]) -> np.ndarray:
    """(H, W, 3) float32. Each row mixes the two reductions that suit how many texels a pixel of it covers."""
    texel_from_ground = np.array(
        [[1 / _TEXEL_M, 0, -_LEFT_M / _TEXEL_M], [0, 1 / _TEXEL_M, -_NEAR_M / _TEXEL_M], [0, 0, 1]]
    )
    texel_from_image = texel_from_ground @ np.linalg.inv(view.image_from_ground)
    depth = texel_from_image[2, 0] * size[0] / 2 + texel_from_image[2, 1] * np.arange(size[1]) + texel_from_image[2, 2]
    covered = np.sqrt(np.abs(np.linalg.det(texel_from_image) / depth**3))
    level = np.clip(np.log2(covered) + 0.35, 0, len(levels) - 1.001)
    image = np.zeros((size[1], size[0], 3), np.float32)
    for k, texture in enumerate(levels):
        share = np.clip(1 - np.abs(level - k), 0, 1).astype(np.float32)
        if share.any():
            matrix = np.diag([0.5**k, 0.5**k, 1]) @ texel_from_image
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            seen = cv2.warpPerspective(texture, matrix, size, flags=flags, borderMode=cv2.BORDER_REFLECT_101)
            image += share[:, None, None] * seen
    return image


def _draw(body: tuple, time_s: float, view: View, image: np.ndarray, mask: np.ndarray, number: int) -> None:
    """A car as a box with a dark cabin, a person as legs, trunk and head; and the shadow."""
    x, y, speed_x, speed_y, half_length, half_width, height, colour = body
    middle = np.array([x + speed_x * time_s, y + speed_y * time_s, 0])
    ahead = np.array([speed_x, speed_y, 0]) / np.hypot(speed_x, speed_y) if number else np.array([1.0, 0.1, 0])
    left = np.array([-ahead[1], ahead[0], 0])

    def fill(
        low: float, high: float, tone: Sequence[float], value: int | None, back: float = -1, front: float = 1
    ) -> None:
        """The outline of a box from one height to another, in the image and (with a value) in the mask."""
        corners = [
            middle + along * half_length * ahead + aside * half_width * left + (0, 0, up)
            for along in (back, front) for aside in (-1, 1) for up in (low, high)
        ]  # fmt: skip
        if value is None:  # on the ground, away from the sun
            corners = [np.array([p[0] + 0.55 * p[2], p[1] + 0.3 * p[2], 0]) for p in corners]
        seen = np.c_[corners, np.ones(8)] @ view.image_from_world.T
        outline = cv2.convexHull((16 * seen[:, :2] / seen[:, 2:]).round().astype(np.int32))
        cv2.fillConvexPoly(image, outline, tone, cv2.LINE_AA, 4)
        if value is not None:
            cv2.fillConvexPoly(mask, outline, value, cv2.LINE_8, 4)

    fill(0, height, (66, 80, 90), None)
    if height > 1.5:
        fill(0, 0.88, (60, 56, 50), number)
        fill(0.88, 1.5, colour, number)
        fill(1.5, height, (90, 120, 160), number, -0.6, 0.6)
        return
    fill(0, 0.8, colour, number)
    for back, tone in ((-0.9, 0.4), (-0.3, 0.75), (0.1, 1.3), (0.5, 0.4)):  # stripes: wheels, doors
        fill(0, 0.5, np.clip(tone * np.array(colour), 10, 250).tolist(), number, back, back + 0.3)
    for back, tone in ((-0.7, 60), (-0.4, 30), (-0.1, 80), (0.2, 40)):  # windows
        fill(0.8, height, (tone, tone, tone), number, back, back + 0.3)
