"""Soft assignment beside all assignments counted one by one."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvision_dddas.functional import log_partition
from torchvision_dddas.geometry import best_pairs


def scores(*shape: int, spread: float = 3.0, seed: int = 0) -> Tensor:
    return spread * torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def shares(score: Tensor, softness: float) -> Tensor:
    score = score.detach().requires_grad_()
    return torch.autograd.grad(log_partition(score, softness).sum(), score)[0]


def counted(score: Tensor, softness: float) -> Tensor:
    """The same by every assignment there is."""

    def sums(row: int, used: frozenset[int]) -> list[Tensor]:
        if row == len(score):
            return [score.new_zeros(())]
        found = sums(row + 1, used)
        for column in set(range(score.shape[1])) - used:
            found += [score[row, column] + rest for rest in sums(row + 1, used | {column})]
        return found

    return softness * torch.logsumexp(torch.stack(sums(0, frozenset())) / softness, 0)


@pytest.mark.parametrize(("rows", "columns"), [(1, 5), (5, 1)])
@pytest.mark.parametrize("softness", [0.3, 3.0])
def test_where_one_frame_has_a_single_target_nothing_is_approximated(rows, columns, softness):
    score = scores(rows, columns).requires_grad_()
    wanted, found = counted(score, softness), log_partition(score, softness)
    assert found.item() == pytest.approx(wanted.item(), abs=1e-12)
    (slope,), (true,) = torch.autograd.grad(found, score), torch.autograd.grad(wanted, score)
    torch.testing.assert_close(slope, true, rtol=0, atol=1e-12)


@pytest.mark.parametrize("softness", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("seed", range(2))
def test_it_is_near_the_sum_over_all_assignments_and_never_above(softness, seed):
    score = scores(5, 4, seed=seed).requires_grad_()
    wanted, found = counted(score, softness), log_partition(score, softness)
    assert 0.97 * wanted.item() <= found.item() <= wanted.item() + 1e-4
    (true,) = torch.autograd.grad(wanted, score)
    torch.testing.assert_close(shares(score, softness).detach(), true, rtol=0, atol=0.15)


def test_shares_and_score_tend_to_the_best_assignment_as_softness_vanishes():
    score = scores(8, 9)
    best, hard = best_pairs(score.numpy()), np.zeros(score.shape)
    hard[best[:, 0], best[:, 1]] = 1
    vanishing = 1.0, 0.3, 0.1, 0.01
    of_shares = [np.abs(shares(score, softness).numpy() - hard).max() for softness in vanishing]
    of_value = [log_partition(score, softness).item() - (score.numpy() * hard).sum() for softness in vanishing]
    for off in (of_shares, of_value):
        assert off == sorted(off, reverse=True) and abs(off[-1]) < 1e-6


def test_a_batch_is_its_members_one_by_one_and_forbidden_pairs_do_not_count():
    many = scores(3, 4, 5)
    together = log_partition(many, 1.0, rounds=300)
    for one, value in zip(many, together, strict=True):
        assert value.item() == pytest.approx(log_partition(one, 1.0, rounds=300).item(), abs=1e-5)
        wider = torch.full((6, 8), -torch.inf, dtype=torch.float64)
        wider[:4, :5] = one
        assert log_partition(wider, 1.0, rounds=300).item() == pytest.approx(value.item(), abs=1e-5)


def test_large_scores_overflow_nothing_and_no_pairs_are_worth_nothing():
    score = torch.tensor([[900.0, 0.0], [0.0, 900.0]], dtype=torch.float64, requires_grad=True)
    assert log_partition(score, 0.01).item() == pytest.approx(1800)
    (slope,) = torch.autograd.grad(log_partition(score, 0.01), score)
    torch.testing.assert_close(slope, torch.eye(2, dtype=torch.float64))
    assert log_partition(torch.zeros(0, 3), 1.0).item() == log_partition(torch.zeros(3, 0), 1.0).item() == 0
    assert log_partition(torch.zeros(1, 1, dtype=torch.float64), 1.0).item() == pytest.approx(math.log(2))
