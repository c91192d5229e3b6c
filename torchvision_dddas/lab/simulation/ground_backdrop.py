"""Sky and ground seen from near the ground. Hills hide the ground behind them, and haze hides far ground."""

from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.lab.simulation.cameras import PinholeView
from torchvision_dddas.lab.simulation.world import GroundTexture, World, equal_runs

HAZE = np.array([214.0, 206, 196], np.float32)  # BGR of the air at the horizon
_ZENITH = np.array([196.0, 140, 84], np.float32)
_RIDGE = np.array([150.0, 128, 116], np.float32)  # BGR of far mountains
VISIBILITY_M = 2500.0  # distance at which the ground's contrast has dropped to 1 / e
_FAR_M = 1500.0
_COLUMN_PX = 16  # columns between rays
_STEPS = 110  # places on the ground on each ray
_LEVELS = 7
_SHARES = 32  # steps of the mix of ground and air
_TILE = 512  # side of the pattern of pebbles, in its own texels
_GRAIN_M = (0.007, 0.031)  # texel sizes of the pattern, which is applied twice


class _Rays(NamedTuple):
    """Rays through all rows of some columns of a picture, (H, C) each.

    east, north: components of a ray 1 m long in depth. level: its length over the ground. rise: up per metre of level.
    """

    east: np.ndarray
    north: np.ndarray
    level: np.ndarray
    rise: np.ndarray

    def rows(self, part: slice) -> "_Rays":
        """Return the rays of some rows."""
        return _Rays(*(values[part] for values in self))


