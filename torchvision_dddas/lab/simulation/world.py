"""The world of the simulated cameras: a piece of sunlit ground with the objects that stand on it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.simulation.cover import Crowns, StandingObjects, scatter_objects
from torchvision_dddas.lab.simulation.scenario import WorldParameters
from torchvision_dddas.lab.simulation.soil import COARSE, draw_patterns, enlarge_rows, soil_rows
from torchvision_dddas.types import Elevation, Ortho

SHADE_BGR = np.array([0.46, 0.39, 0.35], np.float32)  # share of a colour that remains in light of the blue sky alone
_MOST_TEXELS = 12_000  # pixels along a side of the largest texture
_AT_ONCE = 1 << 20  # texture pixels per band of whole rows
_ROWS_OF_SURFACE = 6000
_COARSEST_M = 2.0  # step of the grid of heights
_MOST_STEPS = 1000  # most steps of that grid along a side
_HILLS_M = (60.0, 200.0)  # wavelengths of the synthetic relief
_EMPTY_SHARE = 1e-3  # smaller white or black areas inside a photo are objects, not holes (share of its area)
_DRY_M = 3.0  # least distance of objects from the water's edge
_BETWEEN = 32  # steps of the mix of two texture levels
_WARP = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


@dataclass(frozen=True)
class World:
    """The ground and the objects on it, for a square of side_m about the origin, in local metres, z up.

    albedo: (H, W, 3) uint8 BGR from above, with light and cast shadows, row 0 at the north edge; the first pixel's
    centre is at (-side_m / 2 + texel_m / 2, side_m / 2 - texel_m / 2). surface: (H2, W2) float32 heights of objects
    above the ground, metres, on pixels of surface_texel_m over the same square. relief: heights of the bare ground.
    to_sun: (3,) unit vector. The world is mirrored beyond its edges, as by cv2.BORDER_REFLECT.
    """

    side_m: float
    texel_m: float
    albedo: np.ndarray
    surface: np.ndarray
    surface_texel_m: float
    relief: Elevation
    things: StandingObjects
    to_sun: np.ndarray

    def up_m(self, east_north_m: np.ndarray) -> np.ndarray:
        """Return heights (N,) of the bare ground at places (N, 2), bilinear. The origin has height 0."""
        return height_at(self.relief, east_north_m)


def build_world(
    parameters: WorldParameters,
    seed: int,
    elevation: Elevation | None = None,
    photo: Ortho | None = None,
    keep_clear: tuple[np.ndarray, float] | None = None,
) -> World:
    """Build the world of a scenario. The same arguments always give the same world.

    elevation: replaces the synthetic relief. photo: replaces the synthetic soil. keep_clear: places (N, 2) in local
    metres, and the distance from them within which no object may stand.
    Raises InputError if the texture would be too large, or if the elevation does not cover the world.
    """
    cells = max(round(parameters.side_m / parameters.texel_m / COARSE), 2)
    side_px, side_m = cells * COARSE, parameters.side_m
    if side_px > _MOST_TEXELS:
        least = np.ceil(1000 * side_m / _MOST_TEXELS) / 1000
        raise InputError(
            f"a world of {side_m:g} m with pixels of {parameters.texel_m:g} m has {side_px} pixels per side; at most "
            f"{_MOST_TEXELS} are possible; set world.texel_m to {least:g} or more"
        )
    texel = side_m / side_px
    to_sun = sun_direction(parameters.sun_azimuth_deg, parameters.sun_height_deg)
    if elevation is None:
        rng = np.random.default_rng([seed, 10])
        relief = _make_hills(side_m, parameters.relief_m, parameters.above_sea_m, rng)
    else:
        relief = _resample_raster(elevation, side_m)
    light = _on_texels(_light_on_slopes(relief, to_sun), cells)
    ground = draw_patterns(side_m, light, seed)

    wash, half, road = ground["wash"], ground["wash_half"], np.abs(ground["road"])
    banks = np.exp(-(((wash - half - 1) / 2.5) ** 2))
    wished = (0.12 + 0.5 * ground["grass"] ** 2 + 0.8 * banks) * np.clip((road - 2.5) / 1.5, 0, 1) * (wash > 0.8 * half)
    built = np.clip((road - 9) / 2, 0, 1) * (wash > half + 8)
    hectares = (side_m / 100) ** 2
    if parameters.shore_m:
        north, east = (np.linspace(1, -1, n) * side_m / 2 for n in wished.shape)
        dry = north[:, None] > shore_north_m(-east, parameters.shore_m) + _DRY_M
        wished, built = wished * dry, built * dry
    plants = round(parameters.bushes_per_ha * hectares), round(parameters.trees_per_ha * hectares)
    counts = *plants, parameters.buildings, parameters.poles
    clear = (np.zeros((0, 2)), 0.0) if keep_clear is None else keep_clear
    things = scatter_objects(counts, side_m, np.clip(wished, 0, 1), built, clear, np.random.default_rng([seed, 20]))
    crowns = Crowns(things, side_m, seed)

    factor = 2 if side_px <= _ROWS_OF_SURFACE else 4
    surface = crowns.surface(side_px // factor)
    hills = np.float32(0) if photo is not None else _on_texels(relief.up_m, surface.shape[0])
    over = shadow_above_ground(surface + hills, texel * factor, to_sun)

    def synthetic(rows: tuple[int, int]) -> np.ndarray:
        return soil_rows(ground, rows, texel, seed, to_sun)

    bare = synthetic if photo is None else PhotographedGround(photo, side_m, side_px, synthetic).rows
    albedo = np.empty((side_px, side_px, 3), np.uint8)
    band = max(_AT_ONCE // side_px, 32)
    for first in range(0, side_px, band):
        rows = first, min(first + band, side_px)
        image = bare(rows)
        crowns.paint(image, first, texel, to_sun)
        shade = np.clip(enlarge_rows(over, rows, factor) / 0.25 - 0.2, 0, 1)
        # A shadow darkens slopes that face away from the sun less.
        slopes = enlarge_rows(light, rows, COARSE) if photo is None else np.float32(1)
        for k in range(3):
            lit = image[k] * (1 - shade * np.clip(1 - SHADE_BGR[k] / slopes, 0, 1))
            albedo[rows[0] : rows[1], :, k] = np.clip(np.round(lit), 0, 255)
    return World(side_m, texel, albedo, surface, texel * factor, relief, things, to_sun)


def shore_north_m(east_m: np.ndarray, shore_m: float) -> np.ndarray:
    """Return the north coordinate of the water's edge. shore_m: mean distance of the edge south of the middle."""
    return np.asarray(-shore_m + 3 * np.sin(east_m / 14) + 1.2 * np.sin(east_m / 4.3 + 1))


