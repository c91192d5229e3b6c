"""Gaussian smoothing and reflection against OpenCV."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.functional import filters
from torchvision_dddas.functional.filters import reflect_index


@pytest.mark.parametrize(
    ("size", "sigma"), [(1, None), (3, None), (5, None), (7, None), (9, None), (13, None), (5, 1.3), (31, 4.0)]
)
@pytest.mark.parametrize("shape", [(37, 53), (120, 160)])
def test_agrees_with_opencv_to_a_thousandth_of_a_grey_level(texture, tensor, size, sigma, shape):
    picture = tensor(texture(0, *shape))
    wanted = cv2.GaussianBlur(picture[0, 0].numpy(), (size, size), sigma or 0)
    assert (filters.gaussian(picture, size, sigma)[0, 0] - torch.from_numpy(wanted)).abs().max() < 1e-3 / 255


def test_a_point_spreads_into_the_kernel():
    point = torch.zeros(1, 1, 7, 7)
    point[..., 3, 3] = 16.0
    assert torch.equal(filters.gaussian(point, 3)[0, 0, 2:5, 2:5], torch.tensor([[1.0, 2, 1], [2, 4, 2], [1, 2, 1]]))


def test_a_picture_smaller_than_the_kernel_is_mirrored_again_and_again():
    picture = torch.rand(1, 1, 2, 3, generator=torch.Generator().manual_seed(0))
    wanted = cv2.GaussianBlur(picture[0, 0].numpy(), (9, 9), 2.0)
    torch.testing.assert_close(filters.gaussian(picture, 9, 2.0)[0, 0], torch.from_numpy(wanted), atol=1e-6, rtol=0)


def test_gradients_are_those_of_finite_differences():
    picture = torch.rand(1, 1, 5, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: filters.gaussian(x, 3), (picture,))


@pytest.mark.parametrize("shape", [(120, 160), (61, 87), (2, 3), (1, 1)])
@pytest.mark.parametrize("size", [1, 3, 5, 7, 9])
def test_smoothed_levels_are_opencvs(texture, size, shape):
    picture = texture(0, 120, 160)[: shape[0], : shape[1]].copy()
    picture[: shape[0] // 2] = 255  # the largest sum there is
    smoothed = filters.gaussian_levels(torch.from_numpy(picture)[None, None], size)[0, 0].numpy()
    np.testing.assert_array_equal(smoothed, cv2.GaussianBlur(picture, (size, size), 0))


@pytest.mark.parametrize("size", [11, 31])
def test_widely_smoothed_levels_are_opencvs_to_a_level(texture, size):
    picture = texture(0, 61, 87)
    smoothed = filters.gaussian_levels(torch.from_numpy(picture)[None, None], size)[0, 0].numpy().astype(int)
    assert np.abs(smoothed - cv2.GaussianBlur(picture, (size, size), 0)).max() <= 1


@given(st.integers(1, 30), st.integers(-80, 80), st.integers(0, 60))
def test_reflection_is_opencvs_101_as_often_as_it_takes(length, first, count):
    wanted = [cv2.borderInterpolate(place, length, cv2.BORDER_REFLECT_101) for place in range(first, first + count)]
    assert reflect_index(torch.arange(first, first + count), length).tolist() == wanted
