"""Smoothing, reflection, warping, resizing, differences and keypoints against OpenCV."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import torchvision_dddas.functional as F
from torchvision_dddas.detection import View, match_exposure
from torchvision_dddas.functional import reflect_index, resize
from torchvision_dddas.functional.filters import in_strips, is_above, to_bytes


@pytest.mark.parametrize(("size", "sigma"), [(1, None), (3, None), (7, None), (9, None), (5, 1.3), (31, 4.0)])
def test_smoothing_agrees_with_opencv_closely_where_a_sigma_is_given_and_to_a_level_and_a_half_without(
    texture, tensor, size, sigma
):
    picture = tensor(texture(0, 37, 53))
    wanted = cv2.GaussianBlur(picture[0, 0].numpy(), (size, size), sigma or 0)
    found = F.gaussian_blur2d(picture, size, sigma and (sigma, sigma))[0, 0]
    assert (found - torch.from_numpy(wanted)).abs().max() < (1e-3 if sigma else 1.5) / 255


@pytest.mark.parametrize("shape", [(61, 87), (2, 3), (1, 1)])
@pytest.mark.parametrize("size", [1, 3, 5, 7, 9, 11])
def test_smoothed_levels_are_opencvs_to_three_levels(texture, size, shape):
    picture = texture(0, 120, 160)[: shape[0], : shape[1]].copy()
    picture[: shape[0] // 2] = 255  # the largest sum there is
    smoothed = F.gaussian_blur2d(torch.from_numpy(picture)[None, None], size)[0, 0].numpy()
    apart = np.abs(smoothed.astype(int) - cv2.GaussianBlur(picture, (size, size), 0))
    assert apart.max() <= 3


@given(st.integers(1, 30), st.integers(-80, 80), st.integers(0, 60))
def test_reflection_is_opencvs_101_as_often_as_it_takes(length, first, count):
    wanted = [cv2.borderInterpolate(place, length, cv2.BORDER_REFLECT_101) for place in range(first, first + count)]
    assert reflect_index(torch.arange(first, first + count), length).tolist() == wanted


CAMERA = np.array([[1.01, 0.02, -7.3], [-0.015, 0.99, 4.2], [2e-5, -3e-5, 1]])


def batch(picture: np.ndarray) -> torch.Tensor:
    """uint8 picture -> (1, C, H, W) float32 levels."""
    return torch.from_numpy(np.atleast_3d(picture)).permute(2, 0, 1)[None].float()


@pytest.mark.parametrize("border", [0, 4])
@pytest.mark.parametrize("matrix", [CAMERA, np.eye(3), np.array([[1, 0, 400.0], [0, 1, 0], [0, 0, 1]])])
def test_the_columns_seen_are_those_of_a_warped_mask(matrix, border):
    size = height, width = 61, 87
    inset = np.zeros(size, np.uint8)
    inset[border : height - border, border : width - border] = 255
    wanted = cv2.warpPerspective(inset, matrix, (width, height), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP) > 0
    first, last = F.seen_columns(torch.from_numpy(matrix)[None], size, size, border_px=border)
    np.testing.assert_array_equal(F.columns_between(first, last, width)[0, 0].numpy(), wanted)


@settings(max_examples=150, deadline=None)
@given(st.tuples(*[st.integers(1, 40)] * 4), st.integers(0, 2**32 - 1))
def test_resizing_from_any_size_to_any_size_is_opencvs_to_the_bit(sizes, seed):
    picture = np.random.default_rng(seed).integers(0, 256, sizes[:2], np.uint8)
    wanted = cv2.resize(picture, (sizes[3], sizes[2]), interpolation=cv2.INTER_LINEAR_EXACT)
    assert torch.equal(resize(batch(picture), sizes[2:], rounded=True), batch(wanted))


def test_rounding_changes_no_gradient_and_no_level_for_having_one(texture):
    picture = batch(texture(2, 24, 30))
    asked, smooth = picture.clone().requires_grad_(), picture.clone().requires_grad_()
    found = resize(asked, (17, 23), rounded=True)
    assert torch.equal(found, resize(picture, (17, 23), rounded=True))
    weight = torch.rand(17, 23, generator=torch.Generator().manual_seed(0))
    (found * weight).sum().backward()
    (resize(smooth, (17, 23)) * weight).sum().backward()
    torch.testing.assert_close(asked.grad, smooth.grad)
    rows, columns = torch.tensor([3, 2, 2, 10]), torch.tensor([0, 20, 7])
    assert torch.equal(
        resize(picture, (17, 23), rows=rows, columns=columns, rounded=True), found[..., rows, :][..., columns]
    )


@pytest.mark.parametrize(("gain", "offset"), [(1.15, 0.0), (0.85, 0.03), (1.0, -0.05)])
def test_exposure_recovers_a_change_of_light_despite_movers(texture, tensor, gain, offset):
    reference = tensor(texture(0, 240, 320)) * 0.8 + 0.05
    warped = (reference - offset) / gain
    warped[..., 50:110, 80:160] = tensor(texture(1, 60, 80))
    found = F.fit_exposure(reference, warped, torch.ones(1, 1, 240, 320, dtype=torch.bool))
    assert abs(found[0].item() - gain) < 0.01 and abs(found[1].item() - offset) < 0.005


@pytest.mark.parametrize("seen", [True, False])
def test_exposure_of_a_blank_frame_or_of_nothing_seen_keeps_the_gain(seen):
    blank = torch.full((1, 1, 37, 53), 0.5)
    gain, offset = F.fit_exposure(blank, blank * 0.8, torch.full_like(blank, seen).bool())
    assert gain.item() == 1.0 and offset.item() == pytest.approx(0.1 if seen else 0.0, abs=1e-6)


@pytest.mark.parametrize("block", [2, 3, 5, 7])
def test_min_eigenvalue_is_opencvs_to_a_millionth_of_its_maximum(texture, tensor, block):
    picture = texture(0, 37, 53)
    wanted = torch.from_numpy(cv2.cornerMinEigenVal(picture, block))
    found = F.corner_min_eigenvalue(tensor(picture), block=block)[0, 0]
    assert (found - wanted).abs().max() < 2e-6 * wanted.max()


@pytest.mark.parametrize("shape", [(37, 53), (3, 3), (2, 5), (1, 1)])
def test_a_blank_picture_of_any_size_has_no_keypoints(shape):
    points, score, valid = F.grid_features(torch.full((2, 1, *shape), 0.5), 16)
    assert not valid.any() and torch.isfinite(points).all() and (score == 0).all()


def test_grid_features_are_the_best_pixel_of_every_whole_cell(texture, tensor):
    picture = tensor(texture(2, 37, 53))
    eigen = F.corner_min_eigenvalue(picture)[0, 0]
    points, score, valid = F.grid_features(picture, 16, quality=0.0)
    assert points.shape == (1, 2 * 3, 2) and valid.all()
    for number, (u, v) in enumerate(points[0].long().tolist()):
        row, column = divmod(number, 3)
        cell = eigen[16 * row : 16 * row + 16, 16 * column : 16 * column + 16]
        assert eigen[v, u] == cell.max() == score[0, number]
        assert (v // 16, u // 16) == (row, column)


def test_a_cell_below_the_quality_yields_nothing(texture, tensor):
    picture = texture(2, 64, 64)
    picture[:38, :38] = picture[:38, :38] // 16 + 100
    _, score, valid = F.grid_features(tensor(picture), 32, quality=0.2)
    assert valid.tolist() == [[False, True, True, True]] and score[0, 0] == 0


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (1.2, 0.0), (0.7, 12.0), (1.0, 20.0), (3.0, 0.0)])
def test_exposures_are_matched_as_the_onboard_engine_does(texture, gain, offset):
    earlier = texture(3, 90, 121)
    later = np.clip(earlier.astype(float) * gain + offset, 0, 255).round().astype(np.uint8)
    greys = [np.stack(pair) for pair in ((earlier, earlier), (later, earlier))]
    found = F.match_exposure(*(torch.from_numpy(grey)[:, None].float() for grey in greys))
    for k in range(2):
        wanted = match_exposure(*(View(grey[k], grey[k]) for grey in greys))
        for ours, theirs in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(ours[k, 0].numpy(), theirs)


@pytest.mark.parametrize("rows", [1, 7, 8, 9, 3000])
def test_strips_give_what_the_whole_picture_gives(rows):
    picture = torch.rand(2, 1, rows, 300, generator=torch.Generator().manual_seed(rows))

    def largest(part: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.max_pool2d(part, 5, 1, 2)

    assert torch.equal(in_strips(largest, picture, reach=2), largest(picture))


def test_bytes_are_numbers_cut_down_to_whole_ones():
    whole = torch.arange(256.0)
    assert torch.equal(to_bytes(whole), whole.byte())
    assert torch.equal(to_bytes(whole + 0.99), whole.byte())


@pytest.mark.parametrize("limit", [-1, 0, 7, 254, 255, 300])
def test_bytes_are_above_a_limit_as_whole_numbers_are(limit):
    levels = torch.arange(256)
    assert torch.equal(is_above(levels.byte(), limit), levels > limit)


def test_a_warp_to_bytes_rounds_halves_up(texture):
    picture, matrix = batch(texture(1, 61, 87)), torch.from_numpy(CAMERA)[None]
    levels, whole = (
        F.warp_perspective(picture, matrix, (400, 300), padding_mode="border", subpixels=32, whole=asked)
        for asked in (False, True)
    )
    assert whole.dtype == torch.uint8
    assert torch.equal(whole, (levels + 0.5).floor().byte())


def test_a_masked_median_is_the_lower_one_of_each_row_and_0_of_none():
    values = torch.tensor([[5.0, 1.0, 9.0, 3.0], [4.0, 2.0, 8.0, 6.0], [7.0, 7.0, 7.0, 7.0]])
    mask = torch.tensor([[True, True, True, True], [True, False, True, True], [False] * 4])
    wanted = [[3.0], [6.0], [0.0]]
    assert F.masked_median(values, mask).tolist() == wanted
    assert F.masked_median(values.requires_grad_(), mask).tolist() == wanted


def test_frame_features_are_those_of_opencv(texture, tensor):
    grey = texture(3, 160, 200)
    wanted = cv2.goodFeaturesToTrack(grey, 60, 0.01, 7, blockSize=5)[:, 0]
    points, valid = F.frame_features(tensor(grey), 60, quality=0.01, min_distance_px=7, block=5)
    found = {tuple(point) for point in points[0][valid[0]].tolist()}
    assert len(found & {tuple(point) for point in wanted.tolist()}) >= 0.95 * max(len(wanted), len(found)) > 0