def _on_texels(field: np.ndarray, cells: int) -> np.ndarray:
    """Resample a field (R, C), rows from south to north edge, to the middles of (cells, cells) pixels, north first."""
    step = (np.asarray(field.shape) - 1) / cells
    matrix = np.array([[step[1], 0, 0.5 * step[1]], [0, step[0], 0.5 * step[0]]])
    field = np.ascontiguousarray(field, np.float32)
    return cv2.warpAffine(field, matrix, (cells, cells), flags=_WARP, borderMode=cv2.BORDER_REPLICATE)[::-1].copy()


# The relief: synthetic hills or an elevation raster, on a grid over the whole world.


def _make_hills(side_m: float, relief_m: float, above_sea_m: float, rng: np.random.Generator) -> Elevation:
    """Make synthetic hills with relief_m from the lowest to the highest place, 0 at the origin.

    The hills are waves of 60 to 200 m from all directions, no longer than the world. Longer waves are higher.
    """
    metres, step = _grid(side_m)
    east, north = np.meshgrid(metres, metres)
    up = np.zeros_like(east)
    for length in np.geomspace(_HILLS_M[0], min(_HILLS_M[1], max(side_m, _HILLS_M[0])), 12):
        turn, phase = rng.uniform(0, 2 * np.pi, 2)
        up += length**1.5 * np.sin(2 * np.pi / length * (east * np.cos(turn) + north * np.sin(turn)) + phase)
    return replace(_about_origin(up * (relief_m / float(np.ptp(up))), side_m, step, 0.0), base_m=above_sea_m)


