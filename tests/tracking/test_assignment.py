"""Assignment of three frames: gated triplets, dense scores with a bound, and links in view of the next frame."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.tracking import assignment
from torchvision_dddas.tracking.assignment import choose_links, choose_triplets, link_confidences, plausible_links
from torchvision_dddas.tracking.dual_ascent import assign_triplets


def best_sum(columns, score):
    """The largest sum of disjoint columns, by trial of every choice."""

    def best(c, used):
        if c == len(columns):
            return 0.0
        nodes = {(layer, node) for layer, node in enumerate(columns[c]) if node >= 0}
        without = best(c + 1, used)
        return without if nodes & used else max(without, score[c] + best(c + 1, used | nodes))

    return best(0, frozenset())


def crowd(seed, targets, per_target):
    """Columns among neighbours, as a gate leaves them, with scores that leave ties open."""
    random = np.random.default_rng(seed)
    near = random.integers(0, targets, (targets * per_target, 1)) + random.integers(-2, 3, (1, 3))
    columns = np.maximum(near + random.integers(-1, 2, near.shape), -1)
    columns = columns[(columns >= 0).any(axis=1)]
    return columns, random.normal(1, 2, len(columns)).round(1) * (columns >= 0).sum(axis=1)


def assert_disjoint(columns):
    for layer in columns.T:
        held = layer[layer >= 0]
        assert len(np.unique(held)) == len(held)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(*[st.integers(-1, 3)] * 3).filter(lambda c: max(c) >= 0), max_size=10), st.data())
def test_the_chosen_columns_are_disjoint_and_have_the_largest_sum(rows, data):
    columns = np.array(rows, np.int64).reshape(-1, 3)
    score = np.array(data.draw(st.lists(st.integers(-3, 9), min_size=len(columns), max_size=len(columns))), float)
    chosen = choose_triplets(columns, score)[0]
    assert_disjoint(columns[chosen])
    assert (score[chosen] > 0).all()
    assert score[chosen].sum() == pytest.approx(best_sum(rows, score))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 25))
def test_search_and_linear_programming_find_the_same_sum(seed, targets):
    columns, score = crowd(seed, targets, 6)
    wanted = score[choose_triplets(columns, score)[0]].sum()
    for most in (200, 0):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(assignment, "_SEARCH_COLUMNS", most)
            patch.setattr(assignment, "_SEARCH_STEPS", 1)
            chosen = choose_triplets(columns, score)[0]
        assert_disjoint(columns[chosen])
        assert score[chosen].sum() == pytest.approx(wanted)


def test_a_fractional_linear_program_is_made_whole(monkeypatch):
    """Three pairs in a ring: half of each is worth 1.5, but only one of them can be had."""
    monkeypatch.setattr(assignment, "_SEARCH_COLUMNS", 0)
    ring = np.array([[0, 0, -1], [-1, 0, 0], [0, -1, 0]])
    assert len(choose_triplets(ring, np.ones(3))[0]) == 1
    assert choose_triplets(ring, np.array([1.0, 1.1, 1.0]))[0].tolist() == [1]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_the_order_of_the_columns_does_not_matter_even_among_equal_sums(seed):
    columns, score = crowd(seed, 12, 5)
    order = np.random.default_rng(seed).permutation(len(columns))
    first = columns[choose_triplets(columns, score)[0]]
    second = columns[order][choose_triplets(columns[order], score[order])[0]]
    assert sorted(first.tolist()) == sorted(second.tolist())


@pytest.mark.parametrize(
    ("columns", "score", "message"),
    [
        ([[0, 0]], [1.0], "got \\(1, 2\\)"),
        ([[0, 0, 0]], [1.0, 2.0], "one score for each column"),
        ([[0.0, 0.0, 0.0]], [1.0], "integer"),
        ([[0, -2, 0]], [1.0], "below -1"),
        ([[-1, -1, -1]], [1.0], "column without a node"),
        ([[0, 0, 0]], [np.nan], "NaN"),
        ([[0, 0, 0]], [np.inf], "inf"),
    ],
)
def test_bad_columns_are_refused(columns, score, message):
    with pytest.raises(InputError, match=message):
        choose_triplets(np.array(columns), np.array(score))


def chosen(links, onward=None, born=None, bridging=None):
    """The pairs, sorted. onward: {(track, detection): scores of the next frame}; the default is worth nothing."""
    links = np.asarray(links, float)
    tracks, now = plausible_links(links)
    onward = onward or {}
    ahead = max((len(score) for score in onward.values()), default=0)
    none = np.full((max(links.shape), ahead), -9.0)
    next_frame = np.array([onward.get(pair, none[0]) for pair in zip(tracks, now, strict=True)], float)
    born = none[: links.shape[1]] if born is None else np.asarray(born, float)
    bridging = none[: links.shape[0]] if bridging is None else np.asarray(bridging, float)
    kept = choose_links(links[tracks, now], tracks, now, next_frame.reshape(len(tracks), ahead), born, bridging)
    return sorted(zip(tracks[kept].tolist(), now[kept].tolist(), strict=True))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 5), st.integers(1, 5))
def test_without_a_next_frame_the_links_are_the_best_pairs(seed, tracks, detections):
    links = np.random.default_rng(seed).normal(0, 3, (tracks, detections))
    assert chosen(links) == sorted(map(tuple, best_pairs(links).tolist()))


def test_links_of_a_crowd_take_little_room_beside_their_scores():
    count, random = 600, np.random.default_rng(0)
    near = np.arange(count)
    links = np.full((count, count), -np.inf)
    for away in (-1, 0, 1):
        links[near, (near + away) % count] = random.normal(3, 1, count)
    tracks, now = plausible_links(links)
    onward = links[now] + random.normal(0, 1, (len(now), 1))
    tracemalloc.start()
    kept = choose_links(links[tracks, now], tracks, now, onward, links, links)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert kept.sum() > 0.9 * count
    assert most < 2 * onward.nbytes  # no copy of all scores: twelve rounds over such copies took most of the time


@pytest.mark.parametrize("size", [(30, 40), (5, 4), (40, 7)])
def test_plausible_links_are_the_largest_of_their_row_or_column(size):
    score = np.random.default_rng(1).normal(0, 3, size).round(1)  # with ties
    tracks, now = plausible_links(score)
    rows, columns = size
    distinct = score - 1e-6 * ((np.arange(columns) - np.arange(rows)[:, None]) % columns)
    rank = [(-part).argsort(axis=axis).argsort(axis=axis) for axis, part in enumerate((distinct, distinct))]
    wanted = (score > -2) & ((rank[0] < 6) | (rank[1] < 6))
    assert list(zip(tracks.tolist(), now.tolist(), strict=True)) == list(map(tuple, np.argwhere(wanted).tolist()))


TIE, STRAIGHT = [[2.0, 2.1], [2.1, 2.0]], {(0, 0): [4.0, -9.0], (1, 1): [-9.0, 4.0]}
POOR, BRIDGE, BIRTH = {(0, 0): [-5.0, -5.0]}, [[3.0, -5.0]], [[-5.0, 3.0]]


@pytest.mark.parametrize(
    ("links", "more", "wanted"),
    [
        (TIE, {}, [(0, 1), (1, 0)]),  # a little better now
        (TIE, {"onward": STRAIGHT}, [(0, 0), (1, 1)]),
        ([[3.0]], {"onward": POOR, "bridging": BRIDGE}, [(0, 0)]),
        ([[3.0]], {"onward": POOR, "born": BIRTH}, [(0, 0)]),
        ([[3.0]], {"onward": POOR, "born": BIRTH, "bridging": BRIDGE}, []),  # only both together are worth more
    ],
)
def test_the_next_frame_decides_between_links_births_and_bridges(links, more, wanted):
    assert chosen(links, **more) == wanted


def window(seed):
    """The arguments of choose_links for up to five targets that walk on, come and go within one look's reach."""
    random = np.random.default_rng(seed)
    before = random.uniform(0, 3, (random.integers(1, 6), 2))
    velocity = random.normal(0, 0.5, before.shape)
    now = random.permutation(before + velocity + random.normal(0, 0.2, before.shape))[: random.integers(1, 6)]
    later = (before + 2 * velocity + random.normal(0, 0.2, before.shape))[: random.integers(1, 6)]

    def score(a, b, most):
        return most - 4 * ((a[:, None] - b) ** 2).sum(axis=2)

    links = score(before, now, 4)
    tracks, detections = plausible_links(links)
    onward = score(2 * now[detections] - before[tracks], later, 5)
    value = links[tracks, detections]
    return value, tracks, detections, onward, score(now, later, 3), score(before, later, 2)