class Backdrop:
    """The ground of a world, prepared for views along it."""

    def __init__(self, world: World, seed: int) -> None:
        self._world, self._texture = world, GroundTexture(world, _LEVELS)
        rng = np.random.default_rng([seed, 60])
        self._pebbles = _pebbles(rng)
        self._maps: dict[tuple[int, ...], list[np.ndarray]] = {}
        self._ridge = rng.uniform(0.3, 1, 6) / np.arange(1, 7), rng.uniform(0, 2 * np.pi, 6)

    def seen(self, view: PinholeView, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the picture (H, W, 3) uint8 BGR and 1 / ground distance of each pixel (H, W) float32; 0 is sky."""
        width, height = size
        matrix = np.linalg.inv(view.image_from_world[:, :3]).astype(np.float32)  # ray from pixel (u, v, 1)
        u = np.linspace(0, width - 1, (width - 1) // _COLUMN_PX + 2).astype(np.float32)
        v = np.arange(height, dtype=np.float32)[:, None]
        east, north, up = (matrix[i, 0] * u + (matrix[i, 1] * v + matrix[i, 2]) for i in range(3))
        level = cv2.magnitude(east, north)
        rays = _Rays(east, north, level, up / level)
        # Interpolate linearly between columns. cv2.resize does not fit, because it counts from the pixels' edges.
        inverse = self._widen(self._inverse_distance(view, rays), width)
        inverse[inverse < 0.5 / _FAR_M] = 0
        is_ground = inverse > 0
        rows = np.flatnonzero(is_ground.any(axis=1))
        first = int(rows[0]) if len(rows) else height
        image = np.empty((height, width, 3), np.uint8)
        last = min(first + _COLUMN_PX * 4, height)  # the horizon may slope
        while last < height and not is_ground[last].all():
            last += 1
        image[:last] = self._widen(self._sky(rays.rows(slice(last)), view), width)
        if first < height:
            ground = self._ground(view, inverse[first:], rays.rows(slice(first, None)))
            mixed, onto = last - first, image[first:last]
            onto[:] = np.where(is_ground[first:last, :, None], ground[:mixed], onto)
            image[last:] = ground[mixed:]
        return image, inverse

    def _widen(self, image: np.ndarray, width: int) -> np.ndarray:
        """Interpolate an image (H, C) of some columns to (H, width)."""
        shape = *image.shape[:2], width
        if shape not in self._maps:
            at = np.linspace(0, shape[1] - 1, width, dtype=np.float32)
            v = np.arange(shape[0], dtype=np.float32)[:, None]
            self._maps[shape] = [np.ascontiguousarray(np.broadcast_to(one, (shape[0], width))) for one in (at, v)]
        u, v = self._maps[shape]
        return cv2.remap(image.astype(np.float32), u, v, cv2.INTER_LINEAR)

    def _inverse_distance(self, view: PinholeView, rays: _Rays) -> np.ndarray:
        """Return (H, C) 1 / distance in metres at which each ray first meets the ground; 0 without a hit."""
        count = rays.rise.shape[1]
        middle = np.abs(rays.rise).argmin(axis=0), np.arange(count)
        bearing = np.stack([rays.east[middle], rays.north[middle]], axis=1) / rays.level[middle][:, None]
        r = np.geomspace(0.5, _FAR_M, _STEPS)
        places = view.position_m[:2] + (r[:, None, None] * bearing).reshape(-1, 2)
        up = self._world.up_m(places).reshape(_STEPS, -1)
        # Slopes below the horizontal at which each place is visible over all nearer ground.
        slopes = np.minimum.accumulate((view.position_m[2] - up) / r[:, None], axis=0)
        inverse = np.empty(rays.rise.shape, np.float32)
        for k in range(count):
            inverse[:, k] = np.interp(-rays.rise[:, k], slopes[::-1, k], 1 / r[::-1], left=0.0)
        return inverse

    def _ground(self, view: PinholeView, inverse: np.ndarray, rays: _Rays) -> np.ndarray:
        """Draw the rows that show ground, (H, W, 3) uint8. rays: rays of some columns."""
        inverse = np.maximum(inverse, np.float32(0.5 / _FAR_M))
        width, place = inverse.shape[1], view.position_m[:2]
        x, y = (cv2.divide(self._widen(way / rays.level, width), inverse) for way in (rays.east, rays.north))
        eye = max(float(view.position_m[2] - self._world.up_m(place[None])[0]), 0.2)
        # A pixel covers far / focal across and far^2 / (focal * eye) along the line of sight. A row shares these sizes.
        far = 1 / np.median(inverse[:, ::16], axis=1)
        across, along = far / view.scale_px, far**2 / (view.scale_px * eye)
        image = self._texture.rows(np.sqrt(across * along), x, y, (float(place[0]), float(place[1])))
        self._strew(image, x, y, place, along)
        clear = np.round(np.exp(-far / VISIBILITY_M) * _SHARES).astype(int) / _SHARES
        for begin, end in equal_runs(clear):
            if clear[begin] < 1:
                part = image[begin:end]
                air = np.full(part.shape, np.round(HAZE), np.uint8)
                cv2.addWeighted(part, clear[begin], air, 1 - clear[begin], 0, dst=part)
        return image

    def _strew(self, image: np.ndarray, x: np.ndarray, y: np.ndarray, place_m: np.ndarray, along_m: np.ndarray) -> None:
        """Draw pebbles on the near ground of a picture. x, y: metres east and north of a place."""
        for grain in _GRAIN_M:
            strength = np.clip(1.3 - along_m / (6 * grain), 0, 1).astype(np.float32)
            if strength.max() > 0:
                near = slice(int(np.argmax(strength > 0)), None)  # rows above are farther
                texels = []
                for way, start in zip((x, y), place_m, strict=True):
                    texel = cv2.addWeighted(way[near], 1 / grain, way[near], 0, float(np.mod(start / grain, _TILE)))
                    # Remove whole tiles, because cv2.remap counts pixels in 16 bits.
                    tiles = np.floor(texel * np.float32(1 / _TILE))
                    texels.append(texel - np.multiply(tiles, np.float32(_TILE), out=tiles))
                u, v = texels
                pebbles = cv2.remap(self._pebbles, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
                bright = cv2.multiply(pebbles, np.repeat(64 * strength[near, None], pebbles.shape[1], axis=1))
                bright = cv2.cvtColor(cv2.convertScaleAbs(bright, alpha=1, beta=64), cv2.COLOR_GRAY2BGR)
                cv2.multiply(image[near], bright, dst=image[near], scale=1 / 64)

    def _sky(self, rays: _Rays, view: PinholeView) -> np.ndarray:
        """Draw the sky and far mountains, (H, C, 3) float32 BGR."""
        depth = np.exp(-np.maximum(rays.rise, 0) / 0.3)[..., None]
        sky = _ZENITH + (HAZE - _ZENITH) * depth
        share, phase = self._ridge
        bearing = np.arctan2(rays.east[-1], rays.north[-1])
        waves = share[:, None] * np.sin(np.outer(np.arange(2, 14, 2), bearing) + phase[:, None])
        tall = 0.03 + 0.014 * waves.sum(axis=0)
        covered = np.clip((tall - rays.rise) * view.scale_px + 0.5, 0, 1)[..., None].astype(np.float32)
        return sky + (_RIDGE * 0.6 + HAZE * 0.4 - sky) * covered


def _pebbles(rng: np.random.Generator) -> np.ndarray:
    """Draw a seamless pattern of grit and stones with dark sides, (_TILE, _TILE) float32 about 0."""
    grit = rng.normal(0, 1, (_TILE, _TILE)).astype(np.float32)
    pattern = np.zeros_like(grit)
    for sigma, share in ((0.7, 0.16), (2.5, 0.6), (9, 1.8)):
        wide = cv2.copyMakeBorder(grit, 40, 40, 40, 40, cv2.BORDER_WRAP)
        pattern += share * cv2.GaussianBlur(wide, (0, 0), sigma)[40:-40, 40:-40]
    stones = np.zeros_like(pattern)
    for x, y, size in zip(*rng.uniform(8, _TILE - 8, (2, 260)), rng.gamma(2, 1.1, 260), strict=True):
        axes = (max(1, round(size * 1.4)), max(1, round(size)))
        turn = float(rng.uniform(0, 180))
        cv2.ellipse(stones, (round(x + 1), round(y + 1)), axes, turn, 0, 360, -0.3, -1, cv2.LINE_8)
        cv2.ellipse(stones, (round(x), round(y)), axes, turn, 0, 360, float(rng.uniform(0, 0.22)), -1, cv2.LINE_8)
    return pattern + cv2.GaussianBlur(stones, (0, 0), 0.7)
