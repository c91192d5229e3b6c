"""Hue, saturation, value, ranges of them, and histograms of boxes."""

import math

import cv2
import numpy as np
import pytest
import torch

import torchvision_dddas.functional as F
from torchvision_dddas.tracking import rgb_histograms


def every_colour(step: int = 5) -> np.ndarray:
    """(1, N, 3) uint8 BGR."""
    level = np.unique(np.append(np.arange(0, 256, step), 255)).astype(np.uint8)
    return np.stack(np.meshgrid(level, level, level, indexing="ij"), -1).reshape(1, -1, 3)


def converted(image: np.ndarray) -> torch.Tensor:
    return F.bgr_to_hsv(torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255)


def test_every_colour_is_within_one_unit_of_opencv():
    image = every_colour()
    off = np.abs(converted(image)[0].permute(1, 2, 0).numpy() - cv2.cvtColor(image, cv2.COLOR_BGR2HSV).astype(float))
    off[..., 0] = np.minimum(off[..., 0], 180 - off[..., 0])
    assert off.max() < 1 and off[..., 2].max() < 1e-3


RANGES = (
    torch.tensor([[10.0, 80, 60], [170, 100, 0], [0, 0, 200], [100, 255, 50]]),
    torch.tensor([[25.0, 255, 255], [8, 255, 255], [180, 60, 255], [130, 255, 255]]),
)


def test_hard_ranges_are_those_of_opencv_but_for_colours_that_it_rounds_across_a_bound():
    image = every_colour(3)
    of_opencv, found = cv2.cvtColor(image, cv2.COLOR_BGR2HSV), F.within_ranges(converted(image), *RANGES)[0].numpy()
    assert set(np.unique(found)) == {0, 1}
    for mask, low, high in zip(found, *(bound.numpy() for bound in RANGES), strict=True):
        if low[0] <= high[0]:
            wanted = cv2.inRange(of_opencv, low, high)
        else:
            first = cv2.inRange(of_opencv, low, high * 0 + 255)
            wanted = np.maximum(first, cv2.inRange(of_opencv, low * np.array([0, 1, 1], np.float32), high))
        assert 0.0005 < (wanted > 0).mean() < 0.9
        assert ((wanted > 0) != (mask > 0.5)).mean() < 0.002


def test_gradients_of_grey_and_black_are_finite_and_no_ranges_give_no_masks():
    picture = torch.tensor([0.0, 0.5, 1.0]).repeat(3, 1).reshape(1, 3, 1, 3).requires_grad_()
    F.within_ranges(F.bgr_to_hsv(picture), *RANGES, softness=20.0).sum().backward()
    assert picture.grad is not None and torch.isfinite(picture.grad).all()
    assert F.within_ranges(picture, torch.zeros(0, 3), torch.zeros(0, 3)).shape == (1, 0, 1, 3)


def picture(seed: int = 0, batch: int = 2, height: int = 24, width: int = 32) -> torch.Tensor:
    """8-bit levels as floats in [0, 1]."""
    return torch.randint(0, 256, (batch, 3, height, width), generator=torch.Generator().manual_seed(seed)) / 255.0


def boxes(*rows: tuple[float, float, float, float]) -> torch.Tensor:
    return torch.tensor([rows], dtype=torch.float32)


def given_as_valid(box_px: torch.Tensor) -> torch.Tensor:
    return torch.ones(box_px.shape[:2], dtype=torch.bool)


def test_four_pixels_by_hand():
    image = torch.zeros(1, 3, 2, 2)
    image[0, :, 0, 0] = torch.tensor([255, 10, 0]) / 255
    image[0, :, 0, 1] = torch.tensor([255, 20, 0]) / 255
    found, valid = F.rgb_histogram(image, boxes((0, 0, 2, 1)), torch.tensor([[True]]))
    red, green, blue = found[0, 0].view(3, 256)
    assert valid.all()
    assert (red[255], green[10], green[20], blue[0]) == (1, 0.5, 0.5, 1)
    assert found.sum() == 3


def test_counts_are_those_of_opencv_and_of_the_torch_free_twin():
    image = picture()
    box_px = boxes((3, 2, 10, 12), (-4.6, 5.5, 9.2, 30), (20, 18, 40, 40), (0, 0, 32, 24)).repeat(2, 1, 1)
    found, _ = F.rgb_histogram(image, box_px, given_as_valid(box_px), normalize=False)
    for picked in range(2):
        bgr = np.ascontiguousarray((image[picked] * 255).round().byte().permute(1, 2, 0).numpy()[..., ::-1])
        np.testing.assert_array_equal(found[picked].numpy(), rgb_histograms(bgr, box_px[picked].numpy()))
        # x from 20 to the border, y from 18 to the border; channel 2 of BGR is red
        red = cv2.calcHist([bgr[18:, 20:]], [2], None, [256], [0, 256])[:, 0]
        np.testing.assert_array_equal(found[picked, 2, :256].numpy(), red)


def test_reading_no_more_than_the_largest_box_changes_nothing_and_a_larger_box_is_refused():
    image, box_px = picture(), boxes((3, 2, 10, 12), (30, 20, 10, 12), (0, 0, 11, 5)).repeat(2, 1, 1)
    whole, _ = F.rgb_histogram(image, box_px, given_as_valid(box_px))
    small, valid = F.rgb_histogram(image, box_px, given_as_valid(box_px), largest=(12, 10))
    assert valid.tolist() == [[True, True, False]] * 2
    assert torch.equal(small[:, :2], whole[:, :2]) and not small[:, 2].any()


@pytest.mark.parametrize("box", [(5, 5, 9, 0.4), (5, 5, -3, 9), (40, 5, 9, 9), (-9, 5, 9, 9), (math.nan, 5, 9, 9)])
def test_a_box_without_a_pixel_is_zeros_and_not_valid(box):
    found, valid = F.rgb_histogram(picture(batch=1), boxes(box, (5, 5, 9, 9)), torch.tensor([[True, True]]))
    assert valid.tolist() == [[False, True]]
    assert not found[0, 0].any()
    assert found[0, 1].sum() == pytest.approx(3, abs=1e-5)
    assert not rgb_histograms(np.zeros((24, 32, 3), np.uint8), np.array([box])).any()