def _resample_raster(given: Elevation, side_m: float) -> Elevation:
    """Resample an elevation raster to the world's grid, with height 0 at the origin.

    Raises InputError, with the covered part, if the raster does not cover the whole world.
    """
    metres, step = _grid(side_m)
    heights = np.asarray(given.up_m, np.float64)
    known = np.isfinite(heights)
    at = [((metres - given.corner_m[1 - k]) / given.step_m, heights.shape[k]) for k in (0, 1)]  # rows, columns
    rows, columns = (_node_weights(*one, 1) for one in at)
    covered = rows @ known @ columns.T > 1 - 1e-6
    if not covered.all():
        there = [np.flatnonzero(known.any(axis=k)) for k in (0, 1)]  # columns, rows
        low, high = ([given.corner_m[k] + given.step_m * there[k][end] for k in (0, 1)] for end in (0, -1))
        raise InputError(
            f"the elevation covers {np.floor(100 * covered.mean()):.0f} % of the world: it has heights from "
            f"{low[0]:.0f} m to {high[0]:.0f} m east and {low[1]:.0f} m to {high[1]:.0f} m north of world.origin_deg, "
            f"and the world needs {-side_m / 2:.0f} m to {side_m / 2:.0f} m without holes; "
            "set world.side_m or world.origin_deg, or give a larger raster"
        )
    base = float(np.median(heights[known]))
    rows, columns = (_node_weights(*one, 3) for one in at)
    up_m = rows @ np.where(known, heights - base, 0.0) @ columns.T
    return _about_origin(up_m, side_m, step, base + given.base_m)


def height_at(relief: Elevation, east_north_m: np.ndarray) -> np.ndarray:
    """Return heights (N,) in metres at places (N, 2), bilinear. The grid is mirrored beyond its edges."""
    places = np.asarray(east_north_m, float).reshape(-1, 2)
    width, flat = relief.up_m.shape[1], relief.up_m.ravel()
    cells, shares = [], []
    for k in range(2):
        at = (places[:, k] - relief.corner_m[k]) / relief.step_m
        steps = relief.up_m.shape[1 - k] - 1
        if len(at) and not (at.min() >= 0 and at.max() <= steps):
            at = steps - np.abs(np.mod(at, 2 * steps) - steps)
        cells.append(np.minimum(at.astype(np.int64), steps - 1))
        shares.append(at - cells[-1])
    x, y = shares
    first = cells[1] * width + cells[0]
    low, high = (flat.take(node) + x * (flat.take(node + 1) - flat.take(node)) for node in (first, first + width))
    return np.asarray(low + y * (high - low))


def _node_weights(at: np.ndarray, count: int, order: int) -> np.ndarray:
    """Return weights (N, count) of the nodes 0, 1, ... for places between them, of order 1 (linear) or 3 (cubic).

    Rows of places beyond the nodes are 0.
    """
    slack = 1e-6
    inside = (at >= -slack) & (at <= count - 1 + slack)
    at = np.clip(at, 0, count - 1)
    first = np.minimum(at.astype(int), max(count - 2, 0))
    t = at - first
    # Catmull-Rom cubic: the slope at a node is the slope between its neighbours.
    cubic = {
        -1: -t / 2 + t**2 - t**3 / 2,
        0: 1 - 5 / 2 * t**2 + 3 / 2 * t**3,
        1: t / 2 + 2 * t**2 - 3 / 2 * t**3,
        2: -(t**2) / 2 + t**3 / 2,
    }
    weights = np.zeros((len(at), count))
    for offset, share in ({0: 1 - t, 1: t} if order == 1 else cubic).items():
        np.add.at(weights, (np.arange(len(at)), np.clip(first + offset, 0, count - 1)), share)
    return weights * inside[:, None]


