"""Shortcuts of the onboard engine against the plain way, and its work at half the resolution."""

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import pytest

from tests.synthetic_clip import flight, render
from torchvision_dddas.config import load_config, with_parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.detection import opencv_engine as onboard_half
from torchvision_dddas.detection import opencv_foreground as onboard_pixels
from torchvision_dddas.detection.blobs import close_mask
from torchvision_dddas.detection.engine import Foreground, View, Window
from torchvision_dddas.detection.opencv_engine import OpenCVEngine
from torchvision_dddas.detection.opencv_foreground import find_foreground
from torchvision_dddas.geometry import background_flow, corner_error, transfer
from torchvision_dddas.types import Frame

SIZE = (320, 240)


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return render(seed=1, frames=14, size=SIZE).images


@pytest.fixture(scope="module")
def truth() -> list[np.ndarray]:
    """later_from_earlier of successive frames, on the ground."""
    ground = [view.image_from_ground for view in flight(1, 14, SIZE)]
    return [later @ np.linalg.inv(earlier) for earlier, later in pairwise(ground)]


def homography(perspective: float) -> np.ndarray:
    return np.array([[1.002, 0.004, 3.3], [-0.003, 0.998, -2.6], [perspective, -perspective, 1.0]])


def textured(size: tuple[int, int] = SIZE, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (size[1], size[0])).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]


