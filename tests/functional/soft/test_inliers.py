import torch

from torchvision_dddas.functional.homography import fit
from torchvision_dddas.functional.soft.inliers import fitted, weights


def test_soft_weights_tend_to_the_count_of_inliers() -> None:
    error_px = torch.tensor([0.1, 1.9, 2.1, 40.0], dtype=torch.float64)
    hard = weights(error_px, 2.0)
    assert hard.tolist() == [1, 1, 0, 0]
    misses = [float((weights(error_px, 2.0, softness) - hard).abs().max()) for softness in (0.5, 0.05, 0.005)]
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
        matrix, share = fitted(earlier, later, valid, guess, 3.0, fit, softness)
        assert abs(float(share) - 0.75) < 0.02
        torch.testing.assert_close(matrix[0, :2, 2], torch.tensor([3.0, -1.0]).double(), atol=0.4, rtol=0)


def test_the_tolerance_has_the_right_gradient() -> None:
    earlier, later, valid = scene(1)
    guess = torch.eye(3, dtype=torch.float64)[None]
    guess[:, 0, 2], guess[:, 1, 2] = 3.0, -1.0
    tolerance = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: fitted(earlier, later, valid, guess, t, fit, 0.3)[0], (tolerance,))
