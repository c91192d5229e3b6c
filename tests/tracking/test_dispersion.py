"""Clusters of targets, their entropy, and the weight that follows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.config import PaperParameters
from torchvision_dddas.tracking.dispersion import (
    clusters,
    dispersion,
    location_weight,
    normalized_entropy,
    of_window,
)


def never() -> float:
    raise AssertionError("appearance was computed")


def test_average_linkage_by_hand():
    # 0 and 1 join at 0.1; their mean distance to 2 is (0.3 + 0.5) / 2 = 0.4
    apart = np.array([[0, 0.1, 0.3], [0.1, 0, 0.5], [0.3, 0.5, 0]])
    assert len(set(clusters(apart, 0.05))) == 3
    assert len(set(clusters(apart, 0.39))) == 2
    assert len(set(clusters(apart, 0.41))) == 1


@pytest.mark.parametrize(
    ("cluster", "wanted"),
    [
        ([1, 2, 3, 4], 1.0),
        ([1, 1, 1, 1], 0.0),
        ([1, 1, 2, 2], 0.5),
        ([1, 1, 1, 2], (0.75 * np.log2(4 / 3) + 0.25 * 2) / 2),
        ([1], 1.0),
        ([], 1.0),
    ],
)
def test_normalized_entropy_by_hand(cluster, wanted):
    assert normalized_entropy(np.array(cluster, int)) == pytest.approx(wanted)


def test_targets_side_by_side_are_less_dispersed_than_scattered_ones():
    close = np.array([[100, 100], [104, 100], [400, 300], [404, 300]], float)
    scattered = np.array([[20, 30], [100, 100], [400, 300], [700, 500]], float)
    assert dispersion(close, 0.25) == 0.5
    assert dispersion(scattered, 0.25) == pytest.approx(1.0)


def test_what_is_told_apart_depends_on_the_distance_from_the_corner():
    """A defect of the source: the same two targets, 100 px apart, are two near the corner and one far from it."""
    near = np.array([[100, 100], [200, 100]], float)
    assert dispersion(near, 0.25) == 1.0
    assert dispersion(near + np.array([300, 200]), 0.25) == 0.0


@given(st.lists(st.tuples(st.floats(0, 700), st.floats(0, 500)), max_size=9), st.floats(0, 1))
@settings(max_examples=60, deadline=None)
def test_dispersion_lies_between_0_and_1(points, cut):
    assert 0 <= dispersion(np.array(points, float).reshape(-1, 2), cut) <= 1 + 1e-12


@given(st.integers(0, 1000), st.integers(2, 12), st.floats(0.05, 0.5))
@settings(max_examples=40, deadline=None)
def test_dispersion_does_not_depend_on_the_order_of_targets(seed, count, cut):
    random = np.random.default_rng(seed)
    feature = random.random((count, 2)) * 500
    assert dispersion(feature[random.permutation(count)], cut) == pytest.approx(dispersion(feature, cut))


@pytest.mark.parametrize(
    ("location", "appearance", "weight"), [(0.9, None, 1.0), (0.65, 0.9, 0.0), (0.3, 0.65, 0.5), (0.0, 0.0, 0.5)]
)
def test_the_weight_rule(location, appearance, weight):
    assert location_weight(location, never if appearance is None else lambda: appearance, 0.65) == (weight, appearance)


def test_each_reading_of_the_window_is_its_own():
    values, same, differ = [0.9, 0.4], [3, 3], [3, 4]
    for reading, wanted in (
        ("smallest", (0.4, 0.4)),
        ("newest", (0.9, 0.9)),
        ("smallest_if_counts_differ", (0.9, 0.4)),
    ):
        parameters = PaperParameters.model_validate({"dispersion_of": reading})
        assert (of_window(values, same, parameters), of_window(values, differ, parameters)) == wanted
