"""Finders of colours: OpenCV's ranges onboard, and the same by torch."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.geo.colours import ColourFinder, load_colours

LOW = np.array([[170, 80, 60], [10, 80, 60], [55, 40, 40], [0, 0, 0]], float)
HIGH = np.array([[8, 255, 255], [30, 255, 255], [65, 255, 200], [180, 255, 90]], float)


@pytest.fixture(scope="module", params=["onboard", "torch"])
def finder(request) -> ColourFinder:
    if request.param == "torch":
        pytest.importorskip("torch")
    return load_colours(request.param)


def picture(height: int = 120, width: int = 160) -> np.ndarray:
    random = np.random.default_rng(0)
    patches = random.integers(0, 256, (height // 10, width // 10, 3)).astype(np.float32)
    return cv2.resize(patches, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def by_in_range(image: np.ndarray) -> np.ndarray:
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    masks = [cv2.inRange(hsv, low, high) for low, high in zip(LOW, HIGH, strict=True)]
    ends = cv2.inRange(hsv, LOW[0], np.array([180.0, 255, 255])), cv2.inRange(hsv, LOW[0] * (0, 1, 1), HIGH[0])
    return np.stack([np.maximum(*ends), *masks[1:]])


def test_masks_are_those_of_opencv_also_for_a_hue_that_goes_over_zero(finder):
    image = picture()
    found, wanted = finder.masks(image, LOW, HIGH), by_in_range(image)
    assert found.dtype == np.uint8 and found.shape == (4, 120, 160) and set(np.unique(found)) == {0, 255}
    assert ((wanted > 0).mean((1, 2)) > 0.002).all()
    assert (found != wanted).mean() <= (0 if finder.name == "onboard" else 0.002)


def test_large_pictures_are_looked_at_in_parts_that_leave_no_trace():
    image = picture(700, 900)
    np.testing.assert_array_equal(load_colours("onboard").masks(image, LOW, HIGH), by_in_range(image))
    wide = picture(20, 140_000 // 10 * 10)
    np.testing.assert_array_equal(load_colours("onboard").masks(wide, LOW, HIGH), by_in_range(wide))


def test_no_ranges_and_no_pixels_give_empty_masks(finder):
    assert finder.masks(picture(), LOW[:0], HIGH[:0]).shape == (0, 120, 160)
    assert finder.masks(np.zeros((0, 5, 3), np.uint8), LOW, HIGH).shape == (4, 0, 5)
