"""Noise of which a landscape is made: smooth bumps of a width, and sums of them.

Fine noise is drawn by blocks of rows, each from its own seed, so that a large ground can be made in bands that join.
"""

import cv2
import numpy as np

_BLOCK = 64  # rows of noise that share a seed


def bumps(rng: np.random.Generator, shape: tuple[int, int], width_px: float) -> np.ndarray:
    """(H, W) float32 of mean 0 and standard deviation 1: smooth noise whose bumps are about width_px wide."""
    if width_px <= 1:
        return rng.standard_normal(shape, np.float32)
    cells = [int(np.ceil(n / width_px)) + 3 for n in shape]
    small = rng.standard_normal(cells, np.float32)
    large = cv2.resize(small, None, fx=width_px, fy=width_px, interpolation=cv2.INTER_CUBIC)
    # A cell is left out at the edges, where the enlargement repeats the outermost value.
    first = int(width_px)
    return large[first : first + shape[0], first : first + shape[1]] * np.float32(_SPREAD)


_SPREAD = 1 / 0.74  # what cubic interpolation between independent numbers takes from their spread


def fractal(
    rng: np.random.Generator, shape: tuple[int, int], widest_px: float, narrowest_px: float, fall: float = 0.5
) -> np.ndarray:
    """(H, W) float32 with standard deviation 1: bumps of halving widths, each octave `fall` as high as the wider one."""
    total, power, height, width = np.zeros(shape, np.float32), 0.0, 1.0, widest_px
    while width >= narrowest_px or power == 0:
        total += np.float32(height) * bumps(rng, shape, width)
        power, height, width = power + height**2, height * fall, width / 2
    return total / np.float32(np.sqrt(power))


def band(seed: tuple[int, ...], rows: tuple[int, int], columns: int, width_px: int) -> np.ndarray:
    """Rows [first, last) of an endless (_, columns) noise with spread 1 whose bumps are width_px wide."""
    first, last = rows[0] // width_px - 2, -(-rows[1] // width_px) + 2
    cells = -(-columns // width_px) + 4
    small = _white(seed, first, last, cells)
    if width_px == 1:
        return small[2:-2, 2 : 2 + columns]
    large = cv2.resize(small, None, fx=width_px, fy=width_px, interpolation=cv2.INTER_CUBIC) * np.float32(_SPREAD)
    skip = rows[0] - first * width_px
    return large[skip : skip + rows[1] - rows[0], 2 * width_px : 2 * width_px + columns]


def sparks(seed: tuple[int, ...], rows: tuple[int, int], columns: int, share: np.ndarray | float) -> np.ndarray:
    """Rows [first, last) of an endless picture that is 0 but for a share of its pixels, which are in (0, 1]."""
    drawn = _white(seed, rows[0], rows[1], columns, uniform=True)
    return np.where(drawn < share, 1 - drawn / np.maximum(share, 1e-9), 0).astype(np.float32)


def enlarged(coarse: np.ndarray, rows: tuple[int, int], factor: int) -> np.ndarray:
    """Rows [first, last) of a coarse field (h, w) enlarged `factor` times: smooth, and the same however it is cut."""
    first, last = rows[0] // factor - 3, -(-rows[1] // factor) + 3
    at = np.clip(np.arange(first, last), 0, len(coarse) - 1)
    large = cv2.resize(coarse[at], None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    skip = rows[0] - first * factor
    return large[skip : skip + rows[1] - rows[0]]


def _white(seed: tuple[int, ...], first: int, last: int, columns: int, uniform: bool = False) -> np.ndarray:
    parts = []
    for block in range(first // _BLOCK, (last - 1) // _BLOCK + 1):
        rng = np.random.default_rng([*seed, block + 1_000_000])
        shape = (_BLOCK, columns)
        part = rng.random(shape, np.float32) if uniform else rng.standard_normal(shape, np.float32)
        parts.append(part[max(first - block * _BLOCK, 0) : last - block * _BLOCK])
    return np.concatenate(parts)
