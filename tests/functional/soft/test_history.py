import torch

from torchvision_dddas.functional import history as hard
from torchvision_dddas.functional.soft.history import update

STAMPS = torch.tensor([0.0, 1.0, 3.9, 4.1, 8.0]).double().expand(1, 1, 5, 5).clone()
SILHOUETTE = torch.tensor([0.0, 0.2, 0.45, 0.9, 1.0]).double()[:, None].expand(1, 1, 5, 5).clone()


def test_a_soft_history_tends_to_the_hard_one() -> None:
    wanted = hard.update(STAMPS, SILHOUETTE, 10.0, 6.0)
    misses = [float((update(STAMPS, SILHOUETTE, 10.0, 6.0, s) - wanted).abs().max()) for s in (0.3, 0.03, 0.001)]
    assert misses[0] > misses[1] > misses[2] and misses[2] < 1e-3
    assert torch.equal(update(STAMPS, SILHOUETTE, 10.0, 6.0), wanted)


def test_the_duration_has_the_right_gradient() -> None:
    duration = torch.tensor(6.0, dtype=torch.float64, requires_grad=True)
    silhouette = SILHOUETTE.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda s, d: update(STAMPS, s, 10.0, d, 0.2), (silhouette, duration))
