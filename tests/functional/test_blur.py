"""Gaussian smoothing against OpenCV."""

import cv2
import pytest
import torch

from torchvision_dddas.functional import blur


@pytest.mark.parametrize(
    ("size", "sigma"), [(1, None), (3, None), (5, None), (7, None), (9, None), (13, None), (5, 1.3), (31, 4.0)]
)
@pytest.mark.parametrize("shape", [(37, 53), (120, 160)])
def test_agrees_with_opencv_to_a_thousandth_of_a_grey_level(texture, tensor, size, sigma, shape):
    picture = tensor(texture(0, *shape))
    wanted = cv2.GaussianBlur(picture[0, 0].numpy(), (size, size), sigma or 0)
    assert (blur.gaussian(picture, size, sigma)[0, 0] - torch.from_numpy(wanted)).abs().max() < 1e-3 / 255


def test_a_point_spreads_into_the_kernel():
    point = torch.zeros(1, 1, 7, 7)
    point[..., 3, 3] = 16.0
    assert torch.equal(blur.gaussian(point, 3)[0, 0, 2:5, 2:5], torch.tensor([[1.0, 2, 1], [2, 4, 2], [1, 2, 1]]))


def test_a_batch_of_colours_is_the_same_as_each_plane_alone():
    pictures = torch.rand(2, 3, 37, 53, generator=torch.Generator().manual_seed(0))
    together = blur.gaussian(pictures, 5)
    for clip in range(2):
        for colour in range(3):
            alone = blur.gaussian(pictures[clip : clip + 1, colour : colour + 1], 5)
            assert torch.equal(together[clip, colour], alone[0, 0])


def test_a_picture_smaller_than_the_kernel_is_mirrored_again_and_again():
    picture = torch.rand(1, 1, 2, 3, generator=torch.Generator().manual_seed(0))
    wanted = cv2.GaussianBlur(picture[0, 0].numpy(), (9, 9), 2.0)
    torch.testing.assert_close(blur.gaussian(picture, 9, 2.0)[0, 0], torch.from_numpy(wanted), atol=1e-6, rtol=0)


def test_gradients_are_those_of_finite_differences():
    picture = torch.rand(1, 1, 5, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: blur.gaussian(x, 3), (picture,))
