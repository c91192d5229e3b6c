"""What time costs: measured factors, straight lines between them, and a term with a slope."""

from pathlib import Path

import pytest
import torch

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.tuning.time_cost import Curve, TimeCost, measure_cost, read_cost, timed_points, write_cost

THRESHOLD, CLOSE, BLUR = "difference.threshold", "morphology.close_px", "difference.blur_px"
CLIP = Clip("one", Path("one"))


def scalar(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64, requires_grad=True)


def test_a_factor_is_measured_at_what_was_measured_and_lies_between_elsewhere() -> None:
    curve = Curve(THRESHOLD, (2.0, 4.0, 8.0), (2.0, 1.0, 0.8))
    assert [float(curve.factor(scalar(v)).detach()) for v in (2.0, 4.0, 8.0)] == pytest.approx([2.0, 1.0, 0.8])
    # The knob's scale is that of factors: the middle of 2 and 8 is 4, that of 2 and 4 their geometric mean.
    assert float(curve.factor(scalar(8**0.5)).detach()) == pytest.approx(1.5)
    assert [float(curve.factor(scalar(v)).detach()) for v in (0.5, 90.0)] == pytest.approx([2.0, 0.8])


def test_the_term_has_the_slope_of_what_was_measured() -> None:
    cost = TimeCost(0.5, 0.02, (Curve(THRESHOLD, (2.0, 4.0), (2.0, 1.0)),))
    value = scalar(3.0)
    cost.term({THRESHOLD: value}).backward()
    assert value.grad is not None and float(value.grad) < 0
    assert torch.autograd.gradcheck(lambda v: cost.term({THRESHOLD: v}), scalar(3.0))


def test_as_the_settings_are_the_term_is_nothing_and_twice_the_time_costs_the_weight() -> None:
    cost = TimeCost(0.5, 0.02, (Curve(THRESHOLD, (2.0, 4.0), (2.0, 1.0)), Curve(CLOSE, (5.0, 10.0), (1.0, 1.5))))
    assert float(cost.term({THRESHOLD: scalar(4.0), CLOSE: scalar(5.0)}).detach()) == pytest.approx(0)
    assert float(cost.term({THRESHOLD: scalar(2.0), CLOSE: scalar(5.0)}).detach()) == pytest.approx(0.5)
    assert float(cost.expected({THRESHOLD: scalar(2.0), CLOSE: scalar(10.0)}).detach()) == pytest.approx(0.06)


def test_the_points_are_allowed_values_on_either_side_of_the_knobs_own() -> None:
    settings = with_parameters(Settings(), {THRESHOLD: 200.0, BLUR: 5})
    assert timed_points(settings, [THRESHOLD, BLUR]) == [
        ("", 0.0),
        (THRESHOLD, 100.0),
        (THRESHOLD, 255.0),
        (BLUR, 3.0),
        (BLUR, 11.0),
    ]


def test_what_depends_on_a_parameter_is_found_and_what_does_not_costs_nothing() -> None:
    settings = with_parameters(Settings(), {THRESHOLD: 8.0})
    noise = iter(1 + 0.01 * k for k in (0, 1, -1, 2, 0, 1, -2, 0, 1, 0, 2, -1, 1, 0, -1, 0, 1, 2, 0, 0))

    def timed(changed: Settings) -> float:
        return 0.1 * 8 / changed.difference.threshold * next(noise)

    cost = measure_cost(CLIP, "motion", settings, [THRESHOLD, CLOSE], 1.0, timed=timed)
    (curve,) = cost.curves
    assert curve.parameter == THRESHOLD and curve.values == (4.0, 8.0, 16.0)
    assert curve.times == pytest.approx((2, 1, 0.5), rel=0.05) and cost.seconds == pytest.approx(0.1, rel=0.05)


def test_what_was_measured_is_kept_to_the_last_digit(tmp_path: Path) -> None:
    cost = TimeCost(0.1, 1 / 3, (Curve(THRESHOLD, (2.0, 4.0), (1.1, 1.0)),))
    write_cost(tmp_path / "cost.json", cost)
    assert read_cost(tmp_path / "cost.json") == cost


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        '{"weight": 1}',
        '{"weight": 1, "seconds": 1, "curves": [1]}',
        '{"weight": 1, "seconds": 1, "curves": [{"knob": "difference.threshold", "values": ["a"], "times": [1]}]}',
        '{"weight": 1, "seconds": 1, "curves": [{"knob": "difference.threshold", "values": [1, 2], "times": [1]}]}',
        '{"weight": 1, "seconds": 1, "curves": [{"knob": "difference.absent", "values": [1], "times": [1]}]}',
    ],
)
def test_a_damaged_file_is_told_in_a_line(tmp_path: Path, content: str) -> None:
    (tmp_path / "cost.json").write_text(content)
    with pytest.raises(InputError, match="does not hold the cost"):
        read_cost(tmp_path / "cost.json")
