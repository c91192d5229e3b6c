"""Warping and resizing 8-bit levels against OpenCV."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.functional import warp
from torchvision_dddas.functional.warp import resize

CAMERA = np.array([[1.01, 0.02, -7.3], [-0.015, 0.99, 4.2], [2e-5, -3e-5, 1]])
SIZES = [(120, 160), (61, 87)]


def levels(picture):
    return torch.from_numpy(picture.astype(np.float32))[None, None]


@pytest.mark.parametrize("shape", SIZES)
def test_sampled_levels_are_opencvs_up_to_ties(texture, shape):
    picture = texture(1, *shape)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    wanted = cv2.warpPerspective(picture, CAMERA, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
    sampled = warp.sample(levels(picture), torch.from_numpy(CAMERA)[None]).add(0.5).byte()[0, 0].numpy()
    differs = np.abs(sampled.astype(int) - wanted)
    assert (differs > 0).mean() < 0.01 and differs.max() <= 1


@pytest.mark.parametrize("border", [0, 4])
@pytest.mark.parametrize("matrix", [CAMERA, np.eye(3), np.array([[1, 0, 400.0], [0, 1, 0], [0, 0, 1]])])
def test_the_columns_seen_are_those_of_a_warped_mask(matrix, border):
    height, width = 61, 87
    inset = np.zeros((height, width), np.uint8)
    inset[border : height - border, border : width - border] = 255
    wanted = cv2.warpPerspective(inset, matrix, (width, height), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP) > 0
    size = height, width
    first, last = warp.seen_columns(torch.from_numpy(matrix)[None], size, size, border)
    np.testing.assert_array_equal(warp.between(first, last, width)[0, 0].numpy(), wanted)


def test_nothing_is_seen_of_what_lies_behind_the_camera():
    behind = -torch.eye(3)[None]
    first, last = warp.seen_columns(behind, (5, 6), (5, 6))
    assert (first > last).all()


def opencv(picture: np.ndarray, size: tuple[int, int]) -> torch.Tensor:
    found = cv2.resize(picture, size[::-1], interpolation=cv2.INTER_LINEAR_EXACT)
    return batch(found)


def batch(picture: np.ndarray) -> torch.Tensor:
    """uint8 picture -> (1, C, H, W) float32 levels."""
    return torch.from_numpy(np.atleast_3d(picture)).permute(2, 0, 1)[None].float()


@pytest.mark.parametrize("shape", [(97, 131, 3), (96, 128), (61, 40)])
def test_every_level_of_a_pyramid_is_opencvs_to_the_bit_enlarged_ones_too(shape):
    picture = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    scale, sizes = 0.5, set()
    while round(shape[0] / scale) >= 2:
        sizes.add((round(shape[0] / scale), round(shape[1] / scale)))
        scale *= 1.05
    assert len(sizes) > 50
    for size in sizes:
        assert torch.equal(resize(batch(picture), size), opencv(picture, size)), size


@settings(max_examples=150, deadline=None)
@given(st.tuples(*[st.integers(1, 40)] * 4), st.integers(0, 2**32 - 1))
def test_any_size_from_any_size_is_opencvs_to_the_bit(sizes, seed):
    picture = np.random.default_rng(seed).integers(0, 256, sizes[:2], np.uint8)
    assert torch.equal(resize(batch(picture), sizes[2:]), opencv(picture, sizes[2:]))


def test_two_pixels_into_four_by_hand():
    # Sources at -0.25, 0.25, 0.75 and 1.25: the right one's share is 0, 1/4, 3/4 and 1; 18.75 rounds to 19.
    found = resize(torch.tensor([[[[0.0, 75.0]]]]), (1, 4))
    assert found.flatten().tolist() == [0, 19, 56, 75]


def test_halves_are_rounded_up():
    picture = np.array([[1, 2], [1, 2]], np.uint8)
    assert resize(batch(picture), (1, 1)).item() == 2 == opencv(picture, (1, 1)).item()


def test_chosen_rows_and_columns_are_those_of_the_whole(texture):
    picture = batch(texture(1, 60, 80))
    rows, columns = torch.tensor([3, 2, 2, 40]), torch.tensor([0, 65, 7])
    assert torch.equal(resize(picture, (50, 66), rows, columns), resize(picture, (50, 66))[..., rows, :][..., columns])


def test_unrounded_gradients_are_those_of_finite_differences():
    values = torch.rand(1, 2, 6, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    picture = (values * 255).requires_grad_()
    assert torch.autograd.gradcheck(lambda a: resize(a, (9, 4), rounded=False), picture)


def test_rounding_changes_no_gradient_and_no_level_for_having_one(texture):
    picture = batch(texture(2, 24, 30))
    asked, smooth = picture.clone().requires_grad_(), picture.clone().requires_grad_()
    found = resize(asked, (17, 23))
    assert torch.equal(found, resize(picture, (17, 23)))
    weight = torch.rand(17, 23, generator=torch.Generator().manual_seed(0))
    (found * weight).sum().backward()
    (resize(smooth, (17, 23), rounded=False) * weight).sum().backward()
    torch.testing.assert_close(asked.grad, smooth.grad)
