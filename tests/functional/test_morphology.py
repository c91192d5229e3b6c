"""Erosion and dilation against OpenCV, bit for bit, and softened."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from torchvision_dddas.functional import morphology

SIZES = [1, 2, 3, 4, 5, 7, 8, 15, 25, (5, 9), (10, 3), (1, 7), (7, 1), (3, 2), (41, 41)]
OPERATIONS = {
    cv2.MORPH_DILATE: morphology.dilate,
    cv2.MORPH_ERODE: morphology.erode,
    cv2.MORPH_OPEN: morphology.opening,
    cv2.MORPH_CLOSE: morphology.closing,
}
SHAPES = {"rectangle": cv2.MORPH_RECT, "ellipse": cv2.MORPH_ELLIPSE}


def pair(size: int | tuple[int, int]) -> tuple[int, int]:
    return size if isinstance(size, tuple) else (size, size)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("operation", OPERATIONS)
def test_bit_exact_with_opencv_on_masks_and_grey(texture, shape, size, operation):
    element = cv2.getStructuringElement(SHAPES[shape], pair(size))
    for picture in (texture(1, 37, 53), (texture(2, 90, 121) > 128).astype(np.uint8) * 255):
        wanted = cv2.morphologyEx(picture, operation, element)
        found = OPERATIONS[operation](torch.from_numpy(picture)[None, None], size, shape)
        assert found.dtype == torch.uint8
        assert np.array_equal(found[0, 0].numpy(), wanted)


def test_one_pixel_grows_into_a_square_and_shrinks_back():
    mask = torch.zeros(1, 1, 5, 5, dtype=torch.bool)
    mask[..., 2, 2] = True
    grown = morphology.dilate(mask, 3)
    assert grown.sum() == 9 and grown[..., 1:4, 1:4].all()
    assert torch.equal(morphology.erode(grown, 3), mask)


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
    soft = getattr(morphology, name)
    misses = [float((soft(x, size, shape, softness) - hard).abs().max()) for softness in (0.4, 0.1, 0.02, 0.002)]
    assert misses[-1] < 0.02
    assert all(after <= before + 1e-12 for before, after in pairwise(misses))
    assert torch.equal(soft(x, size, shape), hard)


def test_a_soft_maximum_is_the_log_sum_exp_over_the_element() -> None:
    x = picture()
    rows = morphology.element_rows(5, 5, "ellipse")
    around = torch.cat([x[0, 0, 8 + k, 13 + first : 13 + last] for k, (first, last) in enumerate(rows)])
    wanted = 0.3 * torch.logsumexp(around / 0.3, 0)
    torch.testing.assert_close(morphology.dilate(x, 5, "ellipse", 0.3)[0, 0, 10, 15], wanted)


@pytest.mark.parametrize(("size", "shape"), SIZES)
@pytest.mark.parametrize("name", ["dilate", "erode", "closing"])
def test_a_hard_extremum_sends_its_gradient_to_the_pixel_that_decides(
    name: str, size: tuple[int, int], shape: morphology.Shape
) -> None:
    """As the chain of maxima does where no two pixels are equal, at less memory."""
    x = picture(3).requires_grad_()
    weight = picture(4)
    result = getattr(morphology, name)(x, size, shape)
    (routed,) = torch.autograd.grad((result * weight).sum(), x)
    through_all = x.detach().double().requires_grad_()
    hard = getattr(morphology, name)(through_all, size, shape)
    (wanted,) = torch.autograd.grad((hard * weight).sum(), through_all)
    # float32 where a gradient is wanted: values are compared in steps of a 500,000th of their span
    torch.testing.assert_close(result.detach().double(), hard.detach(), atol=2e-5, rtol=0)
    torch.testing.assert_close(routed.double(), wanted, atol=1e-5, rtol=1e-5)


def test_equal_pixels_of_either_sign_give_the_hard_result_and_a_finite_gradient() -> None:
    x = torch.tensor([[-0.0, 0.0, -2.0, 5.0, 5.0], [-3.0, -3.0, 0.0, -0.0, 1.0]])[None, None].requires_grad_()
    result = morphology.dilate(x, 3)
    assert torch.equal(result, morphology.dilate(x.detach(), 3))
    (slope,) = torch.autograd.grad(result.sum(), x)
    assert float(slope.sum()) == result.numel()
    soft = morphology.erode(x, 3, "rectangle", 0.01)
    assert bool(torch.autograd.grad(soft.sum(), x)[0].isfinite().all())
