"""Operations on whole grey levels: what OpenCV does to 8-bit pictures, so that both back ends see the same."""

import cv2
import numpy as np
import pytest
import torch

from torchvision_dddas.functional import blur, difference, warp

CAMERA = np.array([[1.01, 0.02, -7.3], [-0.015, 0.99, 4.2], [2e-5, -3e-5, 1]])
SIZES = [(120, 160), (61, 87)]


def levels(picture):
    return torch.from_numpy(picture.astype(np.float32))[None, None]


@pytest.mark.parametrize("shape", [*SIZES, (2, 3), (1, 1)])
@pytest.mark.parametrize("size", [1, 3, 5, 7, 9])
def test_smoothed_levels_are_opencvs(texture, size, shape):
    picture = texture(0, 120, 160)[: shape[0], : shape[1]].copy()
    picture[: shape[0] // 2] = 255  # the largest sum there is
    smoothed = blur.gaussian_levels(torch.from_numpy(picture)[None, None], size)[0, 0].numpy()
    np.testing.assert_array_equal(smoothed, cv2.GaussianBlur(picture, (size, size), 0))


@pytest.mark.parametrize("size", [11, 31])
def test_widely_smoothed_levels_are_opencvs_to_a_level(texture, size):
    picture = texture(0, 61, 87)
    smoothed = blur.gaussian_levels(torch.from_numpy(picture)[None, None], size)[0, 0].numpy().astype(int)
    assert np.abs(smoothed - cv2.GaussianBlur(picture, (size, size), 0)).max() <= 1


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


@pytest.mark.parametrize("shape", SIZES)
def test_the_gradient_is_opencvs(texture, shape):
    picture = texture(2, *shape)
    across = cv2.Sobel(picture, cv2.CV_32F, 1, 0, scale=0.5)
    down = cv2.Sobel(picture, cv2.CV_32F, 0, 1, scale=0.5)
    wanted = cv2.blur(cv2.convertScaleAbs(cv2.magnitude(across, down)), (5, 5))
    np.testing.assert_array_equal(difference.gradient(levels(picture))[0, 0].numpy().astype(np.uint8), wanted)


def test_the_masked_median_is_of_the_masked_values_alone():
    values = torch.tensor([[5.0, 1.0, 9.0, 3.0, 7.0], [1.0, 2.0, 3.0, 4.0, 5.0]])
    mask = torch.tensor([[True, True, False, True, True], [False] * 5])
    assert difference.masked_median(values, mask).tolist() == [[3.0], [0.0]]


def test_exposure_follows_a_jump_of_light_that_every_pixel_takes_part_in(texture, tensor):
    reference = tensor(texture(0, 120, 160)) * 0.5
    gain, offset = difference.exposure(reference, reference / 0.7 - 0.2, torch.ones(1, 1, 120, 160, dtype=torch.bool))
    assert abs(gain.item() - 0.7) < 1e-3 and abs(offset.item() - 0.14) < 1e-3