def worth(kept, value, tracks, now, onward, born, bridging):
    """Scores of the links kept, and of the best pairs with the next frame that follow."""
    free_now, free_track = np.ones(len(born), bool), np.ones(len(bridging), bool)
    free_now[now[kept]] = free_track[tracks[kept]] = False
    further = assignment._NEXT_WEIGHT * np.concatenate([onward[kept], born[free_now], bridging[free_track]])
    return value[kept].sum() + further[tuple(best_pairs(further).T)].sum()


def test_links_are_worth_the_most_of_all_choices_in_nearly_all_windows():
    shares = []
    for seed in range(150):
        arguments = window(seed)
        _, tracks, now, *_ = arguments
        choices = [np.zeros(len(tracks), bool)]
        for link in range(len(tracks)):
            choices += [
                np.where(np.arange(len(tracks)) == link, True, kept)
                for kept in choices
                if not np.isin(tracks[link], tracks[kept]) and not np.isin(now[link], now[kept])
            ]
        best = max(worth(kept, *arguments) for kept in choices)
        shares.append(worth(choose_links(*arguments), *arguments) / best if best > 0 else 1.0)
    # The prices close no gap where targets only pair up across three frames.
    assert np.mean(np.array(shares) > 1 - 1e-6) >= 0.97 and np.min(shares) > 0.9


