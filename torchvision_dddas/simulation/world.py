"""A piece of ground with everything that stands on it, as the sun lights it: what the simulated cameras look at."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.simulation.cover import Crowns, StandingObjects, scatter_objects
from torchvision_dddas.simulation.relief import (
    SHADE_BGR,
    height_at,
    light_on_slopes,
    make_hills,
    resample_raster,
    shadow_above_ground,
    sun_direction,
)
from torchvision_dddas.simulation.scenario import WorldParameters
from torchvision_dddas.simulation.soil import COARSE, draw_patterns, enlarge_rows, soil_rows
from torchvision_dddas.types import Elevation, Ortho

MOST_TEXELS = 12_000  # pixels along a side of the largest texture

_AT_ONCE = 1 << 20  # pixels of the texture that are made at once, in whole rows
_ROWS_OF_SURFACE = 6000


@dataclass(frozen=True)
class World:
    """The ground and what stands on it, all for a square of side_m about the origin; local metres, z up.

    albedo: (H, W, 3) uint8 BGR, seen from above, with light and cast shadows, row 0 the north edge; the first pixel's
    centre is at (-side_m / 2 + texel_m / 2, side_m / 2 - texel_m / 2). surface: (H2, W2) float32 metres above the
    ground of what stands there, on pixels of surface_texel_m over the same square. relief: heights of the bare ground.
    to_sun: (3,) unit vector. Beyond its edges the world is mirrored, as by cv2.BORDER_REFLECT.
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
        """(N,) height of the bare ground at places (N, 2), bilinear; 0 at the origin."""
        return height_at(self.relief, east_north_m)


def build_world(
    parameters: WorldParameters,
    seed: int,
    elevation: Elevation | None = None,
    photo: Ortho | None = None,
    keep_clear: tuple[np.ndarray, float] | None = None,
) -> World:
    """The world of a scenario; the same arguments always give the same world.

    elevation: in place of the synthetic relief; photo: in place of the synthetic soil. keep_clear: places (N, 2) in
    local metres and how many metres about them nothing may stand.
    Raises InputError where the texture would be too large, or the elevation does not cover the world.
    """
    cells = max(round(parameters.side_m / parameters.texel_m / COARSE), 2)
    side_px, side_m = cells * COARSE, parameters.side_m
    if side_px > MOST_TEXELS:
        raise InputError(
            f"a world of {side_m:g} m in pixels of {parameters.texel_m:g} m has {side_px} of them a side; at most "
            f"{MOST_TEXELS} are possible; set world.texel_m to {np.ceil(1000 * side_m / MOST_TEXELS) / 1000:g} or more"
        )
    texel = side_m / side_px
    to_sun = sun_direction(parameters.sun_azimuth_deg, parameters.sun_height_deg)
    rng = np.random.default_rng([seed, 10])
    relief = (
        make_hills(side_m, parameters.relief_m, parameters.above_sea_m, rng)
        if elevation is None
        else resample_raster(elevation, side_m)
    )
    light = _on_texels(light_on_slopes(relief.up_m, relief.step_m, to_sun), cells)
    ground = draw_patterns(side_m, light, seed)

    banks = np.exp(-(((ground.wash_m - ground.wash_half_m - 1) / 2.5) ** 2))
    off_road = np.clip((np.abs(ground.road_m) - 2.5) / 1.5, 0, 1)
    wished = (0.12 + 0.5 * ground.grass**2 + 0.8 * banks) * off_road * (ground.wash_m > 0.8 * ground.wash_half_m)
    built = np.clip((np.abs(ground.road_m) - 9) / 2, 0, 1) * (ground.wash_m > ground.wash_half_m + 8)
    hectares = (side_m / 100) ** 2
    counts = round(parameters.bushes_per_ha * hectares), round(parameters.trees_per_ha * hectares), parameters.buildings
    places, radius = keep_clear if keep_clear is not None else (np.zeros((0, 2)), 0.0)
    clear = np.asarray(places, float).reshape(-1, 2), radius
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
        # Ground that lies away from the sun has less to lose to a shadow.
        slopes = enlarge_rows(light, rows, COARSE) if photo is None else np.float32(1)
        for k in range(3):
            lit = image[k] * (1 - shade * np.clip(1 - SHADE_BGR[k] / slopes, 0, 1))
            albedo[rows[0] : rows[1], :, k] = np.clip(np.round(lit), 0, 255)
    return World(side_m, texel, albedo, surface, texel * factor, relief, things, to_sun)


def _on_texels(field: np.ndarray, cells: int) -> np.ndarray:
    """A field (R, C) whose rows go north from edge to edge, at the middles of (cells, cells) pixels from the north."""
    step = (np.asarray(field.shape) - 1) / cells
    matrix = np.array([[step[1], 0, 0.5 * step[1]], [0, step[0], 0.5 * step[0]]])
    return cv2.warpAffine(
        np.ascontiguousarray(field, np.float32), matrix, (cells, cells),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
    )[::-1].copy()  # fmt: skip


# An ortho-photo on the world's ground in place of the synthetic soil.


_EMPTY_SHARE = 1e-3  # a white or black area of less of the photo, inside it, is a thing in it and no hole


