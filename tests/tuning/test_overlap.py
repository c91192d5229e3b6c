import pytest
import torch

from torchvision_dddas.evaluation.metrics.pixels import Pixels, measures
from torchvision_dddas.tuning.motion import LOSSES as BY_NAME
from torchvision_dddas.tuning.motion import dice_loss, f_loss, focal_loss

TRUTH = torch.zeros(2, 1, 40, 50, dtype=torch.bool)
TRUTH[:, :, 5:25, 10:30] = True
KNOWN = torch.ones_like(TRUTH)
LOSSES = [f_loss, dice_loss, focal_loss]


def test_of_hard_masks_the_loss_is_one_less_f() -> None:
    found = torch.zeros(2, 1, 40, 50)
    found[0, :, 10:30, 10:30] = 1
    found[1, :, 5:25, 10:30] = 1
    wanted = 1 - measures(Pixels(300, 100, 100, 1500))["f"]
    for loss in (f_loss, dice_loss):
        assert loss(found, TRUTH, KNOWN).tolist() == pytest.approx([wanted, 0.0], abs=1e-3)


@pytest.mark.parametrize("loss", LOSSES)
def test_what_nobody_labelled_does_not_count(loss) -> None:
    found = TRUTH.double()
    wrong = found.clone()
    wrong[:, :, 30:] = 1
    known = KNOWN.clone()
    known[:, :, 30:] = False
    assert torch.equal(loss(wrong, TRUTH, known), loss(found, TRUTH, known))
    assert bool((loss(wrong, TRUTH, KNOWN) > loss(found, TRUTH, KNOWN)).all())


@pytest.mark.parametrize("loss", LOSSES)
def test_an_empty_frame_in_which_nothing_is_found_is_right(loss) -> None:
    none = torch.zeros_like(TRUTH)
    assert float(loss(none.double(), none, KNOWN).max()) == pytest.approx(0.0, abs=1e-6)
    assert bool(torch.isfinite(loss(none.double(), none, none)).all())


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_have_the_right_gradient(loss) -> None:
    found = 0.05 + 0.9 * torch.rand(2, 1, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    truth, known = TRUTH[..., 3:7, 8:13], KNOWN[..., 3:7, 8:13]
    assert torch.autograd.gradcheck(lambda mask: loss(mask, truth, known), (found.requires_grad_(),))


def test_every_loss_has_a_name_that_can_be_asked_for() -> None:
    assert list(BY_NAME.values()) == LOSSES and next(iter(BY_NAME)) == "f"