@pytest.mark.parametrize("perspective", [0.0, 1e-7, 1e-6, 1e-5, 3e-5, 1e-3])
def test_a_warp_by_tiles_is_the_perspective_warp_but_for_rounding(perspective: float) -> None:
    picture, matrix = textured(), homography(perspective)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    whole = cv2.warpPerspective(picture, matrix, SIZE, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    off = np.abs(onboard_pixels.warp(picture, matrix).astype(int) - whole)
    assert off.max() <= 2 and off.mean() < 0.1


@pytest.mark.parametrize("border", [0, 4, 9])
@pytest.mark.parametrize("perspective", [0.0, 1e-5, 5e-4])
def test_the_view_as_a_polygon_is_the_view_of_every_pixel_but_for_its_border(perspective: float, border: int) -> None:
    matrix = homography(perspective) @ np.array([[0.9, 0.2, 20], [-0.2, 0.9, 40], [0, 0, 1.0]])
    width, height = SIZE
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    place = transfer(matrix, np.c_[u.ravel(), v.ravel()]).reshape(height, width, 2)
    low, high = np.array([border, border]), np.array([width - 1 - border, height - 1 - border])
    each = np.asarray(((place >= low) & (place <= high)).all(axis=2)).astype(np.uint8)
    ours = onboard_pixels.find_seen(matrix, SIZE, border) > 0
    cross = np.ones((3, 3), np.uint8)
    assert not ((cv2.erode(each, cross) > 0) & ~ours).any()
    assert not (ours & (cv2.dilate(each, cross) == 0)).any()


@pytest.mark.parametrize("size", [(320, 240), (33, 64), (40, 65), (50, 129), (3, 3)])
def test_gradients_and_corners_in_strips_are_those_of_the_whole(size: tuple[int, int]) -> None:
    grey = textured(size)
    across, down = (cv2.Sobel(grey, cv2.CV_32F, *order, scale=0.5) for order in ((1, 0), (0, 1)))
    whole = cv2.blur(cv2.convertScaleAbs(cv2.magnitude(across, down)), (5, 5))
    assert np.array_equal(onboard_pixels.measure_texture(grey), whole)
    for block in (3, 5, 7):
        corners = cv2.cornerMinEigenVal(grey, block, ksize=3)
        np.testing.assert_allclose(onboard_half.measure_corners(grey, block), corners, rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize("side", [1, 3, 4, 15, 25])
@pytest.mark.parametrize("seed", range(6))
def test_closing_only_where_something_is_is_closing_everywhere(seed: int, side: int) -> None:
    rng = np.random.default_rng(seed)
    mask = np.zeros(tuple(rng.integers(17, 400, 2)), np.uint8)
    for _ in range(rng.integers(0, 8)):
        row, column = rng.integers(0, mask.shape[0]), rng.integers(0, mask.shape[1])
        mask[row : row + rng.integers(1, 25), column : column + rng.integers(1, 25)] = 255
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    assert np.array_equal(close_mask(mask, side), cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel))


@pytest.mark.parametrize("config", [None, "fast", "half"])
def test_registrations_follow_the_ground(images: list[np.ndarray], truth: list[np.ndarray], config: str | None) -> None:
    engine = OpenCVEngine(load_config(config, ["registration.keypoints=300"] if config == "half" else []))
    views = [engine.prepare(image) for image in images]
    steps = engine.register(list(pairwise(views)))
    assert all(step.reliable for step in steps)
    off = [corner_error(step.later_from_earlier, true, SIZE) for step, true in zip(steps, truth, strict=True)]
    assert np.median(off) < 0.5 and max(off) < 1.5
    flow = [background_flow(true, SIZE) for true in truth]
    np.testing.assert_allclose([step.flow_px for step in steps], flow, atol=0.3)


def test_a_jump_that_no_prediction_foresees_is_found_by_the_deep_search(images: list[np.ndarray]) -> None:
    engine = OpenCVEngine(load_config("fast"))
    big = textured((480, 360), 5)
    views = [engine.prepare(big[40:280, 40 + x : 360 + x].copy()) for x in (0, 1, 2, 3, 33)]
    steps = [engine.register([pair])[0] for pair in pairwise(views)]
    assert steps[-1].reliable
    assert corner_error(steps[-1].later_from_earlier, np.array([[1, 0, -30], [0, 1, 0], [0, 0, 1.0]]), SIZE) < 0.1


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (2, 9), (8, 6)])
def test_any_size_is_halved_and_made_whole_again(size: tuple[int, int]) -> None:
    grey = np.full((size[1], size[0]), 9, np.uint8)
    half = onboard_half.halve_view(View(grey, grey))
    assert half.size == (max(size[0] // 2, 1), max(size[1] // 2, 1))
    assert np.array_equal(onboard_half.double(half.grey, size), grey)


@pytest.mark.parametrize("size", [(161, 121), SIZE])
def test_every_kind_of_difference_and_refinement_can_be_halved(size: tuple[int, int]) -> None:
    settings = with_parameters(load_config(), {"difference.halved": True, "registration.halved": True})
    frames = (Frame(i + 1, i / 10, image) for i, image in enumerate(render(seed=2, frames=6, size=size).images))
    found = list(detect_motion(frames, settings, OpenCVEngine(settings)))
    assert len(found) == 6 and all(scene.mask.shape == size[::-1] for scene in found)


def test_a_chain_that_only_looks_for_blobs_keeps_half_maps_and_finds_what_double_maps_show(
    images: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = load_config("half", ["gates.min_area_px=60"])

    def found() -> list[np.ndarray]:
        frames = (Frame(i + 1, i / 10, image) for i, image in enumerate(images[:10]))
        return [scene.mask for scene in detect_motion(frames, settings, OpenCVEngine(settings))]

    def whole(engine: OpenCVEngine, windows: Sequence[Window]) -> list[Foreground]:
        half = onboard_half.halve_settings(engine.parameters)
        maps = [find_foreground(onboard_half.halve_window(window), half) for window in windows]
        return [
            onboard_half.double_maps(m, window.reference.size, False) for m, window in zip(maps, windows, strict=True)
        ]

    halves = found()
    monkeypatch.setattr(OpenCVEngine, "foreground", whole)
    wholes = found()
    assert any(mask.any() for mask in halves)
    for half, other in zip(halves, wholes, strict=True):
        np.testing.assert_array_equal(half, other)


@pytest.mark.parametrize("seed", range(8))
def test_the_median_over_a_mask_is_numpys_where_it_exceeds_the_least(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.integers(0, rng.integers(8, 80), (40, 51)).astype(np.uint8)
    mask = np.where(rng.random(values.shape) < 0.6, 255, 0).astype(np.uint8)
    assert onboard_pixels.median_above(values, mask, 16) == max(16, float(np.median(values[mask > 0])))
