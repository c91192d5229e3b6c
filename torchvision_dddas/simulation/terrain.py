"""The ground of a world as a camera above it sees it: where each pixel lies, and its colour."""

from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.simulation.march import Standing
from torchvision_dddas.simulation.moment import Moment
from torchvision_dddas.simulation.shutter import Shutter, landing
from torchvision_dddas.simulation.world import World

_STEP_PX = 8  # rays are cast so many pixels apart, and what lies between them is interpolated
_LEVELS = 8
_LEVEL = 0.1  # lines of sight are taken to sink at least so much for each metre, where they meet what stands


class Lie(NamedTuple):
    """Where pixels lie: east_m, north_m (H, W) float32; pixel_m (H,) size of a row's pixels on the ground.

    rise_m: (H, W) float32, above the ground where something stands that is seen there; None where all is bare.
    """

    east_m: np.ndarray
    north_m: np.ndarray
    pixel_m: np.ndarray
    rise_m: np.ndarray | None = None


class Terrain:
    """The ground of a world, made ready for many looks from above."""

    def __init__(self, world: World, shutter: Shutter) -> None:
        self._world, self._shutter = world, shutter
        self._standing = Standing(world)
        self._levels = [world.albedo]
        while len(self._levels) < _LEVELS and min(self._levels[-1].shape[:2]) >= 4:
            above = self._levels[-1]
            size = (above.shape[1] + 1) // 2, (above.shape[0] + 1) // 2
            self._levels.append(cv2.resize(above, size, interpolation=cv2.INTER_AREA))
        width, height = shutter.camera.size_px
        self._cells = -(-width // _STEP_PX) + 2, -(-height // _STEP_PX) + 2
        # The middles of blocks of pixels: so that enlarging them by whole blocks puts each where it belongs.
        u, v = ((np.arange(n) - 1) * _STEP_PX + (_STEP_PX - 1) / 2 for n in self._cells)
        self._block_px = np.stack(np.meshgrid(u, v), axis=-1)

    def lie(self, moment: Moment) -> Lie:
        """Where the pixels of a moment's picture lie."""
        columns, rows = self._cells
        start, way = self._shutter.rays(moment, self._block_px.reshape(-1, 2))
        far, _ = landing(start, way, self._world.up_m)
        place = (start + far[:, None] * way)[:, :2].reshape(rows, columns, 2)
        # On a plane the inverse of the distance is linear over the picture, and so is the place over the distance.
        inverse = (1 / np.maximum(far, 1e-3)).reshape(rows, columns, 1)
        height = self._shutter.camera.size_px[1]
        east, north, scale = cv2.split(self._enlarged(np.concatenate([place * inverse, inverse], axis=2)))
        along = np.diff(place, axis=0)[:, :-1] / _STEP_PX
        aside = np.diff(place, axis=1)[:-1] / _STEP_PX
        area = np.abs(along[..., 0] * aside[..., 1] - along[..., 1] * aside[..., 0])
        size = np.sqrt(np.median(area, axis=1))
        middles = (np.arange(rows - 1) - 0.5) * _STEP_PX + (_STEP_PX - 1) / 2
        pixel_m = np.interp(np.arange(height), middles, size)
        east, north = cv2.divide(east, scale), cv2.divide(north, scale)
        lean = (-way[:, :2] / np.maximum(-way[:, 2:], _LEVEL)).reshape(rows, columns, 2)
        met = self._standing.met(east, north, self._enlarged(lean), pixel_m)
        if met is None:
            return Lie(east, north, pixel_m)
        rise = np.zeros(east.shape, np.float32)
        for picture, values in zip((east, north, rise), met[1:], strict=True):
            picture.ravel()[met[0]] = values
        return Lie(east, north, pixel_m, rise)

    def _enlarged(self, blocks: np.ndarray) -> np.ndarray:
        """What is known of the middles of blocks, (rows, columns, C), for all pixels (H, W, C) float32."""
        columns, rows = self._cells
        width, height = self._shutter.camera.size_px
        size = columns * _STEP_PX, rows * _STEP_PX
        full = cv2.resize(np.asarray(blocks, np.float32), size, interpolation=cv2.INTER_LINEAR)
        return np.ascontiguousarray(full[_STEP_PX : _STEP_PX + height, _STEP_PX : _STEP_PX + width])

    def texture(self, lie: Lie) -> np.ndarray:
        """(H, W, 3) uint8: the colours where the pixels lie, averaged over as much ground as a pixel covers."""
        world = self._world
        level = np.clip(np.log2(lie.pixel_m / world.texel_m), 0, len(self._levels) - 1.001)
        whole = np.floor(level).astype(int)
        picture = np.empty((*lie.east_m.shape, 3), np.uint8)
        edges = [0, *(np.flatnonzero(np.diff(whole)) + 1).tolist(), len(whole)]
        for first, last in pairwise(edges):
            rows, at = slice(first, last), int(whole[first])
            share = (level[rows] - at).astype(np.float32)
            fine = self._look(at, lie.east_m[rows], lie.north_m[rows])
            if share.max() > 0.02:
                coarse = self._look(at + 1, lie.east_m[rows], lie.north_m[rows])
                weight = np.repeat(share[:, None], fine.shape[1], axis=1)
                fine = cv2.blendLinear(fine, coarse, 1 - weight, weight)
            picture[rows] = fine
        return picture

    def _look(self, level: int, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
        texture = self._levels[level]
        half = self._world.side_m / 2
        across, down = (n / self._world.side_m for n in texture.shape[1::-1])
        u = cv2.addWeighted(east_m, across, east_m, 0, half * across - 0.5)
        v = cv2.addWeighted(north_m, -down, north_m, 0, half * down - 0.5)
        return cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
