"""Textured ground, made from noise: dry soil, scrub with its shade, a road with worn paint."""

from collections.abc import Sequence

import cv2
import numpy as np

METRE_PX = 24
LEFT_M, NEAR_M, WIDTH_M, DEPTH_M = -44.0, 4.0, 88.0, 72.0
ROAD_WIDTH_M = 7.0


def road_centre(x_m: np.ndarray | float) -> np.ndarray | float:
    """Distance ahead of the road's centre line at x, metres."""
    return 27 + 0.06 * x_m + 1.2 * np.sin(np.asarray(x_m) / 14)


def texture(seed: int) -> np.ndarray:
    """The ground from above, (H, W, 3) uint8 BGR. Its first pixel lies at LEFT_M, NEAR_M; METRE_PX pixels a metre."""
    rng = np.random.default_rng([seed, 2])
    height, width = int(DEPTH_M * METRE_PX), int(WIDTH_M * METRE_PX)

    def noise(cell_m: float) -> np.ndarray:
        """Smooth noise with spread 1 whose bumps are about cell_m wide."""
        cells = max(int(DEPTH_M / cell_m), 2), max(int(WIDTH_M / cell_m), 2)
        small = rng.normal(0, 1, cells).astype(np.float32)
        return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)

    broad, middle, fine, grain = noise(9), noise(1.6), noise(0.35), noise(0.08)
    soil = _bgr([104, 136, 164]) + (7 * broad + 6 * middle + 7 * fine + 11 * grain)[..., None]
    soil += broad[..., None] * _bgr([-2, 3, 0])
    grass = _bgr([72, 118, 116]) + (9 * middle + 10 * fine + 12 * grain)[..., None]
    cover = np.clip(0.5 + 1.3 * (0.7 * broad + 0.5 * middle + 0.3 * fine - 0.35), 0, 1)[..., None]
    ground = soil + cover * (grass - soil)
    stones = cv2.GaussianBlur((rng.random((height, width)) > 0.9985).astype(np.float32), (0, 0), 1.1) * 7
    ground *= (1 + 0.35 * np.clip(stones, 0, 1) - 0.35 * np.clip(np.roll(stones, (1, 2), (0, 1)), 0, 1))[..., None]

    x = (np.arange(width) + 0.5) / METRE_PX + LEFT_M
    y = (np.arange(height) + 0.5) / METRE_PX + NEAR_M
    offset = (y[:, None] - np.asarray(road_centre(x))[None]).astype(np.float32)
    ragged = np.abs(offset) + 0.25 * middle + 0.12 * fine
    shoulder = np.clip(1.6 - (ragged - ROAD_WIDTH_M / 2) / 0.9, 0, 1)[..., None]
    ground += shoulder * (_bgr([128, 150, 168]) + (7 * fine + 11 * grain)[..., None] - ground)

    _scrub(ground, rng, np.abs(offset) > ROAD_WIDTH_M / 2 + 2.2)

    asphalt = 96 + 4 * broad + 3 * middle + 2.5 * fine + 7 * grain
    asphalt -= 9 * np.exp(-((np.abs(np.abs(offset) - 1.75) - 0.8) ** 2) / 0.08)  # where wheels run
    on_road = np.clip((ROAD_WIDTH_M / 2 - np.abs(offset) - 0.06 * fine) * METRE_PX / 2, 0, 1)[..., None]
    ground += on_road * (asphalt[..., None] * _bgr([1.0, 0.99, 0.97]) - ground)
    worn = np.clip(0.75 + 0.3 * fine + 0.2 * middle, 0, 0.85)
    dashes = (np.abs(offset) < 0.08) & (np.mod(x, 6) < 3)[None]
    edges = np.abs(np.abs(offset) - ROAD_WIDTH_M / 2 + 0.3) < 0.07
    paint = ((dashes | edges) * worn)[..., None]
    ground += paint * (_bgr([200, 208, 212]) - ground)
    return np.clip(ground, 0, 255).astype(np.uint8)


