import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.lab.tuning.parameters import TUNABLE, Parameters, expand_names


@pytest.mark.parametrize("name", TUNABLE)
def test_no_free_number_leads_out_of_a_range(name: str) -> None:
    parameter = TUNABLE[name]
    for free in (-1e6, -40.0, -1.0, 0.0, 2.0, 40.0, 1e6):
        value = float(parameter.value(torch.tensor(free, dtype=torch.float64)))
        assert parameter.low - 1e-6 <= value <= parameter.high * (1 + 1e-6)
        with_parameters(Settings(), {name: parameter.rounded(value)})


@given(st.sampled_from(sorted(TUNABLE)), st.floats(0.01, 0.99))
def test_a_value_comes_back_from_its_parameter(name: str, share: float) -> None:
    parameter = TUNABLE[name]
    edge = (parameter.log and parameter.offset) or 0.0
    low, high = ((math.log(end + edge) if parameter.log else end) for end in (parameter.low, parameter.high))
    value = low + share * (high - low)
    value = math.exp(value) - edge if parameter.log else value
    back = float(parameter.value(torch.tensor(parameter.free(value), dtype=torch.float64)))
    assert math.isclose(back, value, rel_tol=1e-6, abs_tol=1e-9)


def test_a_parameter_that_moved_changes_its_setting_alone() -> None:
    start = with_parameters(Settings(), {"difference.threshold": 3.14159265, "landmarks.common_sigma_m": 0.0})
    parameters = Parameters(start, TUNABLE)
    assert parameters.settings() == start
    with torch.no_grad():
        parameters.free[parameters.names.index("difference.threshold")].add_(0.5)
    tuned = parameters.settings()
    assert tuned.difference.threshold > 3.2
    assert with_parameters(tuned, {"difference.threshold": 3.14159265}) == start


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("difference.blur_px", 5.9, 5),
        ("difference.blur_px", 6.1, 7),
        ("difference.blur_px", 31.0, 31),
        ("morphology.close_px", 24.6, 25),
        ("difference.threshold", 3.141592, 3.142),
    ],
)
def test_a_tuned_value_is_rounded_to_what_its_setting_takes(name: str, value: float, wanted: float) -> None:
    assert TUNABLE[name].rounded(value) == wanted


def test_a_group_stands_for_its_tunable_parameters() -> None:
    assert expand_names(["morphology.*", "morphology.erode_px"]) == [
        "morphology.erode_px",
        "morphology.dilate_px",
        "morphology.close_px",
    ]


def test_whole_sizes_have_no_gradient_and_the_others_have() -> None:
    parameters = Parameters(Settings(), ["morphology.erode_px", "difference.threshold"])
    with torch.no_grad():
        parameters.free[0] += 0.15
    values = parameters.values(whole=True)
    assert float(parameters.values()["morphology.erode_px"].detach()) != 3 and float(values["morphology.erode_px"]) == 3
    assert not values["morphology.erode_px"].requires_grad and values["difference.threshold"].requires_grad
    assert Parameters(Settings(), ["morphology.erode_px"]).values(whole=True)["morphology.erode_px"].requires_grad
