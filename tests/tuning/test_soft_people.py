import numpy as np
import pytest
import torch

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.evaluation.metrics.boxes import areas, iou
from torchvision_dddas.people.suppression import body_boxes, probability
from torchvision_dddas.tuning.people import body_boxes as soft_bodies
from torchvision_dddas.tuning.people import right_nll, soft_f1

VALUES = {
    f"people.{name}": torch.tensor(float(getattr(PeopleParameters(), name)), dtype=torch.float64)
    for name in ("height_share", "width_share", "feet_share", "probability_slope", "probability_even")
}


def drawn(seed: int = 0, count: int = 6) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, 100, (count, 2)), rng.uniform(30, 90, (count, 2))])


def test_bodies_are_those_of_the_hard_recognizer():
    window = drawn()
    np.testing.assert_allclose(
        soft_bodies(torch.as_tensor(window), VALUES).numpy(), body_boxes(window, PeopleParameters())
    )


def test_doubt_is_that_of_the_hard_probability():
    margin = np.linspace(-1, 3, 9)
    told = probability(margin, PeopleParameters())
    for right, wanted in ((1.0, -np.log(told)), (0.0, -np.log(1 - told))):
        found = right_nll(torch.as_tensor(margin), torch.full((9,), right, dtype=torch.float64), VALUES)
        np.testing.assert_allclose(found.numpy(), wanted)


def test_doubt_is_least_where_probabilities_are_the_shares_that_are_right():
    rng = np.random.default_rng(0)
    margin = rng.uniform(-1, 2, 20_000)
    right = rng.uniform(0, 1, 20_000) < 1 / (1 + np.exp(-3.0 * (margin - 0.6)))
    columns = torch.as_tensor(margin), torch.as_tensor(right, dtype=torch.float64)

    def mean(slope: float, even: float) -> float:
        parameters = {"people.probability_slope": slope, "people.probability_even": even}
        return float(right_nll(*columns, {name: torch.tensor(value) for name, value in parameters.items()}).mean())

    assert mean(3.0, 0.6) < min(mean(2.0, 0.6), mean(4.0, 0.6), mean(3.0, 0.4), mean(3.0, 0.8))


def test_soft_f_tends_to_hard_as_softness_vanishes():
    margin, right = torch.tensor([2.0, 1.2, 0.7, 0.2, -0.4]), torch.tensor([1.0, 1.0, 0.0, 1.0, 0.0])
    threshold = torch.tensor(0.5)
    hard = float(soft_f1(margin, right, 4, threshold, 0.0))
    assert hard == pytest.approx(2 * 2 / (3 + 4))
    away = [abs(float(soft_f1(margin, right, 4, threshold, softness)) - hard) for softness in (0.2, 0.1, 0.05, 0.02)]
    assert away == sorted(away, reverse=True)
    assert away[-1] < 1e-3


def test_f_of_a_picture_without_people_falls_with_every_false_one():
    margin, threshold = torch.tensor([2.0, 1.0]), torch.tensor(0.0)
    wrong = torch.zeros(2)
    f = [float(soft_f1(margin[:n], wrong[:n], 0, threshold, 0.0)) for n in (0, 1, 2)]
    assert f == pytest.approx([1, 1 / 2, 1 / 3])


def test_areas_of_tensors_are_those_of_the_measure():
    a, b = drawn(0), drawn(1)
    common, union = areas(torch.as_tensor(a), torch.as_tensor(b))
    np.testing.assert_array_equal((common / union).numpy(), np.diag(iou(a, b)))
    apart = torch.tensor([[0.0, 0, 10, 10]]), torch.tensor([[50.0, 50, 10, 10]])
    assert [float(area) for area in areas(*apart)] == [0, 200]


def test_gradients_of_all_are_right():
    window, true = torch.as_tensor(drawn(0)), torch.as_tensor(drawn(0) + 3)
    margin = torch.linspace(-1, 2, 6, dtype=torch.float64)
    right = torch.tensor([0.0, 0, 1, 0, 1, 1], dtype=torch.float64)

    def lost(*values: torch.Tensor) -> torch.Tensor:
        parameters = dict(zip(VALUES, values[:-1], strict=True))
        common, union = areas(soft_bodies(window, parameters), true)
        return (
            (common / union).sum()
            + right_nll(margin, right, parameters).sum()
            + soft_f1(margin, right, 4, values[-1], 0.3)
        )

    start = [value.clone().requires_grad_() for value in (*VALUES.values(), torch.tensor(0.4, dtype=torch.float64))]
    assert torch.autograd.gradcheck(lost, start)
