"""One-to-one assignment without SciPy's optimizer, against it."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.targets.chi_square import chance_above
from torchvision_dddas.targets.matching import SMALL, cheapest


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (2, 7), (7, 2), (SMALL, SMALL), (SMALL, 40), (40, SMALL)])
def test_a_small_assignment_is_scipys(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(shape))
    for _ in range(20):
        cost = rng.normal(size=shape)
        assert np.array_equal(cheapest(cost), linear_sum_assignment(cost))


def test_equal_costs_give_some_assignment_of_the_least_sum() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        cost = rng.integers(-2, 3, size=tuple(rng.integers(1, SMALL, 2))).astype(float)
        rows, columns = cheapest(cost)
        assert len(set(rows.tolist())) == len(set(columns.tolist())) == min(cost.shape)
        assert cost[rows, columns].sum() == cost[linear_sum_assignment(cost)].sum()


def test_a_crowd_is_scipys() -> None:
    cost = np.random.default_rng(3).normal(size=(SMALL + 1, SMALL + 3))
    assert np.array_equal(cheapest(cost), linear_sum_assignment(cost))


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (3, 0)])
def test_nobody_is_assigned_to_nobody(shape: tuple[int, int]) -> None:
    rows, columns = cheapest(np.zeros(shape))
    assert len(rows) == len(columns) == 0


@pytest.mark.parametrize(
    ("freedom", "value", "chance"), [(1, 3.841458820694124, 0.05), (2, 5.991464547107979, 0.05), (8, 20.09, 0.01)]
)
def test_the_chance_of_a_chi_squared_value_is_that_of_the_tables(freedom: int, value: float, chance: float) -> None:
    assert chance_above(freedom, value) == pytest.approx(chance, rel=1e-4)


def test_the_chance_of_a_chi_squared_value_is_scipys() -> None:
    from scipy.special import chdtrc

    for freedom in range(1, 40):
        for value in (0.0, 1e-6, 0.3, 2.0, 17.0, 250.0):
            assert chance_above(freedom, value) == pytest.approx(float(chdtrc(freedom, value)), rel=1e-12)


def test_what_a_run_onboard_loads_leaves_the_slow_libraries_out() -> None:
    """They are half of its start and a third of its memory."""
    slow = ("scipy", "jaxtyping", "pymap3d", "onnxruntime", "torch", "rich", "asyncio")
    script = "import sys, torchvision_dddas.cli, torchvision_dddas.surveying, torchvision_dddas.sinks.survey_output\n"
    script += f"import torchvision_dddas.vision.onboard_vision\nprint([n for n in {slow!r} if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == "[]"
