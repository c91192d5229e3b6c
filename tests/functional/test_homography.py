"""The plane homography, the linear solver, and the robust estimation shared with the affine map."""

import cv2
import numpy as np
import pytest
import torch

from torchvision_dddas.errors import InputError
from torchvision_dddas.functional import consensus, homography
from torchvision_dddas.functional.consensus import fit_to_inliers, inlier_weights


def test_solves_a_system_worked_by_hand_that_needs_a_row_exchange():
    matrix = torch.tensor([[[0.0, 2.0], [4.0, 2.0]]])
    x, valid = homography.solve_linear(matrix, torch.tensor([[[6.0], [10.0]]]))
    assert valid.all()
    assert torch.equal(x, torch.tensor([[[1.0], [3.0]]]))


def test_agrees_with_lapack_on_random_systems():
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(50, 8, 8, generator=generator, dtype=torch.float64)
    right = torch.randn(50, 8, 3, generator=generator, dtype=torch.float64)
    x, valid = homography.solve_linear(matrix, right)
    assert valid.all()
    torch.testing.assert_close(x, torch.linalg.solve(matrix, right), rtol=1e-8, atol=1e-8)


def test_a_singular_member_is_marked_and_leaves_the_others_alone():
    matrix = torch.stack([torch.eye(3), torch.ones(3, 3), torch.zeros(3, 3)])
    x, valid = homography.solve_linear(matrix, torch.arange(9.0).reshape(3, 3, 1))
    assert valid.tolist() == [True, False, False]
    assert torch.equal(x[0, :, 0], torch.tensor([0.0, 1.0, 2.0]))
    assert torch.equal(x[1:], torch.zeros(2, 3, 1))


def test_validity_does_not_depend_on_the_unit_of_the_equations():
    for unit in (1e-12, 1.0, 1e12):
        assert homography.solve_linear(torch.eye(3)[None] * unit, torch.ones(1, 3, 1))[1].all()


