"""Soft stand-ins of hard steps tend to them as softness vanishes."""

import pytest
import torch

from torchvision_dddas.functional import morphology, soft
from torchvision_dddas.functional.filters import gaussian
from torchvision_dddas.functional.soft import (
    blend_sizes,
    gate_regions,
    gates_of_pixels,
    round_straight_through,
    straight_through,
)


def test_the_hard_step_is_one_above_zero_only():
    assert torch.equal(soft.step(torch.tensor([-1.0, 0.0, 1e-6, 2.0])), torch.tensor([0.0, 0.0, 1.0, 1.0]))


def test_soft_threshold_tends_to_hard_as_softness_vanishes():
    x = torch.tensor([-0.3, -0.01, 0.01, 0.3])
    gaps = [(soft.step(x, softness) - soft.step(x)).abs().max() for softness in (1.0, 0.1, 0.01, 1e-4)]
    assert gaps == sorted(gaps, reverse=True)
    assert gaps[-1] < 1e-6


def test_only_the_soft_step_passes_gradients():
    x = torch.linspace(-1, 1, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda y: soft.step(y, 0.2), (x,))
    assert not soft.step(x).requires_grad


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


def test_a_size_that_the_operation_takes_gives_its_result() -> None:
    x = torch.rand(1, 1, 20, 20)
    for side in (1, 3, 4):
        wanted = morphology.erode(x, side, "ellipse")
        assert torch.equal(blend_sizes(float(side), lambda k: morphology.erode(x, k, "ellipse")), wanted)
        assert torch.equal(blend_sizes(torch.tensor(float(side)), lambda k: morphology.erode(x, k, "ellipse")), wanted)


def test_between_two_sizes_results_are_blended_by_nearness() -> None:
    x = torch.rand(1, 1, 20, 20)
    found = blend_sizes(torch.tensor(5.5, dtype=torch.float64), lambda k: gaussian(x, k), pitch=2)
    torch.testing.assert_close(found, 0.75 * gaussian(x, 5) + 0.25 * gaussian(x, 7))
    torch.testing.assert_close(blend_sizes(5.5, lambda k: gaussian(x, k), pitch=2), found)


def test_a_larger_element_erodes_more_and_the_gradient_says_so() -> None:
    x = torch.rand(1, 1, 20, 20)
    side = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    blend_sizes(side, lambda k: morphology.erode(x, k, "ellipse")).sum().backward()
    assert side.grad is not None and float(side.grad) < 0


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


def test_soft_gates_tend_to_hard_ones() -> None:
    hard = gate_regions(MASK, EVIDENCE, LABELS, 2, 2.5, 6.95)
    misses = [
        float((gate_regions(MASK, EVIDENCE, LABELS, 2, 2.5, 6.95, s) - hard).abs().max()) for s in (0.5, 0.05, 5e-4)
    ]
    assert misses[0] > misses[1] > misses[2] and misses[2] < 1e-6


def test_gates_have_the_right_gradient_in_mask_evidence_and_bounds() -> None:
    mask = (MASK * 0.8).requires_grad_()
    evidence = EVIDENCE + torch.rand(EVIDENCE.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    area, peak = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (3.0, 6.0))
    assert torch.autograd.gradcheck(
        lambda m, e, a, p: gate_regions(m, e, LABELS, 2, a, p, 0.3), (mask, evidence.requires_grad_(), area, peak)
    )


def test_each_pixel_has_the_gate_of_its_region_and_none_has_none() -> None:
    picture = gates_of_pixels(torch.tensor([[0.5, 0.25], [1.0, 0.0]]), LABELS)
    assert float(picture[0, 0, 1, 1]) == 0.5 and float(picture[0, 0, 4, 6]) == 0.25 and float(picture[0, 0, 0, 0]) == 0
    assert float(picture[1].sum()) == 3.0


def test_no_regions_give_no_gates() -> None:
    none = gate_regions(MASK, EVIDENCE, torch.zeros_like(LABELS), 0, 300, 7.0)
    assert none.shape == (2, 0)
    assert not gates_of_pixels(none, torch.zeros_like(LABELS)).any()
