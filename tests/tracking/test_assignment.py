"""Assignment over gated triplets, and the choice of links in view of the next frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.tracking import assignment
from torchvision_dddas.tracking.assignment import choose_links, choose_triplets, plausible_links


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
        for limit in (assignment._SEARCH_COLUMNS, 0):
            patch.setattr(assignment, "_SEARCH_COLUMNS", limit)
            chosen = choose_triplets(columns, score)[0]
            assert_disjoint(columns[chosen])
            sums.append(score[chosen].sum())
    assert sums[0] == pytest.approx(sums[1])


def test_a_fractional_linear_programme_is_made_whole(monkeypatch):
    """Three pairs in a ring: half of each is worth 1.5, but only one of them can be had."""
    monkeypatch.setattr(assignment, "_SEARCH_COLUMNS", 0)
    ring = np.array([[0, 0, -1], [-1, 0, 0], [0, -1, 0]])
    assert len(choose_triplets(ring, np.ones(3))[0]) == 1
    assert choose_triplets(ring, np.array([1.0, 1.1, 1.0]))[0].tolist() == [1]


def test_trying_stops_where_it_takes_too_long(monkeypatch):
    columns, score = crowd(3, 8, 12, nodes=4)
    expected = score[choose_triplets(columns, score)[0]].sum()
    monkeypatch.setattr(assignment, "_SEARCH_STEPS", 1)
    assert score[choose_triplets(columns, score)[0]].sum() == pytest.approx(expected)


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


def test_what_scores_nothing_or_is_forbidden_is_left():
    columns = np.array([[0, 0, 0], [1, 1, -1], [2, -1, -1], [3, 3, 3]])
    assert choose_triplets(columns, np.array([-1.0, 0.0, -np.inf, 2.0]))[0].tolist() == [3]


def test_of_two_equal_columns_the_first_is_taken_and_of_two_scores_the_higher():
    twice = np.array([[1, 2, 3], [1, 2, 3]])
    assert choose_triplets(twice, np.array([1.0, 1.0]))[0].tolist() == [0]
    assert choose_triplets(twice, np.array([1.0, 2.0]))[0].tolist() == [1]


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


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 5), st.integers(1, 5))
def test_no_two_pairs_share_a_track_or_a_detection(seed, tracks, detections, ahead):
    random = np.random.default_rng(seed)
    links = random.normal(0, 3, (tracks, detections))
    i, j = plausible_links(links)
    onward, born = random.normal(0, 3, (len(i), ahead)), random.normal(0, 3, (detections, ahead))
    kept = choose_links(links[i, j], i, j, onward, born, random.normal(0, 3, (tracks, ahead)))
    assert kept.shape == i.shape and kept.dtype == bool
    assert len(np.unique(i[kept])) == len(np.unique(j[kept])) == kept.sum()


def test_the_next_look_can_speak_for_a_doubtful_link_but_not_for_an_absurd_one():
    assert chosen([[-0.5]], onward={(0, 0): [5.0]}, ahead=1) == [(0, 0)]
    assert chosen([[-20.0]], onward={(0, 0): [500.0]}, ahead=1) == []


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


def test_nobody_and_nothing():
    assert chosen(np.zeros((0, 0))) == []
    assert chosen(np.zeros((0, 0)), ahead=2) == []


def test_boxes_in_stacks_keep_to_those_of_their_own_place_in_the_order():
    """Equal scores all over: any whole matching is as good, and it must be found without trying them all."""
    for count in (2, 9, 20):
        assert len(chosen(np.full((count, count), 5.0), born=np.full((count, count), 4.0), ahead=count)) == count
