"""The soft cluster entropy beside the tree of clusters that it stands for."""

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvision_dddas.functional.soft.dispersion import dispersion
from torchvision_dddas.tracking.dispersion import clusters, normalized_entropy


def grouped(*sizes: int, within: float = 0.1, between: float = 0.7) -> Tensor:
    """Dissimilarities of targets in groups."""
    name = np.repeat(np.arange(len(sizes)), sizes)
    apart = np.where(name[:, None] == name, within, between)
    np.fill_diagonal(apart, 0.0)
    return torch.as_tensor(apart)


def everybody(apart: Tensor) -> Tensor:
    return torch.ones(apart.shape[:-1], dtype=torch.bool)


@pytest.mark.parametrize("sizes", [(1, 1, 1), (4,), (2, 1), (3, 2, 2), (5, 1, 1, 1)])
def test_without_softness_it_is_the_entropy_of_clusters_that_lie_apart(sizes):
    apart = grouped(*sizes)
    wanted = normalized_entropy(clusters(apart.numpy(), 0.25))
    assert dispersion(apart, everybody(apart), 0.25).item() == pytest.approx(wanted, abs=1e-12)


def test_it_tends_to_that_as_softness_vanishes():
    apart = grouped(3, 2, 2)
    hard = dispersion(apart, everybody(apart), 0.25).item()
    off = [abs(dispersion(apart, everybody(apart), 0.25, soft).item() - hard) for soft in (0.1, 0.05, 0.02, 0.01)]
    assert off == sorted(off, reverse=True)
    assert off[-1] < 1e-5


def test_a_wider_cut_tells_fewer_targets_apart_and_the_slope_says_so():
    apart = grouped(3, 2, within=0.2, between=0.4)
    cut = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(dispersion(apart, everybody(apart), cut, 0.05), cut)
    assert slope < 0
    assert torch.autograd.gradcheck(lambda c: dispersion(apart, everybody(apart), c, 0.05), cut)


def test_who_is_not_there_has_no_say_and_one_or_none_count_as_apart():
    apart, there = grouped(3, 2), torch.tensor([True, True, False, True, False])
    kept = apart[there][:, there]
    wanted = dispersion(kept, everybody(kept), 0.25, 0.1).item()
    assert dispersion(apart, there, 0.25, 0.1).item() == pytest.approx(wanted, abs=1e-12)
    for few in (0, 1):
        there = torch.arange(5) < few
        cut = torch.tensor(0.25, dtype=torch.float64, requires_grad=True)
        value = dispersion(apart, there, cut, 0.1)
        value.backward()
        assert value.item() == 1
        assert cut.grad is not None
        assert cut.grad.item() == 0


def test_a_batch_is_its_members_one_by_one():
    many = torch.stack([grouped(2, 2), grouped(1, 3)])
    together = dispersion(many, everybody(many), 0.25, 0.1)
    assert together.tolist() == pytest.approx([dispersion(one, everybody(one), 0.25, 0.1).item() for one in many])
