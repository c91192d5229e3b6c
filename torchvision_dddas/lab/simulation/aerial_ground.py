"""The ground of a world seen from above: the place, height and colour that each pixel shows."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.lab.simulation.agents import Moment
from torchvision_dddas.lab.simulation.cameras import Shutter, meet_ground
from torchvision_dddas.lab.simulation.world import GroundTexture, World, halved_levels

_CELL_M = 0.4  # cell of the maps of the greatest height nearby
_BLOCK_SLICES = 20  # heights at which a block of pixels is tested
_LOWEST_M = 0.05  # lower objects are treated as flat
_MARCH_STEPS = (3, 6, 12, 24)  # numbers of steps down a pixel's line of sight
_STRIDE_PX = 1.5  # intended length of a step in the picture
_HALVINGS = 4
_HEIGHT_LEVELS = 5
_STEEP = 3.0  # a surface with a steeper slope, rise over run, is a wall
_BELOW_M = 0.3  # a hit belongs to the wall if it lies at least this far below the wall's edge
_INSIDE_M = 0.4  # walls take the colour of the roof at this distance from its edge
_SKYLIGHT = 0.42
_WIDE = 30_000  # cv2.remap accepts pictures up to 32767 wide

_STEP_PX = 8  # distance between rays; pixels between them are interpolated
_LEVELS = 8
_SLICES = 5  # height slices that are tested for each group of four pixels
_VISIBILITY_M, _CLEAR = 8000.0, 0.03  # distance at which contrast drops to 1 / e; a smaller share of haze is not drawn
_HORIZON = 0.005  # rays that sink less than this per metre along the axis see the sky
_GRAIN_PX, _GRAIN_M, _GRAIN = 512, 0.03, 0.05  # pattern finer than the texture: side in texels, texel size, contrast
_GRAIN_TILES = 6
_FLAT_PX, _LOW_M = 0.8, 1.4
_LEAST_M, _MOST_LEAN = 1.0, 8.0  # least camera height above ground; greatest lean in metres per metre up


class SightLines(NamedTuple):
    """N lines of sight, all fields (N,) float32. east_m, north_m: where they meet the bare ground.

    lean_east, lean_north: metres per metre up. pixel_m: size of the line's pixel on the ground.
    """

    east_m: np.ndarray
    north_m: np.ndarray
    lean_east: np.ndarray
    lean_north: np.ndarray
    pixel_m: np.ndarray

    @property
    def lean(self) -> np.ndarray:
        """(N,) length of the lean, metres per metre up."""
        return np.hypot(self.lean_east, self.lean_north)

    def of(self, which: np.ndarray) -> "SightLines":
        """Return the lines at some indices."""
        return SightLines(*(column.take(which) for column in self))


class Hits(NamedTuple):
    """Hits of lines of sight on objects, all (M,): line index, place that gives the colour, height, brightness."""

    which: np.ndarray
    east_m: np.ndarray
    north_m: np.ndarray
    up_m: np.ndarray
    light: np.ndarray


class StandingSurface:
    """The objects that stand on a world's ground, prepared for lines of sight from above."""

    def __init__(self, world: World) -> None:
        self._side_m, self._to_sun, self._texel_m = world.side_m, world.to_sun, world.surface_texel_m
        self._levels = halved_levels(np.ascontiguousarray(world.surface, np.float32), _HEIGHT_LEVELS)
        cells = max(int(np.ceil(world.side_m / _CELL_M)), 1)
        # Reach one cell from any place inside a cell, plus one texel for the interpolation.
        wide = 2 * int(np.ceil(1.5 * _CELL_M / world.surface_texel_m + 1)) + 1
        highest = cv2.dilate(self._levels[0], np.ones((wide, wide), np.uint8), borderType=cv2.BORDER_REFLECT)
        highest = cv2.resize(highest, (cells, cells), interpolation=cv2.INTER_NEAREST)
        self.tallest_m = float(highest.max())
        # Store heights as bytes, rounded up, so that the map fits the processor's cache.
        self._code_m = max(self.tallest_m, _LOWEST_M) / 255
        self._highest: list[np.ndarray] = [np.ceil(highest / np.float32(self._code_m)).clip(0, 255).astype(np.uint8)]

    def met(self, sights: SightLines, top_m: np.ndarray, bottom_m: np.ndarray) -> Hits | None:
        """Return the hits of lines of sight between two heights (N,), or None without hits."""
        wanted = (top_m - bottom_m) * sights.lean / (_STRIDE_PX * sights.pixel_m)
        steps = np.searchsorted(_MARCH_STEPS[:-1], wanted)
        level = np.clip(np.log2(sights.pixel_m / self._texel_m), 0, len(self._levels) - 1).astype(int)
        kinds = level * len(_MARCH_STEPS) + steps
        found = []
        for part in _parts(kinds):
            at, steps_at = divmod(int(kinds[part[0]]), len(_MARCH_STEPS))
            hit, up = self._march(at, _MARCH_STEPS[steps_at], sights.of(part), top_m[part], bottom_m[part])
            found.append((part[hit], up))
        which, up = (np.concatenate(column) for column in zip(*found, strict=True))
        if not len(which):
            return None
        met = sights.of(which)
        east, north = met.east_m + met.lean_east * up, met.north_m + met.lean_north * up
        light, side = np.ones(len(which), np.float32), np.float32(_INSIDE_M)
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
        return Hits(which, east, north, up, light)

    def between(self, sights: SightLines, reach_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the heights top, bottom (N,) between which lines of sight can meet objects within reach_m (N,).

        Both are 0 where no object is in reach.
        """
        top, bottom = (np.zeros(len(reach_m), np.float32) for _ in range(2))
        whole = np.full(len(reach_m), self.tallest_m + _LOWEST_M, np.float32)
        # One look-up shows that most lines have no object nearby.
        part = np.flatnonzero(self.narrowed(sights, reach_m, whole, top, 1)[0])
        if len(part):
            some = sights.of(part), reach_m[part], whole[part], top[part]
            top[part], bottom[part] = self.narrowed(*some, _BLOCK_SLICES)
        return top, bottom

    def narrowed(
        self, sights: SightLines, reach_m: np.ndarray, top_m: np.ndarray, bottom_m: np.ndarray, slices: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Narrow the heights top_m, bottom_m (N,) to slices with an object within reach_m (N,) of the line of sight.

        The range is divided into `slices` slices. Both heights are 0 where no object is in reach.
        """
        slice_m = (top_m - bottom_m) / np.float32(slices)
        reach = np.maximum(reach_m + sights.lean * slice_m / 2, _CELL_M)
        ring = np.ceil(np.log2(reach / _CELL_M)).astype(np.int8)  # each ring is twice as wide as the last
        top, bottom = (np.zeros(len(ring), np.float32) for _ in range(2))
        below = np.arange(1, slices + 1, dtype=np.float32)[:, None]
        for part in _parts(ring):
            highest = self._nearby(int(ring[part[0]]))
            first, each = top_m[part], slice_m[part]
            edge = first - below * each
            may = self._sample(highest, sights.of(part), edge + each / 2, cv2.INTER_NEAREST)
            may = may > np.maximum(edge, _LOWEST_M) / np.float32(self._code_m)
            high, low = (np.zeros(len(part), np.float32) for _ in range(2))
            for k in range(slices):
                np.copyto(low, edge[k], where=may[k])
                np.copyto(high, edge[slices - 1 - k] + each, where=may[slices - 1 - k])
            top[part], bottom[part] = high, low
        return top, np.maximum(bottom, 0)

    def _march(
        self, level: int, steps: int, sights: SightLines, top_m: np.ndarray, bottom_m: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Follow N lines of sight downwards. Return the indices (M,) of lines that hit an object, and heights (M,)."""
        texture = self._levels[level]
        step = (top_m - bottom_m) / np.float32(steps)
        up = top_m - np.arange(1, steps + 1, dtype=np.float32)[:, None] * step
        # The last step ends a little above the ground, so that flat objects are not hit.
        up[-1] = np.maximum(up[-1], np.minimum(_LOWEST_M, step / 2))
        inside = self._sample(texture, sights, up, cv2.INTER_LINEAR) > np.maximum(up, _LOWEST_M)
        highest = np.full(len(step), -1, np.float32)
        for k in range(steps - 1, -1, -1):
            np.copyto(highest, up[k], where=inside[k])
        hit = np.flatnonzero(highest >= 0)
        low = highest[hit]
        high, met = low + step[hit], sights.of(hit)
        for _ in range(_HALVINGS if len(hit) else 0):
            middle = (low + high) / 2
            within = self._sample(texture, met, middle[None], cv2.INTER_LINEAR)[0] > middle
            low, high = np.where(within, middle, low), np.where(within, high, middle)
        return hit, low

    def _up(self, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
        """Return heights (N,) of the objects at places."""
        up = np.empty_like(east_m)
        for first in range(0, len(up), _WIDE):
            part = slice(first, first + _WIDE)
            none = np.zeros_like(east_m[part])
            plumb = SightLines(east_m[part], north_m[part], none, none, none)
            up[part] = self._sample(self._levels[0], plumb, none[None], cv2.INTER_LINEAR)[0]
        return up

    def _sample(self, texture: np.ndarray, sights: SightLines, up_m: np.ndarray, how: int) -> np.ndarray:
        """Return (K, N) values of the world's texture (H, W) where N lines of sight pass at heights up_m (K, N)."""
        half = self._side_m / 2
        across, down = (np.float32(n / self._side_m) for n in texture.shape[1::-1])
        u = up_m * (sights.lean_east * across)
        u += (sights.east_m + np.float32(half)) * across - np.float32(0.5)
        v = up_m * (sights.lean_north * -down)
        v += (np.float32(half) - sights.north_m) * down - np.float32(0.5)
        return np.asarray(cv2.remap(texture, u, v, how, borderMode=cv2.BORDER_REFLECT))

    def _nearby(self, ring: int) -> np.ndarray:
        """Return (R, C) uint8, the greatest height within 2**ring cells of each cell, in steps of code_m."""
        while len(self._highest) <= ring:
            wide = 2 ** len(self._highest) // 2 * 2 + 1
            last = self._highest[-1]
            self._highest.append(cv2.dilate(last, np.ones((wide, wide), np.uint8), borderType=cv2.BORDER_REFLECT))
        return self._highest[ring]


def _parts(kind: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the rows of each kind (N,), in arrays of at most _WIDE rows."""
    for k in np.flatnonzero(np.bincount(kind)):
        rows = np.flatnonzero(kind == k)
        for first in range(0, len(rows), _WIDE):
            yield rows[first : first + _WIDE]


class PixelPlaces(NamedTuple):
    """Ground places of pixels: east_m, north_m (H, W) float32; pixel_m (H,) size of a row's pixels on the ground.

    rise_m: (H, W) float32, height of the visible standing object; None without objects. met: the hits on objects, or
    None. haze: (H, W) float32, share of the light that comes from the air; None in clear air.
    """

    east_m: np.ndarray
    north_m: np.ndarray
    pixel_m: np.ndarray
    rise_m: np.ndarray | None = None
    met: Hits | None = None
    haze: np.ndarray | None = None


class Terrain:
    """The ground of a world, prepared for many pictures from above."""

    def __init__(self, world: World, shutter: Shutter) -> None:
        self._world, self._shutter = world, shutter
        self._standing = StandingSurface(world)
        self._texture = GroundTexture(world, _LEVELS)
        rough = np.random.default_rng(_GRAIN_PX).standard_normal((_GRAIN_PX, _GRAIN_PX), np.float32)
        rough = np.tile(rough, (3, 3))
        rough = (cv2.GaussianBlur(rough, (0, 0), 0.7) - cv2.GaussianBlur(rough, (0, 0), 3))[_GRAIN_PX : 2 * _GRAIN_PX]
        rough = rough[:, _GRAIN_PX : 2 * _GRAIN_PX]
        rough = np.round(128 * (1 + _GRAIN * rough / rough.std())).clip(0, 255).astype(np.uint8)
        self._grain = np.tile(rough, (_GRAIN_TILES, _GRAIN_TILES))
        width, height = shutter.camera.size_px
        self._cells = -(-width // _STEP_PX) + 2, -(-height // _STEP_PX) + 2
        # The middles of pixel blocks, so that enlarging by whole blocks keeps each value in its place.
        u, v = ((np.arange(n) - 1) * _STEP_PX + (_STEP_PX - 1) / 2 for n in self._cells)
        self._block_px = np.stack(np.meshgrid(u, v), axis=-1)
        row, column = (np.arange(n) // _STEP_PX + 1 for n in (height, width))
        self._block = (row[:, None] * self._cells[0] + column).ravel().astype(np.int32)

    def places(self, moment: Moment) -> PixelPlaces:
        """Return where the pixels of a moment's picture lie."""
        columns, rows = self._cells
        start, way = self._shutter.rays(moment, self._block_px.reshape(-1, 2))
        far, up = meet_ground(start, way, self._world.up_m)
        place = (start + far[:, None] * way)[:, :2].reshape(rows, columns, 2)
        # On a plane, 1 / distance and place / distance are both linear over the picture.
        inverse = (1 / np.maximum(far, 1e-3)).reshape(rows, columns)
        scale = self._enlarge(inverse)
        east, north = (cv2.divide(self._enlarge(place[..., k] * inverse), scale) for k in range(2))
        along, aside = (np.gradient(place, axis=axis) / _STEP_PX for axis in range(2))
        pixel_m = np.sqrt(np.abs(along[..., 0] * aside[..., 1] - along[..., 1] * aside[..., 0]))
        height = self._shutter.camera.size_px[1]
        each_row = np.interp(np.arange(height), self._block_px[:, 0, 1], np.median(pixel_m, axis=1))
        away = far * np.linalg.norm(way, axis=1)
        haze = np.where(way[:, 2] > -_HORIZON, 1, 1 - np.exp(-away / _VISIBILITY_M)).reshape(rows, columns)
        places = PixelPlaces(east, north, each_row, haze=self._enlarge(haze) if haze.max() > _CLEAR else None)
        if self._standing.tallest_m <= 0:
            return places
        blocks = _lines_of_sight(list(place.reshape(-1, 2).T), list(start.T), up, pixel_m.ravel())
        longest = np.sqrt(np.maximum((along**2).sum(axis=2), (aside**2).sum(axis=2))).ravel()
        top, bottom = self._standing.between(blocks, 0.75 * _STEP_PX * longest)
        # Treat low objects that lean by less than a pixel as flat.
        top[(top * blocks.lean < _FLAT_PX * blocks.pixel_m) & (top < _LOW_M)] = 0
        return self._raise(places, moment, blocks, up, top, bottom, longest) if top.any() else places

    def _raise(
        self,
        places: PixelPlaces,
        moment: Moment,
        blocks: SightLines,
        up: np.ndarray,
        top: np.ndarray,
        bottom: np.ndarray,
        longest: np.ndarray,
    ) -> PixelPlaces:
        """Move pixels to the objects that their lines of sight meet between the top and bottom of blocks (N,).

        up: (N,) ground height of the blocks. longest: (N,) length of a pixel on the ground, metres.
        """
        columns, rows = self._cells
        height, width = places.east_m.shape
        hopeful = (top > 0).astype(np.uint8).reshape(rows, columns)[1:-1, 1:-1]
        some = cv2.resize(hopeful, None, fx=_STEP_PX // 2, fy=_STEP_PX // 2, interpolation=cv2.INTER_NEAREST)
        # Most pixels of these blocks miss the object. Test groups of four pixels: one pixel, with a reach for all four.
        across = (width + 1) // 2
        four = np.flatnonzero(some[: (height + 1) // 2, :across].ravel()).astype(np.int32)
        row, column = 2 * (four // across), 2 * (four % across)
        first = row * width + column
        block = self._block.take(first)
        lines = blocks.of(block)._replace(east_m=places.east_m.take(first), north_m=places.north_m.take(first))
        reach = (1.5 * longest).astype(np.float32).take(block)
        top, bottom = self._standing.narrowed(lines, reach, top.take(block), bottom.take(block), _SLICES)
        near = np.flatnonzero(top)
        if not len(near):
            return places
        # Take all four pixels of a group. At an odd edge some pixels occur twice.
        row, column = row.take(near), column.take(near)
        row = np.concatenate([row, row, np.minimum(row + 1, height - 1), np.minimum(row + 1, height - 1)])
        column = np.concatenate([column, np.minimum(column + 1, width - 1)] * 2)
        which, near = row * width + column, np.tile(near, 4)
        top, bottom, block = top.take(near), bottom.take(near), block.take(near)
        lag = self._shutter.lag_s(np.arange(height))[:, None]
        eye = (moment.pose.place_m + lag * moment.velocity_m_s).astype(np.float32).T
        ground = places.east_m.take(which), places.north_m.take(which)
        eyes = [axis.take(row) for axis in eye]
        sights = _lines_of_sight(ground, eyes, up.astype(np.float32).take(block), blocks.pixel_m.take(block))
        met = self._standing.met(sights, top, bottom)
        if met is None:
            return places
        met = met._replace(which=which[met.which])
        rise = np.zeros((height, width), np.float32)
        for picture, values in ((places.east_m, met.east_m), (places.north_m, met.north_m), (rise, met.up_m)):
            picture.ravel()[met.which] = values
        return places._replace(rise_m=rise, met=met)

    def _enlarge(self, blocks: np.ndarray) -> np.ndarray:
        """Interpolate values (rows, columns) at the middles of blocks to all pixels, (H, W) float32."""
        columns, rows = self._cells
        width, height = self._shutter.camera.size_px
        size = columns * _STEP_PX, rows * _STEP_PX
        full = cv2.resize(np.asarray(blocks, np.float32), size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(full[_STEP_PX : _STEP_PX + height, _STEP_PX : _STEP_PX + width])

    def picture(self, places: PixelPlaces) -> np.ndarray:
        """Return (H, W, 3) uint8: the ground's colours at the pixels' places, averaged over the area of a pixel."""
        picture = self._texture.rows(places.pixel_m, places.east_m, places.north_m)
        if places.met is not None:
            dim = places.met.light != 1
            flat, which = picture.reshape(-1, 3), places.met.which[dim]
            flat[which] = np.clip(flat[which] * places.met.light[dim, None], 0, 255)
        # An enlarged texture is smooth, so add the grain that the texture is too coarse to show.
        wanted = float(np.clip(np.log2(self._world.texel_m / np.median(places.pixel_m)), 0, 1))
        if wanted > 0.25:
            # cv2.remap is slow beyond a texture's edge, so tile the pattern and shift it by whole tiles.
            at = []
            for place in (places.east_m, places.north_m):
                start = float(np.floor(place[::16, ::16].min() / (_GRAIN_PX * _GRAIN_M)))
                at.append(cv2.addWeighted(place, 1 / _GRAIN_M, place, 0, -start * _GRAIN_PX))
            u, v = at
            grain = cv2.remap(self._grain, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            cv2.addWeighted(picture, 1, cv2.cvtColor(grain, cv2.COLOR_GRAY2BGR), wanted, -128 * wanted, dst=picture)
        return picture


def _lines_of_sight(
    place_m: Sequence[np.ndarray], eye_m: Sequence[np.ndarray], up_m: np.ndarray, pixel_m: np.ndarray
) -> SightLines:
    """Return the lines of sight to places (east, north; N each) at heights up_m (N,), from eyes (east, north, up)."""
    east, north = (eye - place for eye, place in zip(eye_m, place_m, strict=False))
    down = np.maximum(eye_m[2] - up_m, np.maximum(np.hypot(east, north) / _MOST_LEAN, _LEAST_M))
    columns = *place_m, east / down, north / down, pixel_m
    return SightLines(*(np.ascontiguousarray(column, np.float32) for column in columns))
