"""Pictures of our own making: smoothed noise with hard-edged patches, seen twice through a known homography."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch

MARGIN = 40


def draw_texture(seed: int, height: int, width: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    total = np.zeros((height, width), np.float32)
    for scale in (1.2, 2.5, 6, 15):
        noise = cv2.GaussianBlur(random.standard_normal((height, width)).astype(np.float32), (0, 0), scale)
        total += noise / noise.std() * scale**0.5
    for _ in range(height * width // 4000):
        x, y = int(random.integers(width)), int(random.integers(height))
        w, h = random.integers(6, 40, 2).tolist()
        total[y : y + h, x : x + w] += random.normal(0, 3)
    smoothed = cv2.GaussianBlur(total, (0, 0), 0.8)
    low, high = np.percentile(smoothed, (1, 99))
    return ((smoothed - low) / (high - low) * 235 + 10).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def texture() -> Callable[[int, int, int], np.ndarray]:
    """(seed, height, width) -> uint8 grey picture."""
    return draw_texture


@pytest.fixture(scope="session")
def two_views() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """(seed, height, width, later_from_earlier) -> two uint8 views of one plane, no borders in sight."""

    def make(seed: int, height: int, width: int, later_from_earlier: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ground = draw_texture(seed, height + 2 * MARGIN, width + 2 * MARGIN)
        into = np.array([[1, 0, -MARGIN], [0, 1, -MARGIN], [0, 0, 1]], float)
        later = cv2.warpPerspective(ground, later_from_earlier @ into, (width, height), flags=cv2.INTER_CUBIC)
        return ground[MARGIN : MARGIN + height, MARGIN : MARGIN + width].copy(), later

    return make


@pytest.fixture(scope="session")
def tensor() -> Callable[[np.ndarray], torch.Tensor]:
    """Grey uint8 picture -> (1, 1, H, W) float32 in [0, 1]."""
    return lambda picture: torch.from_numpy(picture.astype(np.float32) / 255)[None, None]
