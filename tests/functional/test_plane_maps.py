"""Homographies and affine maps of the plane, the linear solver, and the robust estimation that both share."""

from typing import Any

import cv2
import numpy as np
import pytest
import torch

import torchvision_dddas.functional as F
from torchvision_dddas.errors import InputError
from torchvision_dddas.functional import MODELS, find_homography, ransac

PROJECTIVE = torch.tensor(
    [
        [[1.02, 0.03, 5.0], [-0.02, 0.98, -7.0], [2e-5, -3e-5, 1.0]],
        [[0.9, 0.1, 50.0], [-0.1, 1.1, -7.0], [-1e-4, 1e-4, 1.0]],
    ]
)
AFFINE = PROJECTIVE * torch.tensor([[1.0], [1], [0]]) + torch.diag(torch.tensor([0.0, 0, 1]))
TRUE = {"homography": PROJECTIVE, "affine": AFFINE}  # maps of two clips
CORNERS = torch.tensor([[0.0, 0.0], [639.0, 0.0], [0.0, 479.0], [639.0, 479.0]])


@pytest.fixture(params=MODELS)
def model(request):
    return MODELS[request.param], TRUE[request.param], MODELS[request.param].size


def corner_error(found: torch.Tensor, wanted: torch.Tensor) -> float:
    one, other = (
        F.transform_points(matrix, CORNERS.expand(len(matrix), 4, 2))
        for matrix in (found.reshape(-1, 3, 3), wanted.reshape(-1, 3, 3))
    )
    return (one - other).norm(dim=-1).max().item()


def pairs(count: int = 200, noise: float = 0.0, wrong: float = 0.0, seed: int = 0, true=PROJECTIVE):
    """Points of two clips, where the true maps take them, and which of the pairs are right."""
    generator = torch.Generator().manual_seed(seed)
    p = torch.rand(2, count, 2, generator=generator) * torch.tensor([640.0, 480.0])
    q = F.transform_points(true, p) + noise * torch.randn(2, count, 2, generator=generator)
    right = torch.rand(2, count, generator=generator) >= wrong
    return p, torch.where(right[..., None], q, torch.rand(2, count, 2, generator=generator) * 500), right


def line(count: int = 30) -> torch.Tensor:
    return torch.linspace(0, 600, count)[None, :, None] * torch.tensor([1.0, 0.5]) + 7


def samples(count: int, points: int, size: int = 4, clips: int = 2) -> torch.Tensor:
    return F.draw_samples(torch.Generator().manual_seed(1), clips, count, points, size=size)


def test_agrees_with_lapack_on_random_systems_and_is_valid_in_any_unit():
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(50, 8, 8, generator=generator, dtype=torch.float64)
    matrix[0, 0, 0] = 0  # rows have to be exchanged
    right = torch.randn(50, 8, 3, generator=generator, dtype=torch.float64)
    x, valid = F.solve_linear(matrix, right)
    assert valid.all()
    torch.testing.assert_close(x, torch.linalg.solve(matrix, right), rtol=1e-8, atol=1e-8)
    for unit in (1e-12, 1e12):
        assert F.solve_linear(torch.eye(3)[None] * unit, torch.ones(1, 3, 1))[1].all()


def test_a_singular_member_is_marked_and_leaves_the_others_alone():
    matrix = torch.stack([torch.eye(3), torch.ones(3, 3), torch.zeros(3, 3)])
    x, valid = F.solve_linear(matrix, torch.arange(9.0).reshape(3, 3, 1))
    assert valid.tolist() == [True, False, False]
    assert x.squeeze(-1).tolist() == [[0, 1, 2], [0, 0, 0], [0, 0, 0]]


