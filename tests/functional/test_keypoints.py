"""Good features to track against OpenCV."""

import cv2
import pytest
import torch

from torchvision_dddas.functional import keypoints


@pytest.mark.parametrize("block", [2, 3, 5, 7])
@pytest.mark.parametrize("shape", [(37, 53), (120, 160)])
def test_min_eigenvalue_is_opencvs_to_a_millionth_of_its_maximum(texture, tensor, block, shape):
    picture = texture(0, *shape)
    wanted = torch.from_numpy(cv2.cornerMinEigenVal(picture, block))
    found = keypoints.min_eigenvalue(tensor(picture), block)[0, 0]
    assert (found - wanted).abs().max() < 2e-6 * wanted.max()


@pytest.mark.parametrize("shape", [(37, 53), (3, 3), (2, 5), (1, 1)])
def test_a_blank_picture_of_any_size_has_none(shape):
    points, score, valid = keypoints.grid_features(torch.full((2, 1, *shape), 0.5), 16)
    assert not valid.any()
    assert torch.isfinite(points).all() and (score == 0).all()


def test_only_allowed_pixels_are_chosen_and_set_the_maximum(texture, tensor):
    picture = texture(0, 120, 160)
    picture[:, 100:] = 0
    picture[40:60, 120:140] = 255
    allowed = torch.zeros(1, 1, 120, 160, dtype=torch.bool)
    allowed[..., :90] = True
    points, _, valid = keypoints.grid_features(tensor(picture), 16, allowed=allowed)
    assert valid.any() and (points[valid][:, 0] < 90).all()


def test_grid_features_are_the_best_pixel_of_every_whole_cell(texture, tensor):
    picture = tensor(texture(2, 37, 53))
    eigen = keypoints.min_eigenvalue(picture)[0, 0]
    points, score, valid = keypoints.grid_features(picture, 16, quality=0.0)
    assert points.shape == (1, 2 * 3, 2) and valid.all()
    for number, (u, v) in enumerate(points[0].long().tolist()):
        row, column = divmod(number, 3)
        cell = eigen[16 * row : 16 * row + 16, 16 * column : 16 * column + 16]
        assert eigen[v, u] == cell.max() == score[0, number]
        assert (v // 16, u // 16) == (row, column)


def test_a_cell_below_the_quality_yields_nothing(texture, tensor):
    picture = texture(2, 64, 64)
    picture[:38, :38] = picture[:38, :38] // 16 + 100
    _, score, valid = keypoints.grid_features(tensor(picture), 32, quality=0.2)
    assert valid.tolist() == [[False, True, True, True]]
    assert score[0, 0] == 0


def test_eigenvalue_gradients_are_those_of_finite_differences():
    picture = torch.rand(1, 1, 6, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(keypoints.min_eigenvalue, (picture,))


def test_eigenvalue_gradients_of_a_blank_picture_are_finite():
    picture = torch.full((1, 1, 6, 7), 0.5, requires_grad=True)
    keypoints.min_eigenvalue(picture).sum().backward()
    assert picture.grad is not None and torch.isfinite(picture.grad).all()
