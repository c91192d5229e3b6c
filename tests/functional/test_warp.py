"""The perspective warp against OpenCV."""

import cv2
import numpy as np
import pytest
import torch

from torchvision_dddas.functional import warp

MOTION = np.array([[1.01, 0.02, 3.3], [-0.015, 0.99, -4.6], [1e-5, -2e-5, 1.0]])


def matrix(values: np.ndarray, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.from_numpy(values).to(dtype)[None]


@pytest.mark.parametrize("shape", [(37, 53), (240, 320)])
def test_agrees_with_opencv_to_a_grey_level_inside(texture, tensor, shape):
    picture = texture(0, *shape)
    wanted = torch.from_numpy(cv2.warpPerspective(picture, MOTION, shape[::-1])).double()
    # OpenCV rounds positions to 1/32 px and the result to whole grey levels; nothing else differs.
    found, inside = warp.warp(tensor(picture).double(), matrix(MOTION, torch.float64), subpixels=32)
    apart = (found[0, 0] * 255 - wanted).abs()[inside[0, 0]]
    assert inside.float().mean() > 0.7
    assert apart.quantile(0.999) < 0.6
    # A position that falls on a rounding limit may go either way.
    assert (apart > 1).float().mean() < 1e-4


def test_without_rounding_positions_nearly_all_pixels_agree_to_a_grey_level(texture, tensor):
    picture = texture(0, 240, 320)
    wanted = torch.from_numpy(cv2.warpPerspective(picture, MOTION, (320, 240)))
    found, inside = warp.warp(tensor(picture), matrix(MOTION))
    apart = (found[0, 0] * 255 - wanted).abs()[inside[0, 0]]
    assert apart.mean() < 0.5
    assert (apart > 1).float().mean() < 0.05


def test_the_identity_returns_the_picture_and_all_of_it_is_inside(texture, tensor):
    picture = tensor(texture(0, 37, 53))
    found, inside = warp.warp(picture, torch.eye(3)[None])
    torch.testing.assert_close(found, picture, atol=1e-5, rtol=0)
    assert inside.all()


def test_a_shift_of_two_pixels_by_hand():
    picture = torch.arange(12.0).reshape(1, 1, 3, 4)
    found, inside = warp.warp(picture, torch.tensor([[[1.0, 0, 2], [0, 1, 0], [0, 0, 1]]]), fill=-1.0)
    torch.testing.assert_close(
        found[0, 0], torch.tensor([[-1.0, -1, 0, 1], [-1, -1, 4, 5], [-1, -1, 8, 9]]), atol=1e-5, rtol=0
    )
    assert torch.equal(inside[0, 0], torch.tensor([[False, False, True, True]] * 3))


def test_inside_means_that_all_four_source_pixels_are(tensor):
    half = torch.tensor([[[1.0, 0, 0.5], [0, 1, 0], [0, 0, 1]]])
    _, inside = warp.warp(torch.ones(1, 1, 3, 5), half)
    assert inside[0, 0, 1].tolist() == [False, True, True, True, True]


def test_the_size_may_differ_from_the_frames(texture, tensor):
    picture = texture(0, 60, 80)
    wanted = torch.from_numpy(cv2.warpPerspective(picture, MOTION, (50, 41)))
    found, inside = warp.warp(tensor(picture), matrix(MOTION), size=(41, 50))
    assert found.shape == (1, 1, 41, 50)
    assert (found[0, 0] * 255 - wanted).abs()[inside[0, 0]].mean() < 0.5


def test_nothing_behind_the_horizon_is_inside():
    tilted = torch.tensor([[[1.0, 0, 0], [0, 1, 0], [-0.05, 0, 1]]])
    _, inside = warp.warp(torch.ones(1, 1, 40, 60), torch.linalg.inv(tilted))
    columns = inside[0, 0].any(0)
    assert columns[:10].any() and not columns[20:].any()


def test_a_batch_of_colours_is_the_same_as_each_plane_alone(texture):
    pictures = torch.rand(2, 3, 37, 53, generator=torch.Generator().manual_seed(0))
    motions = torch.cat([matrix(MOTION), torch.eye(3)[None]])
    found, inside = warp.warp(pictures, motions)
    for clip in range(2):
        one = slice(clip, clip + 1)
        for colour in range(3):
            alone, seen = warp.warp(pictures[one, colour : colour + 1], motions[one])
            assert torch.equal(found[clip, colour], alone[0, 0])
            assert torch.equal(inside[one], seen)


def test_gradients_are_those_of_finite_differences():
    picture = torch.rand(1, 1, 6, 7, dtype=torch.float64, requires_grad=True)
    motion = torch.tensor([[[1.0, 0.02, 0.3], [0.01, 1, -0.4], [1e-3, 0, 1]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: warp.warp(a, b)[0], (picture, motion))
