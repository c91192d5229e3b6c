"""Measure batched operations of `functional` beside Kornia's operations for the same work."""

import time
from collections.abc import Callable

import cv2
import kornia
import numpy as np
import torch

import torchvision_dddas.functional as F

Call = Callable[[], object]
Size = tuple[int, int]

MATRIX = np.array([[1.01, 0.02, -7.3], [-0.015, 0.99, 4.2], [2e-5, -3e-5, 1]])
"""The homography that warps the pictures."""


def random_pictures(size: Size, batch: int) -> np.ndarray:
    """Return (B, H, W, 3) uint8 smoothed noise."""
    random = np.random.default_rng(0)
    coloured = random.integers(0, 256, (batch, size[1], size[0], 3), np.uint8)
    return np.stack([cv2.GaussianBlur(picture, (0, 0), 2) for picture in coloured])


def to_grey(coloured: np.ndarray) -> np.ndarray:
    """Return (B, H, W) uint8 grey levels of BGR pictures."""
    return np.stack([cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) for picture in coloured])


def brightest(grey: np.ndarray) -> np.ndarray:
    """Return (B, H, W) uint8, 1 in the brightest tenth of the pictures."""
    return (grey > np.percentile(grey, 90)).astype(np.uint8)


def kornia_pairs(coloured: np.ndarray, device: str) -> dict[str, tuple[Call, Call]]:
    """Return {operation: (our call, Kornia's call)} for a batch (B, H, W, 3) of BGR pictures on a device."""
    height, width = coloured.shape[1:3]
    grey = to_grey(coloured)
    bytes_ = torch.from_numpy(grey)[:, None].to(device)
    levels = bytes_.float()
    bgr = torch.from_numpy(coloured).to(device).permute(0, 3, 1, 2).float().div(255).contiguous()
    rgb = bgr.flip(1)
    masks = torch.from_numpy(brightest(grey))[:, None].to(device)
    matrices = torch.from_numpy(MATRIX).float().expand(len(grey), 3, 3).to(device)
    smaller = (height * 2 // 3, width * 2 // 3)
    box_blur, sobel = kornia.filters.box_blur, kornia.filters.sobel

    def kornia_corners() -> object:
        du, dv = kornia.filters.spatial_gradient(levels).unbind(2)
        uu, vv, uv = (box_blur(product, 5) for product in (du * du, dv * dv, du * dv))
        return (uu + vv - ((uu - vv).square() + 4 * uv.square()).sqrt()) / 2

    def morphology(side: int, name: str) -> tuple[Call, Call]:
        kernel = F.structuring_element("ellipse", side)
        ones = kernel.float().to(device)
        return (
            lambda: getattr(F, name)(masks, kernel),
            lambda: getattr(kornia.morphology, name)(masks.float(), ones),
        )

    def blurred() -> object:
        return kornia.filters.gaussian_blur2d(levels, 7, (1.4, 1.4))

    return {
        "warp (ours: Kornia's remap)": (
            lambda: F.warp_perspective(levels, matrices, (height, width)),
            lambda: kornia.geometry.warp_perspective(levels, matrices, (height, width)),
        ),
        "resize to two thirds": (
            lambda: F.resize(levels, smaller, rounded=True),
            lambda: kornia.geometry.resize(levels, smaller),
        ),
        "Gaussian 7, floats (ours: Kornia's)": (lambda: F.gaussian_blur2d(levels, 7), blurred),
        "Gaussian 7, bytes (ours: Kornia's and conversions)": (lambda: F.gaussian_blur2d(bytes_, 7), blurred),
        "gradient, box mean 5": (
            lambda: F.mean_gradient(levels),
            lambda: box_blur(sobel(levels, normalized=False), 5),
        ),
        "smaller eigenvalue 5": (lambda: F.corner_min_eigenvalue(levels, block=5), kornia_corners),
        "pyramid of 4": (
            lambda: F.build_pyramid(levels, 4),
            lambda: kornia.geometry.build_pyramid(levels, 4),
        ),
        "erosion 3": morphology(3, "erosion"),
        "closing 15": morphology(15, "closing"),
        "RGB to HSV": (lambda: F.bgr_to_hsv(bgr), lambda: kornia.color.rgb_to_hsv(rgb)),
    }


def measure_operations(size: Size, batch: int, seconds: float, device: str) -> dict[str, tuple[float, float]]:
    """Return {operation: (our milliseconds per picture, Kornia's)}, medians of alternating calls."""
    pairs = kornia_pairs(random_pictures(size, batch), device)
    found = {}
    for name, calls in pairs.items():
        spent: list[list[float]] = []
        end = time.perf_counter() + seconds / len(pairs)
        while len(spent) < 2 or (time.perf_counter() < end and len(spent) < 50):
            spent.append([_timed(call, device) for call in calls])
        ours, kornias = (1e3 * np.median(spent[1:], axis=0) / batch).tolist()  # the first round warms up
        found[name] = ours, kornias
    return found


def _timed(call: Call, device: str) -> float:
    start = time.perf_counter()
    with torch.inference_mode():
        call()
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - start
