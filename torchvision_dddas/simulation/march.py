"""Relief marching: what stands on the ground leans in the picture, and hides what is behind it."""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.simulation.world import World

_CELL_M = 0.4  # of the maps of what is highest nearby
_SLICES = 20  # heights at which a block of pixels is tested
_LEAST_M = 0.05  # what is lower lies flat
_STEPS = (3, 6, 12, 24)  # on the way down of a pixel's line of sight
_STRIDE_PX = 1.5  # that a step should be long in the picture
_HALVINGS = 4
_LEVELS = 5
_STEEP = 3.0  # what rises so many metres for each metre is a wall,
_BELOW_M = 0.3  # where it is met so far below its edge
_INSIDE_M = 0.4  # walls have the colour of the roof so far from its edge
_SKYLIGHT = 0.42
_WIDE = 30_000  # OpenCV remaps no picture wider than 32767


class Sights(NamedTuple):
    """N lines of sight, float32, and where they meet the bare ground. All (N,).

    lean_east, lean_north: metres for each metre up. pixel_m: size of their pixel on the ground.
    """

    east_m: np.ndarray
    north_m: np.ndarray
    lean_east: np.ndarray
    lean_north: np.ndarray
    pixel_m: np.ndarray

    def at(self, up_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places east and north at which they pass so high; up_m (N,) or (K, N)."""
        return self.east_m + self.lean_east * up_m, self.north_m + self.lean_north * up_m

    @property
    def lean(self) -> np.ndarray:
        """(N,) how far they lean, whither ever."""
        return np.hypot(self.lean_east, self.lean_north)

    def of(self, which: np.ndarray) -> "Sights":
        """Some of them."""
        return Sights(*(column.take(which) for column in self))


class Met(NamedTuple):
    """Where lines of sight meet something: which (M,) of them, how high, of what colour (east, north), how bright."""

    which: np.ndarray
    east_m: np.ndarray
    north_m: np.ndarray
    up_m: np.ndarray
    light: np.ndarray


class Standing:
    """What stands on a world's ground, made ready for lines of sight from above."""

    def __init__(self, world: World) -> None:
        self._side_m, self._to_sun = world.side_m, world.to_sun
        self._texel_m = world.surface_texel_m
        self._levels = [np.ascontiguousarray(world.surface, np.float32)]
        while len(self._levels) < _LEVELS and min(self._levels[-1].shape) >= 4:
            size = (self._levels[-1].shape[1] + 1) // 2, (self._levels[-1].shape[0] + 1) // 2
            self._levels.append(
                np.asarray(cv2.resize(self._levels[-1], size, interpolation=cv2.INTER_AREA), np.float32)
            )
        cells = max(int(np.ceil(world.side_m / _CELL_M)), 1)
        # A reach of one cell from wherever in its own cell a place lies, and a texel for what is interpolated.
        wide = 2 * int(np.ceil(1.5 * _CELL_M / world.surface_texel_m + 1)) + 1
        highest = cv2.dilate(self._levels[0], np.ones((wide, wide), np.uint8), borderType=cv2.BORDER_REFLECT)
        highest = cv2.resize(highest, (cells, cells), interpolation=cv2.INTER_NEAREST)
        self.tallest_m = float(highest.max())
        # In bytes, which the processor's cache can hold; rounded up.
        self._code_m = max(self.tallest_m, _LEAST_M) / 255
        self._highest = [np.ceil(highest / np.float32(self._code_m)).clip(0, 255).astype(np.uint8)]

    def met(self, sights: Sights, top_m: np.ndarray, bottom_m: np.ndarray) -> Met | None:
        """What is met by lines of sight between two heights (N,); None: nothing is."""
        wanted = (top_m - bottom_m) * sights.lean / (_STRIDE_PX * sights.pixel_m)
        steps = np.searchsorted(_STEPS[:-1], wanted)
        level = np.clip(np.log2(sights.pixel_m / self._texel_m), 0, len(self._levels) - 1).astype(int)
        kinds = level * len(_STEPS) + steps
        found = []
        for part in _parts(kinds):
            kind = int(kinds[part[0]])
            hit, up = self._march(
                kind // len(_STEPS), _STEPS[kind % len(_STEPS)], sights.of(part), top_m[part], bottom_m[part]
            )
            found.append((part[hit], up))
        which, up = (np.concatenate(column) for column in zip(*found, strict=True))
        if not len(which):
            return None
        east, north = sights.of(which).at(up)
        light = np.ones(len(which), np.float32)
        side = np.float32(_INSIDE_M)
        beside = [self._up(east + x, north + y) for x, y in ((side, 0), (-side, 0), (0, side), (0, -side))]
        rise_east, rise_north = beside[0] - beside[1], beside[2] - beside[3]
        rise = np.hypot(rise_east, rise_north)
        steep = np.flatnonzero((rise > 2 * side * _STEEP) & (np.max(beside, axis=0) > up + _BELOW_M))
        if len(steep):
            outward = -np.stack([rise_east[steep], rise_north[steep]]) / rise[steep]
            sun = np.maximum(self._to_sun[:2].astype(np.float32) @ outward, 0) / max(float(self._to_sun[2]), 0.3)
            light[steep] = np.minimum(_SKYLIGHT + (1 - _SKYLIGHT) * sun, 1.2)
            east[steep] -= side * outward[0]
            north[steep] -= side * outward[1]
        return Met(which, east, north, up, light)

    def between(self, sights: Sights, reach_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Between which heights (N,) lines of sight can meet something that is at most reach_m (N,) beside them.

        Where nothing is in reach, both are 0.
        """
        top, bottom = (np.zeros(len(reach_m), np.float32) for _ in range(2))
        whole = np.full(len(reach_m), self.tallest_m + _LEAST_M, np.float32)
        # Most of them have nothing near at all, which one look tells.
        some, _ = self.narrowed(sights, reach_m, whole, top, 1)
        part = np.flatnonzero(some)
        if len(part):
            top[part], bottom[part] = self.narrowed(sights.of(part), reach_m[part], whole[part], top[part], _SLICES)
        return top, bottom

    def narrowed(
        self, sights: Sights, reach_m: np.ndarray, top_m: np.ndarray, bottom_m: np.ndarray, slices: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Between which heights (N,) of those given (N,) something is at most reach_m (N,) beside lines of sight.

        They are told to a slice of so many. Where nothing is in reach, both are 0.
        """
        slice_m = (top_m - bottom_m) / np.float32(slices)
        ring = rings(reach_m + sights.lean * slice_m / 2)
        top, bottom = (np.zeros(len(ring), np.float32) for _ in range(2))
        below = np.arange(1, slices + 1, dtype=np.float32)[:, None]
        for part in _parts(ring):
            highest = self._nearby(int(ring[part[0]]))
            first, each = top_m[part], slice_m[part]
            edge = first - below * each
            may = self._looked(highest, sights.of(part), edge + each / 2, cv2.INTER_NEAREST)
            may = may > np.maximum(edge, _LEAST_M) / np.float32(self._code_m)
            high, low = (np.zeros(len(part), np.float32) for _ in range(2))
            for k in range(slices):
                np.copyto(low, edge[k], where=may[k])
                np.copyto(high, edge[slices - 1 - k] + each, where=may[slices - 1 - k])
            top[part], bottom[part] = high, low
        return top, np.maximum(bottom, 0)

    def _march(
        self, level: int, steps: int, sights: Sights, top_m: np.ndarray, bottom_m: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Which of N lines of sight meet something, (M,) indices, and how high; they are followed downwards."""
        texture = self._levels[level]
        step = (top_m - bottom_m) / np.float32(steps)
        up = top_m - np.arange(1, steps + 1, dtype=np.float32)[:, None] * step
        # The last step ends a little above the ground, which everything flat is not.
        up[-1] = np.maximum(up[-1], np.minimum(_LEAST_M, step / 2))
        inside = self._looked(texture, sights, up, cv2.INTER_LINEAR) > np.maximum(up, _LEAST_M)
        highest = np.full(len(step), -1, np.float32)
        for k in range(steps - 1, -1, -1):
            np.copyto(highest, up[k], where=inside[k])
        hit = np.flatnonzero(highest >= 0)
        low = highest[hit]
        high, met = low + step[hit], sights.of(hit)
        for _ in range(_HALVINGS if len(hit) else 0):
            middle = (low + high) / 2
            within = self._looked(texture, met, middle[None], cv2.INTER_LINEAR)[0] > middle
            low, high = np.where(within, middle, low), np.where(within, high, middle)
        return hit, low

    def _up(self, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
        """Heights (N,) of what stands at places."""
        up = np.empty_like(east_m)
        for first in range(0, len(up), _WIDE):
            part = slice(first, first + _WIDE)
            none = np.zeros_like(east_m[part])
            plumb = Sights(east_m[part], north_m[part], none, none, none)
            up[part] = self._looked(self._levels[0], plumb, none[None], cv2.INTER_LINEAR)[0]
        return up

    def _looked(self, texture: np.ndarray, sights: Sights, up_m: np.ndarray, how: int) -> np.ndarray:
        """(K, N) what a texture (H, W) of the whole world says of where N lines of sight pass so high (K, N)."""
        half = self._side_m / 2
        across, down = (np.float32(n / self._side_m) for n in texture.shape[1::-1])
        u = up_m * (sights.lean_east * across)
        u += (sights.east_m + np.float32(half)) * across - np.float32(0.5)
        v = up_m * (sights.lean_north * -down)
        v += (np.float32(half) - sights.north_m) * down - np.float32(0.5)
        return np.asarray(cv2.remap(texture, u, v, how, borderMode=cv2.BORDER_REFLECT))

    def _nearby(self, ring: int) -> np.ndarray:
        """(R, C) uint8, the greatest height within 2**ring cells of each cell, in steps of code_m."""
        while len(self._highest) <= ring:
            wide = 2 ** len(self._highest) // 2 * 2 + 1
            last = self._highest[-1]
            self._highest.append(cv2.dilate(last, np.ones((wide, wide), np.uint8), borderType=cv2.BORDER_REFLECT))
        return self._highest[ring]


def rings(reach_m: np.ndarray) -> np.ndarray:
    """How many rings cover a reach (N,): each is twice as wide as the one before."""
    return np.ceil(np.log2(np.maximum(reach_m, _CELL_M) / _CELL_M)).astype(np.int8)


def _parts(kind: np.ndarray) -> Iterator[np.ndarray]:
    """The rows of each kind (N,), 0 or more, in lists that are not too long."""
    for k in np.flatnonzero(np.bincount(kind)):
        rows = np.flatnonzero(kind == k)
        for first in range(0, len(rows), _WIDE):
            yield rows[first : first + _WIDE]