def test_the_fewest_points_give_what_opencv_gives(model):
    module, true, size = model
    by_opencv: Any = cv2.getAffineTransform if size == 3 else cv2.getPerspectiveTransform
    p, q, _ = pairs(count=20 * size, true=true)
    p, q = p.reshape(2, 20, size, 2), q.reshape(2, 20, size, 2)
    found, valid = module.minimal(p, q)
    for clip, number in np.argwhere(valid.numpy()):
        wanted = torch.eye(3)
        wanted[: size - 1] = torch.from_numpy(by_opencv(p[clip, number].numpy(), q[clip, number].numpy()))
        there = F.transform_points(wanted, p[clip, number])
        torch.testing.assert_close(F.transform_points(found[clip, number], p[clip, number]), there, atol=2e-2, rtol=0)
    assert valid.float().mean() > 0.9


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("homography", [[0, 0], [10, 10], [20, 20], [0, 30]]),
        ("homography", [[5, 5]] * 4),
        ("homography", [[0, 0], [9, 0], [0, 9], [9, 9]]),  # in order, but its partner is turned over
        ("affine", [[0, 0], [5, 5], [10, 10]]),
        ("affine", [[1, 1], [1, 1], [4, 7]]),
    ],
)
def test_points_that_fix_no_map_are_marked_and_finite(name, bad):
    q = torch.tensor([[0.0, 0], [0, 9], [9, 0], [9, 9]])[: len(bad)]
    found, valid = MODELS[name].minimal(torch.tensor(bad).float(), q)
    assert not valid and torch.isfinite(found).all()


def test_an_affine_fit_is_the_least_squares_solution():
    p, q, _ = pairs(noise=2.0, true=AFFINE)
    found, valid = F.find_affine(p, q, torch.ones(2, 200))
    rows = torch.cat([p, torch.ones(2, 200, 1)], -1).double()
    wanted = torch.linalg.lstsq(rows, q.double()).solution.mT.float()
    assert valid.all()
    torch.testing.assert_close(found[:, :2], wanted, atol=1e-3, rtol=1e-4)


def test_a_homography_fit_is_opencvs_and_the_normalized_dlt():
    p, q, _ = pairs(noise=0.5)
    found, _ = find_homography(p, q, torch.ones(2, 200))
    for clip in range(2):
        wanted, _ = cv2.findHomography(p[clip].numpy(), q[clip].numpy(), 0)
        assert corner_error(found[clip], torch.from_numpy(wanted).float()) < 0.1
        # cv2 goes on to the reprojection error; the DLT itself is compared more closely.
        assert corner_error(found[clip], normalized_dlt(p[clip], q[clip])) < 0.01


