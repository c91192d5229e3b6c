"""Assignment of three frames: gated triplets, dense scores with a certificate, and links in view of the next frame."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.tracking import assignment
from torchvision_dddas.tracking.assignment import choose_links, choose_triplets, plausible_links
from torchvision_dddas.tracking.dual_ascent import assign_triplets


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
    chosen = choose_triplets(columns, score)[0]
    assert_disjoint(columns[chosen])
    assert (score[chosen] > 0).all()
    assert score[chosen].sum() == pytest.approx(tried(columns.tolist(), score))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 25))
def test_trying_and_programming_find_the_same_sum(seed, targets):
    columns, score = crowd(seed, targets, 6)
    sums = []
    with pytest.MonkeyPatch.context() as patch:
        for most, steps in ((assignment._SEARCH_COLUMNS, assignment._SEARCH_STEPS), (200, 1), (0, 1)):
            patch.setattr(assignment, "_SEARCH_COLUMNS", most)
            patch.setattr(assignment, "_SEARCH_STEPS", steps)
            chosen = choose_triplets(columns, score)[0]
            assert_disjoint(columns[chosen])
            sums.append(score[chosen].sum())
    assert sums == pytest.approx([sums[0]] * 3)


def test_a_fractional_linear_programme_is_made_whole(monkeypatch):
    """Three pairs in a ring: half of each is worth 1.5, but only one of them can be had."""
    monkeypatch.setattr(assignment, "_SEARCH_COLUMNS", 0)
    ring = np.array([[0, 0, -1], [-1, 0, 0], [0, -1, 0]])
    assert len(choose_triplets(ring, np.ones(3))[0]) == 1
    assert choose_triplets(ring, np.array([1.0, 1.1, 1.0]))[0].tolist() == [1]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.randoms(use_true_random=False))
def test_the_order_of_the_columns_does_not_matter(seed, random):
    """Not even among equal sums: the same columns are chosen."""
    columns, score = crowd(seed, 12, 5)
    order = list(range(len(columns)))
    random.shuffle(order)
    first = columns[choose_triplets(columns, score)[0]]
    second = columns[order][choose_triplets(columns[order], score[order])[0]]
    assert sorted(first.tolist()) == sorted(second.tolist())


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
        choose_triplets(np.array(columns), np.array(score))


def chosen(links, onward=None, born=None, bridging=None, ahead=0):
    """The pairs, sorted. onward: {(track, detection): scores to the next look}; what is not given is worth nothing."""
    links = np.asarray(links, float)
    tracks, now = plausible_links(links)
    next_look = np.full((len(tracks), ahead), -9.0)
    for (i, j), score in (onward or {}).items():
        next_look[(tracks == i) & (now == j)] = score
    none = np.full((max(links.shape), ahead), -9.0)
    born = none[: links.shape[1]] if born is None else np.asarray(born, float)
    bridging = none[: links.shape[0]] if bridging is None else np.asarray(bridging, float)
    kept = choose_links(links[tracks, now], tracks, now, next_look, born, bridging)
    return sorted(zip(tracks[kept].tolist(), now[kept].tolist(), strict=True))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 5), st.integers(0, 5))
def test_without_a_next_look_they_are_the_best_pairs_of_two_looks(seed, tracks, detections):
    links = np.random.default_rng(seed).normal(0, 3, (tracks, detections))
    assert chosen(links) == sorted(map(tuple, best_pairs(links).tolist()))


def test_the_next_look_turns_a_near_tie():
    """Two tracks, two detections: crossed is a little better now, but leads nowhere."""
    links = [[2.0, 2.1], [2.1, 2.0]]
    straight = {(0, 0): [4.0, -9.0], (1, 1): [-9.0, 4.0]}
    assert chosen(links) == [(0, 1), (1, 0)]
    assert chosen(links, onward=straight, ahead=2) == [(0, 0), (1, 1)]


def test_a_birth_and_a_bridge_each_count():
    """A link of little worth is left only if both others together are worth more."""
    links, onward = [[3.0]], {(0, 0): [-5.0, -5.0]}
    bridge, birth = [[3.0, -5.0]], [[-5.0, 3.0]]
    assert chosen(links, onward=onward, bridging=bridge, ahead=2) == [(0, 0)]
    assert chosen(links, onward=onward, born=birth, ahead=2) == [(0, 0)]
    assert chosen(links, onward=onward, born=birth, bridging=bridge, ahead=2) == []


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


shapes = st.tuples(*[st.integers(1, 4)] * 3)


@settings(max_examples=120, deadline=None)
@given(shapes, st.data())
def test_exact_triplets_hold_each_target_once_and_score_the_most(shape, data):
    size = int(np.prod(shape))
    score = np.array(data.draw(st.lists(WHOLE, min_size=size, max_size=size)), float).reshape(shape)
    found = triplets_exact(score)
    assert_each_target_once(found, shape)
    assert score[tuple(found.T)].sum() == pytest.approx(best_triplets(score))


@settings(max_examples=60, deadline=None)
@given(shapes, st.integers(0, 10_000), st.sampled_from([0.0, 0.01, 0.5]))
def test_the_best_lies_between_value_and_bound(shape, seed, gap):
    score = tensor_of(seed, shape, -1.0, 1.0)
    solved = assign_triplets(score, gap=gap)
    best = best_triplets(score)
    assert_each_target_once(solved.triplets, shape)
    assert solved.value == pytest.approx(score[tuple(solved.triplets.T)].sum())
    assert solved.value <= best + 1e-9 and best <= solved.bound + 1e-9
    assert solved.gap <= gap + 1e-8
    assert solved.gap == pytest.approx((solved.bound - solved.value) / max(abs(solved.bound), 1e-9), abs=1e-12)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 1000), st.integers(8, 11))
def test_exact_triplets_agree_with_the_choice_among_all_columns(seed, targets):
    """Dummies at 0.6 beside whole assign_triplets below 1, as the source has them: trying all takes too long here."""
    score = tensor_of(seed, (targets + 1, targets, targets + 1)) ** 0.2
    score[0] = score[:, 0] = score[:, :, 0] = 0.6
    score[:, 0, 0] = score[0, :, 0] = score[0, 0, :] = 0.0
    columns = np.argwhere(score > 0)
    value = score[tuple(columns.T)]
    expected = value[choose_triplets(columns - 1, value)].sum()
    assert score[tuple(triplets_exact(score).T)].sum() == pytest.approx(expected)
    loose = assign_triplets(score, most_exact=0)
    assert loose.value - 1e-9 <= expected <= loose.bound + 1e-9 and not loose.exact


def test_a_gap_that_the_relaxation_cannot_close_is_closed_by_the_exact_solver():
    """Three targets that only pair up: half of each pair bounds it at 1.5, and one pair is all there is."""
    score = np.zeros((2, 2, 2))
    score[1, 1, 0] = score[1, 0, 1] = score[0, 1, 1] = 1.0
    open_, closed = assign_triplets(score, most_exact=0), assign_triplets(score)
    assert open_.value == 1.0 and open_.bound == pytest.approx(1.5) and not open_.exact
    assert closed.value == closed.bound == 1.0 and closed.exact


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
