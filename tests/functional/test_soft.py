"""Soft stand-ins of hard steps: their values, their gradients, and gates of regions."""

import pytest
import torch

import torchvision_dddas.functional as F
from torchvision_dddas.functional import (
    blend_sizes,
    gate_regions,
    gates_of_pixels,
    round_straight_through,
    straight_through,
)


def test_the_value_is_the_hard_one_and_the_gradient_the_soft_ones() -> None:
    x = torch.tensor([0.1, 0.7, 1e-9], requires_grad=True)
    result = straight_through((x > 0.5).float(), torch.sigmoid(x))
    assert torch.equal(result.detach(), torch.tensor([0.0, 1.0, 0.0]))
    (slope,) = torch.autograd.grad(result.sum(), x)
    (wanted,) = torch.autograd.grad(torch.sigmoid(x).sum(), x)
    assert torch.equal(slope, wanted)


def test_rounding_is_numpys_and_passes_every_gradient() -> None:
    x = torch.tensor([0.5, 1.5, 2.4, -0.6], requires_grad=True)
    assert round_straight_through(x).tolist() == [0.0, 2.0, 2.0, -1.0]
    (slope,) = torch.autograd.grad(round_straight_through(x).sum(), x)
    assert slope.tolist() == [1.0] * 4


def test_between_two_sizes_results_are_blended_by_nearness_and_a_size_that_is_taken_is_not() -> None:
    x = torch.rand(1, 1, 20, 20)
    for size in (5.5, torch.tensor(5.5, dtype=torch.float64)):
        found = blend_sizes(size, lambda k: F.gaussian_blur2d(x, k), pitch=2)
        torch.testing.assert_close(found, 0.75 * F.gaussian_blur2d(x, 5) + 0.25 * F.gaussian_blur2d(x, 7))
    for side in (1, 3, 4):
        wanted = F.erosion(x, F.structuring_element("ellipse", side))
        for size in (float(side), torch.tensor(float(side))):
            assert torch.equal(blend_sizes(size, lambda k: F.erosion(x, F.structuring_element("ellipse", k))), wanted)


LABELS = torch.zeros(2, 1, 6, 8, dtype=torch.int64)
LABELS[0, 0, 1:3, 1:5] = 1  # 8 pixels
LABELS[0, 0, 4, 6] = 2  # 1 pixel
LABELS[1, 0, 0, :3] = 1
MASK = (LABELS > 0).double()
EVIDENCE = torch.zeros(2, 1, 6, 8, dtype=torch.float64)
EVIDENCE[0, 0, 2, 2], EVIDENCE[0, 0, 4, 6], EVIDENCE[1, 0, 0, 1] = 7.0, 9.0, 6.9


@pytest.mark.parametrize(
    ("min_area_px", "peak", "wanted"),
    [
        (1, 0.0, [[1, 1], [1, 0]]),
        (8, 0.0, [[1, 0], [0, 0]]),
        (9, 0.0, [[0, 0], [0, 0]]),
        (1, 7.0, [[1, 1], [0, 0]]),
        (1, 7.01, [[0, 1], [0, 0]]),
    ],
)
def test_a_region_of_just_the_area_and_just_the_peak_passes(
    min_area_px: float, peak: float, wanted: list[list[int]]
) -> None:
    assert gate_regions(MASK, EVIDENCE, LABELS, 2, min_area_px, peak).tolist() == wanted


def test_each_pixel_has_the_gate_of_its_region_and_none_has_none() -> None:
    picture = gates_of_pixels(torch.tensor([[0.5, 0.25], [1.0, 0.0]]), LABELS)
    assert float(picture[0, 0, 1, 1]) == 0.5 and float(picture[0, 0, 4, 6]) == 0.25 and float(picture[0, 0, 0, 0]) == 0
    assert float(picture[1].sum()) == 3.0