def place_photo(photo: Ortho, side_m: float, side_px: int) -> tuple[np.ndarray, np.ndarray]:
    """The photo on the world's grid: (side_px, side_px, 3) uint8, and which of its pixels are known, uint8 0 or 255.

    Unknown is what the photo does not cover, and its white or black margins and holes. A finer photo is averaged.
    Raises InputError where nothing of the world is known.
    """
    texel = side_m / side_px
    image, known = photo.image, _filled(photo.image)
    pixel_from_metres = cv2.invertAffineTransform(np.asarray(photo.east_north_from_pixel, float))
    finer = texel / _pixel_m(photo)
    if finer > 1.2:
        size = max(round(image.shape[1] / finer), 1), max(round(image.shape[0] / finer), 1)
        shrunk = np.array([size[0] / image.shape[1], size[1] / image.shape[0]])[:, None]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        known = cv2.resize(known, size, interpolation=cv2.INTER_AREA)
        pixel_from_metres = shrunk * pixel_from_metres
        pixel_from_metres = pixel_from_metres + np.c_[np.zeros((2, 2)), 0.5 * shrunk - 0.5]
    first = np.array([-side_m / 2 + texel / 2, side_m / 2 - texel / 2])
    metres_from_texel = np.array([[texel, 0, first[0]], [0, -texel, first[1]], [0, 0, 1]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    matrix, size = pixel_from_metres @ metres_from_texel, (side_px, side_px)
    # The outermost pixels are known to their edges.
    wider, moved = cv2.copyMakeBorder(known, 1, 1, 1, 1, cv2.BORDER_REPLICATE), matrix + np.array([0.0, 0, 1])
    sure = cv2.warpAffine(wider, moved, size, flags=flags, borderValue=0)
    sure = cv2.threshold(sure, 250, 255, cv2.THRESH_BINARY)[1]
    if not sure.any():
        height, width = photo.image.shape[:2]
        corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]])
        metres = corners @ np.asarray(photo.east_north_from_pixel, float).T
        (west, south), (east, north) = metres.min(0), metres.max(0)
        half = side_m / 2
        raise InputError(
            f"the photo shows nothing of the world: it lies from {west:.0f} m to {east:.0f} m east and {south:.0f} m "
            f"to {north:.0f} m north of world.origin_deg, and the world from {-half:.0f} m to {half:.0f} m; "
            "set world.origin_deg, or give another photo"
        )
    return cv2.warpAffine(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), sure


class PhotographedGround:
    """The ground as a photo shows it, row by row, and synthetic soil where it shows none.

    synthetic: gives rows [first, last) of the soil, (3, n, W) float32. It takes the photo's colours, and lends its fine
    structure to a photo that is coarser than the world's grid.
    """

    def __init__(
        self, photo: Ortho, side_m: float, side_px: int, synthetic: Callable[[tuple[int, int]], np.ndarray]
    ) -> None:
        self._image, sure = place_photo(photo, side_m, side_px)
        self._synthetic, self._side_px = synthetic, side_px
        self._blur_px = 0.5 * _pixel_m(photo) * side_px / side_m
        shown = self._image[::8, ::8][sure[::8, ::8] > 0] if sure[::8, ::8].any() else self._image[sure > 0]
        middle = side_px // 2
        sample = synthetic((middle, min(middle + 64, side_px)))
        self._tint = (shown.mean(0) / sample.mean((1, 2)))[:, None, None].astype(np.float32)
        # The seam between photo and soil is soft.
        self._share = cv2.blur(cv2.erode(sure, np.ones((9, 9), np.uint8)), (9, 9)) if not sure.all() else sure

    def rows(self, rows: tuple[int, int]) -> np.ndarray:
        """Rows [first, last), (3, n, W) float32 BGR."""
        first, last = rows
        share = self._share[first:last].astype(np.float32) / 255
        image = np.ascontiguousarray(self._image[first:last].transpose(2, 0, 1), np.float32)
        coarse = self._blur_px > 0.75
        if share.min() == 1 and not coarse:
            return image
        edge = int(3 * self._blur_px) + 1
        soil = self._synthetic((first - edge, last + edge)) * self._tint
        inner = soil[:, edge : edge + last - first]
        if coarse:
            for k in range(3):
                broad = cv2.GaussianBlur(soil[k], (0, 0), self._blur_px)[edge : edge + last - first]
                image[k] *= np.clip(inner[k] / np.maximum(broad, 1), 0.6, 1.4)
        return inner + share * (image - inner)


def _pixel_m(photo: Ortho) -> float:
    """Length of a pixel of a photo on the ground."""
    return float(np.sqrt(np.abs(np.linalg.det(np.asarray(photo.east_north_from_pixel, float)[:, :2]))))


def _filled(image: np.ndarray) -> np.ndarray:
    """(H, W) uint8, 255 where a photo shows something, 0 in its white or black margins and holes."""
    low, high = image.min(axis=2), image.max(axis=2)
    known = np.full(low.shape, 255, np.uint8)
    for empty in (low >= 252, high <= 3):
        count, label, stats, _ = cv2.connectedComponentsWithStats(empty.astype(np.uint8))
        left, top, width, height, area = stats.T
        at_edge = (left == 0) | (top == 0) | (left + width == low.shape[1]) | (top + height == low.shape[0])
        hole = (area >= _EMPTY_SHARE * low.size) | (at_edge & (area >= _EMPTY_SHARE / 20 * low.size))
        hole[0] = False
        if count > 1 and hole.any():
            known[hole[label]] = 0
    # A lossy photo smears its margins over a pixel or two.
    return cv2.erode(known, np.ones((5, 5), np.uint8)) if not known.all() else known