def _scrub(ground: np.ndarray, rng: np.random.Generator, allowed: np.ndarray) -> None:
    """Paint bushes with mottled leaves and a shade to their right, in place. Flat: they have no parallax."""
    height, width = allowed.shape
    for _ in range(420):
        column, row = int(rng.integers(0, width)), int(rng.integers(0, height))
        radius = METRE_PX * float(rng.gamma(3, 0.16) + 0.15)
        reach = int(2.5 * radius) + 2
        if not allowed[row, column] or not (reach < column < width - reach and reach < row < height - reach):
            continue
        patch = ground[row - reach : row + reach, column - reach : column + reach]
        v, u = np.mgrid[-reach:reach, -reach:reach].astype(np.float32)
        lumps = rng.normal(0, 1, (7, 7)).astype(np.float32)
        outline = 1.1 * radius * (1 + 0.2 * cv2.resize(lumps, v.shape, interpolation=cv2.INTER_CUBIC))
        leaves = cv2.GaussianBlur(rng.normal(0, 1, v.shape).astype(np.float32), (0, 0), 1.2) * 2.5
        bush = np.clip((outline - np.hypot(u, v)) / 3, 0, 1)[..., None]
        shade = np.clip((outline - np.hypot(u - 0.7 * radius, v - 0.4 * radius)) / 5, 0, 1)[..., None]
        patch *= 1 - 0.42 * shade
        light = (16 * leaves - 16 * (u + v) / radius)[..., None]  # lit from the near left
        tone = _bgr([52, 92, 84]) + float(rng.normal(0, 8)) + light * _bgr([0.7, 1, 0.95])
        patch += bush * (np.clip(tone, 15, 190) - patch)


def _bgr(values: Sequence[float]) -> np.ndarray:
    return np.array(values, np.float32)


class Ground:
    """The texture with its reductions, so that far ground does not shimmer as the camera moves."""

    def __init__(self, seed: int) -> None:
        self.levels = [texture(seed)]
        while len(self.levels) < 5:
            self.levels.append(cv2.pyrDown(self.levels[-1]))

    def seen(self, image_from_ground: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """The ground in a view, (H, W, 3) float32. Ground beyond the texture's edge is mirrored."""
        ground_from_image = np.linalg.inv(image_from_ground)
        left_px, near_px = LEFT_M * METRE_PX + 0.5, NEAR_M * METRE_PX + 0.5
        map_ = np.array([[METRE_PX, 0, -left_px], [0, METRE_PX, -near_px], [0, 0, 1.0]]) @ ground_from_image
        # Texture pixels that one image pixel covers, by row, down the middle column: it chooses the reduction.
        rows = np.arange(size[1])
        middle = np.stack([np.full(size[1], (size[0] - 1) / 2), rows, np.ones(size[1])])
        depth = (map_ @ middle)[2]
        covered = np.sqrt(np.abs(np.linalg.det(map_) / depth**3))
        level = np.clip(np.log2(np.maximum(covered, 1e-6)) + 0.35, 0, len(self.levels) - 1.001)
        out = np.zeros((size[1], size[0], 3), np.float32)
        for k, picture in enumerate(self.levels):
            share = np.clip(1 - np.abs(level - k), 0, 1).astype(np.float32)
            used = np.flatnonzero(share)
            if len(used) == 0:
                continue
            reduce = np.diag([0.5**k, 0.5**k, 1.0])
            top, bottom = int(used[0]), int(used[-1]) + 1
            shift = np.array([[1, 0, 0], [0, 1, top], [0, 0, 1.0]])
            part = cv2.warpPerspective(
                picture, reduce @ map_ @ shift, (size[0], bottom - top),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT_101,
            )  # fmt: skip
            out[top:bottom] += share[top:bottom, None, None] * part
        return out
