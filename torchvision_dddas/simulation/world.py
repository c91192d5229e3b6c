"""A piece of ground with everything that stands on it, as the sun lights it: what the simulated cameras look at."""

from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.simulation import relief as reliefs
from torchvision_dddas.simulation import sunlight
from torchvision_dddas.simulation.cover import Crowns, Things, scatter
from torchvision_dddas.simulation.noise import enlarged
from torchvision_dddas.simulation.ortho import Photographed
from torchvision_dddas.simulation.scenario import WorldParameters
from torchvision_dddas.simulation.soil import COARSE, lie, soil
from torchvision_dddas.types import Elevation, Ortho

MOST_TEXELS = 12_000
"""Pixels along a side of the largest texture."""

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
    things: Things
    to_sun: np.ndarray

    def up_m(self, east_north_m: np.ndarray) -> np.ndarray:
        """(N,) height of the bare ground at places (N, 2), bilinear; 0 at the origin."""
        return reliefs.up(self.relief, east_north_m)


def build(
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
    to_sun = sunlight.towards(parameters.sun_azimuth_deg, parameters.sun_height_deg)
    rng = np.random.default_rng([seed, 10])
    relief = (
        reliefs.hills(side_m, parameters.relief_m, parameters.above_sea_m, rng)
        if elevation is None
        else reliefs.of_raster(elevation, side_m)
    )
    light = _on_texels(sunlight.on_slopes(relief.up_m, relief.step_m, to_sun), cells)
    ground = lie(side_m, light, seed)

    banks = np.exp(-(((ground.wash_m - ground.wash_half_m - 1) / 2.5) ** 2))
    off_road = np.clip((np.abs(ground.road_m) - 2.5) / 1.5, 0, 1)
    wished = (0.12 + 0.5 * ground.grass**2 + 0.8 * banks) * off_road * (ground.wash_m > 0.8 * ground.wash_half_m)
    built = np.clip((np.abs(ground.road_m) - 9) / 2, 0, 1) * (ground.wash_m > ground.wash_half_m + 8)
    hectares = (side_m / 100) ** 2
    counts = round(parameters.bushes_per_ha * hectares), round(parameters.trees_per_ha * hectares), parameters.buildings
    places, radius = keep_clear if keep_clear is not None else (np.zeros((0, 2)), 0.0)
    clear = np.asarray(places, float).reshape(-1, 2), radius
    things = scatter(counts, side_m, np.clip(wished, 0, 1), built, clear, np.random.default_rng([seed, 20]))
    crowns = Crowns(things, side_m, seed)

    factor = 2 if side_px <= _ROWS_OF_SURFACE else 4
    surface = crowns.surface(side_px // factor)
    hills = np.float32(0) if photo is not None else _on_texels(relief.up_m, surface.shape[0])
    over = sunlight.above_ground(surface + hills, texel * factor, to_sun)

    def synthetic(rows: tuple[int, int]) -> np.ndarray:
        return soil(ground, rows, texel, seed, to_sun)

    bare = synthetic if photo is None else Photographed(photo, side_m, side_px, synthetic).rows
    albedo = np.empty((side_px, side_px, 3), np.uint8)
    band = max(_AT_ONCE // side_px, 32)
    for first in range(0, side_px, band):
        rows = first, min(first + band, side_px)
        image = bare(rows)
        crowns.paint(image, first, texel, to_sun)
        shade = np.clip(enlarged(over, rows, factor) / 0.25 - 0.2, 0, 1)
        # Ground that lies away from the sun has less to lose to a shadow.
        slopes = enlarged(light, rows, COARSE) if photo is None else np.float32(1)
        for k in range(3):
            lit = image[k] * (1 - shade * np.clip(1 - sunlight.SHADE_BGR[k] / slopes, 0, 1))
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
