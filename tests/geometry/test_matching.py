"""One-to-one assignment: pairs of the largest sum of scores or the least cost."""

import itertools
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import best_pairs, cheapest, matching


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (3, 0), (1, 1), (2, 7), (7, 2), (12, 12), (12, 40), (40, 12)])
def test_an_assignment_is_scipys(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(shape))
    for _ in range(20):
        cost = rng.normal(size=shape)
        assert np.array_equal(cheapest(cost), linear_sum_assignment(cost))


def test_equal_costs_give_some_assignment_of_the_least_sum() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        cost = rng.integers(-2, 3, size=tuple(rng.integers(1, 12, 2))).astype(float)
        rows, columns = cheapest(cost)
        assert len(set(rows.tolist())) == len(set(columns.tolist())) == min(cost.shape)
        assert cost[rows, columns].sum() == cost[linear_sum_assignment(cost)].sum()


def printed(script: str) -> str:
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.strip()


def test_an_assignment_loads_scipys_solver_without_the_rest_of_scipy_optimize() -> None:
    script = (
        "import sys, numpy as np; from torchvision_dddas.geometry import cheapest\n"
        "for cost in ([[0., 1, 9], [1, 0, 9]], [[0., 1], [1, 0], [9, 9]], [[0., 1], [0, 2]]):\n"
        "    cheapest(np.array(cost))\n"
        "print('scipy.optimize' in sys.modules)\n"
        "from scipy.optimize import linear_sum_assignment  # still works beside the loaded solver\n"
        "print(linear_sum_assignment(np.eye(2))[1].tolist())"
    )
    assert printed(script).splitlines() == ["False", "[1, 0]"]


def test_an_assignment_loads_scipy_optimize_if_it_has_no_module_for_the_solver(monkeypatch) -> None:
    finder = SimpleNamespace(find_spec=lambda *_: None)
    monkeypatch.setattr("torchvision_dddas.geometry.matching.PathFinder", finder)
    matching.load_assignment_solver.cache_clear()
    assert matching.load_assignment_solver() is linear_sum_assignment
    matching.load_assignment_solver.cache_clear()


def test_what_a_run_onboard_loads_leaves_the_slow_libraries_out() -> None:
    """They are half of its start and a third of its memory."""
    slow = ("scipy", "jaxtyping", "pymap3d", "onnxruntime", "torch", "rich", "asyncio")
    parts = "cli, torchvision_dddas.pipeline, torchvision_dddas.io.output, torchvision_dddas.detection.opencv_engine"
    assert printed(f"import sys, torchvision_dddas.{parts}; print([n for n in {slow!r} if n in sys.modules])") == "[]"
    load = "from torchvision_dddas.geo.plane_homography import load_solver; load_solver('auto')"
    assert printed(f"import sys; {load}; print('torch' in sys.modules)") == "False"


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 3), st.integers(0, 3), st.data())
def test_pairs_are_one_to_one_and_score_the_most(rows, columns, data):
    entry = st.integers(-4, 9) | st.just(-np.inf)
    score = np.array(data.draw(st.lists(entry, min_size=rows * columns, max_size=rows * columns)), float)
    score = score.reshape(rows, columns)
    found = best_pairs(score)
    padded = np.hstack([score, np.zeros((rows, rows))])
    choices = itertools.permutations(range(columns + rows), rows)
    most = max(sum(padded[i, c] for i, c in enumerate(to)) for to in choices)
    assert len(set(found[:, 0])) == len(set(found[:, 1])) == len(found)
    assert (score[tuple(found.T)] > 0).all() and score[tuple(found.T)].sum() == most


@pytest.mark.parametrize("score", [np.zeros(3), [[np.nan]], [[np.inf]]])
def test_bad_scores_are_refused(score):
    with pytest.raises(InputError, match="best_pairs needs"):
        best_pairs(np.array(score))
