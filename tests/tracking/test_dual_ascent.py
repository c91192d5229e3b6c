"""Three-frame assignment of dense scores: exact, and certified where it is not."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.tracking.assignment import choose_triplets
from torchvision_dddas.tracking.dual_ascent import assign_triplets

WHOLE = st.integers(-4, 9)


def triplets_exact(score):
    return assign_triplets(score, gap=0.0, most_exact=None).triplets


def tensor_of(seed, shape, low=0.0, high=1.0):
    return np.random.default_rng(seed).uniform(low, high, shape)


def best_triplets(score):
    """The largest sum with every real target once, by trying all."""

    def best(left):
        if not any(left):
            return 0.0
        # The first target that is left, with any of the others or none.
        layer = next(axis for axis in range(3) if left[axis])
        choices = [(0, *sorted(rest)) for rest in left]
        choices[layer] = (min(left[layer]),)
        return max(
            score[held] + best(tuple(rest - {node} for rest, node in zip(left, held, strict=True)))
            for held in itertools.product(*choices)
        )

    return best(tuple(frozenset(range(1, size)) for size in score.shape))


def assert_each_target_once(found, shape):
    for axis, size in enumerate(shape):
        assert sorted(found[found[:, axis] > 0, axis]) == list(range(1, size))
    assert (found > 0).any(axis=1).all()


def total(score, found):
    return score[tuple(found.T)].sum()


shapes = st.tuples(*[st.integers(1, 4)] * 3)


@settings(max_examples=120, deadline=None)
@given(shapes, st.data())
def test_exact_triplets_hold_each_target_once_and_score_the_most(shape, data):
    size = int(np.prod(shape))
    score = np.array(data.draw(st.lists(WHOLE, min_size=size, max_size=size)), float).reshape(shape)
    found = triplets_exact(score)
    assert_each_target_once(found, shape)
    assert total(score, found) == pytest.approx(best_triplets(score))


@settings(max_examples=60, deadline=None)
@given(shapes, st.integers(0, 10_000), st.sampled_from([0.0, 0.01, 0.5]))
def test_the_best_lies_between_value_and_bound(shape, seed, gap):
    score = tensor_of(seed, shape, -1.0, 1.0)
    solved = assign_triplets(score, gap=gap, steps=3)
    best = best_triplets(score)
    assert_each_target_once(solved.triplets, shape)
    assert solved.value == pytest.approx(total(score, solved.triplets))
    assert solved.value <= best + 1e-9 and best <= solved.bound + 1e-9
    assert solved.gap <= gap + 1e-8
    assert solved.gap == pytest.approx((solved.bound - solved.value) / max(abs(solved.bound), 1e-9), abs=1e-12)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 1000), st.integers(8, 14))
def test_exact_triplets_agree_with_the_choice_among_all_columns(seed, targets):
    """Dummies at 0.6 beside whole assign_triplets below 1, as the source has them: trying all takes too long here."""
    score = tensor_of(seed, (targets + 1, targets, targets + 1)) ** 0.2
    score[0] = score[:, 0] = score[:, :, 0] = 0.6
    score[:, 0, 0] = score[0, :, 0] = score[0, 0, :] = 0.0
    columns = np.argwhere(score > 0)
    value = score[tuple(columns.T)]
    expected = value[choose_triplets(columns - 1, value)].sum()
    assert total(score, triplets_exact(score)) == pytest.approx(expected)
    loose = assign_triplets(score, most_exact=0)
    assert loose.value - 1e-9 <= expected <= loose.bound + 1e-9 and not loose.exact


def test_the_gap_is_kept_and_certified_without_the_exact_solver():
    score = tensor_of(3, (41, 41, 41))
    solved = assign_triplets(score, gap=0.02, most_exact=0)
    assert solved.gap <= 0.02 and not solved.exact
    assert_each_target_once(solved.triplets, score.shape)


def test_a_gap_that_the_relaxation_cannot_close_is_closed_by_the_exact_solver():
    """Three targets that only pair up: half of each pair bounds it at 1.5, and one pair is all there is."""
    score = np.zeros((2, 2, 2))
    score[1, 1, 0] = score[1, 0, 1] = score[0, 1, 1] = 1.0
    open_, closed = assign_triplets(score, most_exact=0), assign_triplets(score)
    assert open_.value == 1.0 and open_.bound == pytest.approx(1.5) and not open_.exact
    assert closed.value == closed.bound == 1.0 and closed.exact


def test_the_order_of_the_targets_does_not_change_the_value():
    score = tensor_of(1, (9, 8, 9), -0.2, 1.0)
    random = np.random.default_rng(2)
    orders = [np.concatenate([[0], 1 + random.permutation(size - 1)]) for size in score.shape]
    shuffled = score[np.ix_(*orders)]
    assert total(score, triplets_exact(score)) == pytest.approx(total(shuffled, triplets_exact(shuffled)))
    first, second = assign_triplets(score, gap=0.05), assign_triplets(shuffled, gap=0.05)
    assert first.value <= second.bound + 1e-9 and second.value <= first.bound + 1e-9


def test_the_scores_are_left_as_they_are():
    score = tensor_of(4, (6, 6, 6))
    before = score.copy()
    assign_triplets(score)
    triplets_exact(score)
    assert (score == before).all()


@pytest.mark.parametrize("solve", [triplets_exact, lambda score: assign_triplets(score).triplets])
def test_where_no_triplet_is_worth_it_all_stay_alone(solve):
    score = np.full((3, 2, 2), -1.0)
    score[:, 0, 0] = score[0, :, 0] = score[0, 0, :] = 0.0
    assert solve(score).tolist() == [[0, 0, 1], [0, 1, 0], [1, 0, 0], [2, 0, 0]]


@pytest.mark.parametrize("solve", [triplets_exact, lambda score: assign_triplets(score).triplets])
def test_empty_layers_and_one_target(solve):
    assert solve(np.zeros((1, 1, 1))).shape == (0, 3)
    assert solve(np.ones((2, 1, 1))).tolist() == [[1, 0, 0]]
    pair = np.zeros((1, 2, 3))
    pair[0, 1, 2] = 1.0
    assert solve(pair).tolist() == [[0, 0, 1], [0, 1, 2]]
    assert solve(np.pad(np.ones((1, 1, 1)), ((1, 0),) * 3)).tolist() == [[1, 1, 1]]


@pytest.mark.parametrize("solve", [triplets_exact, assign_triplets])
@pytest.mark.parametrize("worth", [np.nan, np.inf, 1e9])
def test_the_triplet_of_dummies_is_never_used(solve, worth):
    """Its score is not even read."""
    score = np.ones((2, 2, 2))
    score[0, 0, 0] = worth
    found = solve(score)
    assert_each_target_once(found if solve is triplets_exact else found.triplets, score.shape)


@pytest.mark.parametrize("solve", [triplets_exact, assign_triplets])
@pytest.mark.parametrize("score", [np.zeros((2, 2)), np.zeros((0, 2, 2)), np.full((2, 2, 2), np.nan), -np.inf])
def test_triplets_name_bad_input(solve, score):
    score = score if isinstance(score, np.ndarray) else np.where(np.arange(8).reshape(2, 2, 2) == 7, score, 0.0)
    with pytest.raises(InputError, match="triplets need"):
        solve(score)
