"""The soft and the hard threshold."""

import torch

from torchvision_dddas.functional import threshold


def test_the_hard_step_is_one_above_zero_only():
    assert torch.equal(threshold.step(torch.tensor([-1.0, 0.0, 1e-6, 2.0])), torch.tensor([0.0, 0.0, 1.0, 1.0]))


def test_soft_threshold_tends_to_hard_as_softness_vanishes():
    x = torch.tensor([-0.3, -0.01, 0.01, 0.3])
    gaps = [(threshold.step(x, softness) - threshold.step(x)).abs().max() for softness in (1.0, 0.1, 0.01, 1e-4)]
    assert gaps == sorted(gaps, reverse=True)
    assert gaps[-1] < 1e-6


def test_only_the_soft_step_passes_gradients():
    x = torch.linspace(-1, 1, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda y: threshold.step(y, 0.2), (x,))
    assert not threshold.step(x).requires_grad
