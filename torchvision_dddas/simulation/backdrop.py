"""Sky and ground as a camera near the ground sees them: hills hide what lies behind, haze takes what is far."""

from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from torchvision_dddas.simulation.camera import View

if TYPE_CHECKING:
    from torchvision_dddas.simulation.world import World

HAZE = np.array([214.0, 206, 196], np.float32)  # BGR of the air at the horizon
_ZENITH = np.array([196.0, 140, 84], np.float32)
_RIDGE = np.array([150.0, 128, 116], np.float32)  # of far mountains
VISIBILITY_M = 2500.0  # over which the ground has lost all but 1 / e of its contrast
_FAR_M = 1500.0
_COLUMN_PX = 16  # rays are cast so many columns apart
_STEPS = 110  # places on the ground on each ray
_LEVELS = 7
_TILE = 512  # side of the pattern of pebbles, in its own texels
_GRAIN_M = (0.009, 0.041)  # its texels, laid out twice


class Seen(NamedTuple):
    """image: (H, W, 3) float32 BGR. inverse_m: (H, W) float32, 1 / the way over the ground to each pixel; 0: sky."""

    image: np.ndarray
    inverse_m: np.ndarray


class Backdrop:
    """The ground of a world, made ready for a look along it."""

    def __init__(self, world: "World", seed: int) -> None:
        self._world = world
        self._levels = [world.albedo]
        while len(self._levels) < _LEVELS and min(self._levels[-1].shape[:2]) >= 4:
            above = self._levels[-1]
            size = (above.shape[1] + 1) // 2, (above.shape[0] + 1) // 2
            self._levels.append(cv2.resize(above, size, interpolation=cv2.INTER_AREA))
        rng = np.random.default_rng([seed, 60])
        self._pebbles = _pebbles(rng)
        self._ridge = rng.uniform(0.3, 1, 6) / np.arange(1, 7), rng.uniform(0, 2 * np.pi, 6)

    def seen(self, view: View, size: tuple[int, int]) -> Seen:
        """What a view (its picture's width, height) holds of it."""
        width, height = size
        rays = np.linalg.inv(view.image_from_world[:, :3])  # of a pixel (u, v, 1), in east, north, up
        inverse = self._inverse_distance(view, rays, size)
        v, u = np.mgrid[:height, :width].astype(np.float32)
        ray = [(rays[i, 0] * u + rays[i, 1] * v + rays[i, 2]).astype(np.float32) for i in range(3)]
        level = np.sqrt(ray[0] ** 2 + ray[1] ** 2)
        image = self._sky(ray[2] / level, np.arctan2(ray[0][height // 2], ray[1][height // 2]), view)
        rows = np.flatnonzero((inverse > 0).any(axis=1))
        if len(rows):
            low = slice(int(rows[0]), height)
            ground = self._ground(view, inverse[low], ray[0][low] / level[low], ray[1][low] / level[low])
            away = (inverse[low] > 0)[..., None]
            image[low] = np.where(away, ground, image[low])
        return Seen(image, inverse)

    def _inverse_distance(self, view: View, rays: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """(H, W): on each ray the first place at which the ground reaches it."""
        width, height = size
        columns = np.linspace(0, width - 1, (width - 1) // _COLUMN_PX + 2)
        v = np.arange(height)
        directions = np.einsum(
            "ij,jvu->ivu", rays, np.stack([*np.meshgrid(columns, v), np.ones((height, len(columns)))])
        )
        falls = -directions[2] / np.hypot(directions[0], directions[1])
        middle = directions[:2, np.abs(falls).argmin(axis=0), np.arange(len(columns))]
        middle = middle / np.linalg.norm(middle, axis=0)
        r = np.geomspace(0.5, _FAR_M, _STEPS)
        places = view.position_m[:2] + (r[:, None, None] * middle.T).reshape(-1, 2)
        up = self._world.up_m(places).reshape(_STEPS, -1)
        # Slopes below the horizontal under which each place is seen over all that is nearer.
        slopes = np.minimum.accumulate((view.position_m[2] - up) / r[:, None], axis=0)
        inverse = np.empty((height, len(columns)), np.float32)
        for k in range(len(columns)):
            inverse[:, k] = np.interp(falls[:, k], slopes[::-1, k], 1 / r[::-1], left=0.0)
        at = np.linspace(0, len(columns) - 1, width, dtype=np.float32)
        whole = cv2.remap(
            inverse,
            np.ascontiguousarray(np.broadcast_to(at, (height, width))),
            np.ascontiguousarray(np.broadcast_to(np.arange(height, dtype=np.float32)[:, None], (height, width))),
            cv2.INTER_LINEAR,
        )
        whole[whole < 0.5 / _FAR_M] = 0
        return whole

    def _ground(self, view: View, inverse: np.ndarray, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        far = 1 / np.maximum(inverse, 0.5 / _FAR_M)
        x = east * far + np.float32(view.position_m[0])
        y = north * far + np.float32(view.position_m[1])
        focal = float(np.linalg.norm(view.image_from_world[0, :3]))
        eye = max(float(view.position_m[2] - self._world.up_m(view.position_m[None, :2])[0]), 0.2)
        # A pixel covers far / focal across and far^2 / (focal eye) along the line of sight.
        across, along = far / focal, far**2 / (focal * eye)
        blur = np.log2(np.maximum(np.sqrt(across * along) / self._world.texel_m, 1))
        blur = np.minimum(blur, len(self._levels) - 1)
        image = np.zeros((*far.shape, 3), np.float32)
        for k, texture in enumerate(self._levels):
            share = np.maximum(1 - np.abs(blur - k), 0)
            rows = np.flatnonzero(share.any(axis=1))
            if len(rows):
                part = slice(int(rows[0]), int(rows[-1]) + 1)
                per_m = texture.shape[1] / self._world.side_m
                u = (x[part] + np.float32(self._world.side_m / 2)) * np.float32(per_m) - np.float32(0.5)
                v = (np.float32(self._world.side_m / 2) - y[part]) * np.float32(per_m) - np.float32(0.5)
                colour = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
                image[part] += share[part, :, None] * colour
        for grain in _GRAIN_M:
            strength = np.clip(1.3 - along / (6 * grain), 0, 1)
            rows = np.flatnonzero(strength.any(axis=1))
            if len(rows):
                part = slice(int(rows[0]), int(rows[-1]) + 1)
                u, v = (np.mod(c[part] / np.float32(grain), _TILE).astype(np.float32) for c in (x, y))
                pebbles = cv2.remap(self._pebbles, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
                image[part] *= 1 + (strength[part] * pebbles)[..., None]
        clear = np.exp(-far / VISIBILITY_M)[..., None]
        return image * clear + HAZE * (1 - clear)

    def _sky(self, rise: np.ndarray, bearing: np.ndarray, view: View) -> np.ndarray:
        """rise: (H, W) metres up a metre ahead. bearing: (W,) of the picture's columns."""
        depth = np.exp(-np.maximum(rise, 0) / 0.3)[..., None]
        sky = _ZENITH + (HAZE - _ZENITH) * depth
        share, phase = self._ridge
        tall = 0.03 + 0.014 * (share[:, None] * np.sin(np.outer(np.arange(2, 14, 2), bearing) + phase[:, None])).sum(0)
        focal = float(np.linalg.norm(view.image_from_world[0, :3]))
        covered = np.clip((tall - rise) * focal + 0.5, 0, 1)[..., None].astype(np.float32)
        return sky + (_RIDGE * 0.6 + HAZE * 0.4 - sky) * covered


def _pebbles(rng: np.random.Generator) -> np.ndarray:
    """(_TILE, _TILE) float32, about 0: grit and small stones, each with its dark side, that go on over the border."""
    grit = rng.normal(0, 1, (_TILE, _TILE)).astype(np.float32)
    pattern = np.zeros_like(grit)
    for sigma, share in ((0.7, 0.1), (2.5, 0.5), (9, 2.0)):
        wide = cv2.copyMakeBorder(grit, 40, 40, 40, 40, cv2.BORDER_WRAP)
        pattern += share * cv2.GaussianBlur(wide, (0, 0), sigma)[40:-40, 40:-40]
    stones = np.zeros_like(pattern)
    for x, y, size in zip(*rng.uniform(8, _TILE - 8, (2, 260)), rng.gamma(2, 1.1, 260), strict=True):
        axes = (max(1, round(size * 1.4)), max(1, round(size)))
        turn = float(rng.uniform(0, 180))
        cv2.ellipse(stones, (round(x + 1), round(y + 1)), axes, turn, 0, 360, -0.3, -1, cv2.LINE_8)
        cv2.ellipse(stones, (round(x), round(y)), axes, turn, 0, 360, float(rng.uniform(0, 0.22)), -1, cv2.LINE_8)
    return pattern + cv2.GaussianBlur(stones, (0, 0), 0.7)
