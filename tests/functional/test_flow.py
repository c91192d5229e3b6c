"""Pyramidal Lucas-Kanade against OpenCV and against known motion."""

import cv2
import numpy as np
import pytest
import torch

import torchvision_dddas.functional as F

MOTION = np.array([[1.01, 0.02, 4.0], [-0.015, 0.99, -3.0], [1e-5, -2e-5, 1.0]])


@pytest.fixture(scope="module")
def scene(two_views, tensor):
    first, second = two_views(0, 200, 260, MOTION)
    corners = cv2.goodFeaturesToTrack(first, 150, 0.01, 8)
    return first, second, corners, torch.from_numpy(corners[:, 0])[None]


def pyramids(tensor, first, second, levels) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    return F.build_pyramid(tensor(first), levels), F.build_pyramid(tensor(second), levels)


def inner(points: torch.Tensor, left: float, top: float, right: float, bottom: float) -> torch.Tensor:
    return ((points > torch.tensor([left, top])) & (points < torch.tensor([right, bottom]))).all(-1)


def by_opencv(first, second, corners, levels, window=21, start=None):
    rest = {"winSize": (window, window), "maxLevel": levels - 1}
    criteria = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01
    flags = 0 if start is None else cv2.OPTFLOW_USE_INITIAL_FLOW
    found, status, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, start, criteria=criteria, flags=flags, **rest)
    return torch.from_numpy(found[:, 0]), torch.from_numpy(status[:, 0] > 0)


@pytest.mark.parametrize(("levels", "window"), [(3, 21), (3, 15), (2, 11)])
def test_agrees_with_opencv_to_a_hundredth_of_a_pixel(scene, tensor, levels, window):
    first, second, corners, points = scene
    found, ok = F.lucas_kanade(points, *pyramids(tensor, first, second, levels), window_px=window)
    wanted, status = by_opencv(first, second, corners, levels, window)
    # OpenCV also keeps points that have just left the picture.
    status = status & ((wanted >= 0) & (wanted <= torch.tensor([259.0, 199.0]))).all(-1)
    both = ok[0] & status
    apart = (found[0] - wanted).norm(dim=-1)[both]
    assert both.sum() >= 0.97 * status.sum()
    assert apart.median() < 0.001 and apart.quantile(0.9) < 0.01


def test_with_a_prediction_one_level_and_a_small_table_do(scene, tensor):
    first, second, corners, points = scene
    truth = F.transform_points(torch.from_numpy(MOTION).float()[None], points)
    guess = truth + 0.4 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    views = pyramids(tensor, first, second, 1)
    found, ok = F.lucas_kanade(points, *views, guess=guess, window_px=15, iterations=5, reach_px=2)
    wanted, _ = by_opencv(first, second, corners, 1, 15, guess[0].numpy()[:, None].copy())
    seen = inner(truth, 10, 10, 250, 190)
    assert (ok & seen).sum() >= 0.97 * seen.sum()
    assert (found[0] - wanted).norm(dim=-1)[ok[0]].median() < 0.001
    assert (found - truth).norm(dim=-1)[ok & seen].median() < 0.1


def test_a_point_that_needs_more_than_one_table_is_found_in_further_rounds(two_views, tensor):
    first, second = two_views(3, 120, 160, np.array([[1, 0, 4.0], [0, 1, 0.0], [0, 0, 1.0]]))
    points = torch.tensor([[[80.0, 60.0]]])
    views = pyramids(tensor, first, second, 1)
    assert not F.lucas_kanade(points, *views, window_px=31, reach_px=2, rounds=1)[1].any()
    found, ok = F.lucas_kanade(points, *views, window_px=31, reach_px=2, rounds=4)
    assert ok.all()
    torch.testing.assert_close(found - points, torch.tensor([[[4.0, 0.0]]]), atol=0.1, rtol=0)


@pytest.mark.parametrize("shape", [(37, 53), (9, 11)])
def test_nothing_is_found_on_a_blank_picture(shape):
    blank = F.build_pyramid(torch.full((2, 1, *shape), 0.3), 2)
    found, ok = F.lucas_kanade(torch.full((2, 5, 2), 4.0), blank, blank)
    assert not ok.any() and torch.isfinite(found).all()


def test_forward_backward_drops_points_on_what_was_covered_meanwhile(scene, tensor, texture):
    first, second, _, points = scene
    covered = second.copy()
    covered[60:140, 80:180] = texture(9, 80, 100)
    truth = F.transform_points(torch.from_numpy(MOTION).float()[None], points)
    hidden, near = inner(truth, 90, 70, 170, 130), inner(truth, 60, 40, 200, 160)
    _, found = F.forward_backward(points, *pyramids(tensor, first, covered, 3))
    assert hidden.sum() >= 8 and found[hidden].float().mean() < 0.2
    assert found[~near & inner(truth, 10, 10, 250, 190)].float().mean() > 0.9


def test_gradients_are_those_of_finite_differences(two_views, tensor):
    views = two_views(5, 18, 18, np.array([[1, 0, 0.4], [0, 1, -0.3], [0, 0, 1.0]]))
    first, second = (tensor(view).double() for view in views)
    points = torch.tensor([[[9.2, 8.7]]], dtype=torch.float64)

    def moved(a, b, p):
        return F.lucas_kanade(p, [a], [b], window_px=7, iterations=4, epsilon_px=0.0, reach_px=1)[0]

    assert F.lucas_kanade(points, [first], [second], window_px=7, reach_px=1)[1].all()
    # Where a point goes also depends on where it started.
    for varied in (first, second, points):
        varied.requires_grad_()
        assert torch.autograd.gradcheck(moved, (first, second, points), fast_mode=varied is not points)
        varied.requires_grad_(False)
