"""Good features to track against OpenCV."""

import cv2
import numpy as np
import pytest
import torch

from torchvision_dddas.functional import keypoints


def places(points: torch.Tensor, valid: torch.Tensor) -> set[tuple[float, float]]:
    return {tuple(point) for point in points[0][valid[0]].tolist()}


@pytest.mark.parametrize("block", [2, 3, 5, 7])
@pytest.mark.parametrize("shape", [(37, 53), (120, 160)])
def test_min_eigenvalue_is_opencvs_to_a_millionth_of_its_maximum(texture, tensor, block, shape):
    picture = texture(0, *shape)
    wanted = torch.from_numpy(cv2.cornerMinEigenVal(picture, block))
    found = keypoints.min_eigenvalue(tensor(picture), block)[0, 0]
    assert (found - wanted).abs().max() < 2e-6 * wanted.max()


@pytest.mark.parametrize(("budget", "distance", "block"), [(100, 8, 3), (300, 8, 7), (1000, 4.5, 5), (40, 25, 3)])
@pytest.mark.parametrize("seed", [0, 1])
def test_good_features_are_in_opencvs_places(texture, tensor, budget, distance, block, seed):
    picture = texture(seed, 240, 320)
    points, score, valid = keypoints.good_features(tensor(picture), budget, 0.01, distance, block)
    corners = cv2.goodFeaturesToTrack(picture, budget, 0.01, distance, blockSize=block)
    wanted = {tuple(point) for point in corners[:, 0].tolist()}
    found = places(points, valid)
    # Not all: two maxima that differ in float32's last digit may change places.
    assert len(found & wanted) >= 0.98 * len(wanted)
    assert abs(len(found) - len(wanted)) <= 0.02 * len(wanted)
    assert (score.diff(dim=1) <= 0).all()


def test_good_features_keep_their_distance(texture, tensor):
    points, _, valid = keypoints.good_features(tensor(texture(0, 120, 160)), 200, 0.001, 9.0)
    chosen = points[0][valid[0]]
    assert len(chosen) > 50
    assert torch.pdist(chosen).min() >= 9.0


def test_three_white_dots_are_found_best_first(tensor):
    picture = np.zeros((60, 80), np.uint8)
    for (u, v), grey in (((20, 30), 120), ((60, 15), 255), ((50, 45), 200)):
        picture[v - 1 : v + 2, u - 1 : u + 2] = grey
    points, _, valid = keypoints.good_features(tensor(picture), 10, 0.01, 8.0, block=5)
    assert valid[0].sum() == 3 and valid[0, :3].all()
    wanted = torch.tensor([[60.0, 15.0], [50.0, 45.0], [20.0, 30.0]])
    assert (points[0, :3] - wanted).abs().max() <= 1


@pytest.mark.parametrize("find", [keypoints.good_features, lambda gray: keypoints.grid_features(gray, 16)])
@pytest.mark.parametrize("shape", [(37, 53), (3, 3), (2, 5), (1, 1)])
def test_a_blank_picture_of_any_size_has_none(find, shape):
    points, score, valid = find(torch.full((2, 1, *shape), 0.5))
    assert not valid.any()
    assert torch.isfinite(points).all() and (score == 0).all()


def test_only_allowed_pixels_are_chosen_and_set_the_maximum(texture, tensor):
    picture = texture(0, 120, 160)
    picture[:, 100:] = 0
    picture[40:60, 120:140] = 255
    allowed = torch.zeros(1, 1, 120, 160, dtype=torch.bool)
    allowed[..., :90] = True
    mask = allowed[0, 0].numpy().astype(np.uint8)
    points, _, valid = keypoints.good_features(tensor(picture), 100, 0.3, 8.0, allowed=allowed)
    corners = cv2.goodFeaturesToTrack(picture, 100, 0.3, 8, mask=mask)
    assert places(points, valid) == {tuple(point) for point in corners[:, 0].tolist()}
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


def test_a_batch_is_the_same_as_each_picture_alone(texture, tensor):
    pictures = torch.cat([tensor(texture(seed, 90, 121)) for seed in range(3)])
    for find in (lambda x: keypoints.good_features(x, 60), lambda x: keypoints.grid_features(x, 20)):
        together = find(pictures)
        for clip in range(3):
            for whole, alone in zip(together, find(pictures[clip : clip + 1]), strict=True):
                assert torch.equal(whole[clip], alone[0])


def test_eigenvalue_gradients_are_those_of_finite_differences():
    picture = torch.rand(1, 1, 6, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(keypoints.min_eigenvalue, (picture,))


def test_eigenvalue_gradients_of_a_blank_picture_are_finite():
    picture = torch.full((1, 1, 6, 7), 0.5, requires_grad=True)
    keypoints.min_eigenvalue(picture).sum().backward()
    assert picture.grad is not None and torch.isfinite(picture.grad).all()
