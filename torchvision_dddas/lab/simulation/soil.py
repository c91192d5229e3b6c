"""Bare ground of a desert in southern Arizona: soils, dry creek beds, a dirt road, trails, grass, stones.

Colours are BGR as in a photo in full sun. Broad patterns are computed on a grid 8 times coarser than the texture and
enlarged. Finer patterns are added band by band, so that a large world needs little memory.
"""

from typing import Any

import cv2
import numpy as np

COARSE = 8  # texture pixels per cell of the broad patterns

_TILE = 512  # columns per coloured tile
_BLOCK = 64  # rows of noise that share a seed
_FIRST = 1_000_000  # offset of block seeds, because a margin has negative rows but seeds cannot be negative
_SPREAD = 1.35  # corrects (slightly over-corrects) the loss of spread when independent numbers are interpolated


def _bgr(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


_TAN, _RED, _PALE, _DARK = _bgr(112, 144, 172), _bgr(94, 126, 168), _bgr(150, 176, 196), _bgr(84, 106, 128)
_SAND, _ROAD = _bgr(146, 172, 194), _bgr(138, 164, 186)
_STRAW, _GREEN = _bgr(86, 124, 144), _bgr(58, 82, 78)

# Stones, from gravel to boulders, and single tufts: number per square metre, radius in metres, and extra brightness of
# the stones or density of the tufts.
_STONES = ((4.0, 0.05, 30.0), (0.5, 0.1, 40.0), (0.03, 0.22, 28.0))
_TUFTS = ((2.5, 0.12, 0.9), (0.35, 0.28, 1.0))


def draw_patterns(side_m: float, light: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Draw broad patterns of a world's ground, each (h, w) float32 on a coarse grid, row 0 at the north edge.

    tone: (3, h, w) BGR of the soil. grass: density of grass, 0 to 1. green: share of the grass that is green, not dry.
    gravel: roughness of the soil, about 1. light: the argument, light on the slopes relative to level ground. wash,
    road, trail: metres from the middle of the nearest creek bed, road, trail; the last two are negative on one side.
    wash_half: half the width of that creek, metres.
    """
    cells = len(light)
    rng = np.random.default_rng([seed, 11])
    shape, cell = (cells, cells), side_m / cells
    middle = (np.arange(cells) + 0.5) * cell - side_m / 2
    east, north = np.meshgrid(middle.astype(np.float32), -middle.astype(np.float32))

    def patches(widest_m: float, fall: float = 0.6) -> np.ndarray:
        """Return noise of spread about 1: octaves of half the width and `fall` times the amplitude each."""
        total, power, height, width = np.zeros(shape, np.float32), 0.0, 1.0, max(widest_m / cell, 1)
        while width >= 1:
            total += np.float32(height) * _noise_bumps(rng, shape, width)
            power, height, width = power + height**2, height * fall, width / 2
        return total / np.float32(np.sqrt(power))

    tone = np.empty((3, *shape), np.float32)
    tone[:] = _TAN[:, None, None]
    for share, colour in ((patches(90), _RED), (patches(40) - 0.7, _PALE), (patches(25) - 0.9, _DARK)):
        tone += np.clip(0.5 * share + 0.25, 0, 0.85) * (colour[:, None, None] - tone)
    tone *= 1 + 0.08 * patches(12) + 0.075 * patches(4, 0.75)
    ripple = 1.5 * patches(30, 0.5)

    def course(swing_m: float, winding_m: float) -> np.ndarray:
        """Return the signed distance to a winding line across the world."""
        turn, off = rng.uniform(0, 2 * np.pi), rng.uniform(-0.3, 0.3) * side_m
        along, aside = np.cos(turn) * east + np.sin(turn) * north, -np.sin(turn) * east + np.cos(turn) * north
        swing, slope = np.full_like(along, off), np.zeros_like(along)
        for length in (winding_m, 0.53 * winding_m, 0.29 * winding_m):
            phase, high = rng.uniform(0, 2 * np.pi), swing_m * length / winding_m
            swing += high * np.sin(2 * np.pi / length * along + phase)
            slope += high * 2 * np.pi / length * np.cos(2 * np.pi / length * along + phase)
        return np.asarray((aside - swing) / np.sqrt(1 + slope**2))

    wash, half = np.full(shape, 1e3, np.float32), np.ones(shape, np.float32)
    for size in (1.0, 0.5, 0.35, 0.3)[: max(1, min(4, round(side_m / 100)))]:
        distance = np.abs(course(9 * size**0.5, 110 * size**0.5) + ripple)
        width = size * np.clip(2.6 + 0.8 * _noise_bumps(rng, shape, max(30 / cell, 1)), 1, 4.5)
        nearer = distance / width < wash / half
        wash, half = np.where(nearer, distance, wash), np.where(nearer, width, half)
    road = course(14, 260)
    trail = np.full(shape, 1e3, np.float32)
    for _ in range(max(1, round(side_m / 100))):
        line = course(5, 60)
        trail = np.where(np.abs(line) < np.abs(trail), line, trail)
    grass = np.clip(0.45 + 0.3 * patches(35, 0.65) + 0.12 * patches(4), 0, 1)
    green = np.clip(0.45 + 0.35 * patches(20, 0.7) + 0.4 * np.exp(-np.clip(wash - half, 0, None) / 3), 0, 1)
    gravel = np.clip(1 + 0.35 * patches(18, 0.7), 0.3, 2)
    fields = {"grass": grass, "green": green, "gravel": gravel, "light": light}
    fields |= {"wash": wash, "wash_half": half, "road": road, "trail": trail}
    return {"tone": tone, **{name: np.asarray(field, np.float32) for name, field in fields.items()}}


def soil_rows(
    ground: dict[str, np.ndarray], rows: tuple[int, int], texel_m: float, seed: int, to_sun: np.ndarray
) -> np.ndarray:
    """Return rows [first, last) of the sunlit ground, (3, n, W) float32 BGR. ground: result of `draw_patterns`."""
    columns = ground["grass"].shape[1] * COARSE
    # Light and shade of a pixel depend on its neighbours. These extra rows are cut off at the end.
    edge = max(int(np.ceil(0.3 / texel_m)), 1)
    wide = rows[0] - edge, rows[1] + edge

    def fine(key: int, width_m: float) -> np.ndarray:
        """Return noise with bumps of a width. Bumps narrower than a pixel average out."""
        noise = _noise_band((seed, 12, key), wide, columns, max(round(width_m / texel_m), 1))
        return noise if width_m >= texel_m else noise * np.float32(width_m / texel_m)

    def strewn(key: int, each_m2: float, radius_m: float) -> np.ndarray:
        spread = max(0.6 * radius_m / texel_m, 0.4)
        reach = int(3 * spread) + 2
        drawn = _noise_sparks((seed, 13, key), (wide[0] - reach, wide[1] + reach), columns, each_m2 * texel_m**2)
        full = min(7 * spread**2, (radius_m / texel_m) ** 2 * 6)  # small objects fill a part of a pixel
        return np.minimum(cv2.GaussianBlur(drawn, (0, 0), spread)[reach:-reach] * np.float32(full), 1)

    # The sign may change where the nearest trail changes. Do not draw a trail there.
    trail = np.abs(enlarge_rows(ground["trail"], wide, COARSE, smooth=True))
    trail = np.maximum(trail, enlarge_rows(np.abs(ground["trail"]), wide, COARSE) - 0.5 * COARSE * texel_m)
    grain = fine(3, 0.1)
    # Finer grain is visible to cameras near the ground.
    for key, width_m in ((5, 0.05), (6, 0.025)):
        if texel_m <= 1.2 * width_m:
            grain += 0.7 * fine(key, width_m)
    layers: dict[str, Any] = {
        name: enlarge_rows(ground[name], wide, COARSE) for name in ("wash_half", "grass", "green", "gravel", "light")
    }
    layers |= {
        "broad": fine(4, 1.6),
        "large": fine(0, 0.8),
        "middle": fine(1, 0.4),
        "small": fine(2, 0.2),
        "grain": grain,
        "stones": sum(bright * strewn(k, each_m2, radius_m) for k, (each_m2, radius_m, bright) in enumerate(_STONES)),
        "tufts": sum(dense * strewn(10 + k, each_m2, radius) for k, (each_m2, radius, dense) in enumerate(_TUFTS)),
        "trail": trail,
        "road": np.abs(enlarge_rows(ground["road"], wide, COARSE, smooth=True)),
        "wash": enlarge_rows(ground["wash"], wide, COARSE, smooth=True),
    }
    tone = [enlarge_rows(plane, wide, COARSE) for plane in ground["tone"]]
    image = np.empty((3, rows[1] - rows[0], columns), np.float32)
    # Tiles fit the processor's cache, and most hold no creek, road or trail. They are 3 times as fast as whole rows.
    for left in range(0, columns, _TILE):
        right = min(left + _TILE, columns)
        first, last = max(left - edge, 0), min(right + edge, columns)
        tile = {name: np.ascontiguousarray(layer[:, first:last]) for name, layer in layers.items()}
        colour = _coloured(tile, [plane[:, first:last] for plane in tone], texel_m, to_sun)
        for k in range(3):
            image[k, :, left:right] = colour[k][edge : edge + rows[1] - rows[0], left - first : right - first]
    return image


def _coloured(
    of: dict[str, np.ndarray], tone: list[np.ndarray], texel_m: float, to_sun: np.ndarray
) -> list[np.ndarray]:
    """Return the blue, green and red planes of a tile. of: its layers by name. tone: planes of its soil."""
    large, middle, small, grain = of["large"], of["middle"], of["small"], of["grain"]
    ragged = 0.25 * large + 0.2 * middle
    dull = 1 + 0.05 * of["broad"] + 0.2 * ragged + 0.045 * small + 0.05 * grain
    height = of["gravel"] * (0.012 * large + 0.01 * middle + 0.008 * small + 0.008 * grain)
    stones, bare = np.minimum(of["stones"] * of["gravel"], 50), np.ones_like(large)
    overlays: list[tuple[np.ndarray, np.ndarray]] = []
    from_bank = of["wash"] - of["wash_half"]
    if from_bank.min() < 3:
        in_wash = np.clip(ragged - from_bank / 0.8, 0, 1)
        dull -= 0.15 * np.exp(-(((from_bank - 0.4) / 0.6) ** 2))
        dull += in_wash * (0.05 * np.sin(2 * of["wash"] + 2 * large))
        height = height * (1 - 0.55 * in_wash) + 0.12 * in_wash * (in_wash - 2)
        overlays.append((in_wash, _SAND))
        bare = bare * (1 - in_wash)
    if of["road"].min() < 4:
        on_road = np.clip((1.9 - of["road"]) / 0.5 + ragged, 0, 1)
        wheels = np.exp(-(((of["road"] - 0.85 - 0.04 * large) / 0.25) ** 2))
        dull += on_road * (0.09 * wheels - 0.04 + 0.15 * (1 - dull))
        height *= 1 - 0.5 * on_road
        overlays.append((0.8 * on_road, _ROAD))
        bare = bare * (1 - on_road)
    if of["trail"].min() < 2:
        on_trail = np.clip((0.35 - of["trail"]) / 0.3 + ragged, 0, 0.7)
        overlays.append((0.6 * on_trail, _PALE))
        bare = bare * (1 - on_trail)

    grass = of["grass"]
    clumps = np.clip(1.6 * of["broad"] + 1.4 * large + 1.2 * middle + small - 7.2 + (2 + 4.8 * grass) * bare, 0, 1)
    clumps = np.maximum(clumps, of["tufts"] * np.clip(1.95 * grass + 0.45 * large - 0.3, 0, 1) * bare)
    stones *= (1 - clumps) * (0.5 + 0.5 * bare)
    height += 0.015 * clumps + 0.001 * stones

    slant = (to_sun[:2] / np.maximum(to_sun[2], 0.5)).astype(np.float32)
    step = max(1, round(0.1 / texel_m))
    light = slant[0] * (np.roll(height, step, 1) - np.roll(height, -step, 1))
    light += slant[1] * (np.roll(height, -step, 0) - np.roll(height, step, 0))
    light = np.clip(1 + light / np.float32(2 * step * texel_m), 0.45, 1.4)
    east, north = np.round(-0.2 * slant / np.maximum(np.hypot(*slant), 0.2) / texel_m).astype(int)
    light *= 1 - 0.55 * np.clip(np.roll(clumps, (-north, east), (0, 1)) - clumps, 0, 1)
    # Add bright and dark leaves and stalks.
    light *= 1 + clumps * (0.14 * small + 0.14 * grain)
    light *= dull * of["light"]

    green = np.clip(of["green"] + 0.25 * middle + 0.2 * large, 0, 1)
    planes = []
    for k in range(3):
        plane: np.ndarray = tone[k]
        for share, colour in overlays:
            plane = plane + share * (colour[k] - plane)
        plane = plane + clumps * (_STRAW[k] + green * (_GREEN[k] - _STRAW[k]) - plane)
        planes.append((plane + stones) * light)
    return planes


def _noise_bumps(rng: np.random.Generator, shape: tuple[int, int], width_px: float) -> np.ndarray:
    """Return smooth noise (H, W) float32 of mean 0 and spread about 1, with bumps about width_px wide."""
    if width_px <= 1:
        return rng.standard_normal(shape, np.float32)
    cells = [int(np.ceil(n / width_px)) + 3 for n in shape]
    small = rng.standard_normal(cells, np.float32)
    large = cv2.resize(small, None, fx=width_px, fy=width_px, interpolation=cv2.INTER_CUBIC)
    # Cut off a cell at the edges, where the enlargement repeats the outermost value.
    first = int(width_px)
    return large[first : first + shape[0], first : first + shape[1]] * np.float32(_SPREAD)


def _noise_band(seed: tuple[int, ...], rows: tuple[int, int], columns: int, width_px: int) -> np.ndarray:
    """Return rows [first, last) of endless noise (_, columns) with spread about 1 and bumps width_px wide."""
    first, last = rows[0] // width_px - 2, -(-rows[1] // width_px) + 2
    cells = -(-columns // width_px) + 4
    small = _white(seed, first, last, cells)
    if width_px == 1:
        return small[2:-2, 2 : 2 + columns]
    large = cv2.resize(small, None, fx=width_px, fy=width_px, interpolation=cv2.INTER_CUBIC) * np.float32(_SPREAD)
    skip = rows[0] - first * width_px
    return large[skip : skip + rows[1] - rows[0], 2 * width_px : 2 * width_px + columns]


def _noise_sparks(seed: tuple[int, ...], rows: tuple[int, int], columns: int, share: float) -> np.ndarray:
    """Return rows [first, last) of an endless picture. A share of its pixels is in (0.3, 1], the others are 0."""
    first = rows[0] // _BLOCK
    drawn = np.zeros((((rows[1] - 1) // _BLOCK + 1 - first) * _BLOCK, columns), np.float32)
    for block in range(first, first + len(drawn) // _BLOCK):
        rng = np.random.default_rng([*seed, block + _FIRST])
        at = rng.integers(0, _BLOCK * columns, rng.poisson(min(share, 1) * _BLOCK * columns))
        drawn[(block - first) * _BLOCK :][:_BLOCK].reshape(-1)[at] = 1 - 0.7 * rng.random(len(at), np.float32)
    skip = rows[0] - first * _BLOCK
    return drawn[skip : skip + rows[1] - rows[0]]


def enlarge_rows(coarse: np.ndarray, rows: tuple[int, int], factor: int, smooth: bool = False) -> np.ndarray:
    """Return rows [first, last) of a coarse field (h, w) enlarged `factor` times. Results do not depend on the cut.

    smooth: cubic interpolation, which has no creases and takes three times as long.
    """
    first, last = rows[0] // factor - 3, -(-rows[1] // factor) + 3
    at = np.clip(np.arange(first, last), 0, len(coarse) - 1)
    how = cv2.INTER_CUBIC if smooth else cv2.INTER_LINEAR
    large = cv2.resize(coarse[at], None, fx=factor, fy=factor, interpolation=how)
    skip = rows[0] - first * factor
    return large[skip : skip + rows[1] - rows[0]]


def _white(seed: tuple[int, ...], first: int, last: int, columns: int) -> np.ndarray:
    """Return rows [first, last) of endless noise (_, columns), independent and uniform within +-1.73 (spread 1)."""
    parts = []
    for block in range(first // _BLOCK, (last - 1) // _BLOCK + 1):
        part = np.random.default_rng([*seed, block + _FIRST]).integers(0, 256, (_BLOCK, columns), np.uint8)
        parts.append(part[max(first - block * _BLOCK, 0) : last - block * _BLOCK])
    # Drawing bytes is ten times as fast as drawing normal numbers. Their spread is 256 / sqrt(12).
    return (np.concatenate(parts) - np.float32(127.5)) * np.float32(12**0.5 / 256)
