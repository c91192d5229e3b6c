from itertools import pairwise

import pytest
import torch
from torch import Tensor

from torchvision_dddas.functional import morphology
from torchvision_dddas.functional.soft import morphology as extremum

SIZES = [((1, 1), "ellipse"), ((3, 3), "ellipse"), ((4, 7), "rectangle"), ((5, 5), "ellipse"), ((25, 25), "ellipse")]


def picture(seed: int = 0, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(2, 1, 17, 30, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize(("size", "shape"), SIZES)
@pytest.mark.parametrize("name", ["dilate", "erode", "closing", "opening"])
def test_a_soft_extremum_tends_to_the_hard_one_as_softness_vanishes(
    name: str, size: tuple[int, int], shape: morphology.Shape
) -> None:
    x = picture(dtype=torch.float64)
    hard = getattr(morphology, name)(x, size, shape)
    soft = getattr(extremum, name)
    misses = [float((soft(x, size, shape, softness) - hard).abs().max()) for softness in (0.4, 0.1, 0.02, 0.002)]
    assert misses[-1] < 0.02
    assert all(after <= before + 1e-12 for before, after in pairwise(misses))
    assert torch.equal(soft(x, size, shape), hard)


def test_a_soft_maximum_is_the_log_sum_exp_over_the_element() -> None:
    x = picture()
    rows = morphology.element_rows(5, 5, "ellipse")
    around = torch.cat([x[0, 0, 8 + k, 13 + first : 13 + last] for k, (first, last) in enumerate(rows)])
    wanted = 0.3 * torch.logsumexp(around / 0.3, 0)
    torch.testing.assert_close(extremum.dilate(x, 5, "ellipse", 0.3)[0, 0, 10, 15], wanted)


@pytest.mark.parametrize("size", [1, 2, 3, 6, 7, 13, 25])
def test_a_flat_picture_grows_by_the_logarithm_of_the_elements_pixels(size: int) -> None:
    flat = torch.full((1, 1, 60, 60), 0.5, dtype=torch.float64)
    count = sum(last - first for first, last in morphology.element_rows(size, size, "ellipse"))
    middle = extremum.dilate(flat, size, "ellipse", 0.1)[0, 0, 30, 30]
    assert float(middle) == pytest.approx(0.5 + 0.1 * torch.log(torch.tensor(float(count))).item(), abs=1e-6)


@pytest.mark.parametrize("name", ["dilate", "erode"])
def test_soft_extrema_have_the_right_gradient(name: str) -> None:
    x = picture(dtype=torch.float64)[:1, :, :6, :7].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda t: getattr(extremum, name)(t, (3, 4), "ellipse", 0.3), (x,))


@pytest.mark.parametrize(("size", "shape"), SIZES)
@pytest.mark.parametrize("name", ["dilate", "erode", "closing"])
def test_a_hard_extremum_sends_its_gradient_to_the_pixel_that_decides(
    name: str, size: tuple[int, int], shape: morphology.Shape
) -> None:
    """As the chain of maxima does where no two pixels are equal, at less memory."""
    x = picture(3).requires_grad_()
    weight = picture(4)
    result = getattr(extremum, name)(x, size, shape)
    (routed,) = torch.autograd.grad((result * weight).sum(), x)
    through_all = x.detach().double().requires_grad_()
    hard = getattr(morphology, name)(through_all, size, shape)
    (wanted,) = torch.autograd.grad((hard * weight).sum(), through_all)
    # float32 where a gradient is wanted: values are compared in steps of a 500,000th of their span
    torch.testing.assert_close(result.detach().double(), hard.detach(), atol=2e-5, rtol=0)
    torch.testing.assert_close(routed.double(), wanted, atol=1e-5, rtol=1e-5)


def test_equal_pixels_of_either_sign_give_the_hard_result_and_a_finite_gradient() -> None:
    x = torch.tensor([[-0.0, 0.0, -2.0, 5.0, 5.0], [-3.0, -3.0, 0.0, -0.0, 1.0]])[None, None].requires_grad_()
    result = extremum.dilate(x, 3)
    assert torch.equal(result, morphology.dilate(x.detach(), 3))
    (slope,) = torch.autograd.grad(result.sum(), x)
    assert float(slope.sum()) == result.numel()
    soft = extremum.erode(x, 3, "rectangle", 0.01)
    assert bool(torch.autograd.grad(soft.sum(), x)[0].isfinite().all())
