"""Half the resolution: the same places, the same targets."""

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import pytest

from tests.synthetic_clip import flight, render
from torchvision_dddas.config import load_config, with_parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.detection import opencv_engine as onboard_half
from torchvision_dddas.detection.engine import Foreground, View, Window
from torchvision_dddas.detection.opencv_engine import OpenCVEngine
from torchvision_dddas.detection.opencv_foreground import find_foreground
from torchvision_dddas.geometry import corner_error
from torchvision_dddas.types import Frame

SIZE = (320, 240)


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return render(seed=1, frames=10, size=SIZE).images


def textured(size: tuple[int, int]) -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (size[1], size[0])).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]


def test_a_pixel_of_the_half_picture_is_the_mean_of_four() -> None:
    grey = textured((8, 6))
    mean = grey.reshape(3, 2, 4, 2).mean(axis=(1, 3))
    assert np.abs(onboard_half.halve_view(View(grey, grey)).grey - mean).max() <= 0.5


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (2, 9), (8, 6)])
def test_any_size_is_halved_and_made_whole_again(size: tuple[int, int]) -> None:
    grey = np.full((size[1], size[0]), 9, np.uint8)
    half = onboard_half.halve_view(View(grey, grey))
    assert half.size == (max(size[0] // 2, 1), max(size[1] // 2, 1))
    assert np.array_equal(onboard_half._double(half.grey, size), grey)


def test_the_half_picture_is_made_once() -> None:
    view = View(textured(SIZE), textured(SIZE))
    assert onboard_half.halve_view(view) is onboard_half.halve_view(view)


def test_registration_at_half_the_size_has_the_whole_pictures_pixels(images: list[np.ndarray]) -> None:
    ground = [view.image_from_ground for view in flight(1, 10, SIZE)]
    truth = [later @ np.linalg.inv(earlier) for earlier, later in pairwise(ground)]
    engine = OpenCVEngine(load_config("half", ["registration.keypoints=300"]))
    views = [engine.prepare(image) for image in images]
    steps = [engine.register([pair])[0] for pair in pairwise(views)]
    assert all(step.reliable for step in steps)
    off = [corner_error(step.later_from_earlier, true, SIZE) for step, true in zip(steps, truth, strict=True)]
    assert np.median(off) < 0.5
    flow = [step.flow_px for step in OpenCVEngine(load_config("fast")).register(list(pairwise(views)))]
    assert np.allclose([step.flow_px for step in steps], flow, atol=0.3)


def test_targets_found_at_half_the_size_lie_where_those_of_the_whole_size_do(images: list[np.ndarray]) -> None:
    def masks(config: str) -> list[np.ndarray]:
        settings = load_config(config, ["gates.min_area_px=60"])
        frames = (Frame(i + 1, i / 10, image) for i, image in enumerate(images))
        return [scene.mask > 0 for scene in detect_motion(frames, settings, OpenCVEngine(settings))]

    both = [(a, b) for a, b in zip(masks("fast"), masks("half"), strict=True) if a.any() and b.any()]
    assert len(both) >= 5
    assert np.median([(a & b).sum() / (a | b).sum() for a, b in both]) > 0.6


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
        frames = (Frame(i + 1, i / 10, image) for i, image in enumerate(images))
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
