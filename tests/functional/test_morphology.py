"""Erosion and dilation against OpenCV, bit for bit, and softened."""

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

import torchvision_dddas.functional as F

OPERATIONS = {
    cv2.MORPH_DILATE: F.dilation,
    cv2.MORPH_ERODE: F.erosion,
    cv2.MORPH_OPEN: F.opening,
    cv2.MORPH_CLOSE: F.closing,
}
SHAPES = {"rectangle": cv2.MORPH_RECT, "ellipse": cv2.MORPH_ELLIPSE}
ELEMENTS = [((1, 1), "ellipse"), ((4, 7), "rectangle"), ((5, 5), "ellipse"), ((25, 25), "ellipse")]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", [1, 2, 3, 4, 7, 8, 25, (5, 9), (10, 3), (1, 7), (7, 1), (3, 2), (41, 41)])
@pytest.mark.parametrize("operation", OPERATIONS)
def test_bit_exact_with_opencv_on_masks_and_grey(texture, shape, size, operation):
    element = cv2.getStructuringElement(SHAPES[shape], size if isinstance(size, tuple) else (size, size))
    for picture in (texture(1, 37, 53), (texture(2, 90, 121) > 128).astype(np.uint8) * 255):
        found = OPERATIONS[operation](torch.from_numpy(picture)[None, None], F.structuring_element(shape, size))
        assert found.dtype == torch.uint8
        np.testing.assert_array_equal(found[0, 0].numpy(), cv2.morphologyEx(picture, operation, element))


def picture(seed: int = 0, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(2, 1, 17, 30, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_a_soft_maximum_is_the_log_sum_exp_over_the_element() -> None:
    x = picture()
    around = x[0, 0, 8:13, 13:18][F.structuring_element("ellipse", 5) > 0]
    wanted = 0.3 * torch.logsumexp(around / 0.3, 0)
    torch.testing.assert_close(F.dilation(x, F.structuring_element("ellipse", 5), softness=0.3)[0, 0, 10, 15], wanted)


@pytest.mark.parametrize(("size", "shape"), ELEMENTS)
@pytest.mark.parametrize("operation", [F.dilation, F.erosion, F.closing])
def test_a_hard_extremum_sends_its_gradient_to_the_pixel_that_decides(operation, size, shape) -> None:
    """As the chain of maxima does where no two pixels are equal, at less memory."""
    x, weight = picture(3).requires_grad_(), picture(4)
    kernel = F.structuring_element(shape, size)
    result = operation(x, kernel)
    (routed,) = torch.autograd.grad((result * weight).sum(), x)
    through_all = x.detach().double().requires_grad_()
    hard = operation(through_all, kernel)
    (wanted,) = torch.autograd.grad((hard * weight).sum(), through_all)
    # float32 where a gradient is wanted: values are compared in steps of a 500,000th of their span
    torch.testing.assert_close(result.detach().double(), hard.detach(), atol=2e-5, rtol=0)
    torch.testing.assert_close(routed.double(), wanted, atol=1e-5, rtol=1e-5)


def test_equal_pixels_of_either_sign_give_the_hard_result_and_a_finite_gradient() -> None:
    x = torch.tensor([[-0.0, 0.0, -2.0, 5.0, 5.0], [-3.0, -3.0, 0.0, -0.0, 1.0]])[None, None].requires_grad_()
    result = F.dilation(x, torch.ones(3, 3))
    assert torch.equal(result, F.dilation(x.detach(), torch.ones(3, 3)))
    (slope,) = torch.autograd.grad(result.sum(), x)
    assert float(slope.sum()) == result.numel()
    soft = F.erosion(x, torch.ones(3, 3), softness=0.01)
    assert bool(torch.autograd.grad(soft.sum(), x)[0].isfinite().all())
