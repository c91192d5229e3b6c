"""Hue, saturation, value, and ranges of them."""

import cv2
import numpy as np
import pytest
import torch

from torchvision_dddas.functional import hsv


def every_colour(step: int = 5) -> np.ndarray:
    """(1, N, 3) uint8 BGR."""
    level = np.unique(np.append(np.arange(0, 256, step), 255)).astype(np.uint8)
    return np.stack(np.meshgrid(level, level, level, indexing="ij"), -1).reshape(1, -1, 3)


def converted(image: np.ndarray) -> torch.Tensor:
    return hsv.from_bgr(torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255)


@pytest.mark.parametrize(
    ("bgr", "wanted"),
    [
        ((0, 0, 1), (0, 255, 255)),
        ((0, 1, 0), (60, 255, 255)),
        ((1, 0, 0), (120, 255, 255)),
        ((0, 0.5, 1), (15, 255, 255)),
        ((0.5, 0, 1), (165, 255, 255)),
        ((0.2, 0.2, 0.4), (0, 127.5, 102)),
        ((0.5, 0.5, 0.5), (0, 0, 127.5)),
        ((0, 0, 0), (0, 0, 0)),
    ],
)
def test_colours_worked_by_hand(bgr, wanted):
    found = hsv.from_bgr(torch.tensor(bgr, dtype=torch.float64).reshape(1, 3, 1, 1))
    torch.testing.assert_close(found.flatten(), torch.tensor(wanted, dtype=torch.float64), atol=1e-3, rtol=0)


def test_every_colour_is_within_one_unit_of_opencv():
    image = every_colour()
    wanted = cv2.cvtColor(image, cv2.COLOR_BGR2HSV).astype(float)
    off = np.abs(converted(image)[0].permute(1, 2, 0).numpy() - wanted)
    off[..., 0] = np.minimum(off[..., 0], 180 - off[..., 0])
    assert off.max() < 1
    assert off[..., 2].max() < 1e-3


RANGES = (
    torch.tensor([[10.0, 80, 60], [170, 100, 0], [0, 0, 200], [100, 255, 50]]),
    torch.tensor([[25.0, 255, 255], [8, 255, 255], [180, 60, 255], [130, 255, 255]]),
)


def test_hard_ranges_are_those_of_opencv_but_for_colours_that_it_rounds_across_a_bound():
    image = every_colour(3)
    of_opencv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    found = hsv.within(converted(image), *RANGES)[0].numpy()
    assert set(np.unique(found)) == {0, 1}
    for mask, low, high in zip(found, *(bound.numpy() for bound in RANGES), strict=True):
        if low[0] <= high[0]:
            wanted = cv2.inRange(of_opencv, low, high)
        else:
            first = cv2.inRange(of_opencv, low, high * 0 + 255)
            wanted = np.maximum(first, cv2.inRange(of_opencv, low * np.array([0, 1, 1], np.float32), high))
        assert 0.0005 < (wanted > 0).mean() < 0.9
        assert ((wanted > 0) != (mask > 0.5)).mean() < 0.002


def test_a_range_that_goes_over_zero_holds_both_of_its_ends_and_not_what_lies_between():
    hues = torch.tensor([0.0, 5, 8, 9, 90, 169, 170, 175, 179.9]).reshape(1, 1, 1, -1)
    pixels = torch.cat([hues, torch.full_like(hues, 200), torch.full_like(hues, 200)], 1)
    low, high = torch.tensor([[170.0, 100, 100]]), torch.tensor([[8.0, 255, 255]])
    assert hsv.within(pixels, low, high).flatten().tolist() == [1, 1, 1, 0, 0, 0, 1, 1, 1]


def test_soft_ranges_tend_to_hard_ones_as_softness_vanishes():
    pixels = converted(every_colour(17))
    hard = hsv.within(pixels, *RANGES)
    away = [(hsv.within(pixels, *RANGES, softness=softness) - hard).abs().mean() for softness in (3.0, 0.3, 0.03)]
    assert away[0] > away[1] > away[2] and away[2] < 0.01


def test_no_ranges_give_no_masks():
    assert hsv.within(torch.zeros(2, 3, 4, 5), torch.zeros(0, 3), torch.zeros(0, 3)).shape == (2, 0, 4, 5)


def test_a_batch_is_the_same_as_one_picture_after_the_other():
    pictures = torch.rand(3, 3, 6, 7, generator=torch.Generator().manual_seed(0))
    together = hsv.within(hsv.from_bgr(pictures), *RANGES, softness=2.0)
    for k in range(3):
        alone = hsv.within(hsv.from_bgr(pictures[k : k + 1]), *RANGES, softness=2.0)
        torch.testing.assert_close(together[k : k + 1], alone)


def test_gradients_of_colours_and_of_bounds_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(1)
    picture = (0.1 + 0.8 * torch.rand(1, 3, 2, 3, generator=generator, dtype=torch.float64)).requires_grad_()
    low, high = (bound[:2].double().requires_grad_() for bound in RANGES)
    assert torch.autograd.gradcheck(lambda p, a, b: hsv.within(hsv.from_bgr(p), a, b, 20.0), (picture, low, high))


def test_gradients_of_grey_and_black_are_finite():
    picture = torch.tensor([0.0, 0.5, 1.0]).repeat(3, 1).reshape(1, 3, 1, 3).requires_grad_()
    hsv.within(hsv.from_bgr(picture), *RANGES, softness=20.0).sum().backward()
    assert picture.grad is not None and torch.isfinite(picture.grad).all()
