import numpy as np
import pytest
import torch

from torchvision_dddas.errors import InputError
from torchvision_dddas.functional.color import bgr_to_hsv, within_ranges
from torchvision_dddas.tuning.colours import SoftColours, about, confusion

LOW = torch.tensor([[172, 90, 60], [50, 100, 40]])
HIGH = torch.tensor([[8, 255, 255], [70, 200, 250]])


def test_ranges_come_out_as_they_went_in():
    low, high = SoftColours(LOW, HIGH).ranges()
    assert low.tolist() == LOW.tolist()
    assert high.tolist() == HIGH.tolist()


def test_hard_colours_are_those_of_the_operation():
    bgr = torch.as_tensor(np.random.default_rng(0).uniform(0, 1, (1, 3, 40, 50)))
    found = SoftColours(LOW, HIGH)(bgr, 0.0)
    wanted = within_ranges(bgr_to_hsv(bgr), LOW.double(), HIGH.double())
    assert 0 < float(wanted.mean()) < 1
    torch.testing.assert_close(found.detach(), wanted)


def test_soft_colours_tend_to_hard_ones_as_softness_vanishes():
    bgr = torch.as_tensor(np.random.default_rng(0).uniform(0, 1, (1, 3, 40, 50)))
    colours = SoftColours(LOW, HIGH)
    away = [float((colours(bgr, s) - colours(bgr, 0.0)).detach().abs().mean()) for s in (20.0, 10.0, 5.0, 1.0, 0.1)]
    assert away == sorted(away, reverse=True)
    assert away[-1] < 3e-3


def test_gradients_of_ranges_are_right():
    bgr = torch.as_tensor(np.random.default_rng(1).uniform(0, 1, (1, 3, 5, 6)))
    colours = SoftColours(LOW, HIGH)

    def called(middle: torch.Tensor, free: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(colours, {"middle": middle, "free": free}, (bgr, 15.0))

    start = tuple(value.detach().clone().requires_grad_() for value in (colours.middle, colours.free))
    assert torch.autograd.gradcheck(called, start)


def test_a_range_begins_about_the_patch_s_own_colour_even_across_red():
    hues = torch.tensor([[0.0, 0.02, 0.9], [0.02, 0.0, 0.9]])  # a little to either side of red
    bgr = hues.T.reshape(1, 3, 1, 2)
    low, high = about(bgr, torch.ones(1, 1, 1, 2)).ranges()
    assert low[0, 0] > 160
    assert high[0, 0] < 20
    with pytest.raises(InputError, match="no pixel is labelled with colour 1"):
        about(bgr, torch.zeros(1, 1, 1, 2))


def test_confusion_is_one_less_f():
    worn = torch.tensor([1.0, 1, 1, 0]).reshape(1, 1, 2, 2)
    found = torch.tensor([1.0, 1, 0, 1]).reshape(1, 1, 2, 2)
    assert confusion(found, worn).tolist() == pytest.approx([1 - 2 * 2 / 6])
    assert confusion(worn, worn).tolist() == [0]


def test_ranges_of_other_shapes_are_refused():
    with pytest.raises(InputError, match=r"\(K, 3\) each"):
        SoftColours(torch.zeros(2, 3), torch.zeros(3, 3))
