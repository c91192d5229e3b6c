"""The onboard engine against OpenCV and NumPy, and at half the resolution."""

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import pytest

from tests.synthetic_clip import flight, render
from torchvision_dddas.chain import close_mask
from torchvision_dddas.chain import opencv_operations as onboard_pixels
from torchvision_dddas.config import load_config, with_parameters
from torchvision_dddas.detection import Foreground, Window, detect_motion
from torchvision_dddas.detection import opencv_engine as onboard_half
from torchvision_dddas.detection.opencv_engine import OpenCVEngine, OpenCVView
from torchvision_dddas.geometry import background_flow, corner_error, transfer
from torchvision_dddas.types import Frame

SIZE = (320, 240)


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return render(seed=1, frames=14, size=SIZE).images


def homography(perspective: float) -> np.ndarray:
    return np.array([[1.002, 0.004, 3.3], [-0.003, 0.998, -2.6], [perspective, -perspective, 1.0]])


def textured(size: tuple[int, int] = SIZE, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (size[1], size[0])).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]


@pytest.mark.parametrize("perspective", [0.0, 1e-7, 1e-6, 1e-5, 3e-5, 1e-3])
def test_a_warp_by_tiles_is_opencvs_up_to_rounding(perspective: float) -> None:
    picture, matrix = textured(), homography(perspective)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    whole = cv2.warpPerspective(picture, matrix, SIZE, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    off = np.abs(onboard_pixels.warp(picture, matrix).astype(int) - whole)
    assert off.max() <= 2 and off.mean() < 0.1


@pytest.mark.parametrize("border", [0, 4, 9])
@pytest.mark.parametrize("perspective", [0.0, 1e-5, 5e-4])
def test_the_visible_polygon_matches_the_transfer_of_every_pixel(perspective: float, border: int) -> None:
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
def test_gradients_and_corners_in_strips_are_opencvs(size: tuple[int, int]) -> None:
    grey = textured(size)
    across, down = (cv2.Sobel(grey, cv2.CV_32F, *order, scale=0.5) for order in ((1, 0), (0, 1)))
    whole = cv2.blur(cv2.convertScaleAbs(cv2.magnitude(across, down)), (5, 5))
    assert np.array_equal(onboard_pixels.measure_texture(grey), whole)
    for block in (3, 5, 7):
        corners = cv2.cornerMinEigenVal(grey, block, ksize=3)
        np.testing.assert_allclose(onboard_half.measure_corners(grey, block), corners, rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize("side", [1, 3, 4, 15, 25])
@pytest.mark.parametrize("seed", range(6))
def test_local_closing_is_opencvs_closing(seed: int, side: int) -> None:
    rng = np.random.default_rng(seed)
    mask = np.zeros(tuple(rng.integers(17, 400, 2)), np.uint8)
    for _ in range(rng.integers(0, 8)):
        row, column = rng.integers(0, mask.shape[0]), rng.integers(0, mask.shape[1])
        mask[row : row + rng.integers(1, 25), column : column + rng.integers(1, 25)] = 255
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    assert np.array_equal(close_mask(mask, side), cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel))


@pytest.mark.parametrize("config", [None, "fast", "half"])
def test_registrations_match_the_motion_of_the_ground(images: list[np.ndarray], config: str | None) -> None:
    ground = [view.image_from_ground for view in flight(1, len(images), SIZE)]
    truth = [later @ np.linalg.inv(earlier) for earlier, later in pairwise(ground)]
    engine = OpenCVEngine(load_config(config, ["registration.keypoints=300"] if config == "half" else []))
    steps = engine.register(list(pairwise([engine.prepare(image) for image in images])))
    assert all(step.reliable for step in steps)
    off = [corner_error(step.later_from_earlier, true, SIZE) for step, true in zip(steps, truth, strict=True)]
    assert np.median(off) < 0.5 and max(off) < 1.5
    flow = [background_flow(true, SIZE) for true in truth]
    np.testing.assert_allclose([step.flow_px for step in steps], flow, atol=0.3)


def test_an_unpredicted_jump_is_registered(images: list[np.ndarray]) -> None:
    engine = OpenCVEngine(load_config("fast"))
    big = textured((480, 360), 5)
    views = [engine.prepare(big[40:280, 40 + x : 360 + x].copy()) for x in (0, 1, 2, 3, 33)]
    steps = [engine.register([pair])[0] for pair in pairwise(views)]
    assert steps[-1].reliable
    assert corner_error(steps[-1].later_from_earlier, np.array([[1, 0, -30], [0, 1, 0], [0, 0, 1.0]]), SIZE) < 0.1


@pytest.mark.parametrize(
    ("size", "config", "changed"),
    [
        ((251, 187), None, {"difference.halved": True, "registration.halved": True}),
        (SIZE, "half", {"gates.min_area_px": 60}),  # stays at half the resolution
    ],
)
def test_differences_and_registration_can_be_halved(size, config, changed) -> None:
    settings = with_parameters(load_config(config), changed)
    frames = (Frame(i + 1, i / 10, image) for i, image in enumerate(render(seed=2, frames=8, size=size).images))
    found = list(detect_motion(frames, settings, OpenCVEngine(settings)))
    assert len(found) == 8 and all(scene.mask.shape == size[::-1] for scene in found)
    assert any(scene.mask.any() for scene in found)


@pytest.mark.parametrize("seed", range(8))
def test_the_masked_median_is_numpys_above_its_minimum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.integers(0, rng.integers(8, 80), (40, 51)).astype(np.uint8)
    mask = np.where(rng.random(values.shape) < 0.6, 255, 0).astype(np.uint8)
    assert onboard_pixels.median_above(values, mask, 16) == max(16, float(np.median(values[mask > 0])))


def test_registration_at_half_the_size_has_the_whole_pictures_pixels(images: list[np.ndarray]) -> None:
    ground = [view.image_from_ground for view in flight(1, 14, SIZE)]
    truth = [later @ np.linalg.inv(earlier) for earlier, later in pairwise(ground)]
    engine = OpenCVEngine(load_config("half", ["registration.keypoints=300"]))
    views = [engine.prepare(image) for image in images]
    steps = [engine.register([pair])[0] for pair in pairwise(views)]
    assert all(step.reliable for step in steps)
    off = [corner_error(step.later_from_earlier, true, SIZE) for step, true in zip(steps, truth, strict=True)]
    assert np.median(off) < 0.5
    flow = [step.flow_px for step in OpenCVEngine(load_config("fast")).register(list(pairwise(views)))]
    assert np.allclose([step.flow_px for step in steps], flow, atol=0.3)


def test_half_maps_give_the_masks_of_doubled_maps(images: list[np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    settings = load_config("half", ["gates.min_area_px=60"])

    def found() -> list[np.ndarray]:
        frames = (Frame(i + 1, i / 10, image) for i, image in enumerate(images))
        return [scene.mask for scene in detect_motion(frames, settings, OpenCVEngine(settings))]

    def whole(engine: OpenCVEngine, windows: Sequence[Window[OpenCVView]]) -> list[Foreground]:
        half = onboard_half.halve_settings(engine.parameters)
        maps = [onboard_half.find_foreground(onboard_half.halve_window(window), half) for window in windows]
        return [
            onboard_half.double_maps(m, window.reference.size, False) for m, window in zip(maps, windows, strict=True)
        ]

    halves = found()
    monkeypatch.setattr(OpenCVEngine, "foreground", whole)
    wholes = found()
    assert any(mask.any() for mask in halves)
    for half, other in zip(halves, wholes, strict=True):
        np.testing.assert_array_equal(half, other)
