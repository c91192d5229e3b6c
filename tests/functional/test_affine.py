"""The affine baseline of appendix A."""

import cv2
import pytest
import torch

from torchvision_dddas.functional import affine, consensus

TRUE = torch.tensor([[[1.1, 0.2, 3.0], [-0.1, 0.95, 1.0], [0, 0, 1]], [[0.9, -0.1, -30.0], [0.2, 1.0, 8.0], [0, 0, 1]]])


def pairs(count: int = 120, noise: float = 0.2, wrong: float = 0.4):
    generator = torch.Generator().manual_seed(0)
    p = torch.rand(2, count, 2, generator=generator) * 500
    q = consensus.transfer(TRUE, p) + noise * torch.randn(2, count, 2, generator=generator)
    right = torch.rand(2, count, generator=generator) >= wrong
    return p, torch.where(right[..., None], q, torch.rand(2, count, 2, generator=generator) * 500), right


def test_three_points_give_what_opencv_gives():
    p, q, _ = pairs(count=3, wrong=0)
    found, valid = affine.three_point(p, q)
    assert valid.all()
    for clip in range(2):
        wanted = torch.from_numpy(cv2.getAffineTransform(p[clip].numpy(), q[clip].numpy())).float()
        torch.testing.assert_close(found[clip, :2], wanted, atol=1e-3, rtol=1e-4)


def test_a_shift_by_hand():
    p = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert torch.equal(affine.three_point(p, p + 2)[0], torch.tensor([[1.0, 0, 2], [0, 1, 2], [0, 0, 1]]))


@pytest.mark.parametrize("bad", [[[0, 0], [5, 5], [10, 10]], [[1, 1], [1, 1], [4, 7]], [[3, 3]] * 3])
def test_three_points_on_one_line_are_marked(bad):
    found, valid = affine.three_point(torch.tensor(bad).float(), torch.tensor([[0.0, 0], [1, 0], [0, 1]]))
    assert not valid
    assert torch.equal(found, torch.eye(3))


def test_fit_is_the_least_squares_solution():
    p, q, _ = pairs(wrong=0, noise=2.0)
    found, valid = affine.fit(p, q, torch.ones(2, 120))
    rows = torch.cat([p, torch.ones(2, 120, 1)], -1).double()
    wanted = torch.linalg.lstsq(rows, q.double()).solution.mT.float()
    assert valid.all()
    torch.testing.assert_close(found[:, :2], wanted, atol=1e-3, rtol=1e-4)


def test_fit_of_two_points_or_of_a_line_is_marked():
    p, q, _ = pairs()
    assert not affine.fit(p, q, (torch.arange(120) < 2).float().expand(2, -1))[1].any()
    line = torch.linspace(0, 100, 20)[None, :, None].expand(1, 20, 2)
    assert not affine.fit(line, line + 1, torch.ones(1, 20))[1].any()


def test_fit_gradients_are_those_of_finite_differences():
    p, q, _ = pairs(count=5)
    inputs = (p[:1].double().requires_grad_(), q[:1].double().requires_grad_())
    weight = torch.linspace(0.5, 1, 5, dtype=torch.float64)[None]
    assert torch.autograd.gradcheck(lambda a, b: affine.fit(a, b, weight)[0], inputs)


def test_ransac_finds_the_map_among_wrong_pairs_and_keeps_the_last_row():
    p, q, right = pairs()
    samples = consensus.draw_samples(torch.Generator().manual_seed(1), 2, 100, 120, size=3)
    found, inliers, valid = affine.ransac(p, q, torch.ones_like(right), samples)
    assert valid.all()
    corners = torch.tensor([[0.0, 0], [500, 0], [0, 500], [500, 500]])
    assert consensus.transfer_error(found, corners, consensus.transfer(TRUE, corners)).max() < 0.3
    assert torch.equal(found[:, 2], torch.tensor([[0.0, 0, 1]] * 2))
    assert (inliers & right).sum() >= 0.99 * right.sum()