def normalized_dlt(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Homogeneous least squares by SVD (A h = 0), Hartley-normalised."""

    def normaliser(x):
        scale = np.sqrt(2) / np.sqrt(((x - x.mean(0)) ** 2).sum(1).mean())
        return np.array([[scale, 0, -scale * x[:, 0].mean()], [0, scale, -scale * x[:, 1].mean()], [0, 0, 1]])

    a, b = p.numpy().astype(float), q.numpy().astype(float)
    from_a, from_b = normaliser(a), normaliser(b)
    a, b = (np.c_[x, np.ones(len(x))] @ n.T for x, n in ((a, from_a), (b, from_b)))
    zero = np.zeros_like(a)
    rows = np.r_[np.c_[a, zero, -b[:, :1] * a], np.c_[zero, a, -b[:, 1:2] * a]]
    matrix = np.linalg.inv(from_b) @ np.linalg.svd(rows)[2][-1].reshape(3, 3) @ from_a
    return torch.from_numpy(matrix / matrix[2, 2]).float()


def test_a_fit_leaves_out_pairs_of_weight_zero_even_where_they_hold_no_numbers():
    p, q, right = pairs(wrong=0.3)
    wanted, _ = find_homography(p, q, right.float())
    assert corner_error(wanted, PROJECTIVE) < 2e-3
    for nonsense in (q + 100, torch.full_like(q, torch.nan), torch.full_like(q, torch.inf)):
        other = torch.where(right[..., None], q, nonsense)
        found, valid = find_homography(torch.where(right[..., None], p, nonsense), other, right.float())
        assert valid.all()
        torch.testing.assert_close(found, wanted)


def test_a_fit_of_too_few_points_or_of_a_line_is_marked(model):
    module, true, size = model
    p, q, _ = pairs(true=true)
    for count in range(size):
        found, valid = module.fit(p, q, (torch.arange(200) < count).float().expand(2, -1))
        assert not valid.any() and torch.equal(found, torch.eye(3).expand(2, 3, 3))
    assert not module.fit(line(), line() + 3, torch.ones(1, 30))[1].any()


def test_fit_with_a_point_behind_the_horizon_is_marked():
    p = torch.tensor([[[0.0, 0], [1, 0], [1, 1], [0, 1]]], dtype=torch.float64)
    for tilt, seen in ((-0.999, True), (-1.001, False)):
        assert find_homography(p, p / (1 + tilt * p[..., :1]), torch.ones(1, 4).double())[1].item() is seen


@pytest.mark.parametrize("count", [4, 16])
def test_fit_gradients_hold_for_landmarks_kilometres_from_the_origin(count):
    p, q, _ = pairs(count=count, noise=1.0)
    p, q = 0.05 * p[:1].double() + 2000, q[:1].double()
    weight = torch.linspace(0.5, 1, count, dtype=torch.float64)[None]
    there = p[:, :2] + 3  # of pixels, as the matrix itself has entries of all sizes there
    inputs = (p.requires_grad_(), q.requires_grad_(), weight.requires_grad_())
    assert torch.autograd.gradcheck(
        lambda *x: F.transform_points(find_homography(*x)[0], there), inputs, eps=1e-5, atol=1e-4, rtol=1e-3
    )


def test_the_source_as_printed_agrees_with_least_squares_about_the_origin_and_not_far_from_it():
    p, _, _ = pairs(count=6)
    p, q = p[:1].double() / 100, F.transform_points(PROJECTIVE[:1].double(), p[:1].double()) / 100
    for count, away, low, high in ((6, 0, 0, 1e-8), (6, 100, 1e-3, torch.inf), (4, 100, 0, 1e-3)):
        ground = p[:, :count] if not away else p[:, :count] / 1e4 + away
        found, valid = F.find_homography_raw(ground, q[:, :count])
        assert valid.all()
        assert low <= F.oneway_transfer_error(ground, q[:, :count], found, squared=False).max() < high


def test_the_source_as_printed_refuses_only_what_is_exactly_singular():
    same = torch.ones(1, 4, 2, dtype=torch.float64)
    found, valid = F.find_homography_raw(same, same)
    assert not valid.any() and torch.equal(found[0], torch.eye(3, dtype=torch.float64))
    assert not F.find_homography_raw(same[:, :3], same[:, :3])[1].any()


def test_ransac_finds_the_map_among_half_wrong_pairs(model):
    module, true, size = model
    p, q, right = pairs(noise=0.2, wrong=0.5, true=true)
    found, inliers, valid = ransac(p, q, torch.ones(2, 200).bool(), samples(256, 200, size), model=module)
    assert valid.all()
    assert corner_error(found, true) < 0.4
    assert (inliers & right).sum() >= 0.99 * right.sum() and (inliers & ~right).sum() <= 3
    if size == 3:
        assert torch.equal(found[:, 2], torch.tensor([[0.0, 0, 1]] * 2))
        return
    for clip in range(2):
        wanted, _ = cv2.findHomography(p[clip].numpy(), q[clip].numpy(), cv2.RANSAC, 3.0)
        assert corner_error(found[clip], torch.from_numpy(wanted).float()) < 0.1


def test_ransac_uses_valid_points_only_even_when_few():
    p, q, _ = pairs(noise=0.1)
    known = (torch.arange(200) % 10 == 0).expand(2, -1)
    found, inliers, valid = ransac(p, torch.where(known[..., None], q, q + 50), known, samples(128, 200))
    assert valid.all() and torch.equal(inliers, known) and corner_error(found, PROJECTIVE) < 1.0


@pytest.mark.parametrize("count", [0, 3])
def test_ransac_without_four_valid_points_or_on_one_line_is_marked_and_gives_the_identity(count):
    p, q, _ = pairs()
    found, inliers, valid = ransac(p, q, (torch.arange(200) < count).expand(2, -1), samples(16, 200))
    assert not valid.any() and (count or not inliers.any())
    assert torch.equal(found, torch.eye(3).expand(2, 3, 3))
    assert not ransac(line(), line() + 3, torch.ones(1, 30).bool(), samples(16, 30, clips=1))[2].any()


def test_samples_repeat_with_the_seed_and_never_draw_a_point_twice():
    first = samples(500, 5)
    assert torch.equal(first, samples(500, 5)) and first.shape == (2, 500, 4)
    assert (first.sort(-1).values.diff(dim=-1) > 0).all()
    # Every point is drawn equally often: 4/5 of 1000 times, give or take four standard deviations.
    assert (torch.bincount(first.flatten(), minlength=5) - 800).abs().max() < 51
    with pytest.raises(InputError, match=r"drawn from 4 points; got room for 3"):
        samples(10, 3)


def test_a_point_on_the_horizon_stays_finite():
    matrix = torch.tensor([[[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]]])
    assert torch.isfinite(F.transform_points(matrix, torch.tensor([[[100.0, 5.0]]]))).all()
