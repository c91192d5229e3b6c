"""Disjoint columns: exact, whatever their order."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.tracking import triplets as columns_module
from torchvision_dddas.tracking.triplets import best_columns, least_loss


def tried(columns, score):
    """The largest sum, by trying every choice."""

    def best(c, used):
        if c == len(columns):
            return 0.0
        nodes = {(layer, node) for layer, node in enumerate(columns[c]) if node >= 0}
        without = best(c + 1, used)
        return without if nodes & used else max(without, score[c] + best(c + 1, used | nodes))

    return best(0, frozenset())


def crowd(seed, targets, per_target, nodes=None):
    """Columns among neighbours, as a gate leaves them, with scores that leave ties open."""
    random = np.random.default_rng(seed)
    near = random.integers(0, nodes or targets, (targets * per_target, 1)) + random.integers(-2, 3, (1, 3))
    columns = np.maximum(near + random.integers(-1, 2, near.shape), -1)
    columns = columns[(columns >= 0).any(axis=1)]
    return columns, random.normal(1, 2, len(columns)).round(1) * (columns >= 0).sum(axis=1)


def assert_disjoint(columns):
    for layer in columns.T:
        held = layer[layer >= 0]
        assert len(np.unique(held)) == len(held)


some_columns = st.lists(st.tuples(*[st.integers(-1, 3)] * 3).filter(lambda c: max(c) >= 0), max_size=10).map(
    lambda c: np.array(c, np.int64).reshape(-1, 3)
)


@settings(max_examples=150, deadline=None)
@given(some_columns, st.data())
def test_the_choice_is_disjoint_and_as_good_as_the_best_of_all(columns, data):
    score = np.array(data.draw(st.lists(st.integers(-3, 9), min_size=len(columns), max_size=len(columns))), float)
    chosen = best_columns(columns, score)
    assert_disjoint(columns[chosen])
    assert (score[chosen] > 0).all()
    assert score[chosen].sum() == pytest.approx(tried(columns.tolist(), score))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 25))
def test_trying_and_programming_find_the_same_sum(seed, targets):
    columns, score = crowd(seed, targets, 6)
    sums = []
    with pytest.MonkeyPatch.context() as patch:
        for limit in (columns_module.TRIED_COLUMNS, 0):
            patch.setattr(columns_module, "TRIED_COLUMNS", limit)
            chosen = best_columns(columns, score)
            assert_disjoint(columns[chosen])
            sums.append(score[chosen].sum())
    assert sums[0] == pytest.approx(sums[1])


def test_a_fractional_linear_programme_is_made_whole(monkeypatch):
    """Three pairs in a ring: half of each is worth 1.5, but only one of them can be had."""
    monkeypatch.setattr(columns_module, "TRIED_COLUMNS", 0)
    ring = np.array([[0, 0, -1], [-1, 0, 0], [0, -1, 0]])
    assert len(best_columns(ring, np.ones(3))) == 1
    assert best_columns(ring, np.array([1.0, 1.1, 1.0])).tolist() == [1]


def test_trying_stops_where_it_takes_too_long(monkeypatch):
    columns, score = crowd(3, 8, 12, nodes=4)
    expected = score[best_columns(columns, score)].sum()
    monkeypatch.setattr(columns_module, "TRIED_STEPS", 1)
    assert score[best_columns(columns, score)].sum() == pytest.approx(expected)


def test_a_search_says_when_nothing_loses_less_and_when_it_did_not_end():
    held, gain, price = [[0, 1], [1, 2]], [1.0, 1.2], [0.5, 0.7, 0.5]
    assert least_loss(held, gain, price, steps=100) == [1]
    assert least_loss(held, gain, price, steps=100, limit=0.5) == []
    assert least_loss(held, gain, price, steps=0) is None


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.randoms(use_true_random=False))
def test_the_order_of_the_columns_does_not_matter(seed, random):
    """Not even among equal sums: the same columns are chosen."""
    columns, score = crowd(seed, 12, 5)
    order = list(range(len(columns)))
    random.shuffle(order)
    first = columns[best_columns(columns, score)]
    second = columns[order][best_columns(columns[order], score[order])]
    assert sorted(first.tolist()) == sorted(second.tolist())


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_the_names_of_the_nodes_do_not_change_the_sum(seed):
    columns, score = crowd(seed, 12, 5)
    names = np.random.default_rng(seed).permutation(40)
    renamed = np.where(columns >= 0, names[columns], -1)
    assert score[best_columns(columns, score)].sum() == pytest.approx(score[best_columns(renamed, score)].sum())


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_the_unit_of_the_scores_does_not_change_the_choice(scale):
    columns, score = crowd(5, 20, 8)
    assert best_columns(columns, score).tolist() == best_columns(columns, score * scale).tolist()


def test_what_scores_nothing_or_is_forbidden_is_left():
    columns = np.array([[0, 0, 0], [1, 1, -1], [2, -1, -1], [3, 3, 3]])
    assert best_columns(columns, np.array([-1.0, 0.0, -np.inf, 2.0])).tolist() == [3]


def test_no_columns_and_one_column():
    assert best_columns(np.zeros((0, 3), np.int64), np.zeros(0)).shape == (0,)
    assert best_columns(np.array([[4, -1, 10**12]]), np.array([0.5])).tolist() == [0]


def test_of_two_equal_columns_the_first_is_taken_and_of_two_scores_the_higher():
    twice = np.array([[1, 2, 3], [1, 2, 3]])
    assert best_columns(twice, np.array([1.0, 1.0])).tolist() == [0]
    assert best_columns(twice, np.array([1.0, 2.0])).tolist() == [1]


@pytest.mark.parametrize(
    ("columns", "score", "message"),
    [
        ([[0, 0]], [1.0], "got \\(1, 2\\)"),
        ([[0, 0, 0]], [1.0, 2.0], "one score a column"),
        ([[0.0, 0.0, 0.0]], [1.0], "integer"),
        ([[0, -2, 0]], [1.0], "below -1"),
        ([[-1, -1, -1]], [1.0], "column of none"),
        ([[0, 0, 0]], [np.nan], "NaN"),
        ([[0, 0, 0]], [np.inf], "inf"),
    ],
)
def test_bad_input_is_named(columns, score, message):
    with pytest.raises(InputError, match=message):
        best_columns(np.array(columns), np.array(score))
