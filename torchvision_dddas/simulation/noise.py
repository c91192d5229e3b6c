"""Noise of which a landscape is made: smooth bumps of a width, and sums of them.

Fine noise is drawn by blocks of rows, each from its own seed, so that a large ground can be made in bands that join.
"""

import cv2
import numpy as np

_BLOCK = 64  # rows of noise that share a seed
_FIRST = 1_000_000  # seeds are not negative, and a margin has rows above the first
_SPREAD = 1.35  # makes up for what interpolation between independent numbers takes from their spread, and more


def bumps(rng: np.random.Generator, shape: tuple[int, int], width_px: float) -> np.ndarray:
    """(H, W) float32 of mean 0 and standard deviation about 1: smooth noise whose bumps are about width_px wide."""
    if width_px <= 1:
        return rng.standard_normal(shape, np.float32)
    cells = [int(np.ceil(n / width_px)) + 3 for n in shape]
    small = rng.standard_normal(cells, np.float32)
    large = cv2.resize(small, None, fx=width_px, fy=width_px, interpolation=cv2.INTER_CUBIC)
    # A cell is left out at the edges, where the enlargement repeats the outermost value.
    first = int(width_px)
    return large[first : first + shape[0], first : first + shape[1]] * np.float32(_SPREAD)


def fractal(
    rng: np.random.Generator, shape: tuple[int, int], widest_px: float, narrowest_px: float, fall: float = 0.5
) -> np.ndarray:
    """(H, W) float32 of spread about 1: bumps of halving widths, each octave `fall` times the one before."""
    total, power, height, width = np.zeros(shape, np.float32), 0.0, 1.0, widest_px
    while width >= narrowest_px or power == 0:
        total += np.float32(height) * bumps(rng, shape, width)
        power, height, width = power + height**2, height * fall, width / 2
    return total / np.float32(np.sqrt(power))


def band(seed: tuple[int, ...], rows: tuple[int, int], columns: int, width_px: int) -> np.ndarray:
    """Rows [first, last) of an endless (_, columns) noise with spread about 1 whose bumps are width_px wide."""
    first, last = rows[0] // width_px - 2, -(-rows[1] // width_px) + 2
    cells = -(-columns // width_px) + 4
    small = _white(seed, first, last, cells)
    if width_px == 1:
        return small[2:-2, 2 : 2 + columns]
    large = cv2.resize(small, None, fx=width_px, fy=width_px, interpolation=cv2.INTER_CUBIC) * np.float32(_SPREAD)
    skip = rows[0] - first * width_px
    return large[skip : skip + rows[1] - rows[0], 2 * width_px : 2 * width_px + columns]


def sparks(seed: tuple[int, ...], rows: tuple[int, int], columns: int, share: float) -> np.ndarray:
    """Rows [first, last) of an endless picture that is 0 but for a share of its pixels, which are in (0.3, 1]."""
    first = rows[0] // _BLOCK
    drawn = np.zeros((((rows[1] - 1) // _BLOCK + 1 - first) * _BLOCK, columns), np.float32)
    for block in range(first, first + len(drawn) // _BLOCK):
        rng = np.random.default_rng([*seed, block + _FIRST])
        at = rng.integers(0, _BLOCK * columns, rng.poisson(min(share, 1) * _BLOCK * columns))
        drawn[(block - first) * _BLOCK :][:_BLOCK].reshape(-1)[at] = 1 - 0.7 * rng.random(len(at), np.float32)
    skip = rows[0] - first * _BLOCK
    return drawn[skip : skip + rows[1] - rows[0]]


def enlarged(coarse: np.ndarray, rows: tuple[int, int], factor: int, smooth: bool = False) -> np.ndarray:
    """Rows [first, last) of a coarse field (h, w) enlarged `factor` times, the same however it is cut.

    smooth: without creases, and three times as slow.
    """
    first, last = rows[0] // factor - 3, -(-rows[1] // factor) + 3
    at = np.clip(np.arange(first, last), 0, len(coarse) - 1)
    how = cv2.INTER_CUBIC if smooth else cv2.INTER_LINEAR
    large = cv2.resize(coarse[at], None, fx=factor, fy=factor, interpolation=how)
    skip = rows[0] - first * factor
    return large[skip : skip + rows[1] - rows[0]]


def _white(seed: tuple[int, ...], first: int, last: int, columns: int) -> np.ndarray:
    """Rows [first, last) of an endless (_, columns) picture of independent numbers, even in +-1.73: spread 1."""
    parts = []
    for block in range(first // _BLOCK, (last - 1) // _BLOCK + 1):
        part = np.random.default_rng([*seed, block + _FIRST]).integers(0, 256, (_BLOCK, columns), np.uint8)
        parts.append(part[max(first - block * _BLOCK, 0) : last - block * _BLOCK])
    # Bytes are drawn ten times as fast as normal numbers; their spread is 256 / sqrt(12).
    return (np.concatenate(parts) - np.float32(127.5)) * np.float32(12**0.5 / 256)
