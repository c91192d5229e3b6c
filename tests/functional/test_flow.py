"""Pyramidal Lucas-Kanade against OpenCV and against known motion."""

import cv2
import numpy as np
import pytest
import torch

from torchvision_dddas.functional import flow, plane_maps

MOTION = np.array([[1.01, 0.02, 4.0], [-0.015, 0.99, -3.0], [1e-5, -2e-5, 1.0]])


@pytest.fixture(scope="module")
def scene(two_views, tensor):
    first, second = two_views(0, 200, 260, MOTION)
    corners = cv2.goodFeaturesToTrack(first, 150, 0.01, 8)
    return first, second, corners, torch.from_numpy(corners[:, 0])[None]


def pyramids(tensor, first, second, levels) -> tuple[flow.Pyramid, flow.Pyramid]:
    return flow.pyramid(tensor(first), levels), flow.pyramid(tensor(second), levels)


def by_opencv(first, second, corners, levels, window=21, **rest):
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        corners,
        winSize=(window, window),
        maxLevel=levels - 1,
        criteria=criteria,
        **({"nextPts": None} | rest),
    )
    return torch.from_numpy(found[:, 0]), torch.from_numpy(status[:, 0] > 0)


@pytest.mark.parametrize(("levels", "window"), [(3, 21), (3, 15), (4, 21), (2, 11)])
def test_agrees_with_opencv_to_a_hundredth_of_a_pixel(scene, tensor, levels, window):
    first, second, corners, points = scene
    found, ok = flow.track(points, *pyramids(tensor, first, second, levels), window_px=window)
    wanted, status = by_opencv(first, second, corners, levels, window)
    # OpenCV also keeps points that have just left the picture.
    status = status & ((wanted >= 0) & (wanted <= torch.tensor([259.0, 199.0]))).all(-1)
    both = ok[0] & status
    apart = (found[0] - wanted).norm(dim=-1)[both]
    assert both.sum() >= 0.97 * status.sum()
    assert apart.median() < 0.001
    assert apart.quantile(0.9) < 0.01


def test_with_a_prediction_one_level_and_a_small_table_do(scene, tensor):
    first, second, corners, points = scene
    truth = plane_maps.transfer(torch.from_numpy(MOTION).float()[None], points)
    guess = truth + 0.4 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    found, ok = flow.track(
        points, *pyramids(tensor, first, second, 1), guess=guess, window_px=15, iterations=5, reach_px=2
    )
    start = guess[0].numpy()[:, None].copy()
    wanted, _ = by_opencv(first, second, corners, 1, 15, nextPts=start, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
    inner = ((truth > 10) & (truth < torch.tensor([250.0, 190.0]))).all(-1)
    assert (ok & inner).sum() >= 0.97 * inner.sum()
    assert (found[0] - wanted).norm(dim=-1)[ok[0]].median() < 0.001
    assert (found - truth).norm(dim=-1)[ok & inner].median() < 0.1


def test_a_point_that_needs_more_than_one_table_is_found_in_further_rounds(two_views, tensor):
    first, second = two_views(3, 120, 160, np.array([[1, 0, 4.0], [0, 1, 0.0], [0, 0, 1.0]]))
    points = torch.tensor([[[80.0, 60.0]]])
    views = pyramids(tensor, first, second, 1)
    assert not flow.track(points, *views, window_px=31, reach_px=2, rounds=1)[1].any()
    found, ok = flow.track(points, *views, window_px=31, reach_px=2, rounds=4)
    assert ok.all()
    torch.testing.assert_close(found - points, torch.tensor([[[4.0, 0.0]]]), atol=0.1, rtol=0)


@pytest.mark.parametrize("shape", [(37, 53), (9, 11)])
def test_nothing_is_found_on_a_blank_picture(shape):
    blank = flow.pyramid(torch.full((2, 1, *shape), 0.3), 2)
    found, ok = flow.track(torch.full((2, 5, 2), 4.0), blank, blank)
    assert not ok.any()
    assert torch.isfinite(found).all()


def test_forward_backward_drops_points_on_what_was_covered_meanwhile(scene, tensor, texture):
    first, second, _, points = scene
    covered = second.copy()
    covered[60:140, 80:180] = texture(9, 80, 100)
    truth = plane_maps.transfer(torch.from_numpy(MOTION).float()[None], points)
    inside = ((truth > torch.tensor([90.0, 70.0])) & (truth < torch.tensor([170.0, 130.0]))).all(-1)
    away = ((truth < torch.tensor([60.0, 40.0])) | (truth > torch.tensor([200.0, 160.0]))).any(-1)
    away &= ((truth > 10) & (truth < torch.tensor([250.0, 190.0]))).all(-1)
    _, found = flow.forward_backward(points, *pyramids(tensor, first, covered, 3))
    assert inside.sum() >= 8
    assert found[inside].float().mean() < 0.2
    assert found[away].float().mean() > 0.9


def test_gradients_are_those_of_finite_differences(two_views, tensor):
    first, second = two_views(5, 18, 18, np.array([[1, 0, 0.4], [0, 1, -0.3], [0, 0, 1.0]]))
    points = torch.tensor([[[9.2, 8.7]]], dtype=torch.float64)
    images = (tensor(first).double().requires_grad_(), tensor(second).double().requires_grad_())

    def moved(a, b, p):
        return flow.track(p, [a], [b], window_px=7, iterations=4, epsilon_px=0.0, reach_px=1)[0]

    assert flow.track(points, [images[0]], [images[1]], window_px=7, reach_px=1)[1].all()
    assert torch.autograd.gradcheck(lambda b: moved(images[0].detach(), b, points), (images[1],), fast_mode=True)
    assert torch.autograd.gradcheck(lambda a: moved(a, images[1].detach(), points), (images[0],), fast_mode=True)
    # Where a point goes also depends on where it started.
    assert torch.autograd.gradcheck(
        lambda p: moved(images[0].detach(), images[1].detach(), p), (points.requires_grad_(),)
    )
