import torch

from torchvision_dddas.functional.soft.straight_through import rounded, through


def test_the_value_is_the_hard_one_and_the_gradient_the_soft_ones() -> None:
    x = torch.tensor([0.1, 0.7, 1e-9], requires_grad=True)
    result = through((x > 0.5).float(), torch.sigmoid(x))
    assert torch.equal(result.detach(), torch.tensor([0.0, 1.0, 0.0]))
    (slope,) = torch.autograd.grad(result.sum(), x)
    (wanted,) = torch.autograd.grad(torch.sigmoid(x).sum(), x)
    assert torch.equal(slope, wanted)


def test_rounding_is_numpys_and_passes_every_gradient() -> None:
    x = torch.tensor([0.5, 1.5, 2.4, -0.6], requires_grad=True)
    assert rounded(x).tolist() == [0.0, 2.0, 2.0, -1.0]
    (slope,) = torch.autograd.grad(rounded(x).sum(), x)
    assert slope.tolist() == [1.0] * 4
