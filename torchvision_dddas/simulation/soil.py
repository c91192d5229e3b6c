"""Bare ground of a desert in southern Arizona: soils of several tones, dry creek beds, a dirt road, trails, grass, stones.

Colours are BGR as a photo shows them in full sun. Broad patterns are laid on a grid 8 times coarser than the texture and
enlarged; what is finer is added band by band, so that a large world needs little memory.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.simulation.noise import band, bumps, enlarged, fractal, sparks

COARSE = 8
"""Pixels of the texture to a cell of the broad patterns."""

_TAN, _RED, _PALE, _DARK = (
    np.array(c, np.float32) for c in ((112, 144, 172), (98, 128, 168), (150, 176, 196), (84, 108, 130))
)
_SAND, _GRASS, _ROAD = (np.array(c, np.float32) for c in ((140, 168, 190), (98, 138, 152), (136, 164, 186)))


@dataclass(frozen=True)
class Lie:
    """Broad patterns of the ground, each (h, w) float32 on the coarse grid, row 0 the north edge.

    tone: (h, w, 3) of the soil. grass: how much of it grows, 0 to 1. wash_m, road_m, trail_m: metres from the middle of
    the nearest creek bed, road, trail; wash_half_m: half the creek's width there.
    """

    tone: np.ndarray
    grass: np.ndarray
    wash_m: np.ndarray
    wash_half_m: np.ndarray
    road_m: np.ndarray
    trail_m: np.ndarray
    cell_m: float

    def at(self, field: np.ndarray, east_north_m: np.ndarray) -> np.ndarray:
        """(N,) of a field at places (N, 2)."""
        half = field.shape[0] * self.cell_m / 2
        column = np.clip((east_north_m[:, 0] + half) / self.cell_m, 0, field.shape[1] - 1).astype(int)
        row = np.clip((half - east_north_m[:, 1]) / self.cell_m, 0, field.shape[0] - 1).astype(int)
        return field[row, column]


def lie(side_m: float, cells: int, seed: int) -> Lie:
    """Where soils, creeks, road and trails of a world lie. cells: of the coarse grid along a side."""
    rng = np.random.default_rng([seed, 11])
    shape, cell = (cells, cells), side_m / cells
    middle = (np.arange(cells) + 0.5) * cell - side_m / 2
    east, north = np.meshgrid(middle.astype(np.float32), -middle.astype(np.float32))

    def patches(widest_m: float, fall: float = 0.6) -> np.ndarray:
        return fractal(rng, shape, max(widest_m / cell, 1), 1, fall)

    red, pale, dark = patches(90), patches(40), patches(25)
    tone = np.broadcast_to(_TAN, (*shape, 3)).copy()
    for share, colour in ((red, _RED), (pale - 0.7, _PALE), (dark - 0.9, _DARK)):
        tone += np.clip(0.5 * share + 0.25, 0, 0.85)[..., None] * (colour - tone)
    tone *= (1 + 0.05 * patches(12))[..., None]
    ripple = 1.5 * patches(30, 0.5)

    def course(swing_m: float, winding_m: float) -> np.ndarray:
        """Signed distance to a winding line across the world."""
        turn, off = rng.uniform(0, 2 * np.pi), rng.uniform(-0.3, 0.3) * side_m
        along, aside = np.cos(turn) * east + np.sin(turn) * north, -np.sin(turn) * east + np.cos(turn) * north
        swing, slope = np.full_like(along, off), np.zeros_like(along)
        for length in winding_m * np.array([1.0, 0.53, 0.29]):
            phase, high = rng.uniform(0, 2 * np.pi), swing_m * length / winding_m
            swing += high * np.sin(2 * np.pi / length * along + phase)
            slope += high * 2 * np.pi / length * np.cos(2 * np.pi / length * along + phase)
        return (aside - swing) / np.sqrt(1 + slope**2)

    wash, half = np.full(shape, 1e3, np.float32), np.zeros(shape, np.float32)
    for size in (1.0, 0.5, 0.35, 0.3)[: max(1, min(4, round(side_m / 100)))]:
        distance = np.abs(course(9 * size**0.5, 110 * size**0.5) + ripple)
        width = size * (3.0 + 1.5 * bumps(rng, shape, 30 / cell)).clip(1.2)
        nearer = distance / width < wash / np.maximum(half, 1e-6)
        wash, half = np.where(nearer, distance, wash), np.where(nearer, width, half)
    road = course(14, 260)
    trail = np.full(shape, 1e3, np.float32)
    for _ in range(max(1, round(side_m / 100))):
        line = course(5, 60)
        trail = np.where(np.abs(line) < np.abs(trail), line, trail)
    grass = np.clip(0.45 + 0.35 * patches(35, 0.65), 0, 1)
    return Lie(*(np.ascontiguousarray(f, np.float32) for f in (tone, grass, wash, half, road, trail)), cell)


def soil(ground: Lie, rows: tuple[int, int], texel_m: float, seed: int, to_sun: np.ndarray) -> np.ndarray:
    """Rows [first, last) of the ground's colours, (n, W, 3) float32 BGR, as on a level plane in the sun."""
    columns = ground.grass.shape[1] * COARSE

    def broad(field: np.ndarray) -> np.ndarray:
        return enlarged(field, rows, COARSE)

    def fine(key: int, width_m: float) -> np.ndarray:
        return band((seed, 12, key), rows, columns, max(round(width_m / texel_m), 1))

    coarse, middle, small, grain = fine(0, 0.8), fine(1, 0.4), fine(2, 0.2), fine(3, 0.1)
    image = broad(ground.tone)
    grass = np.clip(broad(ground.grass) + 0.12 * coarse + 0.1 * middle, 0, 1)
    wash, half, road, trail = (broad(f) for f in (ground.wash_m, ground.wash_half_m, ground.road_m, ground.trail_m))
    in_wash = np.clip((half - wash) / 0.8 + 0.25 * coarse + 0.15 * middle, 0, 1)
    on_road = np.clip((1.9 - np.abs(road)) / 0.5 + 0.3 * middle + 0.3 * coarse, 0, 1)
    on_trail = np.clip((0.35 - np.abs(trail)) / 0.3 + 0.25 * middle, 0, 0.7)
    bare = (1 - in_wash) * (1 - on_road) * (1 - on_trail)
    grass *= bare
    rough = 5 * coarse + 5 * middle + 5 * small + 5 * grain
    image += in_wash[..., None] * (_SAND - image)
    bank = np.exp(-(((wash - half - 0.5) / 0.7) ** 2)) * (1 - on_road)
    image *= (1 - 0.18 * bank)[..., None]
    image += (0.8 * on_road)[..., None] * (_ROAD - image)
    wheels = np.exp(-(((np.abs(road) - 0.85 - 0.04 * coarse) / 0.25) ** 2))
    image *= (1 + on_road * (0.09 * wheels - 0.04))[..., None]
    image += (0.7 * on_trail)[..., None] * (_PALE - image)
    image += (0.55 * grass)[..., None] * (_GRASS - image)
    image += (rough * (1 - 0.5 * in_wash - 0.4 * on_road))[..., None]

    # Tufts and stones: sparks spread into blots, lit on the side of the sun and shaded on the other.
    for key, (each_m2, size_m, strength) in enumerate(
        ((3.0, 0.12, -70), (0.7, 0.22, -60), (0.5, 0.1, 60), (0.08, 0.2, 55))
    ):
        share = np.clip(each_m2 * texel_m**2, 0, 0.2)
        amount = share * (
            np.clip(grass * 1.6, 0.08, 1) if strength < 0 else np.clip(1.2 - grass, 0.1, 1) * (1 - 0.7 * on_road)
        )
        spread = max(size_m / texel_m, 0.45)
        margin = int(4 * spread) + 2
        wide = rows[0] - margin, rows[1] + margin
        drawn = sparks((seed, 13, key), wide, columns, float(share))
        drawn[margin:-margin] *= np.clip(amount / share, 0, 1) > 0.5
        blot = cv2.GaussianBlur(drawn, (0, 0), spread)[margin:-margin] * np.float32(2 * np.pi * spread**2)
        image += (np.clip(blot, 0, 1) * strength)[..., None] * np.array([1, 0.95, 0.95], np.float32)
    return image
