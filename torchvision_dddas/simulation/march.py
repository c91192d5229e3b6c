"""Relief marching: what stands on the ground leans in the picture, and hides what is behind it."""

import cv2
import numpy as np

from torchvision_dddas.simulation.world import World

_CELL_M = 0.8  # of the map that tells where anything can be met at all
_BINS_M = np.array([0.4, 0.8, 1.2, 1.8, 2.5, 3.5, 5.0, 7.0, 10.0, 14.0, 20.0, 40.0, 100.0, 1000.0])
_LEANS = (0.25, 0.5, 0.8, 1.2, 2.0, 4.0)
_LEAST_M = 0.05
_STEPS = 14
_HALVINGS = 4
_LEVELS = 5
_WIDE = 512  # OpenCV remaps no picture wider than 32767: long lists are folded


class Standing:
    """What stands on a world's ground, made ready for lines of sight from above."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._levels = [np.ascontiguousarray(world.surface, np.float32)]
        while len(self._levels) < _LEVELS and min(self._levels[-1].shape) >= 4:
            size = (self._levels[-1].shape[1] + 1) // 2, (self._levels[-1].shape[0] + 1) // 2
            self._levels.append(cv2.resize(self._levels[-1], size, interpolation=cv2.INTER_AREA))
        cells = max(int(np.ceil(world.side_m / _CELL_M)), 1)
        wide = max(int(np.ceil(_CELL_M / world.surface_texel_m)) | 1, 1)
        most = cv2.dilate(self._levels[0], np.ones((wide, wide), np.uint8))
        self._most = cv2.resize(most, (cells, cells), interpolation=cv2.INTER_NEAREST)
        self._near: dict[float, np.ndarray] = {}

    def met(
        self, east_m: np.ndarray, north_m: np.ndarray, lean: np.ndarray, pixel_m: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        """Which lines of sight meet something before the ground, and where; None: none does.

        east_m, north_m: (H, W) where they meet the ground. lean: (H, W, 2) metres east and north that they go for each
        metre up. pixel_m: (H,). Returns flat indices (M,), east, north and height above ground (M,) of what is met.
        """
        if not self._most.any():
            return None
        steepest = float(np.sqrt((lean[::8, ::8] ** 2).sum(axis=-1).max()))
        near = self._nearby(steepest)
        u, v = self._folded(near, east_m, north_m)
        bins = cv2.remap(near, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REFLECT)
        which = np.flatnonzero(bins)
        if not len(which):
            return None
        found = []
        row = which // east_m.shape[1]
        level = np.clip(np.log2(pixel_m / self._world.surface_texel_m).astype(int), 0, len(self._levels) - 1)[row]
        edges = [0, *(np.flatnonzero(np.diff(level)) + 1).tolist(), len(which)]
        for k in range(len(edges) - 1):
            part = which[edges[k] : edges[k + 1]]
            place = east_m.ravel()[part], north_m.ravel()[part]
            way = lean.reshape(-1, 2)[part]
            top = _BINS_M.astype(np.float32)[bins.ravel()[part] - 1]
            hit, up = self._march(int(level[edges[k]]), place, way, top)
            found.append((part[hit], place[0][hit] + way[hit, 0] * up, place[1][hit] + way[hit, 1] * up, up))
        which, east, north, up = (np.concatenate(column) for column in zip(*found, strict=True))
        return (which, east, north, up) if len(which) else None

    def up_m(self, east_m: np.ndarray, north_m: np.ndarray, level: int = 0) -> np.ndarray:
        """Height above ground of what stands at places, each (N,) or (K, N) float32."""
        shape = east_m.shape
        count = east_m.size
        folded = -(-count // _WIDE) * _WIDE
        east, north = np.zeros(folded, np.float32), np.zeros(folded, np.float32)
        east[:count], north[:count] = east_m.ravel(), north_m.ravel()
        texture = self._levels[level]
        u, v = self._folded(texture, east.reshape(-1, _WIDE), north.reshape(-1, _WIDE))
        up = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(up.ravel()[:count].reshape(shape))

    def _march(
        self, level: int, place: tuple[np.ndarray, np.ndarray], way: np.ndarray, top: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Which of N lines of sight meet something, (M,) indices, and how high; they are followed down from top."""
        shares = (1 - np.arange(1, _STEPS + 1) / (_STEPS + 0.5)).astype(np.float32)
        up = shares[:, None] * top
        stands = self.up_m(place[0] + way[:, 0] * up, place[1] + way[:, 1] * up, level)
        inside = stands > np.maximum(up, _LEAST_M)
        first = inside.argmax(axis=0)
        hit = np.flatnonzero(inside[first, np.arange(len(first))])
        low = up[first[hit], hit]
        high = low + top[hit] / np.float32(_STEPS + 0.5)
        east, north, way = place[0][hit], place[1][hit], way[hit]
        for _ in range(_HALVINGS if len(hit) else 0):
            middle = (low + high) / 2
            within = self.up_m(east + way[:, 0] * middle, north + way[:, 1] * middle, level) > middle
            low, high = np.where(within, middle, low), np.where(within, high, middle)
        return hit, low

    def _folded(self, texture: np.ndarray, east_m: np.ndarray, north_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of a texture (H, W) of the whole world at places, each (h, w) float32."""
        half = self._world.side_m / 2
        across, down = texture.shape[1] / self._world.side_m, texture.shape[0] / self._world.side_m
        u = cv2.addWeighted(east_m, across, east_m, 0, half * across - 0.5)
        return u, cv2.addWeighted(north_m, -down, north_m, 0, half * down - 0.5)

    def _nearby(self, lean: float) -> np.ndarray:
        """(R, C) uint8: what can be met above each cell under so steep a lean at most: 0, or the bin of its height."""
        lean = next((step for step in _LEANS if step >= lean), _LEANS[-1])
        if lean not in self._near:
            near = np.zeros(self._most.shape, np.uint8)
            below = _LEAST_M
            for k, top in enumerate(_BINS_M):
                mine = (self._most > below) & (self._most <= top)
                below = top
                if mine.any():
                    away = cv2.distanceTransform((~mine).astype(np.uint8), cv2.DIST_L2, 5)
                    highest = float(self._most[mine].max())
                    near[away * _CELL_M <= lean * highest + 2 * _CELL_M] = k + 1
            self._near[lean] = near
        return self._near[lean]