@pytest.mark.parametrize(
    ("score", "wanted"),
    [
        ([[9.0, -40], [-40, 9.0]], [1, 1]),  # far apart
        ([[9.0, 9], [9, 9]], [0.5, 0.5]),  # crossing: an exchange is as likely
        ([[9.0, 8], [-40, 9]], [1, 1]),  # the exchange as a whole is unlikely
        ([[0.0, -40], [-40, 9]], [0.5, 1]),  # no link is as likely
        ([[9.0, -40, 9], [-40, 9, -40]], [0.5, 1]),  # a free detection is as likely
        ([[9.0, -40], [-40, 9], [-40, 9]], [1, 0.5]),  # a free track is as likely
    ],
)
def test_a_link_is_as_sure_as_it_is_likelier_than_its_alternatives(score, wanted):
    np.testing.assert_allclose(link_confidences(np.array(score), np.arange(2), np.arange(2)), wanted, atol=1e-3)
    assert link_confidences(np.zeros((2, 0)), np.zeros(0, int), np.zeros(0, int)).shape == (0,)


def assert_each_target_once(found, shape):
    for axis, size in enumerate(shape):
        assert sorted(found[found[:, axis] > 0, axis]) == list(range(1, size))
    assert (found > 0).any(axis=1).all()


@settings(max_examples=120, deadline=None)
@given(st.tuples(*[st.integers(1, 7)] * 3), st.integers(0, 10_000), st.sampled_from([0.0, 0.01, 0.5]), st.booleans())
def test_the_best_sum_with_each_target_once_lies_between_value_and_bound(shape, seed, gap, whole):
    score = np.random.default_rng(seed).uniform(-1.0, 1.0, shape)
    score = (9 * score).round() if whole else score
    columns = np.argwhere(np.ones(shape))[1:]
    large = 100.0 * (columns > 0).sum(axis=1)  # so that the choice takes every target
    picked = columns[choose_triplets(columns - 1, score[tuple(columns.T)] + large)[0]]
    assert_each_target_once(picked, shape)
    best = score[tuple(picked.T)].sum()
    solved = assign_triplets(score, gap=gap)
    assert_each_target_once(solved.triplets, shape)
    assert solved.value == pytest.approx(score[tuple(solved.triplets.T)].sum())
    assert solved.value <= best + 1e-9 and best <= solved.bound + 1e-9
    assert solved.gap <= gap + 1e-8
    assert solved.gap == pytest.approx((solved.bound - solved.value) / max(abs(solved.bound), 1e-9), abs=1e-12)
    assert assign_triplets(score, gap=0.0, most_exact=None).value == pytest.approx(best)
    assert assign_triplets(score, most_exact=0).bound >= best - 1e-9


def test_a_gap_that_the_relaxation_cannot_close_is_closed_by_the_exact_solver():
    """Three targets that only pair up: half of each pair bounds it at 1.5, and one pair is all there is."""
    score = np.zeros((2, 2, 2))
    score[1, 1, 0] = score[1, 0, 1] = score[0, 1, 1] = 1.0
    open_, closed = assign_triplets(score, most_exact=0), assign_triplets(score)
    assert open_.value == 1.0 and open_.bound == pytest.approx(1.5) and not open_.exact
    assert closed.value == closed.bound == 1.0 and closed.exact


@pytest.mark.parametrize("most_exact", [None, 12])
@pytest.mark.parametrize("worth", [np.nan, np.inf, 1e9])
def test_the_score_of_the_triplet_of_dummies_is_not_read(most_exact, worth):
    score = np.ones((2, 2, 2))
    score[0, 0, 0] = worth
    assert_each_target_once(assign_triplets(score, most_exact=most_exact).triplets, score.shape)


@pytest.mark.parametrize("shape", [(2, 2), (0, 2, 2), (2, 2, 2)])
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_triplets_refuse_bad_input(shape, value):
    with pytest.raises(InputError, match="triplets need"):
        assign_triplets(np.full(shape, value))
