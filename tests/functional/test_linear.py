"""Batched Gaussian elimination."""

import torch

from torchvision_dddas.functional import linear


def test_solves_a_system_worked_by_hand_that_needs_a_row_exchange():
    matrix = torch.tensor([[[0.0, 2.0], [4.0, 2.0]]])
    x, valid = linear.solve(matrix, torch.tensor([[[6.0], [10.0]]]))
    assert valid.all()
    assert torch.equal(x, torch.tensor([[[1.0], [3.0]]]))


def test_agrees_with_lapack_on_random_systems():
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(50, 8, 8, generator=generator, dtype=torch.float64)
    right = torch.randn(50, 8, 3, generator=generator, dtype=torch.float64)
    x, valid = linear.solve(matrix, right)
    assert valid.all()
    torch.testing.assert_close(x, torch.linalg.solve(matrix, right), rtol=1e-8, atol=1e-8)


def test_a_singular_member_is_marked_and_leaves_the_others_alone():
    matrix = torch.stack([torch.eye(3), torch.ones(3, 3), torch.zeros(3, 3)])
    x, valid = linear.solve(matrix, torch.arange(9.0).reshape(3, 3, 1))
    assert valid.tolist() == [True, False, False]
    assert torch.equal(x[0, :, 0], torch.tensor([0.0, 1.0, 2.0]))
    assert torch.equal(x[1:], torch.zeros(2, 3, 1))


def test_validity_does_not_depend_on_the_unit_of_the_equations():
    for unit in (1e-12, 1.0, 1e12):
        assert linear.solve(torch.eye(3)[None] * unit, torch.ones(1, 3, 1))[1].all()


def test_gradients_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(1)
    matrix = torch.randn(2, 4, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    right = torch.randn(2, 4, 2, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: linear.solve(a, b)[0], (matrix, right))
