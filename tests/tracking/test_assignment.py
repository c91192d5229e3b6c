"""Two- and three-frame assignment: exact, and certified where it is not."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.tracking import lagrangian as relaxation
from torchvision_dddas.tracking.assignment import triplets_exact
from torchvision_dddas.tracking.dual_prices import best_over, bound, cheap, low_prices, settle, shared_prices
from torchvision_dddas.tracking.lagrangian import triplets
from torchvision_dddas.tracking.triplets import best_columns

WHOLE = st.integers(-4, 9)


def tensor_of(seed, shape, low=0.0, high=1.0):
    return np.random.default_rng(seed).uniform(low, high, shape)


def best_by_trying(score):
    """The largest sum of scores of one-to-one pairs, by trying all."""
    rows, columns = score.shape
    padded = np.hstack([score, np.zeros((rows, rows))])
    return max(
        sum(padded[i, c] for i, c in enumerate(to)) for to in itertools.permutations(range(columns + rows), rows)
    )


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


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 3), st.integers(0, 3), st.data())
def test_pairs_are_one_to_one_and_score_the_most(rows, columns, data):
    entry = WHOLE | st.just(-np.inf)
    score = np.array(data.draw(st.lists(entry, min_size=rows * columns, max_size=rows * columns)), float)
    score = score.reshape(rows, columns)
    found = best_pairs(score)
    assert found.shape == (len(found), 2) and found.dtype == np.int64
    assert len(set(found[:, 0])) == len(set(found[:, 1])) == len(found)
    assert (score[tuple(found.T)] > 0).all()
    assert score[tuple(found.T)].sum() == best_by_trying(score)


def test_pairs_must_score_more_than_the_least():
    assert best_pairs(np.array([[2.0, 0.0], [0.0, 5.0]]), least=2.0).tolist() == [[1, 1]]


def test_pairs_below_zero_are_never_worth_it():
    assert best_pairs(np.array([[-1.0]]), least=-2.0).shape == (0, 2)


def test_a_row_of_forbidden_pairs_stays_alone():
    score = np.array([[-np.inf, -np.inf], [1.0, 3.0], [-np.inf, 2.5]])
    assert best_pairs(score).tolist() == [[1, 0], [2, 1]]


@pytest.mark.parametrize("score", [np.zeros(3), [[np.nan]], [[np.inf]]])
def test_pairs_name_bad_input(score):
    with pytest.raises(InputError, match="pairs needs"):
        best_pairs(np.array(score))


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
    solved = triplets(score, gap=gap, steps=3)
    best = best_triplets(score)
    assert_each_target_once(solved.triplets, shape)
    assert solved.value == pytest.approx(total(score, solved.triplets))
    assert solved.value <= best + 1e-9 and best <= solved.bound + 1e-9
    assert solved.gap <= gap + 1e-8
    assert solved.gap == pytest.approx((solved.bound - solved.value) / max(abs(solved.bound), 1e-9), abs=1e-12)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 1000), st.integers(8, 14))
def test_exact_triplets_agree_with_the_choice_among_all_columns(seed, targets):
    """Dummies at 0.6 beside whole triplets below 1, as the source has them: trying all takes too long here."""
    score = tensor_of(seed, (targets + 1, targets, targets + 1)) ** 0.2
    score[0] = score[:, 0] = score[:, :, 0] = 0.6
    score[:, 0, 0] = score[0, :, 0] = score[0, 0, :] = 0.0
    columns = np.argwhere(score > 0)
    value = score[tuple(columns.T)]
    expected = value[best_columns(columns - 1, value)].sum()
    assert total(score, triplets_exact(score)) == pytest.approx(expected)
    loose = triplets(score, most_exact=0)
    assert loose.value - 1e-9 <= expected <= loose.bound + 1e-9 and not loose.exact


def test_the_gap_is_kept_and_certified_without_the_exact_solver():
    score = tensor_of(3, (41, 41, 41))
    solved = triplets(score, gap=0.02, most_exact=0)
    assert solved.gap <= 0.02 and not solved.exact
    assert_each_target_once(solved.triplets, score.shape)


def test_a_gap_that_the_relaxation_cannot_close_is_closed_by_the_exact_solver():
    """Three targets that only pair up: half of each pair bounds it at 1.5, and one pair is all there is."""
    score = np.zeros((2, 2, 2))
    score[1, 1, 0] = score[1, 0, 1] = score[0, 1, 1] = 1.0
    open_, closed = triplets(score, most_exact=0), triplets(score)
    assert open_.value == 1.0 and open_.bound == pytest.approx(1.5) and not open_.exact
    assert closed.value == closed.bound == 1.0 and closed.exact


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_searching_by_the_prices_and_branching_find_the_same_value(seed):
    score = tensor_of(seed, (8, 8, 8)) ** 0.3
    with pytest.MonkeyPatch.context() as patch:
        searched = triplets(score, gap=0.0)
        patch.setattr(relaxation, "SEARCHED", 0)
        branched = triplets(score, gap=0.0)
    assert searched.value == pytest.approx(branched.value)


def test_an_exact_solver_that_gives_up_leaves_the_gap_certified(monkeypatch):
    score = np.zeros((2, 2, 2))
    score[1, 1, 0] = score[1, 0, 1] = score[0, 1, 1] = 1.0
    monkeypatch.setattr(relaxation, "SEARCHED", 0)
    monkeypatch.setattr(relaxation, "good_columns", lambda nodes, worth, branches: (np.zeros(0, np.int64), False))
    solved = triplets(score)
    assert solved.value == 1.0 and solved.bound == pytest.approx(1.5) and not solved.exact


def test_the_order_of_the_targets_does_not_change_the_value():
    score = tensor_of(1, (9, 8, 9), -0.2, 1.0)
    random = np.random.default_rng(2)
    orders = [np.concatenate([[0], 1 + random.permutation(size - 1)]) for size in score.shape]
    shuffled = score[np.ix_(*orders)]
    assert total(score, triplets_exact(score)) == pytest.approx(total(shuffled, triplets_exact(shuffled)))
    first, second = triplets(score, gap=0.05), triplets(shuffled, gap=0.05)
    assert first.value <= second.bound + 1e-9 and second.value <= first.bound + 1e-9


def test_the_same_scores_give_the_same_triplets():
    score = tensor_of(4, (31, 31, 31))
    assert triplets(score).triplets.tolist() == triplets(score.copy()).triplets.tolist()


def test_the_scores_are_left_as_they_are():
    score = tensor_of(4, (6, 6, 6))
    before = score.copy()
    triplets(score)
    triplets_exact(score)
    assert (score == before).all()


@pytest.mark.parametrize("solve", [triplets_exact, lambda score: triplets(score).triplets])
def test_where_no_triplet_is_worth_it_all_stay_alone(solve):
    score = np.full((3, 2, 2), -1.0)
    score[:, 0, 0] = score[0, :, 0] = score[0, 0, :] = 0.0
    assert solve(score).tolist() == [[0, 0, 1], [0, 1, 0], [1, 0, 0], [2, 0, 0]]


@pytest.mark.parametrize("solve", [triplets_exact, lambda score: triplets(score).triplets])
def test_empty_layers_and_one_target(solve):
    assert solve(np.zeros((1, 1, 1))).shape == (0, 3)
    assert solve(np.ones((2, 1, 1))).tolist() == [[1, 0, 0]]
    pair = np.zeros((1, 2, 3))
    pair[0, 1, 2] = 1.0
    assert solve(pair).tolist() == [[0, 0, 1], [0, 1, 2]]
    assert solve(np.pad(np.ones((1, 1, 1)), ((1, 0),) * 3)).tolist() == [[1, 1, 1]]


@pytest.mark.parametrize("solve", [triplets_exact, triplets])
@pytest.mark.parametrize("worth", [np.nan, np.inf, 1e9])
def test_the_triplet_of_dummies_is_never_used(solve, worth):
    """Its score is not even read."""
    score = np.ones((2, 2, 2))
    score[0, 0, 0] = worth
    found = solve(score)
    assert_each_target_once(found if solve is triplets_exact else found.triplets, score.shape)


@pytest.mark.parametrize("solve", [triplets_exact, triplets])
@pytest.mark.parametrize("score", [np.zeros((2, 2)), np.zeros((0, 2, 2)), np.full((2, 2, 2), np.nan), -np.inf])
def test_triplets_name_bad_input(solve, score):
    score = score if isinstance(score, np.ndarray) else np.where(np.arange(8).reshape(2, 2, 2) == 7, score, 0.0)
    with pytest.raises(InputError, match="triplets need"):
        solve(score)


@settings(max_examples=40, deadline=None)
@given(shapes, st.integers(0, 10_000))
def test_prices_pay_for_every_triplet(shape, seed):
    gain = tensor_of(seed, shape, -1.0, 1.0)
    gain[:, 0, 0] = gain[0, :, 0] = gain[0, 0, :] = 0.0
    settled, _ = settle(best_over(gain, shared_prices(gain)[1], 1), shared_prices(gain), 1)
    for prices in (shared_prices(gain), low_prices(gain), settled):
        assert all(price[0] == 0.0 and (price >= -1e-12).all() for price in prices)
        loss = prices[0][:, None, None] + prices[1][:, None] + prices[2] - gain
        assert loss.min() >= -1e-9
        index, lost = cheap(gain, prices, 0.3)
        assert index.tolist() == np.flatnonzero(loss.ravel() <= 0.3).tolist()
        assert lost == pytest.approx(loss.ravel()[index])
    assert bound(low_prices(gain)) <= bound(shared_prices(gain)) + 1e-12


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 2))
def test_settling_two_layers_gives_the_least_prices_that_the_third_allows(seed, layer):
    """Their sum is what the best two-frame assignment of the other layers gains."""
    gain = tensor_of(seed, (4, 5, 4), -0.5, 1.0)
    gain[:, 0, 0] = gain[0, :, 0] = gain[0, 0, :] = 0.0
    price = shared_prices(gain)[layer] * 0.5
    best = best_over(gain, price, layer)
    expected = np.maximum(np.moveaxis(gain, layer, 0) - price[:, None, None], -np.inf).max(axis=0)
    assert best == pytest.approx(expected)
    settled, found = settle(best, shared_prices(gain), layer)
    alone_first, alone_second = np.maximum(best[1:, 0], 0).sum(), np.maximum(best[0, 1:], 0).sum()
    over = best[tuple(found.T)] - np.maximum(best[found[:, 0], 0], 0) - np.maximum(best[0, found[:, 1]], 0)
    others = [settled[axis] for axis in range(3) if axis != layer]
    assert bound(others) == pytest.approx(alone_first + alone_second + over.sum())
