"""The ground of a world as a camera above it sees it: where each pixel lies, and its colour."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.simulation.march import Met, Sights, Standing
from torchvision_dddas.simulation.moment import Moment
from torchvision_dddas.simulation.runs import runs
from torchvision_dddas.simulation.shutter import Shutter, landing
from torchvision_dddas.simulation.world import World

_STEP_PX = 8  # rays are cast so many pixels apart, and what lies between them is interpolated
_LEVELS = 8
_BETWEEN = 32  # shares in which two levels are mixed
_SLICES = 5  # of the heights between which a block of pixels may meet something, for four of its pixels
_VISIBILITY_M, _CLEAR = 8000.0, 0.03  # over which all but 1 / e of the contrast is lost; less haze is not drawn
_HORIZON = 0.005  # rays that sink less for each metre along the axis see the sky
_GRAIN_PX, _GRAIN_M, _GRAIN = 512, 0.03, 0.05  # what is finer than the texture: its side, its texels, its contrast
_GRAIN_TILES = 6
_FLAT_PX, _LOW_M = 0.8, 1.4
_LEAST_M, _MOST_LEAN = 1.0, 8.0  # below the camera; lines of sight further from upright are taken to lean so much


class Lie(NamedTuple):
    """Where pixels lie: east_m, north_m (H, W) float32; pixel_m (H,) size of a row's pixels on the ground.

    rise_m: (H, W) float32, above the ground where something stands that is seen there, None where all is bare.
    met: the same as a list of flat indices. haze: (H, W) float32, share of the air's light; None where it is clear.
    """

    east_m: np.ndarray
    north_m: np.ndarray
    pixel_m: np.ndarray
    rise_m: np.ndarray | None = None
    met: Met | None = None
    haze: np.ndarray | None = None


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
        rough = np.random.default_rng(_GRAIN_PX).standard_normal((_GRAIN_PX, _GRAIN_PX), np.float32)
        rough = np.tile(rough, (3, 3))
        rough = (cv2.GaussianBlur(rough, (0, 0), 0.7) - cv2.GaussianBlur(rough, (0, 0), 3))[_GRAIN_PX : 2 * _GRAIN_PX]
        rough = rough[:, _GRAIN_PX : 2 * _GRAIN_PX]
        rough = np.round(128 * (1 + _GRAIN * rough / rough.std())).clip(0, 255).astype(np.uint8)
        self._grain = np.tile(rough, (_GRAIN_TILES, _GRAIN_TILES))
        width, height = shutter.camera.size_px
        self._cells = -(-width // _STEP_PX) + 2, -(-height // _STEP_PX) + 2
        # The middles of blocks of pixels: so that enlarging them by whole blocks puts each where it belongs.
        u, v = ((np.arange(n) - 1) * _STEP_PX + (_STEP_PX - 1) / 2 for n in self._cells)
        self._block_px = np.stack(np.meshgrid(u, v), axis=-1)
        row, column = (np.arange(n) // _STEP_PX + 1 for n in (height, width))
        self._block = (row[:, None] * self._cells[0] + column).ravel().astype(np.int32)

    def lie(self, moment: Moment) -> Lie:
        """Where the pixels of a moment's picture lie."""
        columns, rows = self._cells
        start, way = self._shutter.rays(moment, self._block_px.reshape(-1, 2))
        far, up = landing(start, way, self._world.up_m)
        place = (start + far[:, None] * way)[:, :2].reshape(rows, columns, 2)
        # On a plane the inverse of the distance is linear over the picture, and so is the place over the distance.
        inverse = (1 / np.maximum(far, 1e-3)).reshape(rows, columns)
        scale = self._enlarged(inverse)
        east, north = (cv2.divide(self._enlarged(place[..., k] * inverse), scale) for k in range(2))
        along, aside = (np.gradient(place, axis=axis) / _STEP_PX for axis in range(2))
        pixel_m = np.sqrt(np.abs(along[..., 0] * aside[..., 1] - along[..., 1] * aside[..., 0]))
        height = self._shutter.camera.size_px[1]
        each_row = np.interp(np.arange(height), self._block_px[:, 0, 1], np.median(pixel_m, axis=1))
        away = far * np.linalg.norm(way, axis=1)
        haze = np.where(way[:, 2] > -_HORIZON, 1, 1 - np.exp(-away / _VISIBILITY_M)).reshape(rows, columns)
        lie = Lie(east, north, each_row, haze=self._enlarged(haze) if haze.max() > _CLEAR else None)
        if self._standing.tallest_m <= 0:
            return lie
        sights = _sights(list(place.reshape(-1, 2).T), list(start.T), up, pixel_m.ravel())
        longest = np.sqrt(np.maximum((along**2).sum(axis=2), (aside**2).sum(axis=2))).ravel()
        top, bottom = self._standing.between(sights, 0.75 * _STEP_PX * longest)
        # Low things that lean by less than a pixel may lie flat.
        top[(top * sights.lean < _FLAT_PX * sights.pixel_m) & (top < _LOW_M)] = 0
        return self._risen(lie, moment, sights, up, top, bottom, longest) if top.any() else lie

    def _risen(
        self, lie: Lie, moment: Moment, blocks: Sights, up: np.ndarray, top: np.ndarray, bottom: np.ndarray,
        longest: np.ndarray,
    ) -> Lie:  # fmt: skip
        """Where pixels lie once lines of sight have met what stands, between the heights that blocks say (N,).

        longest: (N,) metres that a pixel is long on the ground.
        """
        columns, rows = self._cells
        height, width = lie.east_m.shape
        hopeful = (top > 0).astype(np.uint8).reshape(rows, columns)[1:-1, 1:-1]
        some = cv2.resize(hopeful, None, fx=_STEP_PX // 2, fy=_STEP_PX // 2, interpolation=cv2.INTER_NEAREST)
        # Most pixels of such blocks pass it by. Pixels are told apart by fours: their first, and so far about it.
        across = (width + 1) // 2
        four = np.flatnonzero(some[: (height + 1) // 2, :across].ravel()).astype(np.int32)
        row, column = 2 * (four // across), 2 * (four % across)
        first = row * width + column
        block = self._block.take(first)
        lines = Sights(
            lie.east_m.take(first), lie.north_m.take(first), blocks.lean_east.take(block),
            blocks.lean_north.take(block), blocks.pixel_m.take(block),
        )  # fmt: skip
        reach = (1.5 * longest).astype(np.float32).take(block)
        top, bottom = self._standing.narrowed(lines, reach, top.take(block), bottom.take(block), _SLICES)
        near = np.flatnonzero(top)
        if not len(near):
            return lie
        # All four of them; at an odd edge some count twice.
        row, column = row.take(near), column.take(near)
        row = np.concatenate([row, row, np.minimum(row + 1, height - 1), np.minimum(row + 1, height - 1)])
        column = np.concatenate([column, np.minimum(column + 1, width - 1)] * 2)
        which, near = row * width + column, np.tile(near, 4)
        top, bottom, block = top.take(near), bottom.take(near), block.take(near)
        lag = self._shutter.lag_s(np.arange(height))[:, None]
        eye = (moment.pose.place_m + lag * moment.velocity_m_s).astype(np.float32).T
        sights = _sights(
            (lie.east_m.take(which), lie.north_m.take(which)), [axis.take(row) for axis in eye],
            up.astype(np.float32).take(block), blocks.pixel_m.take(block),
        )  # fmt: skip
        met = self._standing.met(sights, top, bottom)
        if met is None:
            return lie
        rise = np.zeros((height, width), np.float32)
        for picture, values in ((lie.east_m, met.east_m), (lie.north_m, met.north_m), (rise, met.up_m)):
            picture.ravel()[which[met.which]] = values
        return lie._replace(rise_m=rise, met=met._replace(which=which[met.which]))

    def _enlarged(self, blocks: np.ndarray) -> np.ndarray:
        """What is known of the middles of blocks, (rows, columns), for all pixels, (H, W) float32."""
        columns, rows = self._cells
        width, height = self._shutter.camera.size_px
        size = columns * _STEP_PX, rows * _STEP_PX
        full = cv2.resize(np.asarray(blocks, np.float32), size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(full[_STEP_PX : _STEP_PX + height, _STEP_PX : _STEP_PX + width])

    def texture(self, lie: Lie) -> np.ndarray:
        """(H, W, 3) uint8: the colours where the pixels lie, averaged over as much ground as a pixel covers."""
        world = self._world
        level = np.clip(np.log2(lie.pixel_m / world.texel_m), 0, len(self._levels) - 1)
        level = np.round(level * _BETWEEN).astype(int)
        picture = np.empty((*lie.east_m.shape, 3), np.uint8)
        for first, last in runs(level // _BETWEEN):
            rows, at = slice(first, last), int(level[first]) // _BETWEEN
            share = level[rows] % _BETWEEN
            fine = self._look(at, lie.east_m[rows], lie.north_m[rows])
            if share.any():
                coarse = self._look(at + 1, lie.east_m[rows], lie.north_m[rows])
                for begin, end in runs(share):
                    part, weight = slice(begin, end), float(share[begin]) / _BETWEEN
                    cv2.addWeighted(fine[part], 1 - weight, coarse[part], weight, 0, dst=fine[part])
            picture[rows] = fine
        if lie.met is not None:
            dim = lie.met.light != 1
            flat, which = picture.reshape(-1, 3), lie.met.which[dim]
            flat[which] = np.clip(flat[which] * lie.met.light[dim, None], 0, 255)
        # Enlarged, a texture is smooth: it gets the grain that it is too coarse to show.
        wanted = float(np.clip(np.log2(world.texel_m / np.median(lie.pixel_m)), 0, 1))
        if wanted > 0.25:
            # OpenCV is slow beyond a texture's edge: the pattern is laid out often enough, and moved by whole patterns.
            side = _GRAIN_PX * _GRAIN_M
            corner = (float(np.floor(place[::16, ::16].min() / side)) for place in (lie.east_m, lie.north_m))
            u, v = (
                cv2.addWeighted(place, 1 / _GRAIN_M, place, 0, -start * _GRAIN_PX)
                for place, start in zip((lie.east_m, lie.north_m), corner, strict=True)
            )
            grain = cv2.remap(self._grain, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            cv2.addWeighted(picture, 1, cv2.cvtColor(grain, cv2.COLOR_GRAY2BGR), wanted, -128 * wanted, dst=picture)
        return picture

    def _look(self, level: int, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
        texture = self._levels[level]
        half = self._world.side_m / 2
        across, down = (n / self._world.side_m for n in texture.shape[1::-1])
        u = cv2.addWeighted(east_m, across, east_m, 0, half * across - 0.5)
        v = cv2.addWeighted(north_m, -down, north_m, 0, half * down - 0.5)
        return cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def _sights(
    place_m: Sequence[np.ndarray], eye_m: Sequence[np.ndarray | float], up_m: np.ndarray, pixel_m: np.ndarray
) -> Sights:
    """The lines of sight to places (east, north; N each) so high (N,), from eyes (east, north, up; N each, or one)."""
    east, north = (eye - place for eye, place in zip(eye_m, place_m, strict=False))
    down = np.maximum(eye_m[2] - up_m, np.maximum(np.hypot(east, north) / _MOST_LEAN, _LEAST_M))
    columns = *place_m, east / down, north / down, pixel_m
    return Sights(*(np.ascontiguousarray(column, np.float32) for column in columns))
