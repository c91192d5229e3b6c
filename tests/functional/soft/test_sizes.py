import torch

from torchvision_dddas.functional import morphology
from torchvision_dddas.functional.blur import gaussian
from torchvision_dddas.functional.soft.fractional_size import between


def test_a_size_that_the_operation_takes_gives_its_result() -> None:
    x = torch.rand(1, 1, 20, 20)
    for side in (1, 3, 4):
        wanted = morphology.erode(x, side, "ellipse")
        assert torch.equal(between(float(side), lambda k: morphology.erode(x, k, "ellipse")), wanted)
        assert torch.equal(between(torch.tensor(float(side)), lambda k: morphology.erode(x, k, "ellipse")), wanted)


def test_between_two_sizes_results_are_blended_by_nearness() -> None:
    x = torch.rand(1, 1, 20, 20)
    found = between(torch.tensor(5.5, dtype=torch.float64), lambda k: gaussian(x, k), pitch=2)
    torch.testing.assert_close(found, 0.75 * gaussian(x, 5) + 0.25 * gaussian(x, 7))
    torch.testing.assert_close(between(5.5, lambda k: gaussian(x, k), pitch=2), found)


def test_a_larger_element_erodes_more_and_the_gradient_says_so() -> None:
    x = torch.rand(1, 1, 20, 20)
    side = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    between(side, lambda k: morphology.erode(x, k, "ellipse")).sum().backward()
    assert side.grad is not None and float(side.grad) < 0