def test_solver_gradients_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(1)
    matrix = torch.randn(2, 4, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    right = torch.randn(2, 4, 2, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: homography.solve_linear(a, b)[0], (matrix, right))


TRUE = torch.tensor(
    [
        [[1.02, 0.03, 5.0], [-0.02, 0.98, -7.0], [2e-5, -3e-5, 1.0]],
        [[0.9, 0.1, 50.0], [-0.1, 1.1, -7.0], [-1e-4, 1e-4, 1.0]],
    ]
)
CORNERS = torch.tensor([[0.0, 0.0], [639.0, 0.0], [0.0, 479.0], [639.0, 479.0]])


def corner_error(found: torch.Tensor, wanted: torch.Tensor) -> float:
    return consensus.transfer_error(found, CORNERS, consensus.transfer(wanted, CORNERS)).max().item()


def pairs(count: int = 200, noise: float = 0.0, wrong: float = 0.0, seed: int = 0):
    """Points of two clips, where TRUE takes them, and which of the pairs are right."""
    generator = torch.Generator().manual_seed(seed)
    p = torch.rand(2, count, 2, generator=generator) * torch.tensor([640.0, 480.0])
    q = consensus.transfer(TRUE, p) + noise * torch.randn(2, count, 2, generator=generator)
    right = torch.rand(2, count, generator=generator) >= wrong
    return p, torch.where(right[..., None], q, torch.rand(2, count, 2, generator=generator) * 500), right


def test_four_points_of_a_square_moved_and_doubled_give_the_matrix_written_by_hand():
    p = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    found, valid = homography.four_point(p, 2 * p + torch.tensor([3.0, -1.0]))
    assert valid
    torch.testing.assert_close(found, torch.tensor([[2.0, 0, 3], [0, 2, -1], [0, 0, 1]]), atol=1e-6, rtol=0)


def test_four_points_give_what_opencv_gives():
    p, q, _ = pairs(count=80)
    p, q = p.reshape(2, 20, 4, 2), q.reshape(2, 20, 4, 2)
    found, valid = homography.four_point(p, q)
    for clip, number in np.argwhere(valid.numpy()):
        wanted = cv2.getPerspectiveTransform(p[clip, number].numpy(), q[clip, number].numpy())
        there = consensus.transfer(torch.from_numpy(wanted).float(), p[clip, number])
        torch.testing.assert_close(consensus.transfer(found[clip, number], p[clip, number]), there, atol=2e-2, rtol=0)
    assert valid.float().mean() > 0.9


@pytest.mark.parametrize(
    "bad",
    [
        [[0, 0], [10, 10], [20, 20], [0, 30]],
        [[0, 0], [0, 0], [20, 20], [0, 30]],
        [[5, 5]] * 4,
        [[0, 0], [9, 0], [0, 9], [9, 9]],
    ],
)
def test_four_points_that_fix_no_camera_view_are_marked_and_finite(bad):
    # The last one is in order, but its partner is turned over.
    p, q = torch.tensor(bad).float(), torch.tensor([[0.0, 0], [0, 9], [9, 0], [9, 9]])
    found, valid = homography.four_point(p, q)
    assert not valid
    assert torch.isfinite(found).all()


def test_four_point_gradients_are_those_of_finite_differences():
    p = torch.tensor([[[0.0, 0], [90, 10], [100, 80], [5, 70]]], dtype=torch.float64, requires_grad=True)
    q = torch.tensor([[[3.0, 1], [95, 15], [99, 90], [1, 72]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: homography.four_point(a, b)[0], (p, q))


def test_fit_recovers_the_exact_matrix():
    p, q, right = pairs()
    found, valid = homography.fit(p, q, right.float())
    assert valid.all()
    assert corner_error(found, TRUE) < 2e-3


def test_fit_equals_the_normalised_dlt_to_a_fiftieth_of_the_noise():
    p, q, _ = pairs(noise=0.5)
    found, _ = homography.fit(p, q, torch.ones(2, 200))
    for clip in range(2):
        wanted, _ = cv2.findHomography(p[clip].numpy(), q[clip].numpy(), 0)
        assert corner_error(found[clip], torch.from_numpy(wanted).float()) < 0.1
        # cv2 goes on to the reprojection error; the DLT itself is compared more closely.
        assert corner_error(found[clip], _dlt(p[clip], q[clip])) < 0.01


def _dlt(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
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


def test_a_pair_of_weight_zero_has_no_influence():
    p, q, right = pairs(wrong=0.3)
    kept = right.float()
    moved = torch.where(right[..., None], q, q + 100)
    assert torch.equal(homography.fit(p, q, kept)[0], homography.fit(p, moved, kept)[0])


def test_fit_gradients_are_those_of_finite_differences():
    p, q, _ = pairs(count=6, noise=1.0)
    p, q = p[:1].double().requires_grad_(), q[:1].double().requires_grad_()
    weight = torch.linspace(0.5, 1, 6, dtype=torch.float64)[None].requires_grad_()
    assert torch.autograd.gradcheck(lambda *x: homography.fit(*x)[0], (p, q, weight))


@pytest.mark.parametrize("count", [4, 7, 16])
def test_fit_gradients_hold_for_landmarks_kilometres_from_the_origin(count):
    p, q, _ = pairs(count=count, noise=1.0)
    p, q = 0.05 * p[:1].double() + 2000, q[:1].double()
    weight = torch.linspace(0.5, 1, count, dtype=torch.float64)[None]
    # Of pixels, as the matrix itself has entries of all sizes there.
    there = p[:, :2] + 3

    def pixels(*inputs):
        return consensus.transfer(homography.fit(*inputs)[0], there)

    inputs = (p.requires_grad_(), q.requires_grad_(), weight.requires_grad_())
    assert torch.autograd.gradcheck(pixels, inputs, eps=1e-5, atol=1e-4, rtol=1e-3)


def test_a_pair_of_weight_zero_may_hold_no_numbers_at_all():
    p, q, _ = pairs(count=6)
    weight = torch.ones(2, 6)
    weight[:, 5] = 0
    wanted, _ = homography.fit(p[:, :5], q[:, :5], weight[:, :5])
    p[:, 5], q[:, 5] = torch.nan, torch.inf
    found, valid = homography.fit(p, q, weight)
    assert valid.all()
    torch.testing.assert_close(found, wanted)


def test_fit_with_a_point_behind_the_horizon_is_marked():
    p = torch.tensor([[[0.0, 0], [1, 0], [1, 1], [0, 1]]], dtype=torch.float64)
    for tilt, seen in ((-0.999, True), (-1.001, False)):
        depth = 1 + tilt * p[..., :1]
        assert homography.fit(p, p / depth, torch.ones(1, 4, dtype=torch.float64))[1].item() is seen


def test_the_source_as_printed_agrees_with_least_squares_about_the_origin_and_not_far_from_it():
    p, q, _ = pairs(count=6)
    p, q = p[:1].double() / 100, consensus.transfer(TRUE[:1].double(), p[:1].double()) / 100
    near, valid = homography.fit_raw(p, q)
    assert valid.all()
    assert consensus.transfer_error(near, p, q).max() < 1e-8
    for count, low, high in ((6, 1e-3, torch.inf), (4, 0, 1e-3)):
        far, valid = homography.fit_raw(p[:, :count] / 1e4 + 100, q[:, :count])
        assert valid.all()
        assert low <= consensus.transfer_error(far, p[:, :count] / 1e4 + 100, q[:, :count]).max() < high


def test_the_source_as_printed_refuses_only_what_is_exactly_singular():
    same = torch.ones(1, 4, 2, dtype=torch.float64)
    found, valid = homography.fit_raw(same, same)
    assert not valid.any() and torch.equal(found[0], torch.eye(3, dtype=torch.float64))
    assert not homography.fit_raw(same[:, :3], same[:, :3])[1].any()


@pytest.mark.parametrize("count", [4, 6])
def test_the_source_as_printed_has_the_gradients_of_finite_differences(count):
    p, q, _ = pairs(count=count)
    p, q = (p[:1].double() / 300).requires_grad_(), (q[:1].double() / 300).requires_grad_()
    assert torch.autograd.gradcheck(lambda *x: homography.fit_raw(*x)[0], (p, q))


@pytest.mark.parametrize("count", [0, 1, 3])
def test_fit_of_fewer_than_four_points_is_marked(count):
    p, q, _ = pairs()
    weight = (torch.arange(200) < count).float().expand(2, -1)
    found, valid = homography.fit(p, q, weight)
    assert not valid.any()
    assert torch.equal(found, torch.eye(3).expand(2, 3, 3))


def test_fit_of_points_on_one_line_is_marked():
    p = torch.linspace(0, 600, 30)[None, :, None] * torch.tensor([1.0, 0.5]) + 7
    assert not homography.fit(p, p + 3, torch.ones(1, 30))[1].any()


def test_ransac_finds_the_plane_among_half_wrong_pairs():
    p, q, right = pairs(noise=0.2, wrong=0.5)
    samples = consensus.draw_samples(torch.Generator().manual_seed(1), 2, 256, 200)
    found, inliers, valid = homography.ransac(p, q, torch.ones(2, 200, dtype=torch.bool), samples)
    assert valid.all()
    assert corner_error(found, TRUE) < 0.4
    assert (inliers & right).sum() >= 0.99 * right.sum()
    assert (inliers & ~right).sum() <= 3


def test_ransac_is_within_a_tenth_of_a_pixel_of_opencv_on_its_inliers():
    p, q, _ = pairs(noise=0.2, wrong=0.4)
    samples = consensus.draw_samples(torch.Generator().manual_seed(1), 2, 256, 200)
    found, _, _ = homography.ransac(p, q, torch.ones(2, 200, dtype=torch.bool), samples)
    for clip in range(2):
        wanted, _ = cv2.findHomography(p[clip].numpy(), q[clip].numpy(), cv2.RANSAC, 3.0)
        assert corner_error(found[clip], torch.from_numpy(wanted).float()) < 0.1


def test_ransac_uses_valid_points_only_even_when_few():
    p, q, _ = pairs(noise=0.1)
    valid_points = torch.arange(200) % 10 == 0
    q = torch.where(valid_points[:, None], q, q + 50)
    samples = consensus.draw_samples(torch.Generator().manual_seed(1), 2, 128, 200)
    found, inliers, valid = homography.ransac(p, q, valid_points.expand(2, -1), samples)
    assert valid.all()
    assert torch.equal(inliers, valid_points.expand(2, -1))
    assert corner_error(found, TRUE) < 1.0


@pytest.mark.parametrize("count", [0, 3])
def test_ransac_without_four_valid_points_is_marked_and_returns_the_identity(count):
    p, q, _ = pairs()
    samples = consensus.draw_samples(torch.Generator().manual_seed(1), 2, 16, 200)
    found, inliers, valid = homography.ransac(p, q, (torch.arange(200) < count).expand(2, -1), samples)
    assert not valid.any()
    assert not inliers.any() or count
    assert torch.equal(found, torch.eye(3).expand(2, 3, 3))


def test_ransac_of_points_on_one_line_is_marked():
    p = torch.linspace(0, 600, 30)[None, :, None] * torch.tensor([1.0, 0.5]) + 7
    samples = consensus.draw_samples(torch.Generator().manual_seed(1), 1, 16, 30)
    assert not homography.ransac(p, p + 3, torch.ones(1, 30, dtype=torch.bool), samples)[2].any()


def test_what_a_pair_gives_does_not_depend_on_its_company():
    p, q, right = (part.repeat(2, *[1] * (part.ndim - 1)) for part in pairs(count=300, noise=0.3, wrong=0.4))
    p, q = p.double() + torch.arange(4.0)[:, None, None], q.double()
    samples = consensus.draw_samples(torch.Generator().manual_seed(1), 1, 64, 300).expand(4, -1, -1)
    together = homography.ransac(p, q, right, samples)
    for k in range(4):
        alone = homography.ransac(p[k : k + 1], q[k : k + 1], right[k : k + 1], samples[:1])
        # BLAS takes other paths for other batch sizes: the last digits may differ.
        torch.testing.assert_close(together[0][k], alone[0][0], atol=1e-9, rtol=1e-9)
        assert torch.equal(together[1][k], alone[1][0])


def test_samples_repeat_with_the_seed_and_never_draw_a_point_twice():
    first = consensus.draw_samples(torch.Generator().manual_seed(3), 2, 500, 5)
    assert torch.equal(first, consensus.draw_samples(torch.Generator().manual_seed(3), 2, 500, 5))
    assert first.shape == (2, 500, 4)
    assert (first.sort(-1).values.diff(dim=-1) > 0).all()
    assert first.min() == 0 and first.max() == 4
    # Every point is drawn equally often: 4/5 of 1000 times, give or take four standard deviations.
    assert (torch.bincount(first.flatten(), minlength=5) - 800).abs().max() < 51


def test_samples_from_three_points_are_refused_in_one_line():
    with pytest.raises(InputError, match=r"drawn from 4 points; got room for 3"):
        consensus.draw_samples(torch.Generator(), 1, 10, 3)


def test_a_point_on_the_horizon_stays_finite():
    matrix = torch.tensor([[[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]]])
    assert torch.isfinite(consensus.transfer(matrix, torch.tensor([[[100.0, 5.0]]]))).all()


def test_soft_weights_tend_to_the_count_of_inliers() -> None:
    error_px = torch.tensor([0.1, 1.9, 2.1, 40.0], dtype=torch.float64)
    hard = inlier_weights(error_px, 2.0)
    assert hard.tolist() == [1, 1, 0, 0]
    misses = [float((inlier_weights(error_px, 2.0, softness) - hard).abs().max()) for softness in (0.5, 0.05, 0.005)]
    assert misses[0] > misses[1] > misses[2] and misses[2] < 1e-4


def scene(seed: int = 0) -> tuple[torch.Tensor, ...]:
    random = torch.Generator().manual_seed(seed)
    earlier = torch.rand(1, 40, 2, generator=random, dtype=torch.float64) * 300
    later = earlier + torch.tensor([3.0, -1.0]) + 0.1 * torch.randn(1, 40, 2, generator=random, dtype=torch.float64)
    later[:, 30:] += 25 * torch.rand(1, 10, 2, generator=random, dtype=torch.float64) + 10
    return earlier, later, torch.ones(1, 40, dtype=torch.bool)


def test_a_refit_on_soft_inliers_leaves_out_what_does_not_fit() -> None:
    earlier, later, valid = scene()
    guess = torch.eye(3, dtype=torch.float64)[None]
    guess[:, 0, 2], guess[:, 1, 2] = 3.2, -0.8
    for softness in (0.0, 0.05, 0.2):
        matrix, share = fit_to_inliers(earlier, later, valid, guess, 3.0, homography.fit, softness)
        assert abs(float(share) - 0.75) < 0.02
        torch.testing.assert_close(matrix[0, :2, 2], torch.tensor([3.0, -1.0]).double(), atol=0.4, rtol=0)


def test_the_tolerance_has_the_right_gradient() -> None:
    earlier, later, valid = scene(1)
    guess = torch.eye(3, dtype=torch.float64)[None]
    guess[:, 0, 2], guess[:, 1, 2] = 3.0, -1.0
    tolerance = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda t: fit_to_inliers(earlier, later, valid, guess, t, homography.fit, 0.3)[0], (tolerance,)
    )