def _grid(side_m: float) -> tuple[np.ndarray, float]:
    """Return the grid's places along a side, metres, and their step. An even number of steps includes the origin."""
    steps = 2 * int(np.ceil(min(side_m / _COARSEST_M, _MOST_STEPS) / 2))
    return np.linspace(-side_m / 2, side_m / 2, steps + 1), side_m / steps


def _about_origin(up_m: np.ndarray, side_m: float, step_m: float, base_m: float) -> Elevation:
    at_origin = float(up_m[up_m.shape[0] // 2, up_m.shape[0] // 2])
    return Elevation(up_m - at_origin, (-side_m / 2, -side_m / 2), step_m, base_m + at_origin)


# Sunlight: slopes that face the sun or face away from it, and shadows of objects.


def sun_direction(azimuth_deg: float, height_deg: float) -> np.ndarray:
    """Return the unit vector (3,) to the sun in east, north, up. The azimuth is clockwise from north."""
    azimuth, height = np.radians([azimuth_deg, height_deg])
    return np.array([np.sin(azimuth) * np.cos(height), np.cos(azimuth) * np.cos(height), np.sin(height)])


def _light_on_slopes(relief: Elevation, to_sun: np.ndarray) -> np.ndarray:
    """Return light (R, C) on the relief, whose rows go north, relative to level ground."""
    north, east = np.gradient(relief.up_m, relief.step_m)
    facing = (to_sun[2] - east * to_sun[0] - north * to_sun[1]) / np.sqrt(1 + east**2 + north**2)
    direct = 1 - float(SHADE_BGR.mean())
    return np.asarray(1 - direct + direct * np.clip(facing / to_sun[2], 0, 2), np.float32)


def shadow_above_ground(heights_m: np.ndarray, texel_m: float, to_sun: np.ndarray) -> np.ndarray:
    """Return (H, W) float32 heights of the shadow's edge above the surface, metres; negative values are sunlit.

    heights_m: (H, W) of the surface, row 0 at the north edge. The map is turned so that the sun is above its first row.
    Then the shadow's edge sinks from row to row, and each row takes the maximum of edge and surface.
    """
    rows, columns = heights_m.shape
    level = float(np.hypot(*to_sun[:2]))
    if level < 1e-3:
        return np.full(heights_m.shape, -1, np.float32)
    sink = texel_m * to_sun[2] / level
    # Rows of the turned map go away from the sun. matrix maps its (column, row, 1) to the (column, row) of the world.
    away = np.array([-to_sun[0], to_sun[1]]) / level
    aside = np.array([away[1], -away[0]])
    size = int(np.ceil(np.hypot(rows, columns))) + 2
    centre = np.array([(columns - 1) / 2, (rows - 1) / 2])
    matrix = np.c_[aside, away, centre - (size - 1) / 2 * (aside + away)]
    heights_m = heights_m.astype(np.float32)
    turned = cv2.warpAffine(heights_m, matrix, (size, size), flags=_WARP, borderMode=cv2.BORDER_REPLICATE)
    edge = turned[0].copy()
    for row in range(size):
        height = turned[row].copy()
        turned[row] = np.clip(edge - height, -1, None)
        edge = np.maximum(edge, height) - np.float32(sink)
    return cv2.warpAffine(turned, cv2.invertAffineTransform(matrix), (columns, rows), flags=_WARP, borderValue=-1)


# An orthophoto that replaces the synthetic soil.


class PhotographedGround:
    """The ground of a photo, row by row, with synthetic soil where the photo is empty.

    synthetic: returns rows [first, last) of the soil, (3, n, W) float32. The soil is tinted like the photo. Its fine
    structure is added to a photo coarser than the world's grid. Raises InputError if the photo misses the world.
    """

    def __init__(
        self, photo: Ortho, side_m: float, side_px: int, synthetic: Callable[[tuple[int, int]], np.ndarray]
    ) -> None:
        self._image, sure = _place_photo(photo, side_m, side_px)
        self._synthetic = synthetic
        self._blur_px = 0.5 * _pixel_m(photo) * side_px / side_m
        shown = self._image[::8, ::8][sure[::8, ::8] > 0] if sure[::8, ::8].any() else self._image[sure > 0]
        middle = side_px // 2
        sample = synthetic((middle, min(middle + 64, side_px)))
        self._tint = (shown.mean(0) / sample.mean((1, 2)))[:, None, None].astype(np.float32)
        # Blend photo and soil softly at the seam.
        self._share = cv2.blur(cv2.erode(sure, np.ones((9, 9), np.uint8)), (9, 9)) if not sure.all() else sure

    def rows(self, rows: tuple[int, int]) -> np.ndarray:
        """Return rows [first, last), (3, n, W) float32 BGR."""
        first, last = rows
        share = self._share[first:last].astype(np.float32) / 255
        image = np.ascontiguousarray(self._image[first:last].transpose(2, 0, 1), np.float32)
        is_coarse = self._blur_px > 0.75
        if share.min() == 1 and not is_coarse:
            return image
        edge = int(3 * self._blur_px) + 1
        soil = self._synthetic((first - edge, last + edge)) * self._tint
        inner = soil[:, edge : edge + last - first]
        if is_coarse:
            for k in range(3):
                broad = cv2.GaussianBlur(soil[k], (0, 0), self._blur_px)[edge : edge + last - first]
                image[k] *= np.clip(inner[k] / np.maximum(broad, 1), 0.6, 1.4)
        return inner + share * (image - inner)


def _place_photo(photo: Ortho, side_m: float, side_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Resample the photo to the world's grid: (side_px, side_px, 3) uint8, and a mask of known pixels, 0 or 255.

    Pixels outside the photo and in its white or black margins and holes are unknown. A finer photo is averaged.
    """
    texel, half = side_m / side_px, side_m / 2
    metres_from_pixel = np.asarray(photo.east_north_from_pixel, float)
    image, known = photo.image, _known_pixels(photo.image)
    pixel_from_metres = cv2.invertAffineTransform(metres_from_pixel)
    finer = texel / _pixel_m(photo)
    if finer > 1.2:
        size = max(round(image.shape[1] / finer), 1), max(round(image.shape[0] / finer), 1)
        shrunk = np.array([size[0] / image.shape[1], size[1] / image.shape[0]])[:, None]
        image, known = (cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in (image, known))
        pixel_from_metres = shrunk * pixel_from_metres
        pixel_from_metres = pixel_from_metres + np.c_[np.zeros((2, 2)), 0.5 * shrunk - 0.5]
    metres_from_texel = np.array([[texel, 0, -half + texel / 2], [0, -texel, half - texel / 2], [0, 0, 1]])
    matrix, size = pixel_from_metres @ metres_from_texel, (side_px, side_px)
    # The outermost pixels are known up to their outer edges.
    wider, moved = cv2.copyMakeBorder(known, 1, 1, 1, 1, cv2.BORDER_REPLICATE), matrix + np.array([0.0, 0, 1])
    sure = cv2.warpAffine(wider, moved, size, flags=_WARP, borderValue=0)
    sure = cv2.threshold(sure, 250, 255, cv2.THRESH_BINARY)[1]
    if not sure.any():
        height, width = photo.image.shape[:2]
        corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]])
        metres = corners @ metres_from_pixel.T
        (west, south), (east, north) = metres.min(0), metres.max(0)
        raise InputError(
            f"the photo shows nothing of the world: it lies from {west:.0f} m to {east:.0f} m east and {south:.0f} m "
            f"to {north:.0f} m north of world.origin_deg, and the world from {-half:.0f} m to {half:.0f} m; "
            "set world.origin_deg, or give another photo"
        )
    return cv2.warpAffine(image, matrix, size, flags=_WARP, borderMode=cv2.BORDER_REPLICATE), sure


def _pixel_m(photo: Ortho) -> float:
    """Return the length of a photo's pixel on the ground, metres."""
    return float(np.sqrt(np.abs(np.linalg.det(np.asarray(photo.east_north_from_pixel, float)[:, :2]))))


def _known_pixels(image: np.ndarray) -> np.ndarray:
    """Return (H, W) uint8: 0 in the white or black margins and holes of a photo, 255 elsewhere."""
    low, high = image.min(axis=2), image.max(axis=2)
    known = np.full(low.shape, 255, np.uint8)
    for empty in (low >= 252, high <= 3):
        _, label, stats, _ = cv2.connectedComponentsWithStats(empty.astype(np.uint8))
        left, top, width, height, area = stats.T
        at_edge = (left == 0) | (top == 0) | (left + width == low.shape[1]) | (top + height == low.shape[0])
        is_hole = (area >= _EMPTY_SHARE * low.size) | (at_edge & (area >= _EMPTY_SHARE / 20 * low.size))
        is_hole[0] = False
        known[is_hole[label]] = 0
    # Lossy compression smears the margins over one or two pixels.
    return cv2.erode(known, np.ones((5, 5), np.uint8)) if not known.all() else known


# The texture that cameras sample.


def equal_runs(values: np.ndarray) -> Iterable[tuple[int, int]]:
    """Return the first row and the row after the last of each run of equal values (N,)."""
    return pairwise([0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)])


def halved_levels(texture: np.ndarray, most: int) -> list[np.ndarray]:
    """Return a texture (H, W, ...) and its reductions by factors of 2, at most `most` levels."""
    levels = [texture]
    while len(levels) < most and min(levels[-1].shape[:2]) >= 4:
        size = (levels[-1].shape[1] + 1) // 2, (levels[-1].shape[0] + 1) // 2
        levels.append(np.asarray(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA)))
    return levels


class GroundTexture:
    """The colours of a world's ground, averaged over the area of a pixel."""

    def __init__(self, world: World, most: int) -> None:
        self._world, self._levels = world, halved_levels(world.albedo, most)

    def rows(
        self, pixel_m: np.ndarray, east_m: np.ndarray, north_m: np.ndarray, origin_m: tuple[float, float] = (0.0, 0.0)
    ) -> np.ndarray:
        """Return (H, W, 3) uint8 at places (H, W) float32 about origin_m. pixel_m: (H,) size of a row's pixels."""
        level = np.clip(np.log2(pixel_m / self._world.texel_m), 0, len(self._levels) - 1)
        level = np.round(level * _BETWEEN).astype(int)
        picture = np.empty((*east_m.shape, 3), np.uint8)
        for first, last in equal_runs(level // _BETWEEN):
            rows, at = slice(first, last), int(level[first]) // _BETWEEN
            share = level[rows] % _BETWEEN
            fine = self._sample(at, east_m[rows], north_m[rows], origin_m)
            if share.any():
                coarse = self._sample(at + 1, east_m[rows], north_m[rows], origin_m)
                for begin, end in equal_runs(share):
                    weight = float(share[begin]) / _BETWEEN
                    cv2.addWeighted(fine[begin:end], 1 - weight, coarse[begin:end], weight, 0, dst=fine[begin:end])
            picture[rows] = fine
        return picture

    def _sample(self, level: int, east_m: np.ndarray, north_m: np.ndarray, origin_m: tuple[float, float]) -> np.ndarray:
        texture, half = self._levels[level], self._world.side_m / 2
        per_m = texture.shape[1] / self._world.side_m
        u = cv2.addWeighted(east_m, per_m, east_m, 0, (half + origin_m[0]) * per_m - 0.5)
        v = cv2.addWeighted(north_m, -per_m, north_m, 0, (half - origin_m[1]) * per_m - 0.5)
        return cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
